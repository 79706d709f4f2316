"""The net force of an object on both jaws (Eq. 3 of the paper), against the truth of both."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from finforce.gripper_frames import SIDES
from finforce.transforms import pose_from_quaternion
from finforce_eval.evaluation.results import CaseResult
from finforce_eval.evaluation.scoring import compare_torques, compare_vectors
from finforce_eval.recordings.tracks import Recording
from finforce_ifea.grasp_force import JawDistance, Wrench, combine_wrenches

_SAME = 0.2  # [s] within which a jaw's pose is still that of an image


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
        torque_rmse_Nm: root mean square length of the difference of the torques about the gripper's origin [N m], None
            where they, or the jaws' places, are not known.
    """

    n: int
    vector_rmse_N: float | None = None
    axis_rmse_N: tuple[float, float, float] | None = None
    within_3_sigma_pct: tuple[float, float, float] | None = None
    answered_pct: float | None = None
    torque_rmse_Nm: float | None = None


def score_manipulation(
    results: Iterable[CaseResult], recordings: Iterable[Recording] = ()
) -> dict[str, ManipulationStats]:
    """Return the score of every recording of which both jaws were evaluated, by its name."""
    pairs: dict[str, dict[str, CaseResult]] = {}
    for result in results:
        pairs.setdefault(result.name.removesuffix(f"/{result.side}"), {})[result.side] = result
    known = {recording.name: recording for recording in recordings}
    return {
        name: score_pair(pair["left"], pair["right"], known.get(name)) for name, pair in pairs.items() if len(pair) == 2
    }


@dataclass(frozen=True, kw_only=True, eq=False)
class NetForces:
    """The net wrenches of both jaws in the n images of the record phases in which both are answered and measured.

    Attributes:
        stamps: (n,) [ns].
        found: force and torque (n, 3) in the gripper's frame, of the estimates; a torque that is not known is NaN.
        true: the same, as measured.
        stated: (n, 3) standard deviation of the found force [N]; None where nobody states it.
        answered_pct: share of the images with both truths in which both jaws were answered [%]; None without any.
    """

    stamps: NDArray
    found: Wrench
    true: Wrench
    stated: NDArray | None
    answered_pct: float | None


def join_net(left: CaseResult, right: CaseResult, recording: Recording | None = None) -> NetForces:
    """Return the net wrenches of two jaws of one recording, image by image with equal stamps.

    Args:
        left: of the left jaw.
        right: of the right jaw.
        recording: with the jaws' poses, without which no torque is known.
    """
    stamps, mine, theirs = np.intersect1d(left.stamps, right.stamps, return_indices=True)
    counted = left.scored[mine] & right.scored[theirs]
    counted &= np.isfinite(left.truth[mine, 0]) & np.isfinite(right.truth[theirs, 0])
    stamps, mine, theirs = stamps[counted], mine[counted], theirs[counted]
    both = np.isfinite(left.force[mine, 0]) & np.isfinite(right.force[theirs, 0])
    answered = 100.0 * float(both.mean()) if len(both) else None
    stamps, mine, theirs = stamps[both], mine[both], theirs[both]
    jaws = ((left, mine), (right, theirs))
    ways = find_distances(recording, stamps)
    found = _combine(*((jaw.force[rows], _rows_of(jaw.torque, rows)) for jaw, rows in jaws), ways)
    ways = find_distances(recording, stamps, true=True)
    true = _combine(*((jaw.truth[rows], _rows_of(jaw.true_torque, rows)) for jaw, rows in jaws), ways)
    stated = None
    if left.axis_stddev is not None and right.axis_stddev is not None:
        # the jaws' frames are turned about z by half a turn: their axes are those of the gripper
        stated = np.hypot(left.axis_stddev[mine], right.axis_stddev[theirs])
    return NetForces(stamps=stamps, found=found, true=true, stated=stated, answered_pct=answered)


def score_pair(left: CaseResult, right: CaseResult, recording: Recording | None = None) -> ManipulationStats:
    """Return the score of two jaws of one recording; see `join_net`."""
    net = join_net(left, right, recording)
    if not len(net.stamps):
        return ManipulationStats(n=0, answered_pct=net.answered_pct)
    known = np.isfinite(net.found.torque - net.true.torque).all(axis=1)
    is_measured = known.any() and net.true.torque.any()
    torque = compare_torques(net.found.torque[known], net.true.torque[known]) if is_measured else {}
    return ManipulationStats(
        n=len(net.stamps),
        answered_pct=net.answered_pct,
        torque_rmse_Nm=torque.get("torque_rmse_Nm"),
        **compare_vectors(net.found.force - net.true.force, net.stated),
    )


def _rows_of(torque: NDArray | None, rows: NDArray) -> NDArray:
    """Return the torques in some images (n, 3) [N m], NaN where none were kept."""
    return np.full((len(rows), 3), np.nan) if torque is None else torque[rows]


def find_distances(recording: Recording | None, stamps: NDArray, *, true: bool = False) -> list[float | None]:
    """Return the distance between the jaws in images (n,) [ns], as it was seen or as it was; None where unknown."""
    distance, tracks = JawDistance(_SAME), {}
    for side in SIDES if recording is not None else ():
        jaw = recording.jaw(side)
        track = (jaw.true_pose or jaw.pose) if true else (jaw.pose or jaw.true_pose)
        if track is None:
            break
        poses = zip(track.position, track.quaternion, strict=True)
        tracks[side] = dict(zip(track.stamps.tolist(), (pose_from_quaternion(*pose) for pose in poses), strict=True))
    found: list[float | None] = []
    for stamp in stamps.tolist():
        for side, poses in tracks.items():
            if stamp in poses:
                distance.take(side, stamp, poses[stamp])
        found.append(distance.at(stamp))
    return found


def _combine(left: tuple[NDArray, NDArray], right: tuple[NDArray, NDArray], ways: Iterable[float | None]) -> Wrench:
    """Return the net wrenches (n, 3) in the gripper's frame; a torque that is not known is NaN."""
    rows = zip(*left, *right, ways, strict=True)
    grasps = [combine_wrenches(Wrench(f, t), Wrench(g, u), way) for f, t, g, u, way in rows]
    nothing = np.full(3, np.nan)
    torques = [nothing if grasp.torque is None else grasp.torque for grasp in grasps]
    return Wrench(np.array([grasp.manipulation for grasp in grasps]).reshape(-1, 3), np.array(torques).reshape(-1, 3))


def format_manipulation(scores: Mapping[str, ManipulationStats]) -> list[str]:
    """Return a line per recording with two jaws; none without any."""
    lines = []
    for name, score in scores.items():
        if score.vector_rmse_N is None:
            lines.append(f"{name}: no net force: never were both jaws answered")
            continue
        axes = " ".join(f"{value:.2f}" for value in score.axis_rmse_N)
        turn = "" if score.torque_rmse_Nm is None else f", torque by {1e3 * score.torque_rmse_Nm:.1f} N mm"
        lines.append(
            f"{name}: net force on the gripper off by {score.vector_rmse_N:.3f} N (x, y, z: {axes}){turn}, "
            f"{score.answered_pct:.1f} % answered"
        )
    return lines
