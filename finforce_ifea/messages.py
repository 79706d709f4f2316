"""Messages into observations, contacts and forces; any object with a message's attributes will do."""

from __future__ import annotations

import struct
from typing import Any

import numpy as np
from numpy.typing import NDArray

from finforce_health import NANOSECONDS
from finforce_ifea.errors import ContactError, ObservationError
from finforce_ifea.observation import Contact, Observation
from finforce_ifea.outline import ObjectOutline
from finforce_ifea.outline_cloud import COLUMNS, outline_from_columns
from finforce_ifea.pointcloud import decode_columns, decode_keypoints


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


def observation_from_cloud(cloud: Any, frame: str) -> Observation:
    """Return the key points of a sensor_msgs/PointCloud2 in the jaw frame `frame`.

    Raises:
        ObservationError: the frame, the height, the fields, a standard deviation or the buffer are wrong.
    """
    check_cloud(cloud, frame, "the key points")
    points, likelihood, stddev = decode_keypoints(cloud)
    stamp = cloud.header.stamp.sec + 1e-9 * cloud.header.stamp.nanosec
    return Observation(stamp=stamp, points=points, likelihood=likelihood, stddev=stddev)


def contact_from_cloud(cloud: Any, frame: str, *, free: bool) -> Contact:
    """Return the contact of a sensor_msgs/PointCloud2; no rows say that there is no object.

    Weights default to one. `touching` holds if any row touches, and is None in a cloud that does not say.

    Args:
        cloud: points on the undeformed inner surface, in the jaw frame.
        frame: the jaw frame.
        free: whether the solver may move the contact.

    Raises:
        ObservationError: the frame, the height, the fields or the buffer are wrong.
        ContactError: a coordinate or a weight is not finite.
    """
    check_cloud(cloud, frame, "the contact")
    columns = decode_columns(cloud, ("x", "y", "z"), ("weight", "touching"))
    points = np.stack([columns[name] for name in "xyz"], axis=-1).astype(np.float64).reshape(-1, 3)
    weights = columns.get("weight", np.ones(len(points))).astype(np.float64)
    if not (np.isfinite(points).all() and np.isfinite(weights).all()):
        raise ContactError("the contact has coordinates or weights that are not finite")
    touching = bool((columns["touching"] == 1).any()) if "touching" in columns else None
    return Contact(points=points, weights=weights, touching=touching if len(points) else False, free=free)


def outline_from_cloud(cloud: Any, frame: str, previous: ObjectOutline | None) -> ObjectOutline | None:
    """Return the object's outline of a sensor_msgs/PointCloud2, None when it has no rows.

    Args:
        cloud: one row per corner, in the jaw frame.
        frame: the jaw frame.
        previous: whose polygons are used again when no corner was cut anew.

    Raises:
        ObservationError: the frame, the height, the fields or the buffer are wrong.
        ContactError: the corners are no outline.
    """
    check_cloud(cloud, frame, "the outline")
    return outline_from_columns(decode_columns(cloud, COLUMNS), previous)


def force_from_wrench(message: Any, frame: str, what: str) -> NDArray[np.float64]:
    """Return the force (3,) [N] of a geometry_msgs/WrenchStamped.

    Raises:
        ObservationError: the frame is not `frame`, or the force is not finite.
    """
    check_frame(message, frame, what)
    force = message.wrench.force
    values = np.array([force.x, force.y, force.z])
    if not np.isfinite(values).all():
        raise ObservationError(f"{what} is not finite: {values}")
    return values
