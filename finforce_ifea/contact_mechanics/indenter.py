"""Rigid objects pressed into a jaw: what they do to surface points at a place (depth, shape, height).

The second number of a place is the one more thing that key points can tell of an object: of an unknown object its
logarithmic radius, of a known outline its tilt.
"""

from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from finforce_ifea.contact_mechanics.penalty import (
    CELL,
    DistanceField,
    PenaltyContact,
    Touch,
    build_distance_field,
    find_leading,
    read_value,
    touch_cylinder,
    touch_field,
)
from finforce_ifea.observation import Contact, ObjectOutline, are_same_polygons
from finforce_ifea.settings import EstimatorSettings

DEPTH, SHAPE, HEIGHT = 0, 1, 2
_OTHER_SIZE = 3.0
# Uncertainty of a known outline's tilt in addition to that of its pose [rad].
_TILT_STDDEV = 0.02
# What leads by more [m] is outside of the heights.
_OUTSIDE = 1.0


_OPTIONS = {"cache": True, "error_model": "numpy"}


class PressedObject(NamedTuple):
    """An indenter for compiled code.

    Attributes:
        is_round: whether it is a cylinder, of which the rest tells nothing.
        coefficients: of an outline's distance field (a, b) [m].
        low: x and z of the first coefficient (2,) [m].
        front: distance from the origin to the leading point, against x [m].
        segments: of the side that faces the jaw (s, 4) [m].
    """

    is_round: bool
    coefficients: NDArray
    low: NDArray
    front: float
    segments: NDArray


class FaceProfile(NamedTuple):
    """An undeformed inner surface for compiled code.

    Attributes:
        points: its x and z, rising (p, 2) [m]; of a flat one the first and the last suffice.
        is_flat: whether all x are the same.
        x: of the inner face, from which depths count [m].
    """

    points: NDArray
    is_flat: bool
    x: float


class ObjectPose(NamedTuple):
    """Where an object of a place (depth, shape, height) is.

    Attributes:
        x: of a cylinder's axis or an outline's origin [m].
        z: the same [m].
        radius: of a cylinder, 0 of an outline [m].
        c: cosine of an outline's tilt.
        s: its sine.
    """

    x: float
    z: float
    radius: float
    c: float
    s: float


@njit(**_OPTIONS)
def pose_object(pressed, face_x, place):
    """Return the `ObjectPose` at a place (3,)."""
    if pressed.is_round:
        radius = np.exp(place[1])
        return ObjectPose(face_x + radius - place[0], place[2], radius, 1.0, 0.0)
    return ObjectPose(face_x + pressed.front - place[0], place[2], 0.0, np.cos(place[1]), np.sin(place[1]))


@njit(**_OPTIONS)
def is_clear_of(pressed, pose, x, z):
    """Whether a point at x and z [m] is surely outside an object."""
    dx, dz = x - pose.x, z - pose.z
    if pressed.is_round:
        return dx * dx + dz * dz >= pose.radius * pose.radius
    rows, columns = pressed.coefficients.shape
    a = (pose.c * dx + pose.s * dz - pressed.low[0]) / CELL
    b = (pose.c * dz - pose.s * dx - pressed.low[1]) / CELL
    return a < 1.0 or b < 1.0 or a >= rows - 2 or b >= columns - 2


@njit(**_OPTIONS)
def touch_object(pressed, pose, x, z, stiffness, weights):
    """Return the `Touch` of one point at x and z [m], derivatives by the place's shape; `weights` is (6, 4)."""
    if pressed.is_round:
        touch = touch_cylinder(x, z, stiffness, pose.x, pose.z, pose.radius)
        bx, bz = pose.radius * (touch.bx + touch.kxx), pose.radius * (touch.bz + touch.kxz)
        return Touch(touch.fx, touch.fz, touch.kxx, touch.kxz, touch.kzz, bx, bz)
    field = pressed.coefficients, pressed.low, CELL
    return touch_field(x, z, stiffness, *field, pose.x, pose.z, pose.c, pose.s, weights)


@njit(**_OPTIONS)
def measure_gap(pressed, pose, points):
    """Return the least distance [m] of points (p, 3) [m] from an object, negative inside."""
    least, weights = np.inf, np.zeros((6, 4))
    for p in range(len(points)):
        dx, dz = points[p, 0] - pose.x, points[p, 2] - pose.z
        if pressed.is_round:
            gap = np.sqrt(dx * dx + dz * dz) - pose.radius
        else:
            x, z = pose.c * dx + pose.s * dz, pose.c * dz - pose.s * dx
            gap = -read_value(pressed.coefficients, pressed.low, CELL, x, z, weights)[0]
        least = min(least, gap)
    return least


@njit(**_OPTIONS)
def find_first_touch(pressed, face, place):
    """Return the depth [m] at which an object of a place (3,) first touches an undeformed `FaceProfile`."""
    points = face.points
    if pressed.is_round:
        radius = np.exp(place[1])
        least = 0.0 if face.is_flat else radius
        for p in range(0 if face.is_flat else len(points)):
            dz = points[p, 1] - place[2]
            if abs(dz) < radius:
                least = min(least, face.x + radius - np.sqrt(radius * radius - dz * dz) - points[p, 0])
        return least
    c, s = np.cos(place[1]), np.sin(place[1])
    if face.is_flat:
        low, high = points[0, 1] - place[2], points[-1, 1] - place[2]
        least = find_leading(pressed.segments, c, s, low, high)
        return least + pressed.front if least < _OUTSIDE else 0.0
    least = np.inf
    for p in range(len(points)):
        z = points[p, 1] - place[2]
        lead = find_leading(pressed.segments, c, s, z, z)
        if lead < _OUTSIDE:
            least = min(least, face.x + lead - points[p, 0])
    return least + pressed.front if np.isfinite(least) else 0.0


def flat_profile(low: float, high: float, x: float = 0.0) -> FaceProfile:
    """Return a plane inner surface x = const between two heights [m]."""
    return FaceProfile(np.array([[x, low], [x, high]]), True, x)


@dataclass(frozen=True, kw_only=True)
class ShapeRange:
    """What the second number of a place may do: its bounds, its change at once, and a change that matters no more."""

    low: float
    high: float
    largest_change: float
    settled_change: float


@njit(**_OPTIONS)
def _press_points(pressed, pose, points, stiffness):
    """Return forces (p, 3), springs (p, 3, 3) and derivatives by the shape (p, 3) of points (p, 3)."""
    count, weights = len(points), np.zeros((6, 4))
    forces, springs, by_shape = np.zeros((count, 3)), np.zeros((count, 3, 3)), np.zeros((count, 3))
    for p in range(count):
        touch = touch_object(pressed, pose, points[p, 0], points[p, 2], stiffness[p], weights)
        forces[p, 0], forces[p, 2], by_shape[p, 0], by_shape[p, 2] = touch.fx, touch.fz, touch.bx, touch.bz
        springs[p, 0, 0], springs[p, 2, 2] = touch.kxx, touch.kzz
        springs[p, 0, 2] = springs[p, 2, 0] = touch.kxz
    return forces, springs, by_shape


class Indenter:
    """A rigid object, endless along y; one with corners may rock between them.

    Attributes:
        pressed: the object for compiled code.
        shape_range: what the second number of its places may do.
        has_corners: whether it has corners.
    """

    pressed: PressedObject
    shape_range: ShapeRange
    has_corners: bool

    def press(self, points: NDArray, stiffness: NDArray, face_x: float, place: NDArray) -> PenaltyContact:
        """Return the contact with surface points.

        Args:
            points: deformed positions (p, 3) [m].
            stiffness: of each point (p,) [N/m].
            face_x: from which depths count [m].
            place: of the object (3,).
        """
        return PenaltyContact(*_press_points(self.pressed, self._pose(face_x, place), points, stiffness))

    def find_gap(self, points: NDArray, face_x: float, place: NDArray) -> float:
        """Return the least distance [m] of points (p, 3) [m] from the object, negative inside."""
        return float(measure_gap(self.pressed, self._pose(face_x, place), np.ascontiguousarray(points)))

    def find_touch(self, place: NDArray, face: FaceProfile) -> float:
        """Return the depth [m] of first touch with an undeformed surface.

        An outline beyond the ends of a plane surface touches with its leading point all the same.
        """
        return find_first_touch(self.pressed, face, place)

    def _pose(self, face_x: float, place: NDArray) -> ObjectPose:
        return pose_object(self.pressed, face_x, place)


class RoundIndenter(Indenter):
    """A cylinder of any radius: place (depth [m], ln radius, height of its axis [m]).

    A larger radius moves the axis away, so that the depth stays.
    """

    shape_range = ShapeRange(low=float(np.log(3e-3)), high=float(np.log(0.2)), largest_change=0.15, settled_change=5e-2)
    has_corners = False
    pressed = PressedObject(True, np.zeros((1, 1)), np.zeros(2), 0.0, np.zeros((0, 4)))


class OutlineIndenter(Indenter):
    """A known outline: place (depth [m], tilt [rad], height of its origin [m]); depth 0 touches without tilt."""

    shape_range = ShapeRange(low=-1.0, high=1.0, largest_change=0.03, settled_change=5e-3)
    has_corners = True

    def __init__(self, polygons: tuple[NDArray, ...]) -> None:
        """Build the distance field of the polygons (n, 2) [m]; raises ContactError for one that is too small."""
        self.polygons = polygons
        self._size = np.ptp(np.concatenate(polygons), axis=0)
        self.field: DistanceField = build_distance_field(polygons)
        field = self.field
        self.pressed = PressedObject(False, field.coefficients, field.low, field.front, field.segments)

    def describes(self, outline: ObjectOutline) -> bool:
        """Whether an outline has this object's polygons."""
        return are_same_polygons(outline.polygons, self.polygons)

    def resembles(self, other: "OutlineIndenter") -> bool:
        """Whether another outline has about the size of this one, as two cuts of one object do."""
        return other is self or bool((np.abs(np.log(self._size / other._size)) < np.log(_OTHER_SIZE)).all())


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
    """Return the object of some polygons, the same one as before if they came lately."""
    return OutlineIndenter(shape.polygons)


def expect_object(contact: Contact, settings: EstimatorSettings, known: Indenter | None = None) -> ExpectedObject:
    """Return the object of a contact: its outline, or a cylinder about the height of the points.

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
    own = np.array([_TILT_STDDEV, settings.height_stddev])
    mean = np.array([outline.tilt, outline.origin[1]])
    return ExpectedObject(indenter=indenter, mean=mean, variance=outline.stddev[[2, 1]] ** 2 + own**2)
