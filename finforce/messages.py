"""ROS messages into stamps, poses, wrenches, images, columns of clouds, and which of them belong to one image.

Any object with a message's attributes will do.
"""

from __future__ import annotations

import math
import struct
from collections import deque
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from dataclasses import fields as fields_of
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from finforce.camera import (
    MILLIMETRE,
    PACKET,
    PLUMB_BOB,
    CameraIntrinsics,
    ImageError,
    ImageLayout,
    decode_color,
    decode_depth,
    decode_picture,
    name_lens,
    name_matrix,
    open_picture,
    unpack_rows,
)
from finforce.errors import ObservationError, PoseError
from finforce.transforms import pose_from_quaternion
from finforce.video_packets import PacketDecoder

NANOSECONDS = 1_000_000_000  # in a second
SECOND = 1e-9  # a nanosecond [s]
# sensor_msgs/msg/PointField: INT8 = 1 ... FLOAT64 = 8
DATATYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
STDDEV_COLUMNS = ("stddev_x", "stddev_y", "stddev_z")
_CODES = {np.dtype(name): code for code, name in DATATYPES.items()}


@dataclass(frozen=True)
class PointField:
    """One field of a point cloud, with the attributes of sensor_msgs/PointField."""

    name: str
    offset: int
    datatype: int
    count: int = 1


class EncodedCloud(NamedTuple):
    """The parts of a PointCloud2 of height 1 that depend on its columns."""

    fields: tuple[PointField, ...]
    point_step: int
    data: bytes


class SharedStddev(NamedTuple):
    """Standard deviations of the errors that all key points of an image share.

    Attributes:
        shift: of the points [m], because the position of the jaw is uncertain. They may then also rotate together by a
            few degrees.
        height: of the jaw along its z where poses of an object are compared with it [m].
        scale: relative error of all displacements [-].
        closing: of a shift along the closing axis alone [m]: of a jaw whose reference mark is not seen.
    """

    shift: float = 0.0
    height: float = 0.0
    scale: float = 0.0
    closing: float = 0.0


NOTHING_SHARED = SharedStddev()
# Columns of a key point cloud.
_SHARED = dict(zip(SharedStddev._fields, ("shared", "shared_height", "shared_scale", "shared_closing"), strict=True))


def shared_columns(shared: SharedStddev, count: int) -> dict[str, NDArray[np.float32]]:
    """Return the columns (count,) of a key point cloud that say what its points share."""
    return {_SHARED[name]: np.full(count, value, np.float32) for name, value in shared._asdict().items()}


class Keypoints(NamedTuple):
    """Key points of one cloud: `points (K, 3)` [m], NaN = none; `likelihood (K,)` in [0, 1]; `stddev (K, 3)` [m]."""

    points: NDArray[np.float64]
    likelihood: NDArray[np.float64]
    stddev: NDArray[np.float64] | None
    shared: SharedStddev = NOTHING_SHARED


_LARGEST_POINT = 1 << 16  # bytes


@lru_cache(maxsize=64)
def _layout(entries: tuple[tuple[str, int, int, int], ...], point_step: int, big_endian: bool) -> np.dtype:
    """Build the structured dtype of one point; `entries` are (name, offset, datatype, count)."""
    order = ">" if big_endian else "<"
    names, formats, offsets = [], [], []
    for name, offset, datatype, count in entries:
        if datatype not in DATATYPES:
            raise ObservationError(f"field '{name}' has the unknown datatype {datatype}; expected 1 to 8")
        scalar = np.dtype(order + DATATYPES[datatype])
        if offset < 0 or offset + scalar.itemsize * max(count, 1) > point_step:
            raise ObservationError(f"field '{name}' at offset {offset} leaves a point of {point_step} bytes")
        names.append(name)
        formats.append(scalar if count <= 1 else (scalar, (count,)))
        offsets.append(offset)
    return np.dtype({"names": names, "formats": formats, "offsets": offsets, "itemsize": point_step})


def _wanted(
    fields: Iterable[Any], names: Sequence[str], optional: Sequence[str]
) -> tuple[tuple[str, int, int, int], ...]:
    """Pick the wanted fields; the first of a repeated name wins, unknown ones are ignored."""
    entries: dict[str, tuple[str, int, int, int]] = {}
    for field in fields:
        if field.name in names or field.name in optional:
            entry = (field.name, int(field.offset), int(field.datatype), int(field.count))
            entries.setdefault(field.name, entry)
    missing = [name for name in names if name not in entries]
    if missing:
        raise ObservationError(f"the cloud has no field {', '.join(missing)}; expected {', '.join(names)}")
    return tuple(entries.values())


def _points(cloud: Any, layout: np.dtype) -> NDArray:
    """Return the points of a cloud (width * height,), without the padding of its rows."""
    width, height, row_step = int(cloud.width), int(cloud.height), int(cloud.row_step)
    used = width * layout.itemsize
    step = used if height == 1 else row_step
    if step < used:
        raise ObservationError(f"row_step is {row_step} bytes; {width} points of {layout.itemsize} need {used}")
    buffer = np.frombuffer(cloud.data, dtype=np.uint8)
    needed = step * (height - 1) + used
    if buffer.size < needed:
        raise ObservationError(f"the cloud's buffer holds {buffer.size} bytes; {needed} were announced")
    return np.ndarray((height, width), layout, buffer, strides=(step, layout.itemsize)).reshape(-1)


def encode_cloud(columns: Mapping[str, ArrayLike]) -> EncodedCloud:
    """Pack columns of equal length into the little-endian buffer of a PointCloud2 of height 1.

    Args:
        columns: name -> (n,) or (n, count) array; the field takes the array's type, in this order.

    Returns:
        The field descriptions, the bytes per point and the buffer; `decode_columns` inverts it.

    Raises:
        ObservationError: the columns differ in length or have a type that PointField lacks.
    """
    arrays = {name: np.asarray(values) for name, values in columns.items()}
    lengths = {array.shape[:1] for array in arrays.values()}
    if len(lengths) > 1:
        sizes = ", ".join(f"{name} {array.shape}" for name, array in arrays.items())
        raise ObservationError(f"the columns of a cloud differ in length: {sizes}")
    fields, layout = _plan(tuple((name, array.dtype, array.shape[1:]) for name, array in arrays.items()))
    table = np.zeros(lengths.pop() if lengths else (0,), dtype=layout)
    for name, array in arrays.items():
        table[name] = array.reshape(table[name].shape)
    return EncodedCloud(fields, layout.itemsize, table.tobytes())


@lru_cache(maxsize=64)
def _plan(columns: tuple[tuple[str, np.dtype, tuple[int, ...]], ...]) -> tuple[tuple[PointField, ...], np.dtype]:
    """Return fields and layout of a point with columns (name, type, shape without the first axis)."""
    for name, kind, shape in columns:
        if kind.newbyteorder("=") not in _CODES or len(shape) > 1:
            raise ObservationError(f"column '{name}' of type {kind}, shape (n, *{shape}) is not a field")
    layout = np.dtype([(name, kind.newbyteorder("<"), shape) for name, kind, shape in columns])
    fields = (
        PointField(name, layout.fields[name][1], _CODES[kind.newbyteorder("=")], *shape)
        for name, kind, shape in columns
    )
    return tuple(fields), layout


@dataclass(eq=False)
class CloudColumns:
    """A point cloud of height 1 that was not packed yet, and need not be within one process.

    Attributes:
        header: of the message.
        columns: name -> (n,) array, which nobody changes.
    """

    header: Any
    columns: Mapping[str, NDArray]
    height: int = 1

    @property
    def width(self) -> int:
        """The number of points."""
        return len(next(iter(self.columns.values()), ()))

    @property
    def fields(self) -> tuple[PointField, ...]:
        """The descriptions of the columns."""
        return _plan(tuple((name, array.dtype, array.shape[1:]) for name, array in self.columns.items()))[0]

    def pick(self, names: Sequence[str], optional: Sequence[str]) -> dict[str, NDArray]:
        """Return columns by name as `decode_columns` does of the packed cloud."""
        if not self.width:
            return {name: np.empty(0) for name in names}
        missing = [name for name in names if name not in self.columns]
        if missing:
            raise ObservationError(f"the cloud has no field {', '.join(missing)}; expected {', '.join(names)}")
        return {name: array for name, array in self.columns.items() if name in names or name in optional}


def decode_columns(cloud: Any, names: Sequence[str], optional: Sequence[str] = ()) -> dict[str, NDArray]:
    """Return columns of a PointCloud2, or any object with its attributes, whatever their order, type and byte order.

    Args:
        cloud: its data may be bytes, array('B') or a uint8 array; `row_step` is ignored for a single row.
        names: columns that must be there.
        optional: columns that are returned when they are there.

    Returns:
        For each name an array (width * height,) with the field's own type in native byte order.

    Raises:
        ObservationError: a field is missing, leaves the point or has several elements, or the buffer is too short.
    """
    if isinstance(cloud, CloudColumns):
        return cloud.pick(names, optional)
    width, height, point_step = int(cloud.width), int(cloud.height), int(cloud.point_step)
    if min(width, height) < 0 or not 0 <= point_step <= _LARGEST_POINT:
        raise ObservationError(f"{height} rows of {width} points of {point_step} bytes; expected a cloud")
    if not width * height:
        return {name: np.empty(0) for name in names}
    layout = _layout(_wanted(cloud.fields, names, optional), point_step, bool(cloud.is_bigendian))
    for name in layout.names:
        if layout[name].shape:
            raise ObservationError(f"field '{name}' has {layout[name].shape[0]} numbers a point; expected count 1")
    table = _points(cloud, layout)
    return {name: np.ascontiguousarray(table[name], dtype=table[name].dtype.newbyteorder("=")) for name in layout.names}


def decode_keypoints(cloud: Any) -> Keypoints:
    """Return points, likelihood and standard deviations of a key point cloud (any object like a PointCloud2).

    A cloud without the field `likelihood` gets ones. Rows whose field `valid` is zero, if there is one, become NaN.

    Raises:
        ObservationError: the cloud has no x, y, z, its buffer is too short, it has some of the fields `stddev_x`,
            `stddev_y`, `stddev_z` and not all, or a point states what is no standard deviation.
    """
    columns = decode_columns(cloud, ("x", "y", "z"), ("likelihood", "valid", *_SHARED.values(), *STDDEV_COLUMNS))
    points = _stack(columns, ("x", "y", "z"))
    valid, likelihood = columns.get("valid"), columns.get("likelihood")
    if valid is not None:
        points[valid == 0] = np.nan
    ones = np.ones(len(points))
    stddev = _stated(columns, points)
    shared = SharedStddev(
        **{name: float(columns[column].max(initial=0.0)) for name, column in _SHARED.items() if column in columns}
    )
    return Keypoints(points, ones if likelihood is None else likelihood.astype(np.float64), stddev, shared)


def _stated(columns: Mapping[str, NDArray], points: NDArray[np.float64]) -> NDArray[np.float64] | None:
    """Return the standard deviations (K, 3) [m] of a cloud's points, None when it states none."""
    have = [name for name in STDDEV_COLUMNS if name in columns]
    if not have:
        return None
    if len(have) < len(STDDEV_COLUMNS):
        raise ObservationError(f"the cloud has {', '.join(have)}; expected all of {', '.join(STDDEV_COLUMNS)}, or none")
    stddev = _stack(columns, STDDEV_COLUMNS)
    check_stddev(stddev, points)
    return stddev


def check_stddev(stddev: NDArray, points: NDArray) -> None:
    """Refuse what cannot be the standard deviations (K, 3) [m] of key points (K, 3) [m], NaN where there is none.

    Raises:
        ObservationError: another shape, or a point with a standard deviation that is not a number above zero.
    """
    if stddev.shape != points.shape:
        raise ObservationError(f"standard deviations of shape {stddev.shape}, expected {points.shape}")
    there = np.isfinite(points).all(axis=1)[:, None]
    odd = there & ~((stddev > 0.0) & (stddev < np.inf))
    if odd.any():
        row, axis = np.argwhere(odd)[0]
        raise ObservationError(
            f"key point {row} states the standard deviation {stddev[row, axis]:g} m along {'xyz'[axis]}, expected a "
            "number above zero; a point that must not be used has valid = 0 or NaN coordinates"
        )


def _stack(columns: Mapping[str, NDArray], names: Sequence[str]) -> NDArray[np.float64]:
    """Return columns (K,) side by side (K, 3)."""
    stacked = np.stack([columns.get(name, np.empty(0)) for name in names], axis=-1).astype(np.float64)
    if stacked.ndim != 2:
        raise ObservationError(f"{', '.join(names)} of a key point cloud must be single numbers (count 1)")
    return stacked


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


def pose_from_transform(transform: Any) -> NDArray:
    """Return the pose (4, 4) of a geometry_msgs/Transform.

    Raises:
        PoseError: a number is not finite, or the quaternion is no unit quaternion.
    """
    place, turn = transform.translation, transform.rotation
    return pose_from_quaternion((place.x, place.y, place.z), (turn.x, turn.y, turn.z, turn.w))


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


_LEAST_LENGTH = 1e-6  # of what is a direction


def direction_from_message(message: Any, frame: str, what: str) -> NDArray:
    """Return the unit vector (3,) of a geometry_msgs/Vector3Stamped in `frame`, whatever its length.

    Raises:
        ObservationError: the frame is another one, a number is not finite, or the length is next to nothing.
    """
    check_frame(message, frame, what)
    return check_direction([message.vector.x, message.vector.y, message.vector.z], what)


def check_direction(vector: ArrayLike, what: str) -> NDArray:
    """Return the unit vector (3,) of a direction of any length.

    Raises:
        ObservationError: it is no vector, a number is not finite, or the length is next to nothing.
    """
    vector = np.asarray(vector, dtype=float)
    length = float(np.linalg.norm(vector)) if vector.shape == (3,) else np.nan
    if not _LEAST_LENGTH < length < np.inf:
        raise ObservationError(f"{what} is {vector.tolist()}, expected a direction: three finite numbers, not all zero")
    return vector / length


def magnitude_stddev(axes: Sequence[float]) -> float:
    """Return the standard deviation [N] of the magnitude of a jaw's force: that along x, the closing direction.

    What is uncertain across it, as friction, changes the direction and hardly the magnitude.

    Args:
        axes: standard deviations of the force along x, y and z [N].

    Raises:
        ObservationError: one is no finite number from 0.
    """
    x, y, z = (float(value) for value in axes)
    if not all(math.isfinite(value) and value >= 0.0 for value in (x, y, z)):
        raise ObservationError(f"the force's standard deviation: got {(x, y, z)} N, expected finite numbers from 0")
    return x


def camera_from_info(info: Any, frame: str, images: str = "") -> CameraIntrinsics:
    """Return the intrinsics of a sensor_msgs/CameraInfo for the images on a topic.

    Those of image_proc, image_rect*, are rectified: the projection matrix is theirs, without a lens.

    Raises:
        ObservationError: the frame is another one.
        IntrinsicsError: the numbers are no camera's, its axes are skew, or its distortion model is not known.
    """
    check_frame(info, frame, "the camera info")
    model = name_lens(info.distortion_model) or PLUMB_BOB
    matrix, distortion = np.ravel(info.k), np.array(info.d)
    rectified = np.reshape(info.p, (3, 4))[:, :3].ravel()
    if "/image_rect" in images and rectified.any() and not np.allclose(rectified, matrix):  # RealSense's P is its K
        matrix, distortion, model = rectified, np.zeros(0), PLUMB_BOB
    return CameraIntrinsics(
        width=info.width,
        height=info.height,
        **name_matrix([float(number) for number in matrix]),
        distortion=distortion,
        model=model,
    )


def same_camera(one: CameraIntrinsics | None, other: CameraIntrinsics) -> bool:
    """Say whether two cameras have the same numbers."""
    if one is None:
        return False
    return all(np.array_equal(getattr(one, entry.name), getattr(other, entry.name)) for entry in fields_of(one))


def layout_of(image: Any) -> ImageLayout:
    """Return how the bytes of a sensor_msgs/Image lie."""
    return ImageLayout(height=image.height, width=image.width, step=image.step, is_bigendian=bool(image.is_bigendian))


DEPTH_FORMAT = "16UC1; compressedDepth png"
DEPTH_HEADER = 12  # bytes of compressed_depth_image_transport: an enum and two numbers for 32-bit depth
_PNG = b"\x89PNG"
_STEPPED = ("", "16UC1", "mono16")  # what a png of depth in steps can be said to hold


def depth_from_message(message: Any, scale: float = MILLIMETRE) -> NDArray[np.float32]:
    """Return the depth image (h, w) [m], NaN invalid, of a sensor_msgs/Image or CompressedImage.

    One step of 16 bits is `scale` [m].

    Raises:
        ImageError: the encoding is not known, or the data are damaged.
    """
    if not hasattr(message, "format"):
        return decode_depth(message.data, message.encoding, layout_of(message), scale)
    pixels = depth_steps(message)
    return decode_depth(pixels, depth_encoding(pixels), scale=scale)


def depth_encoding(pixels: NDArray) -> str:
    """Return the encoding of what `depth_steps` returns."""
    return "32FC1" if pixels.dtype == np.float32 else "16UC1"


def depth_steps(message: Any) -> NDArray[np.uint16] | NDArray[np.float32]:
    """Return the depth image (h, w) in steps, most cameras' are of 1 mm, or of 32FC1 in metres, 0 invalid.

    Raises:
        ImageError: it is no 16-bit png, or its inverse depths have no scale.
    """
    encoding = message.format.partition(";")[0].strip() if ";" in message.format else ""
    if encoding not in (*_STEPPED, "32FC1"):
        raise ImageError(f"depth image {message.format!r}: encoding {encoding}; expected '{DEPTH_FORMAT}'")
    data = bytes(message.data)
    begin = data.find(_PNG, 0, DEPTH_HEADER + len(_PNG))
    if begin < 0:
        raise ImageError(f"depth image {message.format!r}: no png in it; expected '{DEPTH_FORMAT}', or depth=none")
    image = np.array(open_picture(data[begin:], f"depth image {message.format!r}"))
    if image.ndim != 2 or image.dtype.kind not in "ui" or image.dtype == np.uint8:
        raise ImageError(f"depth image {message.format!r}: {image.dtype} {image.shape}; expected 16 bits, one channel")
    steps = np.clip(image, 0, 65535).astype(np.uint16)
    return _metres_of_inverse(steps, data[:begin], message.format) if encoding == "32FC1" else steps


def _metres_of_inverse(steps: NDArray[np.uint16], header: bytes, what: str) -> NDArray[np.float32]:
    """Return depth [m], 0 invalid, of steps of inverse depth, as compressed_depth_image_transport packs 32-bit depth.

    Raises:
        ImageError: the header does not tell their scale.
    """
    scale, shift = struct.unpack_from("<ff", header, 4) if len(header) == DEPTH_HEADER else (0.0, 0.0)
    if not (np.isfinite(scale) and np.isfinite(shift) and scale > 0.0 and shift < 1.0):
        raise ImageError(f"depth image {what!r}: its header has no scale of the inverse depths")
    return np.where(steps > 0, np.float32(scale) / (steps - np.float32(shift)), np.float32(0.0))


def mask_from_message(message: Any) -> NDArray[np.bool_]:
    """Return the mask (h, w) of a sensor_msgs/Image of 8 bits, or a compressed one; not zero is the object.

    Raises:
        ImageError: encoding or size are wrong.
    """
    if hasattr(message, "format"):
        return decode_picture(message.data, f"mask {message.format!r}").any(axis=2)
    if message.encoding not in MASKS:
        raise ImageError(f"mask: encoding '{message.encoding}'; expected {' or '.join(MASKS)}")
    return unpack_rows("mask", message.data, np.dtype(np.uint8), layout_of(message)) != 0


_STAMPED = 12  # bytes: the encapsulation's four, and the stamp's eight


def read_stamp(data: bytes) -> int:
    """Return the stamp [ns] of a message with a header from its CDR bytes, of which nothing else is read.

    Raises:
        ObservationError: the bytes are too few.
    """
    if len(data) < _STAMPED:
        raise ObservationError(f"{len(data)} bytes are no message with a header")
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


def is_packet(message: Any) -> bool:
    """Say whether an image is a packet of a video, which needs those before it: of H.264 or H.265."""
    return hasattr(message, "format") and bytes(message.data[: len(PACKET[0])]).startswith(PACKET)


def color_from_message(message: Any, video: PacketDecoder | None = None) -> NDArray[np.uint8]:
    """Return the colours (h, w, 3), red green blue, of a sensor_msgs/Image, without a copy where its bytes lie so.

    Of a sensor_msgs/CompressedImage the jpeg, png or packet of H.264 is decoded, the latter by a decoder that has had
    those before it; without one, only key frames can be.

    Raises:
        MissingFrameError: a packet is damaged, or what it is predicted from is missing.
        ImageError: the encoding is not known, the data do not fill the image, or the picture is damaged.
    """
    if is_packet(message) and not any(name in message.format.lower() for name in ("265", "hevc")):
        what = f"colour image {message.format!r}"
        return (video or PacketDecoder()).decode(bytes(message.data), stamp_of(message), what)
    if hasattr(message, "format"):
        return decode_picture(message.data, f"colour image {message.format!r}")
    return decode_color(np.frombuffer(message.data, dtype=np.uint8), message.encoding, layout_of(message))


class CameraStream:
    """The messages of one camera: those of one frame, the named one, else that of the first message.

    Attributes:
        frame: of the camera, empty while it is not known.
        camera: its intrinsics, None until they came.
        video: decoder of the colour images that are packets.

    Args:
        frame: of the camera; empty while it is not known.
        depth_scale: a step of depth images of 16 bits [m].
        topic: of images; see `camera_from_info`.
    """

    def __init__(self, frame: str = "", depth_scale: float = MILLIMETRE, topic: str = "") -> None:
        self.frame, self._is_sure, self._depth_scale, self._topic = frame, bool(frame), depth_scale, topic
        self.camera: CameraIntrinsics | None = None
        self._numbers: tuple[Any, ...] = ()
        self.video = PacketDecoder()

    def frame_of(self, message: Any, *, is_sure: bool = True) -> str:
        """Return the frame, which is that of this message where none was known, or none for sure."""
        if not self.frame or (is_sure and not self._is_sure):
            self.frame, self._is_sure = message.header.frame_id, is_sure
        return self.frame

    def take_info(self, info: Any) -> bool:
        """Take a sensor_msgs/CameraInfo and say whether it is another camera's than the last.

        Raises:
            ObservationError: the frame is another one.
            IntrinsicsError: the numbers are no camera's.
        """
        frame, arrays = self.frame_of(info), (np.asarray(numbers).tobytes() for numbers in (info.d, info.k, info.p))
        numbers = (info.width, info.height, info.distortion_model, *arrays)
        if numbers == self._numbers:  # most come with every image
            check_frame(info, frame, "the camera info")
            return False
        camera = camera_from_info(info, frame, self._topic)
        is_new = not same_camera(self.camera, camera)
        if is_new:
            self.camera = camera
        self._numbers = numbers
        return is_new

    def known_camera(self, topic: str) -> CameraIntrinsics:
        """Return the intrinsics; raises ImageError where none came on their topic yet."""
        if self.camera is None:
            raise ImageError(f"images came, but no camera_info on {topic} yet")
        return self.camera

    def read_color(self, message: Any) -> NDArray[np.uint8]:
        """Return the colours of an image as `color_from_message`; raises ObservationError for another frame."""
        check_frame(message, self.frame_of(message), "the colour image")
        return color_from_message(message, self.video)

    def read_depth(self, message: Any) -> NDArray[np.float32]:
        """Return the depth of an image as `depth_from_message`; raises ObservationError for another frame."""
        check_frame(message, self.frame_of(message), "the depth image")
        return depth_from_message(message, self._depth_scale)

    def read_mask(self, message: Any) -> NDArray[np.bool_]:
        """Return the mask of an image as `mask_from_message`; raises ObservationError for another frame."""
        check_frame(message, self.frame_of(message), "the mask")
        return mask_from_message(message)


@dataclass(frozen=True, eq=False)
class Stamped:
    """Something and the stamp of its image [ns]."""

    stamp: int
    value: Any


class Synchronizer:
    """Keeps the newest entries of several streams and finds those that belong to one image.

    Args:
        streams: their names, each with the number of entries that are kept of it, None for all.
        tolerance: greatest distance between stamps that belong together [ns].
    """

    def __init__(self, streams: dict[str, int | None], tolerance: int = 0) -> None:
        self._streams: dict[str, deque[Stamped]] = {name: deque(maxlen=depth) for name, depth in streams.items()}
        self.tolerance = tolerance

    def reset(self, *streams: str) -> None:
        """Forget the entries of some streams, of all without a name."""
        for name in streams or self._streams:
            self._streams[name].clear()

    def belong(self, one: int, other: int) -> bool:
        """Return whether two stamps [ns] are those of one image."""
        return abs(one - other) <= self.tolerance

    def add(self, stream: str, stamp: int, value: Any) -> None:
        """Keep an entry of a stream, and forget its oldest where there are too many."""
        self._streams[stream].append(Stamped(stamp, value))

    def entries(self, stream: str) -> deque[Stamped]:
        """Return the entries of a stream in the order of their arrival."""
        return self._streams[stream]

    def nearest(self, stream: str, stamp: int) -> Stamped | None:
        """Return the entry of a stream that is nearest to a stamp [ns], the oldest of equals."""
        return min(self._streams[stream], key=lambda entry: abs(entry.stamp - stamp), default=None)

    def find(self, stream: str, stamp: int) -> Stamped | None:
        """Return the nearest entry of a stream to a stamp [ns], None where none belongs to it."""
        found = self.nearest(stream, stamp)
        return found if found is not None and self.belong(found.stamp, stamp) else None

    def take(self, stream: str, stamp: int) -> Stamped | None:
        """Return the entry that `find` finds, and forget it."""
        found = self.find(stream, stamp)
        if found is not None:
            self._streams[stream].remove(found)
        return found

    def newest_pair(self, stream: str, other: str) -> tuple[Stamped, Stamped] | None:
        """Return the newest entry of a stream that has one of another stream, with that one."""
        for entry in reversed(self._streams[stream]):
            found = self.find(other, entry.stamp)
            if found is not None:
                return entry, found
        return None


_SLOWEST = 100_000_000  # [ns] period of a camera whose depth may be half of it away
_NEAREST = 0.55  # of a period that the nearest of two images may be away, with a tenth for the jitter of stamps


def pairing_tolerance(stamps: Sequence[int] | NDArray[np.int64]) -> int:
    """Return how far [ns] depth may be from colour images with rising stamps (n,) [ns]; 0 of fewer than two."""
    return round(_NEAREST * min(median_period(stamps), _SLOWEST))


def median_period(stamps: Sequence[int] | NDArray[np.int64]) -> float:
    """Return the median distance of rising stamps (n,) [ns], 0 of fewer than two."""
    return float(np.median(np.diff(stamps))) if len(stamps) > 1 else 0.0


def find_nearest(times: NDArray[np.int64], stamps: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return for each of the stamps (n,) the index of the nearest of times (m,) in any order, the earlier of equals."""
    order = np.argsort(times, kind="stable")
    rising = times[order]
    after = np.clip(np.searchsorted(rising, stamps), 0, len(rising) - 1)
    before = np.maximum(after - 1, 0)
    return order[np.where(stamps - rising[before] <= rising[after] - stamps, before, after)]
