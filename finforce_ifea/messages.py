"""Messages into observations and contacts, kept while they are fresh; outlines as clouds; the look of markers."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from finforce.errors import ObservationError
from finforce.messages import check_cloud, decode_columns, decode_keypoints, direction_from_message, stamp_of
from finforce_ifea.errors import ContactError
from finforce_ifea.observation import Contact, ObjectOutline, Observation, are_same_polygons
from finforce_ifea.posture import WristPosture

if TYPE_CHECKING:
    from finforce_ifea.jaw.jaw import Jaw
    from finforce_ifea.parameters import NodeParameters

# How contact and force look in RViz and Foxglove, live and in recordings.
CONTACT = (1.0, 0.8, 0.0, 1.0)
FORCE = (0.9, 0.1, 0.6, 1.0)
NEWTONS_PER_METRE = 200.0  # 5 N are drawn 25 mm long, a third of a bench finger
CONTACT_DIAMETER = 0.005
ARROW = (0.002, 0.004, 0.005)  # shaft, head, head length


def observation_from_cloud(cloud: Any, frame: str, posture: WristPosture | None = None) -> Observation:
    """Return the key points of a sensor_msgs/PointCloud2 in the jaw frame `frame`.

    Args:
        cloud: one row per key point.
        frame: the jaw frame.
        posture: of the jaw, None where unknown.

    Raises:
        ObservationError: the frame, the height, the fields, a standard deviation or the buffer are wrong.
    """
    check_cloud(cloud, frame, "the key points")
    seen = decode_keypoints(cloud)
    stamp = cloud.header.stamp.sec + 1e-9 * cloud.header.stamp.nanosec
    return Observation(stamp=stamp, posture=posture, **seen._asdict())


def contact_from_cloud(cloud: Any, frame: str, *, free: bool) -> Contact:
    """Return the contact of a sensor_msgs/PointCloud2; no rows say that there is no object.

    Weights default to one. `touching` holds if any row touches, and is None in a cloud that does not say.

    Args:
        cloud: points on the undeformed inner surface, in the jaw frame.
        frame: the jaw frame.
        free: True if the solver may move the contact.

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


def columns_from_contact(contact: Contact, candidates: NDArray) -> dict[str, NDArray]:
    """Return the columns of a contact, with the nearest of the jaw's candidates by their heights (c,) [m]."""
    points = np.asarray(contact.points, np.float32)
    nearest = np.abs(candidates - contact.points[:, 2, None]).argmin(axis=1)
    return dict(zip("xyz", points.T, strict=True)) | {
        "candidate": nearest.astype(np.uint16),
        "touching": np.full(len(points), bool(contact.touching), np.uint8),
        "weight": np.asarray(contact.weights, np.float32),
    }


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
    polygons = tuple(np.split(np.ascontiguousarray(cut.T), 1 + np.flatnonzero(np.diff(polygon))))
    known = previous.polygons if previous else ()
    return ObjectOutline(
        polygons=known if are_same_polygons(known, polygons) else polygons,  # what was computed from them still holds
        origin=middle_now - turn @ middle_cut,
        tilt=tilt,
        stddev=values[5:, 0].copy(),
        across=np.array([columns[name][0] for name in ACROSS], float) if set(ACROSS) <= set(columns) else None,
    )


# Rows with which an image is still solved in time; a contact has a row every few millimetres, an outline some hundred.
MOST_ROWS, MOST_CORNERS = 500, 5000
IN_STEP = 2  # images in a row whose contacts came in time, after which the next one waits for its own


class ContactFeed:
    """Keeps the newest contact and the object's newest outline, and gives them away while they are fresh.

    Args:
        frame: the jaw frame, in which contacts have to come.
        fixed: a contact that holds for ever, instead of messages.
        free: True if the solver may move a contact that came by message.
        max_age: greatest distance between the stamps of contact and image [ns].
        timeout: after an image, in which its contact comes in time [s].
    """

    def __init__(self, *, frame: str, fixed: Contact | None, free: bool, max_age: int, timeout: float = 0.0) -> None:
        self._timeout = timeout
        self._frame, self._fixed, self._free, self._max_age = frame, fixed, free, max_age
        self._contact: Contact | None = None
        self._outline: ObjectOutline | None = None
        self._cut: ObjectOutline | None = None
        self._stamp = self._outline_stamp = 0
        self._image, self._seen, self._in_time = 0, -math.inf, 0

    def expect(self, stamp: int, now: float) -> bool:
        """Note that an image [ns] has come at a time [s]; return whether its contact will, and is worth waiting for."""
        if self._is_there(self._image) is False:
            self._in_time = 0
        self._image, self._seen = stamp, now
        return not (self.is_fixed or self._is_there(stamp)) and self._in_time >= IN_STEP

    def completes(self, now: float) -> bool:
        """Say whether the contact of the last image is there, at a time [s]; outlines come before their contacts."""
        is_there, is_next = self._is_there(self._image), self._is_there(self._image + 1)
        self._in_time = self._in_time + 1 if is_next or (is_there and now - self._seen <= self._timeout) else 0
        return is_there

    def _is_there(self, stamp: int) -> bool:
        return min(self._stamp, self._outline_stamp) >= stamp

    @property
    def is_fixed(self) -> bool:
        """True if messages are needed at all."""
        return self._fixed is not None

    def take(self, cloud: Any, stamp: int) -> None:
        """Keep the contact of a sensor_msgs/PointCloud2; one that cannot be read leaves none.

        Raises:
            ObservationError: the frame, the height, the fields, the buffer or the number of rows are wrong.
            ContactError: a coordinate or a weight is not finite.
        """
        self._contact, self._stamp = None, stamp
        _check_size(cloud, MOST_ROWS, "the contact")
        self._contact = contact_from_cloud(cloud, self._frame, free=self._free)

    def take_outline(self, cloud: Any, stamp: int) -> None:
        """Keep the object's outline of a sensor_msgs/PointCloud2; one that cannot be read leaves none.

        Raises:
            ObservationError: the frame, the height, the fields, the buffer or the number of rows are wrong.
            ContactError: the corners are no outline.
        """
        self._outline, self._outline_stamp = None, stamp
        _check_size(cloud, MOST_CORNERS, "the outline")
        self._outline = outline_from_cloud(cloud, self._frame, self._cut)
        self._cut = self._outline or self._cut

    def at(self, stamp: int) -> Contact | None:
        """Return the contact for an image [ns], None if none is known or the known one is too old.

        It carries the object's outline while that is fresh; the same messages give the same object again.
        """
        if self._fixed is not None:
            return self._fixed
        if self._contact is None or abs(stamp - self._stamp) > self._max_age:
            return None
        fresh = abs(stamp - self._outline_stamp) <= self._max_age and len(self._contact.points)
        outline = self._outline if fresh else None
        if outline is not self._contact.outline:
            self._contact = replace(self._contact, outline=outline)
        return self._contact


def _check_size(cloud: Any, most: int, what: str) -> None:
    """Refuse a cloud of more than `most` rows, or with fields of several numbers each."""
    rows = cloud.width * cloud.height
    if rows > most:
        raise ObservationError(f"{what} came with {rows} rows; expected {most} at most")
    wide = [field.name for field in cloud.fields if field.count > 1]
    if wide:
        raise ObservationError(f"{what} came with several numbers in the field {', '.join(wide)}; expected one each")


class PostureFeed:
    """Keeps the posture of the gripper, and gives it away while it is fresh.

    Args:
        parameters: of the node.
    """

    def __init__(self, parameters: NodeParameters) -> None:
        self._frame = parameters.base_frame
        self._max_age = round(1e9 * parameters.max_age)
        self._posture: WristPosture | None = None
        self._stamp = 0

    def take(self, message: Any) -> None:
        """Keep a direction in the gripper's frame (geometry_msgs/Vector3Stamped), of any length.

        Raises:
            ObservationError: it is in another frame, or no direction.
        """
        self.keep(stamp_of(message), WristPosture(direction_from_message(message, self._frame, "gravity")))

    def keep(self, stamp: int, posture: WristPosture) -> None:
        """Keep a posture of the gripper, of a time [ns]."""
        self._posture, self._stamp = posture, stamp

    def at(self, stamp: int) -> WristPosture | None:
        """Return the posture of the gripper; None farther from an image [ns] than `max_age`."""
        return self._posture if abs(stamp - self._stamp) <= self._max_age else None


def build_contact_feed(jaw: Jaw, parameters: NodeParameters) -> ContactFeed:
    """Return the source of contacts that the parameters ask for.

    Raises:
        ContactError: the fixed height is not on the jaw.
    """
    height = parameters.contact_height
    return ContactFeed(
        frame=parameters.frame,
        fixed=None if math.isnan(height) else Contact.fixed(jaw, height),
        free=parameters.contact_free,
        max_age=round(1e9 * parameters.max_age),
        timeout=parameters.contact_timeout,
    )
