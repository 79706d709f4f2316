"""Direction of gravity and elevation of the gripper in a recording, from /gravity or from /tf."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from finforce.errors import ObservationError, PoseError
from finforce.messages import direction_from_message, pose_from_transform, stamp_of
from finforce.settings import GripperParameters
from finforce_eval.errors import RecordingError
from finforce_eval.recordings.tracks import GravityTrack, check_stamps

GRAVITY, VECTOR = "/gravity", "geometry_msgs/msg/Vector3Stamped"
MOVING, FIXED, TRANSFORMS = "/tf", "/tf_static", "tf2_msgs/msg/TFMessage"
_GRIPPER = GripperParameters.gripper_frame


class _Link(NamedTuple):
    """Poses of a frame in its parent (n, 4, 4), and their stamps (n,) [ns]; one pose without a stamp if it is fixed."""

    poses: NDArray[np.float64]
    stamps_ns: NDArray[np.int64]

    def at(self, stamps: NDArray[np.int64]) -> NDArray[np.float64]:
        """Return the last pose before each time (m, 4, 4)."""
        return self.poses[np.maximum(np.searchsorted(self.stamps_ns, stamps, side="right") - 1, 0)]


def read_gravity(samples: Sequence[Any], name: str) -> GravityTrack:
    """Return the directions of messages on /gravity; the elevation is not known.

    Raises:
        RecordingError: a message is in another frame, or no direction; or the stamps go back.
    """
    stamps = check_stamps(map(stamp_of, samples), GRAVITY, name)
    try:
        directions = np.array([direction_from_message(sample, _GRIPPER, "gravity") for sample in samples])
    except ObservationError as error:
        raise RecordingError(f"{name}: {GRAVITY}: {error}") from error
    return GravityTrack(stamps_ns=stamps, direction=directions, elevation=np.full(len(stamps), np.nan))


def read_transforms(samples: Mapping[str, Sequence[Any]], upright: str, name: str) -> GravityTrack:
    """Return gravity and elevation of the gripper by the transforms from an upright frame to its own.

    Args:
        samples: messages on /tf and /tf_static, by topic.
        upright: frame whose z axis points up.
        name: of the recording, for messages.

    Raises:
        RecordingError: no transforms connect the two frames, nothing moves, or a transform is no pose.
    """
    moving, fixed = (_by_child(samples.get(topic, ())) for topic in (MOVING, FIXED))
    frame, chain = _GRIPPER, []
    while frame != upright:
        found = moving.get(frame) or fixed.get(frame, ())[-1:]
        if not found or len(chain) > len(moving) + len(fixed):
            raise RecordingError(
                f"{name}: --gravity-frame {upright}: {MOVING} connects {_GRIPPER} with {frame} at most"
            )
        chain.append(_read_link(found, frame in moving, name))
        frame = _name(found[-1].header.frame_id)
    stamps = np.unique(np.concatenate([np.zeros(0, np.int64), *(link.stamps_ns for link in chain)]))
    if not len(stamps):
        raise RecordingError(f"{name}: --gravity-frame {upright}: {MOVING} does not move {_GRIPPER}")
    stamps = stamps[stamps >= max(link.stamps_ns[0] for link in chain if len(link.stamps_ns))]
    T = np.eye(4)
    for link in chain:  # from the gripper up
        T = link.at(stamps) @ T
    return GravityTrack(stamps_ns=stamps, direction=-T[:, 2, :3], elevation=T[:, 2, 3])


def _by_child(messages: Iterable[Any]) -> dict[str, list[Any]]:
    """Return transforms by the names of the frames that they place."""
    found: dict[str, list[Any]] = {}
    for message in messages:
        for transform in message.transforms:
            found.setdefault(_name(transform.child_frame_id), []).append(transform)
    return found


def _name(frame: str) -> str:
    return frame.lstrip("/")


def _read_link(transforms: Sequence[Any], moves: bool, name: str) -> _Link:
    """Return the poses of one frame in the order of their stamps; raises RecordingError for one that is none."""
    stamps = np.array([stamp_of(each) for each in transforms], dtype=np.int64)
    order = np.argsort(stamps, kind="stable")
    try:
        poses = np.stack([pose_from_transform(transforms[row].transform) for row in order])
    except PoseError as error:
        raise RecordingError(f"{name}: {MOVING}: the pose of {_name(transforms[0].child_frame_id)}: {error}") from error
    return _Link(poses, stamps[order] if moves else np.zeros(0, np.int64))
