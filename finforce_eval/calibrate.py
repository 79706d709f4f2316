"""Recordings with ground truth into calibration cases; the fitting itself is done in finforce_ifea."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from finforce_ifea.calibration import CalibrationCase, CalibrationFit, fit_calibration
from finforce_ifea.estimator import Contact, Observation
from finforce_ifea.settings import EstimatorSettings

from finforce_eval.contacts import ContactChoice
from finforce_eval.evaluate import check_keypoint_count
from finforce_eval.scoring import match_truth
from finforce_eval.tracks import Recording
from finforce_ifea.jaw import Jaw


def calibration_case(recording: Recording, jaw: Jaw, contacts: ContactChoice, side: str) -> CalibrationCase:
    """Return the observations and true forces of one jaw of a recording.

    Args:
        recording: a recording with ground truth.
        jaw: the jaw of that side.
        contacts: contact heights.
        side: "left" or "right".

    Raises:
        RecordingError: no ground truth, or another number of key points than the jaw's.
        OptionError: no contact height.
    """
    track, truth = recording.jaw(side).keypoints, recording.truth(side)
    check_keypoint_count(recording, side, jaw)
    forces = match_truth(truth, track.stamps)
    known = np.isfinite(forces).all(axis=1)
    observations = [
        Observation(stamp=stamp * 1e-9, points=points, likelihood=likelihood)
        for stamp, points, likelihood in zip(track.stamps, track.points, track.likelihood, strict=True)
    ]
    return CalibrationCase(
        name=recording.name,
        observations=observations,
        contact=Contact.fixed(jaw, contacts.height(recording)),
        stamps_true=track.stamps[known] * 1e-9,
        forces_true=forces[known],
    )


def calibrate(
    recordings: Sequence[Recording], jaw: Jaw, contacts: ContactChoice, settings: EstimatorSettings
) -> CalibrationFit:
    """Fit the material to recordings.

    Raises:
        FinforceError: a recording cannot be used, or the fit makes no sense.
    """
    cases = [calibration_case(recording, jaw, contacts, jaw.side) for recording in recordings]
    return fit_calibration(jaw, cases, settings)
