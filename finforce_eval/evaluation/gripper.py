"""Both jaws of a recording as one gripper: grasp force, net force and torque (Eq. 3 of the paper)."""

from __future__ import annotations

from collections.abc import Collection, Mapping

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from finforce.gripper_frames import SIDES
from finforce.transforms import pose_from_quaternion
from finforce_eval.recordings.tracks import Recording
from finforce_eval.table import ForceSeries
from finforce_ifea.grasp_force import Grasp, JawDistance, Wrench, combine_wrenches, single_jaw_grasp
from finforce_ifea.payload import Payload
from finforce_ifea.posture import WristPosture

_SAME = 0.2  # [s] within which a jaw's pose is still that of an image


def with_gripper(jaws: Mapping[str, ForceSeries], recording: Recording) -> dict[str, ForceSeries]:
    """Return the series of both jaws with what a recording says of the gripper.

    That is the distance between the jaws, as it was seen and as it was, and gravity and elevation where known.
    """
    return {
        side: series.with_columns(
            **_find_postures(recording, series.stamps_ns),
            jaw_distance=find_distances(recording, series.stamps_ns),
            true_jaw_distance=find_distances(recording, series.stamps_ns, true=True),
        )
        for side, series in jaws.items()
    }


def combine_jaws(jaws: Mapping[str, ForceSeries]) -> ForceSeries:
    """Return what the gripper feels, in its frame, in every image of one of its jaws.

    Args:
        jaws: by side; both, or the only one. See `with_gripper` for torques, and for the weight that is carried.

    Returns:
        Net force and torque about the gripper's origin, their truth, and the grasp force with its standard deviation;
        NaN where a jaw has none.
    """
    stamps = np.unique(np.concatenate([each.stamps_ns for each in jaws.values()]))
    first = next(iter(jaws.values()))
    jaws = {
        side: ForceSeries(each.table.set_index("stamp").reindex(stamps).reset_index()) for side, each in jaws.items()
    }
    found, true = _combine(jaws, ""), _combine(jaws, "true_")
    net = ForceSeries.build(
        first.name.removesuffix(f"/{first.side}"),
        "gripper",
        stamps,
        force=found["manipulation"],
        torque=found["torque"],
        grasp_force=found["grasp"][:, 0],
        grasp_stddev=_weakest_stddev(jaws.values(), found["grasp"][:, 0]),
        true_force=true["manipulation"],
        true_torque=true["torque"],
        # the jaws' frames are turned about z by half a turn: their axes are those of the gripper
        force_stddev=np.sqrt(np.sum([each.column("force_stddev") ** 2 for each in jaws.values()], axis=0)),
        scored=np.all([each.table["scored"].fillna(False).astype(bool) for each in jaws.values()], axis=0),
    )
    return _carry_payload(net, next(iter(jaws.values()))) if first.has("gravity") else net


def _carry_payload(net: ForceSeries, jaw: ForceSeries) -> ForceSeries:
    """Return the series of a gripper with the weight that it carries, by the posture in a jaw's rows; see `Payload`."""
    payload, told, stated = Payload(), net.force.copy(), net.column("force_stddev").copy()
    held, gravity, elevation = net.column("grasp_force"), jaw.column("gravity"), jaw.column("elevation")
    for row in np.flatnonzero(np.isfinite(told).all(axis=1)):
        grasp = Grasp(grasp=np.array([held[row], 0.0, 0.0]), manipulation=told[row], torque=None, stddev=stated[row])
        posture = WristPosture(gravity[row], float(elevation[row])) if np.isfinite(gravity[row]).all() else None
        grasp = payload.update(grasp, float(net.stamps[row]), posture)
        told[row], stated[row] = grasp.manipulation, grasp.stddev
    return net.with_columns(force=told, force_stddev=stated)


def _find_postures(recording: Recording, stamps: NDArray) -> dict[str, NDArray]:
    """Return gravity (n, 3) and elevation (n,) of the gripper in images (n,) [ns] as columns; none if nothing says."""
    if recording.gravity is None:
        return {}
    found = [recording.gravity.at(stamp) or WristPosture(np.full(3, np.nan)) for stamp in stamps.tolist()]
    return {
        "gravity": np.array([one.gravity for one in found]),
        "elevation": np.array([one.elevation for one in found]),
    }


def _weakest_stddev(jaws: Collection[ForceSeries], grasp: NDArray) -> NDArray:
    """Return the standard deviation (n,) [N] of the smaller force, which is the grasp force (n,) [N]."""
    weakest = np.argmin([np.nan_to_num(each.magnitude) for each in jaws], axis=0)
    stddev = np.choose(weakest, [each.column("magnitude_stddev").astype(float) for each in jaws])
    return np.where(np.isfinite(grasp), stddev, np.nan)


def _combine(jaws: Mapping[str, ForceSeries], prefix: str) -> dict[str, NDArray]:
    """Return grasp, net force and torque (n, 3) of the columns with a prefix, NaN where a jaw has no force."""
    wrenches = [
        zip(*(each.column(f"{prefix}{name}") for name in ("force", "torque")), strict=True) for each in jaws.values()
    ]
    distances = (
        pd.DataFrame([each.column(f"{prefix}jaw_distance").astype(float) for each in jaws.values()]).bfill().iloc[0]
    )
    out = {name: np.full((len(distances), 3), np.nan) for name in ("grasp", "manipulation", "torque")}
    for row, (distance, *pairs) in enumerate(zip(distances, *wrenches, strict=True)):
        each = {side: Wrench(*pair) for side, pair in zip(jaws, pairs, strict=True)}
        if not all(np.isfinite(wrench.force).all() for wrench in each.values()):
            continue
        if len(each) == 2:
            grasp = combine_wrenches(each["left"], each["right"], None if np.isnan(distance) else float(distance))
        else:
            grasp = single_jaw_grasp(next(iter(each.values())), next(iter(each)))
        out["grasp"][row], out["manipulation"][row] = grasp.grasp, grasp.manipulation
        if grasp.torque is not None:
            out["torque"][row] = grasp.torque
    return out


def find_distances(recording: Recording | None, stamps: NDArray, *, true: bool = False) -> list[float | None]:
    """Return the distance between the jaws in images (n,) [ns], as it was seen or as it was; None where unknown."""
    distance, tracks = JawDistance(_SAME), {}
    for side in SIDES if recording is not None else ():
        jaw = recording.jaw(side)
        track = (jaw.true_pose or jaw.pose) if true else (jaw.pose or jaw.true_pose)
        if track is None:
            break
        poses = zip(track.position, track.quaternion, strict=True)
        tracks[side] = dict(zip(track.stamps_ns.tolist(), (pose_from_quaternion(*pose) for pose in poses), strict=True))
    found: list[float | None] = []
    for stamp in stamps.tolist():
        for side, poses in tracks.items():
            if stamp in poses:
                distance.take(side, stamp, poses[stamp])
        found.append(distance.at(stamp))
    return found
