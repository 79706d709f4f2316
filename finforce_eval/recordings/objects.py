"""The object of a recording: its mesh file, and its pose in the frame of a jaw over time."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from math import isfinite
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from finforce.errors import PoseError
from finforce.gripper_frames import FARTHEST_CAMERA
from finforce.messages import SECOND, find_nearest
from finforce.transforms import invert_pose, pose_from_quaternion
from finforce_eval.errors import RecordingError
from finforce_eval.recordings.images import ALONE
from finforce_eval.recordings.recording import read_recording
from finforce_eval.recordings.tracks import PoseTrack, Recording, Timed
from finforce_ifea.contact_mechanics.friction import Coefficient
from finforce_ifea.observation import Observation

# A pose of the object and one of the jaw are of the same image up to this distance of their stamps [ns].
PAIRED = 50_000_000


@dataclass(frozen=True, kw_only=True, eq=False)
class CameraTrack(Timed):
    """Poses of the camera in the frame of one jaw.

    Attributes:
        stamps_ns: (m,) image time [ns], in any order.
        poses: T_jaw_camera (m, 4, 4) [m].
    """

    stamps_ns: NDArray[np.int64]
    poses: NDArray[np.float64]

    def at(self, stamp: int) -> NDArray[np.float64] | None:
        """Return the pose (4, 4) in the image of a stamp [ns], the nearest one; None where there is none nearby."""
        nearest = int(find_nearest(self.stamps_ns, np.array([stamp]))[0])
        return self.poses[nearest] if abs(int(self.stamps_ns[nearest]) - stamp) <= PAIRED else None


@dataclass(frozen=True, kw_only=True, eq=False)
class ObjectTrack(Timed):
    """Poses of the object in the frame of one jaw.

    Attributes:
        stamps_ns: (n,) image time [ns], rising.
        poses: T_jaw_object (n, 4, 4) [m].
        camera: what the poses were seen from; None when it is not known.
    """

    stamps_ns: NDArray[np.int64]
    poses: NDArray[np.float64]
    camera: CameraTrack | None = None


def find_mesh(recording: Recording, object_file: str | None = None) -> Path | None:
    """Return the mesh file that was given, or the one that the `case.json` names; None without either.

    The path in a `case.json` is relative to the folder that holds the recordings: the one above the recording's own
    folder, or the one with the bag file itself. A mesh in the recording's own folder is found when that was renamed.
    """
    if object_file is not None:
        return Path(object_file)
    name = recording.case.get("mesh")
    if not isinstance(name, str) or not name:
        return None
    path = recording.path.resolve()
    folder = path if path.is_dir() else path.parent
    paths = (folder.parent / name, folder / name, folder / Path(name).name)
    return next((path for path in paths if path.is_file()), None)


def require_mesh(recording: Recording, object_file: str | None = None) -> Path:
    """Return the object's mesh file.

    Raises:
        RecordingError: there is none.
    """
    path = find_mesh(recording, object_file)
    if path is not None:
        return path
    name = recording.case.get("mesh")
    found = f"the mesh '{name}' of its case.json is not there" if name else "no mesh in a case.json next to it"
    raise RecordingError(f"{recording.name}: no object mesh: {found}; give --object MESH or --contact fixed:Z_MM")


# The largest coefficient of friction that a `case.json` may state [-].
LARGEST_FRICTION = 2.0


def read_friction(recording: Recording) -> Coefficient | None:
    """Return the friction of the object on the finger as the `case.json` states it; None where it is unknown.

    Raises:
        RecordingError: it is no object of two numbers in their bounds.
    """
    stated = recording.case.get("friction")
    if stated is None:
        return None
    values = [stated.get(name) for name in ("mean", "stddev")] if isinstance(stated, Mapping) else []
    are_numbers = len(values) == 2 and all(type(value) in (int, float) and isfinite(value) for value in values)
    if not (are_numbers and 0.0 <= values[0] <= LARGEST_FRICTION and 0.0 < values[1] <= LARGEST_FRICTION):
        raise RecordingError(
            f"{recording.name}: friction {stated!r} in its case.json, expected "
            f'{{"mean": from 0 to {LARGEST_FRICTION:g}, "stddev": above 0, at most {LARGEST_FRICTION:g}}}'
        )
    return Coefficient(float(values[0]), float(values[1]))


def has_object(recording: Recording, side: str) -> bool:
    """Say whether a recording tells where the object is in the frame of the jaw `side`, or images will."""
    poses, track = recording.object_pose, recording.jaw(side)
    return poses is not None and (_is_in_jaw(poses, side) or track.pose is not None or track.is_awaited)


def track_object(recording: Recording, side: str) -> ObjectTrack:
    """Return the object's poses in the frame of a jaw, T_jaw_object = inv(T_camera_jaw) T_camera_object.

    The jaw's pose is the one nearest in time. Poses that came late are sorted in. Object poses may be recorded
    in the frame of the jaw itself; no poses of the jaw are needed then.

    Args:
        recording: with object poses.
        side: "left" or "right".

    Raises:
        RecordingError: poses are missing, of different frames, far away, never of the same time, or no poses.
    """
    objects = recording.object_pose
    if objects is None:
        raise RecordingError(
            f"{recording.name}: no object poses: /object_pose is absent or has no messages; give --contact fixed:Z_MM"
        )
    T_parent_object = _matrices(objects, "/object_pose", recording.name)
    order = np.argsort(objects.stamps_ns, kind="stable")
    stamps, T_parent_object = objects.stamps_ns[order], T_parent_object[order]
    if _is_in_jaw(objects, side):
        return ObjectTrack(stamps_ns=stamps, poses=T_parent_object)
    jaw = _require_jaw_poses(recording, side, objects.frame_id)
    closest = float(np.linalg.norm(T_parent_object[:, :3, 3], axis=1).min())
    if closest > FARTHEST_CAMERA:
        raise RecordingError(
            f"{recording.name}: /object_pose has the object {closest:.3g} m or more from the camera; expected "
            f"{FARTHEST_CAMERA:g} m at most: is it in millimetres?"
        )
    T_camera_jaw = _matrices(jaw, f"/{side}/jaw_pose", recording.name)
    nearest = find_nearest(jaw.stamps_ns, stamps)
    apart = np.abs(jaw.stamps_ns[nearest] - stamps)
    paired = apart <= PAIRED
    if not paired.any():
        raise RecordingError(
            f"{recording.name}: /object_pose is at least {SECOND * apart.min():.3g} s from any image, or pose of the "
            f"{side} jaw; expected {PAIRED // 10**6} ms at most: have both stamps of one clock?"
        )
    T_jaw_camera = np.stack([invert_pose(T) for T in T_camera_jaw])
    return ObjectTrack(
        stamps_ns=stamps[paired],
        poses=T_jaw_camera[nearest[paired]] @ T_parent_object[paired],
        camera=CameraTrack(stamps_ns=jaw.stamps_ns, poses=T_jaw_camera),
    )


def pose_object_in_images(recording: Recording, tolerance: int) -> ObjectTrack | None:
    """Return the object's poses T_camera_object at the stamps of images, with depth if there is some; None without.

    Args:
        recording: any.
        tolerance: greatest distance of the stamps of a pose and an image that belong together [ns].

    Raises:
        RecordingError: a pose is none.
    """
    objects, images = recording.object_pose, recording.images
    if objects is None or images is None or not len(objects.stamps_ns):
        return None
    if objects.frame_id.lstrip("/") != images.frame_id.lstrip("/"):
        return None
    stamps = images.stamps_ns[images.depth_stamps != ALONE] if images.has_depth else images.stamps_ns
    order = np.argsort(objects.stamps_ns, kind="stable")
    nearest = order[find_nearest(objects.stamps_ns[order], stamps)]
    paired = np.abs(objects.stamps_ns[nearest] - stamps) <= tolerance
    poses = _matrices(objects, "/object_pose", recording.name)
    return ObjectTrack(stamps_ns=stamps[paired], poses=poses[nearest[paired]])


class RecordedImage(NamedTuple):
    """The data of a recording for one image of a jaw.

    Attributes:
        poses: stamp [s] and T_jaw_object (4, 4) [m] of every pose of the object since the image before.
        observation: the key points.
    """

    poses: list[tuple[float, NDArray[np.float64]]]
    observation: Observation


def iter_frames(recording: Recording | str | Path, side: str = "left") -> Iterator[RecordedImage]:
    """Yield the key points of one jaw image by image, each with the object poses since the image before.

    Args:
        recording: with key points, or its path.
        side: "left" or "right".

    Raises:
        RecordingError: there are no key points of that jaw, or no poses; see `track_object`.
    """
    recording = recording if isinstance(recording, Recording) else read_recording(recording)
    track, objects = recording.jaw(side).keypoints, track_object(recording, side)
    known = 0
    for index, stamp in enumerate(track.stamps_ns):
        newest = int(np.searchsorted(objects.stamps_ns, stamp, side="right"))
        poses = [(SECOND * objects.stamps_ns[pose], objects.poses[pose]) for pose in range(known, newest)]
        known = newest
        yield RecordedImage(poses, track.observation(index))


def mean_pose(poses: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the mean (4, 4) of poses (n, 4, 4): mean position, and the rotation nearest to all by chordal distance."""
    T = np.eye(4)
    T[:3, :3] = Rotation.from_matrix(poses[:, :3, :3]).mean().as_matrix()
    T[:3, 3] = poses[:, :3, 3].mean(axis=0)
    return T


def _is_in_jaw(poses: PoseTrack, side: str) -> bool:
    return poses.frame_id.lstrip("/") == f"{side}_jaw"


def _require_jaw_poses(recording: Recording, side: str, frame: str) -> PoseTrack:
    """Return the poses of a jaw in the frame of the object's poses."""
    poses = recording.jaw(side).pose
    if poses is None:
        raise RecordingError(
            f"{recording.name}: no jaw poses: /{side}/jaw_pose is absent or has no messages, and the object's poses "
            f"are in '{frame}'; give --contact fixed:Z_MM"
        )
    if poses.frame_id.lstrip("/") != frame.lstrip("/"):
        raise RecordingError(
            f"{recording.name}: the {side} jaw, by /{side}/jaw_pose or the images, is in '{poses.frame_id}' and "
            f"/object_pose in '{frame}'; expected one frame: transform the poses with /tf before, or give "
            "--contact fixed:Z_MM"
        )
    return poses


def _matrices(track: PoseTrack, topic: str, name: str) -> NDArray[np.float64]:
    """Return the poses (n, 4, 4) of a track in the order of its messages."""
    poses = []
    for index, (position, quaternion) in enumerate(zip(track.position, track.quaternion, strict=True)):
        try:
            poses.append(pose_from_quaternion(position, quaternion))
        except PoseError as error:
            raise RecordingError(f"{name}: {topic} message {index}: {error}") from error
    return np.stack(poses)
