"""The net force of an object on both jaws (Eq. 3 of the paper), against the truth of both."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from finforce_eval.evaluation.results import CaseResult
from finforce_eval.evaluation.scoring import compare_vectors
from finforce_ifea.grasp_force import combine_forces


@dataclass(frozen=True, kw_only=True)
class ManipulationStats:
    """How far `/manipulation_wrench` is from the truth, in `gripper_base`.

    Attributes:
        n: images of the record phases in which both jaws have a force, and both a truth.
        vector_rmse_N: root mean square length of the difference [N], None without any.
        axis_rmse_N: root mean square difference along x, y and z [N].
        within_3_sigma_pct: share of the images in which the difference along x, y and z is within three of the stated
            standard deviations of both jaws together, or 1 mN [%].
        answered_pct: share of the images with both truths in which both jaws were answered [%].
    """

    n: int
    vector_rmse_N: float | None = None
    axis_rmse_N: tuple[float, float, float] | None = None
    within_3_sigma_pct: tuple[float, float, float] | None = None
    answered_pct: float | None = None


def score_manipulation(results: Mapping[str, CaseResult]) -> dict[str, ManipulationStats]:
    """Return the score of every recording of which both jaws were evaluated, by its name."""
    pairs: dict[str, dict[str, CaseResult]] = {}
    for name, result in results.items():
        pairs.setdefault(name.removesuffix(f"/{result.side}"), {})[result.side] = result
    return {name: score_pair(pair["left"], pair["right"]) for name, pair in pairs.items() if len(pair) == 2}


def score_pair(left: CaseResult, right: CaseResult) -> ManipulationStats:
    """Return the score of two jaws of one recording, image by image with equal stamps."""
    _, mine, theirs = np.intersect1d(left.stamps, right.stamps, return_indices=True)
    counted = left.scored[mine] & right.scored[theirs]
    counted &= np.isfinite(left.truth[mine, 0]) & np.isfinite(right.truth[theirs, 0])
    mine, theirs = mine[counted], theirs[counted]
    both = np.isfinite(left.force[mine, 0]) & np.isfinite(right.force[theirs, 0])
    answered = 100.0 * float(both.mean()) if len(both) else None
    mine, theirs = mine[both], theirs[both]
    if not len(mine):
        return ManipulationStats(n=0, answered_pct=answered)
    found = _combine(left.force[mine], right.force[theirs])
    difference = found - _combine(left.truth[mine], right.truth[theirs])
    stated = None
    if left.axis_stddev is not None and right.axis_stddev is not None:
        # the jaws' frames are turned about z by half a turn: their axes are those of the gripper
        stated = np.hypot(left.axis_stddev[mine], right.axis_stddev[theirs])
    return ManipulationStats(n=len(mine), answered_pct=answered, **compare_vectors(difference, stated))


def _combine(left: NDArray, right: NDArray) -> NDArray:
    """Return the net forces (n, 3) [N] in the gripper's frame."""
    return np.array([combine_forces(mine, theirs).manipulation for mine, theirs in zip(left, right, strict=True)])


def format_manipulation(scores: Mapping[str, ManipulationStats]) -> list[str]:
    """Return a line per recording with two jaws; none without any."""
    lines = []
    for name, score in scores.items():
        if score.vector_rmse_N is None:
            lines.append(f"{name}: no net force: never were both jaws answered")
            continue
        axes = " ".join(f"{value:.2f}" for value in score.axis_rmse_N)
        lines.append(
            f"{name}: net force on the gripper off by {score.vector_rmse_N:.3f} N (x, y, z: {axes}), "
            f"{score.answered_pct:.1f} % answered"
        )
    return lines
