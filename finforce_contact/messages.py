"""Messages into poses, surfaces and images, contacts into columns."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from finforce.camera import CameraIntrinsics, ImageError, ImageLayout, IntrinsicsError, decode_depth
from finforce.errors import ObservationError, PoseError
from finforce.pointcloud import decode_keypoints
from finforce.transforms import pose_from_quaternion
from finforce_ifea.messages import check_cloud, check_frame

if TYPE_CHECKING:
    from finforce_contact.estimator import ContactEstimate

NANOSECONDS = 1_000_000_000
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


def surface_from_cloud(cloud: Any, frame: str) -> NDArray:
    """Return the deformed vertices (n, 3) [m] of a solver's surface.

    Raises:
        ObservationError: the frame or the fields are wrong, or a vertex is not finite.
    """
    check_cloud(cloud, frame, "the surface")
    points = decode_keypoints(cloud).points
    if not np.isfinite(points).all():
        raise ObservationError("the surface has vertices that are not finite")
    return points


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
    layout = ImageLayout(height=image.height, width=image.width, step=image.step, is_bigendian=bool(image.is_bigendian))
    return decode_depth(image.data, image.encoding, layout, scale)


def mask_from_image(image: Any, frame: str) -> NDArray[np.bool_]:
    """Return the mask (h, w) of a sensor_msgs/Image of 8 bits; not zero is the object.

    Raises:
        ObservationError: the frame is another one.
        ImageError: encoding or size are wrong.
    """
    check_frame(image, frame, "the mask")
    if image.encoding not in MASKS:
        raise ImageError(f"mask: encoding '{image.encoding}'; expected {' or '.join(MASKS)}")
    data = np.frombuffer(image.data, dtype=np.uint8)
    step = image.step or image.width
    if step < image.width or data.size != step * image.height:
        raise ImageError(f"mask: {data.size} bytes with {step} a row; expected {image.height} rows of {image.width}")
    return data.reshape(image.height, step)[:, : image.width] != 0


def contact_columns(estimate: ContactEstimate) -> dict[str, NDArray]:
    """Return the columns of a contact cloud, one row per contact, none without an object."""
    points = np.asarray(estimate.points, dtype=np.float32).reshape(-1, 3)
    return {
        **dict(zip("xyz", points.T, strict=True)),
        "candidate": np.asarray(estimate.candidates, dtype=np.uint16),
        "touching": np.full(len(points), estimate.touching, dtype=np.uint8),
        "weight": np.asarray(estimate.weights, dtype=np.float32),
    }
