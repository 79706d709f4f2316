"""Messages of ROS into stamps, poses, wrenches and images; any object with a message's attributes will do."""

from __future__ import annotations

import struct
from typing import Any

import numpy as np
from numpy.typing import NDArray

from finforce.camera import (
    CameraIntrinsics,
    ImageError,
    ImageLayout,
    IntrinsicsError,
    decode_color,
    decode_depth,
    unpack_rows,
)
from finforce.errors import ObservationError, PoseError
from finforce.stamps import NANOSECONDS
from finforce.transforms import pose_from_quaternion

MASKS = ("mono8", "8UC1")


def stamp_of(message: Any) -> int:
    """Return the stamp of a message with a header [ns]."""
    stamp = message.header.stamp
    return stamp.sec * NANOSECONDS + stamp.nanosec


def pose_from_message(message: Any, frame: str, what: str) -> NDArray:
    """Return the pose (4, 4) of a geometry_msgs/PoseStamped in `frame`.

    Raises:
        ObservationError: the frame is another one.
        PoseError: a number is not finite, or the quaternion is no unit quaternion.
    """
    check_frame(message, frame, what)
    position, turn = message.pose.position, message.pose.orientation
    try:
        return pose_from_quaternion((position.x, position.y, position.z), (turn.x, turn.y, turn.z, turn.w))
    except PoseError as error:
        raise PoseError(f"{what}: {error}") from None


def wrench_from_message(message: Any, frame: str) -> tuple[NDArray, NDArray]:
    """Return force (3,) [N] and torque (3,) [N m] about the jaw's origin of a geometry_msgs/WrenchStamped.

    Raises:
        ObservationError: the frame is another one, or a component is not finite.
    """
    check_frame(message, frame, "the wrench")
    force, torque = (np.array([part.x, part.y, part.z]) for part in (message.wrench.force, message.wrench.torque))
    if not np.isfinite([force, torque]).all():
        raise ObservationError(f"the wrench is not finite: {force}, {torque}")
    return force, torque


def camera_from_info(info: Any, frame: str) -> CameraIntrinsics:
    """Return the intrinsics of a sensor_msgs/CameraInfo.

    Raises:
        ObservationError: the frame is another one.
        IntrinsicsError: the numbers are no camera's, its axes are skew, or the distortion is not plumb-bob.
    """
    check_frame(info, frame, "the camera info")
    if info.distortion_model not in ("plumb_bob", ""):
        raise IntrinsicsError(f"distortion model '{info.distortion_model}'; expected plumb_bob, or rectified images")
    k = info.k
    if any(k[index] != 0.0 for index in (1, 3, 6, 7)):
        raise IntrinsicsError(
            f"camera matrix K {[float(number) for number in k]}: expected no skew, [fx 0 cx 0 fy cy 0 0 1]"
        )
    return CameraIntrinsics(
        width=info.width, height=info.height, fx=k[0], fy=k[4], cx=k[2], cy=k[5], distortion=np.array(info.d)
    )


def same_camera(one: CameraIntrinsics | None, other: CameraIntrinsics) -> bool:
    """Say whether two cameras have the same numbers."""
    if one is None:
        return False
    return all(np.array_equal(value, getattr(other, name)) for name, value in vars(one).items())


def layout_of(image: Any) -> ImageLayout:
    """Return how the bytes of a sensor_msgs/Image lie."""
    return ImageLayout(height=image.height, width=image.width, step=image.step, is_bigendian=bool(image.is_bigendian))


def depth_from_image(image: Any, frame: str, scale: float) -> NDArray:
    """Return the depth (h, w) [m] of a sensor_msgs/Image, NaN where there is none.

    Args:
        image: 16UC1 in steps of `scale`, or 32FC1 [m].
        frame: in which it has to come.
        scale: one step of a 16-bit image [m].

    Raises:
        ObservationError: the frame is another one.
        ImageError: encoding or size are wrong.
    """
    check_frame(image, frame, "the depth image")
    return decode_depth(image.data, image.encoding, layout_of(image), scale)


def mask_from_image(image: Any, frame: str) -> NDArray[np.bool_]:
    """Return the mask (h, w) of a sensor_msgs/Image of 8 bits; not zero is the object.

    Raises:
        ObservationError: the frame is another one.
        ImageError: encoding or size are wrong.
    """
    check_frame(image, frame, "the mask")
    if image.encoding not in MASKS:
        raise ImageError(f"mask: encoding '{image.encoding}'; expected {' or '.join(MASKS)}")
    return unpack_rows("mask", image.data, np.dtype(np.uint8), layout_of(image)) != 0


def read_stamp(data: bytes) -> int:
    """Return the stamp [ns] of a message with a header from its CDR bytes, of which nothing else is read."""
    seconds, rest = struct.unpack_from("<iI" if data[1] & 1 else ">iI", data, 4)
    return NANOSECONDS * seconds + rest


def check_frame(message: Any, frame: str, what: str) -> None:
    """Refuse a message of another coordinate frame.

    Raises:
        ObservationError: `header.frame_id` is not `frame`.
    """
    if message.header.frame_id != frame:
        raise ObservationError(f"{what} came in the frame '{message.header.frame_id}'; expected '{frame}'")


def check_cloud(cloud: Any, frame: str, what: str) -> None:
    """Refuse a cloud of another frame, or one of several rows.

    Raises:
        ObservationError: the frame or the height is wrong.
    """
    check_frame(cloud, frame, what)
    if cloud.height != 1:
        raise ObservationError(f"{what} came as {cloud.height} x {cloud.width} points; expected height 1")


def color_from_image(message: Any) -> NDArray[np.uint8]:
    """Return the colours (h, w, 3), red green blue, of a sensor_msgs/Image, without a copy where its bytes lie so.

    Raises:
        ImageError: the encoding is not known, or the data do not fill the image.
    """
    return decode_color(np.frombuffer(message.data, dtype=np.uint8), message.encoding, layout_of(message))
