"""Recordings with ground truth into calibration cases; the fitting itself is done in finforce_ifea."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from finforce_eval.errors import RecordingError
from finforce_eval.evaluation.contact_source import ContactChoice, first_touch
from finforce_eval.evaluation.forces import check_keypoint_count
from finforce_eval.evaluation.scoring import match_truth
from finforce_eval.recordings.objects import read_friction
from finforce_eval.recordings.tracks import Recording
from finforce_ifea.identification import CalibrationCase, CalibrationFit, fit_calibration
from finforce_ifea.jaw.jaw import Jaw
from finforce_ifea.settings import EstimatorSettings

# unit and factor in which each number is printed
UNITS = {
    "young_modulus": ("MPa", 1e-6),
    "clamped_z": ("mm", 1e3),
    "time_constant_1": ("s", 1.0),
    "time_constant_2": ("s", 1.0),
}


def calibration_case(
    recording: Recording, jaw: Jaw, contacts: ContactChoice, density: str = "default"
) -> CalibrationCase:
    """Return the observations and true forces of one jaw of a recording.

    Args:
        recording: a recording with ground truth.
        jaw: the jaw of that side.
        contacts: where the contact comes from.
        density: mesh density of the surface that the solver returns.

    Raises:
        RecordingError: no ground truth, none at the time of an image, or another number of key points than the jaw's.
        FinforceError: no contact height, no object mesh or poses.
    """
    side = jaw.side
    track, truth = recording.jaw(side).keypoints, recording.truth(side)
    check_keypoint_count(recording, side, jaw)
    forces = match_truth(truth, track.stamps_ns)
    known = np.isfinite(forces).all(axis=1)
    if not known.any():
        raise RecordingError(f"{recording.name}: no true force at the time of an image: do both have one clock?")
    observations = [track.observation(index) for index in range(len(track.stamps_ns))]
    return CalibrationCase(
        name=recording.name,
        observations=observations,
        contact=first_touch(contacts, recording, jaw, density),
        stamps_true=track.stamps_ns[known] * 1e-9,
        forces_true=forces[known],
        friction=read_friction(recording),
    )


def calibrate(cases: Sequence[CalibrationCase], jaw: Jaw, settings: EstimatorSettings) -> CalibrationFit:
    """Fit the finger to the cases, showing the falling cost.

    Raises:
        FinforceError: the cases say nothing about the finger.
    """
    from tqdm import tqdm

    with tqdm(unit="evaluation", desc="fitting", disable=None, leave=False) as bar:

        def show(cost: float) -> None:
            bar.set_postfix(cost=f"{cost:.5g}", refresh=False)
            bar.update()

        return fit_calibration(jaw, cases, settings, show)


def fitted_values(fit: CalibrationFit) -> dict[str, float]:
    """Return what was identified under the names of its uncertainties, in SI units."""
    values = dict(fit.calibration)
    for number, term in enumerate(fit.calibration.relaxation, 1):
        values[f"share_{number}"] = term.share
        values[f"time_constant_{number}"] = term.time_constant
    return {name: values[name] for name in fit.uncertainty}


def format_fit(fit: CalibrationFit, cases: Sequence[CalibrationCase]) -> str:
    """Return the fit and its uncertainty as a table, with what is left unexplained."""
    lines = []
    for name, value in fitted_values(fit).items():
        unit, factor = UNITS.get(name, ("", 1.0))
        spread = fit.uncertainty[name]
        lines.append(f"{name:<24} {factor * value:9.3f} ± {factor * spread:.3f} {unit}".rstrip())
    lines.append("")
    for case, radius in zip(cases, fit.radii, strict=True):
        shape = "outline of its mesh" if radius is None else f"radius of the object {1e3 * radius:.1f} mm"
        lines.append(f"{case.name}: first touch at {1e3 * case.contact.points[0, 2]:.2f} mm, {shape}")
    lines.append(
        f"{fit.plateaus} steady loads of {len(cases)} recordings; left over: force {fit.force_rms:.3f} N "
        f"({100 * fit.calibration.force_error:.1f} %), key points {1e3 * fit.shape_rms:.3f} mm."
    )
    return "\n".join(lines)
