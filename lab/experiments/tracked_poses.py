"""Poses of the object by the built-in tracker in place of those of a recording, and how far poses are off."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from finforce.transforms import invert_pose, pose_from_quaternion, quaternion_from_pose, rotation_between
from finforce_contact.errors import PoseLostError
from finforce_contact.mesh.object_mesh import load_object_mesh
from finforce_contact.mesh.views import MeshView
from finforce_contact.pose.symmetry import Symmetry, read_symmetry
from finforce_contact.pose.tracker import PoseTracker
from finforce_eval.errors import RecordingError
from finforce_eval.recordings.objects import require_mesh
from finforce_eval.recordings.tracks import PoseTrack, Recording
from finforce_keypoints.images import RgbdImage
from finforce_sim.gripper.footage import CAMERAS, FINGER, START
from finforce_sim.gripper.gripper import TwinGripper
from finforce_sim.scenes.scenarios import build_scenario

ON_MESH = 4e-3  # [m] within which a pixel's depth is that of the object, for the first pose
FIRST_WITHIN = 50_000_000  # [ns] between the first pose that is known and an image
NANOSECOND = 1e-9


@dataclass(frozen=True, kw_only=True, eq=False)
class TrackedObject:
    """What the built-in tracker made of a recording's images.

    Attributes:
        recording: with its poses.
        delay: median time of an image [ns].
        lost: images in which the object was not found.
    """

    recording: Recording
    delay: int
    lost: int


def track_object(recording: Recording) -> TrackedObject:
    """Follow the object in a recording's depth images, from the first pose that the recording has.

    Raises:
        RecordingError: there are no depth images, or none near the first pose.
    """
    images = recording.images
    if images is None or not images.has_depth:
        raise RecordingError(f"{recording.name}: the built-in tracker needs depth images, which are not in it")
    mesh = load_object_mesh(require_mesh(recording))
    tracker, view = PoseTracker(mesh, images.camera), MeshView(mesh)
    known, first = recording.object_pose, _read_poses(recording.object_pose)[0]
    stamps, poses, times, lost = [], [], [], 0
    for stamp, image in images.at(images.stamps[images.stamps >= known.stamps[0] - FIRST_WITHIN]):
        began = time.perf_counter()
        pose = find_pose(tracker, view, image, first, ON_MESH)
        if pose is None:
            lost += 1
            continue
        times.append(time.perf_counter() - began)
        stamps.append(stamp)
        poses.append(pose)
    if not stamps:
        raise RecordingError(f"{recording.name}: the built-in tracker did not find the object in {lost} depth images")
    track = PoseTrack(
        stamps=np.array(stamps, dtype=np.int64),
        position=np.array([T[:3, 3] for T in poses]),
        quaternion=np.array([quaternion_from_pose(T) for T in poses]),
        frame_id=images.frame_id,
    )
    return TrackedObject(
        recording=replace(recording, object_pose=track), delay=round(np.median(times) / NANOSECOND), lost=lost
    )


def find_pose(
    tracker: PoseTracker, view: MeshView, image: RgbdImage, T_first: NDArray, within: float
) -> NDArray | None:
    """Return T_camera_object (4, 4) in an image, None where the object is lost.

    Args:
        tracker: that has seen the images before.
        view: of the object.
        image: with depth.
        T_first: (4, 4) near which it is, as long as the tracker has no pose.
        within: depth by which a pixel may be off the mesh there and still be the object's [m].
    """
    try:
        if tracker.latest is not None:
            return tracker.track(image.stamp, image.depth).T_camera_object
        mask = np.abs(image.depth - view.render(T_first, image.camera).depth) < within
        return tracker.locate(image.stamp, image.depth, mask, [T_first]).T_camera_object
    except PoseLostError:
        return None


def true_poses(settings: Mapping[str, Any]) -> dict[int, NDArray]:
    """Return T_camera_object (4, 4) of a scene of the twin by the stamps of its images [ns]."""
    scenario = build_scenario(settings["scene"], **settings["changes"])
    T_camera_gripper = invert_pose(CAMERAS[scenario.camera])
    return {
        START + round(state.stamp / NANOSECOND): T_camera_gripper @ state.T_gripper_object
        for state in TwinGripper(scenario, FINGER).states()
        if state.T_gripper_object is not None
    }


def score_poses(recording: Recording, truth: Mapping[int, NDArray]) -> dict[str, float]:
    """Return how often poses come [Hz], and their median and 95th percentile of distance [mm] and turn [°] from truth.

    Distances are of the middle of the object; of what looks the same turned the nearest turn counts. Without truth only
    the rate is known.
    """
    mesh = load_object_mesh(require_mesh(recording))
    symmetry = read_symmetry("auto", mesh)
    track = recording.object_pose
    pairs = zip(track.stamps.tolist(), _read_poses(track), strict=True)
    errors = np.array([_measure(T, truth[stamp], symmetry) for stamp, T in pairs if stamp in truth])
    seconds = NANOSECOND * float(np.ptp(track.stamps))
    rate = {"rate_Hz": (len(track.stamps) - 1) / seconds if seconds > 0.0 else float("nan")}
    if not len(errors):
        return rate
    away, turn = 1e3 * errors[:, 0], np.degrees(errors[:, 1])
    return rate | {
        "position_median_mm": float(np.median(away)),
        "position_p95_mm": float(np.quantile(away, 0.95)),
        "rotation_median_deg": float(np.median(turn)),
        "rotation_p95_deg": float(np.quantile(turn, 0.95)),
    }


def _measure(T: NDArray, T_true: NDArray, symmetry: Symmetry) -> tuple[float, float]:
    """Return distance [m] of the middle and turn [rad] of a pose from the true one."""
    middle = symmetry.middle
    away = np.linalg.norm(T[:3, :3] @ middle + T[:3, 3] - T_true[:3, :3] @ middle - T_true[:3, 3])
    return float(away), rotation_between(symmetry.nearest(T, T_true), T_true)


def _read_poses(track: PoseTrack) -> list[NDArray]:
    """Return the poses (4, 4) of a track."""
    return [pose_from_quaternion(*numbers) for numbers in zip(track.position, track.quaternion, strict=True)]
