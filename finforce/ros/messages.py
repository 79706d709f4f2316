"""Messages of ROS from arrays and numbers, exact in their stamps."""

from __future__ import annotations

import array
import math
from collections.abc import Mapping, Sequence
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticStatus, KeyValue
from geometry_msgs.msg import Point, Pose, PoseStamped, Quaternion, Twist, TwistStamped, Vector3, Wrench, WrenchStamped
from numpy.typing import ArrayLike, NDArray
from sensor_msgs.msg import Image, PointCloud2, PointField
from std_msgs.msg import ColorRGBA, Header
from visualization_msgs.msg import Marker

from finforce.errors import ObservationError
from finforce.health import Report
from finforce.messages import (
    NANOSECONDS,
    CloudColumns,
    check_cloud,
    check_frame,
    decode_columns,
    encode_cloud,
    magnitude_stddev,
)

MARKERS = {"triangles": Marker.TRIANGLE_LIST, "spheres": Marker.SPHERE_LIST, "arrow": Marker.ARROW}


def stamp_message(stamp: int) -> Time:
    """Return integer nanoseconds as a builtin_interfaces/Time."""
    seconds, rest = divmod(stamp, NANOSECONDS)
    return Time(sec=seconds, nanosec=rest)


def cloud_message(header: Header, columns: Mapping[str, ArrayLike]) -> PointCloud2:
    """Return a cloud of height 1 with one field per column (n,), in their order and type."""
    encoded = encode_cloud(columns)
    return PointCloud2(
        header=header,
        height=1,
        width=len(encoded.data) // encoded.point_step,
        fields=_point_fields(encoded.fields),
        point_step=encoded.point_step,
        row_step=len(encoded.data),
        data=array.array("B", encoded.data),  # an ndarray would be checked byte by byte
        is_dense=all(bool(np.isfinite(values).all()) for values in columns.values()),
    )


def pack(message: Any) -> Any:
    """Return a message as it can be sent: of the columns of a cloud the PointCloud2."""
    return cloud_message(message.header, message.columns) if isinstance(message, CloudColumns) else message


@lru_cache(maxsize=64)
def _point_fields(entries: Sequence[Any]) -> list[PointField]:
    """Return a cloud's fields as messages, which all clouds with these fields share."""
    return [PointField(**vars(entry)) for entry in entries]


def xyz_columns(points: ArrayLike) -> dict[str, NDArray[np.float32]]:
    """Return points (n, 3) as the float32 columns x, y, z."""
    return dict(zip("xyz", np.asarray(points, dtype=np.float32).reshape(-1, 3).T, strict=True))


def image_message(header: Header, picture: NDArray, encoding: str = "rgb8") -> Image:
    """Return a picture (h, w, 3) of red, green and blue, or (h, w) of another encoding, as an image."""
    height, width = picture.shape[:2]
    return Image(
        header=header,
        height=height,
        width=width,
        encoding=encoding,
        step=picture.nbytes // height,
        data=array.array("B", picture.tobytes()),  # an ndarray would be checked byte by byte
    )


def wrench_message(header: Header, force: ArrayLike, torque: ArrayLike = (0.0, 0.0, 0.0)) -> WrenchStamped:
    """Return a wrench from force (3,) [N] and torque (3,) [N m].

    Raises:
        ObservationError: a component is not finite; such a wrench must not leave.
    """
    numbers = _finite("the wrench", *force, *torque)
    return WrenchStamped(header=header, wrench=Wrench(force=_vector(numbers[:3]), torque=_vector(numbers[3:])))


def twist_message(header: Header, linear: ArrayLike) -> TwistStamped:
    """Return a velocity (3,) [m/s] without rotation.

    Raises:
        ObservationError: a component is not finite.
    """
    return TwistStamped(header=header, twist=Twist(linear=_vector(_finite("the velocity", *linear))))


def _finite(what: str, *values: float) -> list[float]:
    """Return numbers of a message; raise ObservationError where one is not finite."""
    numbers = [*map(float, values)]
    if not all(map(math.isfinite, numbers)):
        raise ObservationError(f"{what} is not finite: {numbers}")
    return numbers


def _vector(xyz: Sequence[float]) -> Vector3:
    return Vector3(x=xyz[0], y=xyz[1], z=xyz[2])


def grasp_force(message: WrenchStamped, frame: str) -> float:
    """Return the grasp force [N] of a grasp_wrench, as it came: it may be no number.

    Raises:
        ObservationError: the frame is another one.
    """
    check_frame(message, frame, "the grasp wrench")
    return message.wrench.force.x


def force_stddev(message: WrenchStamped, frame: str) -> float:
    """Return the standard deviation [N] of the magnitude of a jaw's force.

    Raises:
        ObservationError: the frame is another one, or a deviation is no finite number from 0.
    """
    check_frame(message, frame, "the wrench's standard deviation")
    vector = message.wrench.force
    return magnitude_stddev((vector.x, vector.y, vector.z))


def is_touching(cloud: PointCloud2, frame: str) -> bool:
    """Say whether a contact estimator's cloud shows the object to touch the jaw.

    Raises:
        ObservationError: the frame, the height, the fields or the buffer are wrong.
    """
    check_cloud(cloud, frame, "the contact")
    return bool(np.any(decode_columns(cloud, (), ("touching",)).get("touching", 0) == 1))


def pose_message(header: Header, numbers: Sequence[float]) -> PoseStamped:
    """Return a pose from x, y, z [m], qx, qy, qz, qw."""
    x, y, z, *turn = map(float, numbers)
    orientation = Quaternion(**dict(zip("xyzw", turn, strict=True)))
    return PoseStamped(header=header, pose=Pose(position=Point(x=x, y=y, z=z), orientation=orientation))


def status_message(name: str, source: str, report: Report) -> DiagnosticStatus:
    """Return a report as the status `name` of a node `source`."""
    return DiagnosticStatus(
        level=bytes([report.level]),
        name=name,
        message=report.message,
        hardware_id=source,
        values=[KeyValue(key=key, value=value) for key, value in report.values.items()],
    )


class MarkerStyle(NamedTuple):
    """The look of a marker: "triangles", "spheres" or "arrow"; red, green, blue, opacity; its size, by its kind [m]."""

    kind: str
    color: Sequence[float]
    scale: Sequence[float]


def points_marker(
    header: Header, name: str, style: MarkerStyle, points: ArrayLike, colors: Sequence[Sequence[float]] = ()
) -> Marker:
    """Return a marker of points (n, 3) [m]: triangles, spheres or an arrow from the first to the second.

    Args:
        header: stamp and frame.
        name: the marker's namespace; each holds one marker.
        style: kind, colour and size.
        points: in the frame of the header; none of them deletes the marker.
        colors: one per point, in place of that of the style.
    """
    known = [Point(x=x, y=y, z=z) for x, y, z in np.asarray(points, dtype=np.float64).reshape(-1, 3).tolist()]
    return Marker(
        header=header,
        ns=name,
        type=MARKERS[style.kind],
        action=Marker.ADD if known else Marker.DELETE,
        points=known,
        color=ColorRGBA(**dict(zip("rgba", style.color, strict=True))),
        colors=[ColorRGBA(**dict(zip("rgba", entry, strict=True))) for entry in colors],
        scale=_vector(style.scale),
    )
