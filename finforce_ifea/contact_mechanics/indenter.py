"""Rigid objects pressed into a jaw: what they do to surface points at a place (depth, shape, height).

The second number of a place is the one more thing that key points can tell of an object: of an unknown object its
logarithmic radius, of a known outline its tilt.
"""

from dataclasses import dataclass
from functools import lru_cache
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from finforce_ifea.contact_mechanics.penalty import (
    CELL,
    DistanceField,
    PenaltyContact,
    build_distance_field,
    find_leading,
    press_cylinder,
    press_field,
    read_depth,
)
from finforce_ifea.observation import Contact, ObjectOutline, are_same_polygons
from finforce_ifea.settings import EstimatorSettings

DEPTH, SHAPE, HEIGHT = 0, 1, 2
_OTHER_SIZE = 3.0


@dataclass(frozen=True, kw_only=True)
class ShapeRange:
    """What the second number of a place may do: its bounds, its change at once, and a change that matters no more."""

    low: float
    high: float
    largest_change: float
    settled_change: float


class Indenter(Protocol):
    """A rigid object, endless along y; one with corners may rock between them."""

    shape_range: ShapeRange
    has_corners: bool

    def press(self, points: NDArray, stiffness: NDArray, face_x: float, place: NDArray) -> PenaltyContact:
        """Returns the contact with points (p, 3) [m] at a place (3,); `by_shape` is the derivative by place[SHAPE]."""
        ...

    def find_gap(self, points: NDArray, face_x: float, place: NDArray) -> float:
        """Returns the least distance [m] of points (p, 3) [m] from the object, negative inside."""
        ...

    def find_touch(self, place: NDArray, low: float, high: float) -> float:
        """Returns the depth [m] of first touch with a plane undeformed surface between two heights [m]."""
        ...

    def find_touch_at(self, points: NDArray, face_x: float, place: NDArray) -> float:
        """Returns the depth [m] of first touch with an undeformed surface of points (p, 2), x and z [m]."""
        ...


@dataclass(frozen=True, kw_only=True)
class RoundIndenter:
    """A cylinder of any radius: place (depth [m], ln radius, height of its axis [m])."""

    shape_range: ShapeRange = ShapeRange(
        low=float(np.log(3e-3)), high=float(np.log(0.2)), largest_change=0.15, settled_change=5e-2
    )
    has_corners: bool = False

    def press(self, points: NDArray, stiffness: NDArray, face_x: float, place: NDArray) -> PenaltyContact:
        """See `Indenter`; a larger radius moves the axis away, so that the depth stays."""
        radius = float(np.exp(place[SHAPE]))
        contact = press_cylinder(points, stiffness, face_x + radius - place[DEPTH], place[HEIGHT], radius)
        by_shape = radius * (contact.by_shape + contact.springs[:, :, 0])
        return PenaltyContact(forces=contact.forces, springs=contact.springs, by_shape=by_shape)

    def find_gap(self, points: NDArray, face_x: float, place: NDArray) -> float:
        """See `Indenter`."""
        radius = float(np.exp(place[SHAPE]))
        centre = np.array([face_x + radius - place[DEPTH], place[HEIGHT]])
        return float(np.sqrt(((points[:, [0, 2]] - centre) ** 2).sum(1)).min() - radius)

    def find_touch(self, place: NDArray, low: float, high: float) -> float:
        """See `Indenter`; a round object touches at once."""
        return 0.0

    def find_touch_at(self, points: NDArray, face_x: float, place: NDArray) -> float:
        """See `Indenter`."""
        radius, beside = float(np.exp(place[SHAPE])), points[:, 1] - place[HEIGHT]
        met = np.abs(beside) < radius
        behind = face_x + radius - np.sqrt(radius**2 - beside[met] ** 2) - points[met, 0]
        return float(behind.min(initial=radius))


class OutlineIndenter:
    """A known outline: place (depth [m], tilt [rad], height of its origin [m]); depth 0 touches without tilt."""

    shape_range = ShapeRange(low=-1.0, high=1.0, largest_change=0.03, settled_change=5e-3)
    has_corners = True

    def __init__(self, polygons: tuple[NDArray, ...]) -> None:
        """Builds the distance field of the polygons (n, 2) [m]; raises ContactError for one that is too small."""
        self.polygons = polygons
        self.field: DistanceField = build_distance_field(polygons)

    def describes(self, outline: ObjectOutline) -> bool:
        """Whether an outline has this object's polygons."""
        return are_same_polygons(outline.polygons, self.polygons)

    def resembles(self, other: "OutlineIndenter") -> bool:
        """Whether another outline has about the size of this one, as two cuts of one object do."""
        sizes = [np.ptp(np.concatenate(item.polygons), axis=0) for item in (self, other)]
        return bool((np.abs(np.log(sizes[0] / sizes[1])) < np.log(_OTHER_SIZE)).all())

    def press(self, points: NDArray, stiffness: NDArray, face_x: float, place: NDArray) -> PenaltyContact:
        """See `Indenter`."""
        return press_field(points, stiffness, self.field, self._origin(face_x, place), float(place[SHAPE]))

    def find_gap(self, points: NDArray, face_x: float, place: NDArray) -> float:
        """See `Indenter`."""
        c, s = np.cos(place[SHAPE]), np.sin(place[SHAPE])
        local = (points[:, [0, 2]] - self._origin(face_x, place)) @ np.array([[c, -s], [s, c]])
        return -float(read_depth(self.field.coefficients, self.field.low, CELL, local)[:, 0].max())

    def find_touch(self, place: NDArray, low: float, high: float) -> float:
        """See `Indenter`; an outline that is beside the heights touches with its leading point all the same."""
        c, s = np.cos(place[SHAPE]), np.sin(place[SHAPE])
        least = find_leading(self.field.segments, c, s, low - place[HEIGHT], high - place[HEIGHT])
        return least + self.field.front if least < 1.0 else 0.0

    def find_touch_at(self, points: NDArray, face_x: float, place: NDArray) -> float:
        """See `Indenter`; as `find_touch` where the outline is beside all points."""
        c, s = np.cos(place[SHAPE]), np.sin(place[SHAPE])
        turn = np.array([[c, s], [-s, c]])
        begin, end = self.field.segments[:, :2] @ turn, self.field.segments[:, 2:] @ turn
        z = points[:, 1, None] - place[HEIGHT]
        rise = end[:, 1] - begin[:, 1]
        share = (z - begin[:, 1]) / np.where(rise == 0.0, np.inf, rise)
        across = (share >= 0.0) & (share <= 1.0) & (rise != 0.0)
        lead = np.where(across, begin[:, 0] + share * (end[:, 0] - begin[:, 0]), np.inf).min(axis=1)
        behind = face_x + lead - points[:, 0]
        nearest = float(behind.min())
        return nearest + self.field.front if np.isfinite(nearest) else 0.0

    def _origin(self, face_x: float, place: NDArray) -> NDArray:
        return np.array([face_x + self.field.front - place[DEPTH], place[HEIGHT]])


@dataclass(frozen=True, kw_only=True, eq=False)
class ExpectedObject:
    """What a contact says of its object before any key point.

    Attributes:
        indenter: the object.
        mean: expected shape and height [m] (2,).
        variance: of both (2,).
    """

    indenter: Indenter
    mean: NDArray
    variance: NDArray


class _Shape:
    """Polygons (n, 2) [m] that know their equals, so that what was built from them can be found again."""

    def __init__(self, polygons: tuple[NDArray, ...]) -> None:
        self.polygons = polygons
        self._key = tuple(np.asarray(polygon, float).tobytes() for polygon in polygons)

    def __hash__(self) -> int:
        return hash(self._key)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Shape) and self._key == other._key


@lru_cache(maxsize=8)
def _build_outline(shape: _Shape) -> OutlineIndenter:
    """Returns the object of some polygons, the same one as before if they came lately."""
    return OutlineIndenter(shape.polygons)


def expect_object(contact: Contact, settings: EstimatorSettings, known: Indenter | None = None) -> ExpectedObject:
    """Returns the object of a contact: its outline, or a cylinder about the height of the points.

    Args:
        contact: where the object touches.
        settings: what is expected of objects.
        known: the object so far, taken over if it has the contact's outline.

    Raises:
        ContactError: The outline is too small.
    """
    outline = contact.outline
    if outline is None:
        height = np.average(contact.points[:, 2], weights=contact.weights)
        mean = np.array([np.log(settings.radius), height])
        own = np.array([settings.radius_log_stddev, settings.height_stddev])
        return ExpectedObject(indenter=RoundIndenter(), mean=mean, variance=own**2)
    same = isinstance(known, OutlineIndenter) and known.describes(outline)
    indenter = known if same else _build_outline(_Shape(outline.polygons))
    own = np.array([settings.tilt_stddev, settings.height_stddev])
    mean = np.array([outline.tilt, outline.origin[1]])
    return ExpectedObject(indenter=indenter, mean=mean, variance=outline.stddev[[2, 1]] ** 2 + own**2)
