"""The subcommand `weigh`: options to records, calls, and print."""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from finforce_eval.calibration.weighing import (
    LEAST_HOLD,
    SHORT_HOLD,
    find_holds,
    format_weighing,
    list_holds,
    scale_calibration,
    weigh,
)
from finforce_eval.cli.parser import BAG_HELP, FORCE_HELP, CommandResult, add_run_options
from finforce_eval.errors import OptionError
from finforce_eval.evaluation.forces import ImageRun, estimate_shown
from finforce_eval.evaluation.setup import make_setup, print_notes, read_keypoints
from finforce_ifea.jaw.calibration import save_calibration


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the subcommand."""
    parser.add_argument("bags", nargs=1, metavar="BAG", help=BAG_HELP)
    add_run_options(parser)
    parser.add_argument("--side", default="left", choices=("left", "right"), help="jaw on the scale (left)")
    text = "reading of the scale [g] at the end of each hold, in order; without readings, the holds are listed"
    parser.add_argument("--grams", nargs="+", type=grams, metavar="G", help=text)
    parser.add_argument("-o", "--output", metavar="FILE", help="calibration file to write; needs --grams")
    parser.add_argument("--force", action="store_true", help=FORCE_HELP)


def grams(text: str) -> list[float]:
    """Return the readings [g] of a word such as 160 or 160,238,320."""
    return [float(part) for part in text.split(",") if part]


def run(options: argparse.Namespace) -> CommandResult:
    """Find the holds of a recording, and scale the stiffness by the readings of a scale."""
    readings = [reading for word in options.grams or () for reading in word]
    if options.output and not readings:
        raise OptionError("-o needs --grams: the readings of the scale, one for each hold")
    setup = make_setup(options).side(options.side)
    options.jaws = options.side
    (recording,) = read_keypoints(options)
    stamps = recording.jaw(options.side).keypoints.stamps
    forces = estimate_shown(recording, setup, [options.side], ImageRun(strict=True))[options.side]
    pressed = stamps - stamps[0], np.abs(forces.force[:, 0])
    holds = find_holds(*pressed)
    short = [hold for hold in find_holds(*pressed, SHORT_HOLD) if hold.end - hold.start < LEAST_HOLD]
    if short:
        print_notes(recording.name, [f"too short to count, under {LEAST_HOLD} s: {list_holds(short)}"])
    if not readings:
        for number, hold in enumerate(holds, 1):
            print(f"hold {number}: {hold.start:.1f} to {hold.end:.1f} s, estimated {hold.force:.3f} N")
        print(f"{len(holds)} holds; give their readings with --grams")
        return CommandResult({"holds": [vars(hold) for hold in holds]})
    weighing = weigh(holds, readings, recording.name)
    print(format_weighing(weighing))
    scaled = scale_calibration(
        weighing, setup.jaw, setup.calibration, solver=setup.settings.solver, force=options.force
    )
    if options.output:
        Path(options.output).parent.mkdir(parents=True, exist_ok=True)
        save_calibration(scaled, options.output)
        print(f"Calibration: {options.output}")
    holds = [{**vars(hold), "scale": weight} for hold, weight in zip(holds, weighing.weights.tolist(), strict=True)]
    found = {"factor": weighing.factor, "factor_stddev": weighing.stddev, "misfit": weighing.misfit, "holds": holds}
    return CommandResult({**found, "calibration": scaled.model_dump(mode="json")})
