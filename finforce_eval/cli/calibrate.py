"""`finforce calibrate`: the material of a finger from recordings with ground truth."""

from __future__ import annotations

import argparse
from pathlib import Path

from finforce_eval.cli.parser import BAG_HELP, FORCE_HELP, CommandResult, add_run_options
from finforce_eval.evaluation.forces import truth_sides
from finforce_eval.evaluation.setup import make_setup, read_keypoints
from finforce_ifea.jaw.calibration import name_mechanics, save_calibration


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the subcommand."""
    parser.add_argument("bags", nargs="+", metavar="BAG", help=BAG_HELP)
    add_run_options(parser, calibration=False)
    parser.add_argument("-o", "--output", required=True, metavar="FILE", help="calibration file to write")
    parser.add_argument("--force", action="store_true", help=f"{FORCE_HELP}; or forces that do not fit")


def run(options: argparse.Namespace) -> CommandResult:
    """Identify the material and write the calibration."""
    from finforce_eval.calibration.calibrate import calibrate, calibration_case, format_fit

    options.calibration = None
    setup = make_setup(options)
    recordings = read_keypoints(options)
    is_left = all("left" in truth_sides(recording) for recording in recordings)
    setup = setup.side("left" if is_left else "right")
    jaw, contacts = setup.jaw, setup.contacts
    cases = [calibration_case(recording, jaw, contacts, setup.density) for recording in recordings]
    Path(options.output).parent.mkdir(parents=True, exist_ok=True)
    fit = calibrate(cases, jaw, setup.settings)
    print(format_fit(fit, cases))
    if not options.force:
        fit.calibration.check_plausible(jaw)
    solver = name_mechanics(jaw, setup.settings.solver)
    found = fit.calibration.changed(solver=solver, uncertainty=fit.uncertainty)
    save_calibration(found, options.output)
    print(f"Calibration: {options.output}")
    left = {"force_rms_N": fit.force_rms, "shape_rms_mm": 1e3 * fit.shape_rms, "plateaus": fit.plateaus}
    return CommandResult({**left, "calibration": found.model_dump(mode="json")})
