"""How far /grasp_wrench is from the truth, and how late; hears no topic and knows no estimator."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from finforce_eval.delay_scoring import DelayStats, delay_stats, onset_delays
from finforce_eval.scoring import Stats, compute_stats, match_truth
from finforce_eval.tracks import Recording


@dataclass(frozen=True, kw_only=True)
class GraspScore:
    """The grasp force against the smaller of the jaws' true forces.

    Attributes:
        error: over the record phases, or over every image without phases.
        frames: images that were to be scored, with or without an answer.
        largest: true grasp force [N]; NaN where it is not known.
        delay: after the true onsets.
    """

    error: Stats
    frames: int
    largest: float
    delay: DelayStats


def score_grasp(recording: Recording, grasp: Mapping[int, float], lag: Mapping[int, float]) -> GraspScore:
    """Return how good grasp forces were; of a recording without the truth of all jaws nothing is known.

    Args:
        recording: that was played.
        grasp: by recorded stamp [ns] -> [N].
        lag: from the image to the grasp force [s], by recorded stamp [ns].
    """
    if any(track.truth is None for track in recording.jaws.values()):
        nothing = compute_stats(np.zeros(0), 0.0)
        return GraspScore(error=nothing, frames=0, largest=float("nan"), delay=delay_stats([]))
    stamps = next(iter(recording.jaws.values())).keypoints.stamps
    forces = [np.linalg.norm(match_truth(recording.truth(side), stamps), axis=1) for side in recording.jaws]
    truth, said = np.min(forces, axis=0), _rows(grasp, stamps)
    scored = recording.phases_at(stamps).scored & np.isfinite(truth)
    error = (said - truth)[scored]
    known = truth[np.isfinite(truth)]
    return GraspScore(
        error=compute_stats(error[np.isfinite(error)], float(np.ptp(known)) if known.size else 0.0),
        frames=int(scored.sum()),
        largest=float(known.max()) if known.size else float("nan"),
        delay=delay_stats(onset_delays(stamps * 1e-9, truth, said, _rows(lag, stamps))),
    )


def _rows(values: Mapping[int, float], stamps: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return one value per stamp, NaN where there is none."""
    return np.array([values.get(int(stamp), np.nan) for stamp in stamps])
