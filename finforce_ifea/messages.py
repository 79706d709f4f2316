"""Messages into observations and contacts; outlines to and from the columns of a point cloud; the look of markers."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from finforce.messages import check_cloud, decode_columns, decode_keypoints
from finforce_ifea.errors import ContactError
from finforce_ifea.observation import Contact, ObjectOutline, Observation, are_same_polygons

# How contact and force look in RViz and Foxglove, live and in recordings.
CONTACT = (1.0, 0.8, 0.0, 1.0)
FORCE = (0.9, 0.1, 0.6, 1.0)
NEWTONS_PER_METRE = 200.0  # 5 N are drawn 25 mm long, a third of a bench finger
CONTACT_DIAMETER = 0.005
ARROW = (0.002, 0.004, 0.005)  # shaft, head, head length


def observation_from_cloud(cloud: Any, frame: str, gravity: NDArray | None = None) -> Observation:
    """Return the key points of a sensor_msgs/PointCloud2 in the jaw frame `frame`.

    Args:
        cloud: one row per key point.
        frame: the jaw frame.
        gravity: its direction (3,) there, None where unknown.

    Raises:
        ObservationError: the frame, the height, the fields, a standard deviation or the buffer are wrong.
    """
    check_cloud(cloud, frame, "the key points")
    points, likelihood, stddev = decode_keypoints(cloud)
    stamp = cloud.header.stamp.sec + 1e-9 * cloud.header.stamp.nanosec
    return Observation(stamp=stamp, points=points, likelihood=likelihood, stddev=stddev, gravity=gravity)


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
    return outline_from_columns(decode_columns(cloud, COLUMNS, ACROSS), previous)


STDDEVS = ("stddev_x", "stddev_z", "stddev_tilt")
ACROSS = ("across", "stddev_across")
COLUMNS = ("x", "z", "u", "v", "polygon", *STDDEVS)
# Corners that come out farther than this from a turned and shifted outline were not made from one [m].
_RIGID = 1e-5


def columns_from_outline(outline: ObjectOutline | None) -> dict[str, NDArray]:
    """Return the columns of an outline, without rows when there is none.

    `x y z` [m] are the corners now, in the jaw frame, `u v` [m] as they were cut, about the outline's origin; the
    motion from `u v` to `x z` is the outline's place and tilt.
    """
    across = None if outline is None else outline.across
    if outline is None:
        corners, sizes, stddev = np.empty((0, 4)), [], np.zeros(3)
    else:
        corners = np.hstack([np.concatenate(outline.placed()), np.concatenate(outline.polygons)])
        sizes, stddev = [len(polygon) for polygon in outline.polygons], np.asarray(outline.stddev)
    x, z, u, v = corners.astype(np.float32).T
    spread = np.broadcast_to(stddev.astype(np.float32)[:, None], (3, len(x)))
    known = {} if across is None else {name: np.full_like(x, value) for name, value in zip(ACROSS, across, strict=True)}
    return {
        "x": x,
        "y": np.zeros_like(x),
        "z": z,
        "u": u,
        "v": v,
        "polygon": np.repeat(np.arange(len(sizes)), sizes).astype(np.uint16),
        **dict(zip(STDDEVS, spread, strict=True)),
        **known,
    }


def outline_from_columns(columns: Mapping[str, NDArray], previous: ObjectOutline | None = None) -> ObjectOutline | None:
    """Return the outline of such columns, None without rows.

    Place and tilt are the rigid motion with the least squares of x - (c u - s v) - x0 and z - (s u + c v) - z0.

    Args:
        columns: those named in `COLUMNS` and, if known, in `ACROSS`, (n,) each.
        previous: whose polygons are used again, the same objects, when no corner was cut anew.

    Raises:
        ContactError: the corners are no turned and shifted outline, or no outline at all.
    """
    if not len(columns["x"]):
        return None
    values = np.array([columns[name] for name in COLUMNS], dtype=float)
    if not np.isfinite(values).all():
        raise ContactError("the outline has numbers that are not finite")
    now, cut, polygon = values[:2], values[2:4], values[4]
    middle_now, middle_cut = now.mean(1), cut.mean(1)
    about_now, about_cut = now - middle_now[:, None], cut - middle_cut[:, None]
    (xx, xz), (zx, zz) = (about_cut @ about_now.T).tolist()
    tilt = math.atan2(xz - zx, xx + zz)
    turn = np.array([[math.cos(tilt), -math.sin(tilt)], [math.sin(tilt), math.cos(tilt)]])
    if not np.abs(about_now - turn @ about_cut).max() < _RIGID:
        raise ContactError("the corners of the outline are no turned and shifted copy of the outline as it was cut")
    polygons = np.split(np.ascontiguousarray(cut.T), 1 + np.flatnonzero(np.diff(polygon)))
    return ObjectOutline(
        polygons=_known_polygons(tuple(polygons), previous),
        origin=middle_now - turn @ middle_cut,
        tilt=tilt,
        stddev=values[5:, 0].copy(),
        across=np.array([columns[name][0] for name in ACROSS], float) if set(ACROSS) <= set(columns) else None,
    )


def _known_polygons(polygons: tuple[NDArray, ...], previous: ObjectOutline | None) -> tuple[NDArray, ...]:
    """Return the previous polygons when they are equal: what was computed from them still holds."""
    known = previous.polygons if previous else ()
    return known if are_same_polygons(known, polygons) else polygons
