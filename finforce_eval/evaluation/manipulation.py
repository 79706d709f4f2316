"""The net force of an object on both jaws (Eq. 3 of the paper), against the truth of both."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from finforce.gripper_frames import SIDES
from finforce.transforms import pose_from_quaternion
from finforce_eval.evaluation.scoring import compare_torques, compare_vectors
from finforce_eval.recordings.tracks import Recording
from finforce_eval.table import ForceSeries
from finforce_ifea.grasp_force import Grasp, JawDistance, Wrench, combine_wrenches, single_jaw_grasp

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


def score_manipulation(results: Iterable[ForceSeries]) -> dict[str, ManipulationStats]:
    """Return the score of every recording of which both jaws were evaluated, by its name."""
    pairs: dict[str, dict[str, ForceSeries]] = {}
    for result in results:
        pairs.setdefault(result.name.removesuffix(f"/{result.side}"), {})[result.side] = result
    return {name: score_net(join_net(pair)) for name, pair in pairs.items() if len(pair) == 2}


def with_distances(jaws: Mapping[str, ForceSeries], recording: Recording) -> dict[str, ForceSeries]:
    """Return the series of both jaws with the distance between them, as it was seen and as it was."""
    return {
        side: series.with_columns(
            jaw_distance=find_distances(recording, series.stamps),
            true_jaw_distance=find_distances(recording, series.stamps, true=True),
        )
        for side, series in jaws.items()
    }


def combine_jaws(jaws: Mapping[str, ForceSeries]) -> ForceSeries:
    """Return what the gripper feels, in its frame, in every image of one of its jaws.

    Args:
        jaws: by side; both, or the only one. Where both have distances, see `with_distances`, torques are known.

    Returns:
        Net force and torque about the gripper's origin, their truth, and the grasp force; NaN where a jaw has none.
    """
    stamps = np.unique(np.concatenate([each.stamps for each in jaws.values()]))
    rows = {side: pd.Index(each.stamps).get_indexer(stamps) for side, each in jaws.items()}
    found, true = _combine(jaws, rows), _combine(jaws, rows, "true_")
    stated = [_take(each.column("force_stddev"), rows[side]) for side, each in jaws.items()]
    scored = [_take(each.scored.astype(float), rows[side]) == 1.0 for side, each in jaws.items()]
    first = next(iter(jaws.values()))
    return ForceSeries.build(
        first.name.removesuffix(f"/{first.side}"),
        "gripper",
        stamps,
        force=found["manipulation"],
        torque=found["torque"],
        grasp_force=found["grasp"][:, 0],
        true_force=true["manipulation"],
        true_torque=true["torque"],
        # the jaws' frames are turned about z by half a turn: their axes are those of the gripper
        force_stddev=np.sqrt(np.sum(np.square(stated), axis=0)),
        scored=np.all(scored, axis=0),
    )


def join_net(jaws: Mapping[str, ForceSeries]) -> ForceSeries:
    """Return what `combine_jaws` does, in the images of the record phases in which both jaws were measured."""
    net = combine_jaws(jaws)
    return net.at(net.scored & np.isfinite(net.true_force).all(axis=1))


def score_net(net: ForceSeries) -> ManipulationStats:
    """Return the score of the net force on the gripper; see `join_net`."""
    answered = 100.0 * float(net.solved.mean()) if len(net) else None
    net = net.at(net.solved)
    if not len(net):
        return ManipulationStats(n=0, answered_pct=answered)
    found, true = net.column("torque"), net.column("true_torque")
    known = np.isfinite(found - true).all(axis=1)
    torque = compare_torques(found[known], true[known]) if known.any() and np.nan_to_num(true).any() else {}
    stated = net.column("force_stddev")
    return ManipulationStats(
        n=len(net),
        answered_pct=answered,
        torque_rmse_Nm=torque.get("torque_rmse_Nm"),
        **compare_vectors(net.force - net.true_force, stated if np.isfinite(stated).any() else None),
    )


def _take(values: NDArray, rows: NDArray) -> NDArray[np.float64]:
    """Return the values of some rows, NaN where the row is -1."""
    taken = np.full((len(rows), *values.shape[1:]), np.nan)
    taken[rows >= 0] = values[rows[rows >= 0]]
    return taken


def _combine(jaws: Mapping[str, ForceSeries], rows: Mapping[str, NDArray], prefix: str = "") -> dict[str, NDArray]:
    """Return grasp, net force and torque (n, 3) of the columns with a prefix, NaN where a jaw has no force."""
    wrenches = [
        [_take(each.column(f"{prefix}{name}"), rows[side]) for name in ("force", "torque")]
        for side, each in jaws.items()
    ]
    ways = [_take(each.column(f"{prefix}jaw_distance").astype(float), rows[side]) for side, each in jaws.items()]
    out = {name: np.full((len(ways[0]), 3), np.nan) for name in ("grasp", "manipulation", "torque")}
    way = np.where(np.isnan(ways[0]), ways[-1], ways[0])
    for row in range(len(way)):
        each = dict(zip(jaws, (Wrench(force[row], torque[row]) for force, torque in wrenches), strict=True))
        if not all(np.isfinite(wrench.force).all() for wrench in each.values()):
            continue
        distance = None if np.isnan(way[row]) else float(way[row])
        grasp = combine_wrenches(each["left"], each["right"], distance) if len(each) == 2 else _single(each)
        out["grasp"][row], out["manipulation"][row] = grasp.grasp, grasp.manipulation
        if grasp.torque is not None:
            out["torque"][row] = grasp.torque
    return out


def _single(wrenches: Mapping[str, Wrench]) -> Grasp:
    """Return the grasp of the only jaw."""
    ((side, wrench),) = wrenches.items()
    return single_jaw_grasp(wrench, side)


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
