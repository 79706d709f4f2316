"""Rigid objects pressed into a jaw: what they do to surface points in a contact state (depth, shape, height).

The second number of a contact state is the one more thing that key points can tell of an object: of an unknown object
its radius, of a known outline its tilt.

Surface points are pushed out by a smoothed penalty. The penetration into an outline is a smooth field, twice
differentiable: signed distances to the polygons are the coefficients of a uniform cubic B-spline, which smooths over
half a cell, so that corners and the facets of a mesh do not make the contact rattle.
"""

from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from finforce.compiled import njit
from finforce_ifea.contact_mechanics.friction import FRICTIONLESS, POINT_SHAPE, Touch, Traction, add_traction
from finforce_ifea.errors import ContactError
from finforce_ifea.observation import Contact, ObjectOutline, are_same_polygons
from finforce_ifea.settings import EstimatorSettings

DEPTH, SHAPE, HEIGHT = 0, 1, 2
CELL = 0.6e-3
# What can be touched: this far behind the leading point, and not what faces away from the jaw.
_REACH = 25e-3
_MARGIN = 4 * CELL
_FACES_AWAY = 0.6
# Steps per cell of the traced front, and halvings of a cell that place it.
_TRACE = 3
_HALVINGS = 14
_OTHER_SIZE = 3.0
# Uncertainty of a known outline's tilt in addition to that of its pose [rad].
_TILT_STDDEV = 0.02
# What is so far outside of an outline has all coefficients of its cell there [m], the diagonal of two cells.
_CLEAR = 3 * CELL
# What leads by more [m] is outside of the heights.
_OUTSIDE = 1.0
_OPTIONS = {"cache": True, "error_model": "numpy"}


class PressedObject(NamedTuple):
    """An indenter for compiled code.

    Attributes:
        is_round: True if it is a cylinder, of which the rest tells nothing.
        coefficients: depth below the outline over a grid in its own frame, negative outside (a, b) [m].
        low: x and z of the first coefficient (2,) [m].
        front: distance from the origin to the leading point, against x [m].
        segments: of the side that faces the jaw, as the field has it (s, 4): x, z of begin and end [m].
    """

    is_round: bool
    coefficients: NDArray
    low: NDArray
    front: float
    segments: NDArray


def build_outline(polygons: tuple[NDArray, ...]) -> PressedObject:
    """Return the object with an outline of polygons, (n, 2) [m] each, about its origin.

    Raises:
        ContactError: The polygons span less than a cell of the grid.
    """
    # of one type, so that nothing is compiled anew while a jaw waits
    segments = np.concatenate([np.hstack([p, np.roll(p, -1, axis=0)]) for p in polygons]).astype(float)
    low, high = segments[:, :2].min(0), segments[:, :2].max(0)
    if (high - low < CELL).any():
        raise ContactError(f"the outline spans {1e3 * (high - low)} mm, expected at least {1e3 * CELL:g} mm")
    high = np.array([min(high[0], low[0] + _REACH), high[1]]) + _MARGIN
    low = low - _MARGIN
    shape = np.ceil((high - low) / CELL).astype(int) + 1
    depth = _measure_depth(segments, low, CELL, shape[0], shape[1], _FACES_AWAY)
    traced = _trace_front(depth, low, CELL, _TRACE)
    traced = traced[np.isfinite(traced[:, 0])]
    if len(traced) < 2:
        raise ContactError(f"the outline is thinner than {1e3 * CELL:g} mm where it faces the jaw")
    front = np.hstack([traced[:-1], traced[1:]])
    return PressedObject(False, depth, low, -float(traced[:, 0].min()), front)


@njit(**_OPTIONS)
def _is_before(segment, x, z):
    """Return True if the way from a point at x and z [m] towards the jaw crosses a segment (4,)."""
    ax, az, bx, bz = segment
    return (az > z) != (bz > z) and x >= ax + (bx - ax) * (z - az) / (bz - az)


@njit(**_OPTIONS)
def _find_hidden(segments):
    """Return which segments (s,) lie behind a gap in the object, as seen from the jaw, bool."""
    count = len(segments)
    hidden = np.zeros(count, dtype=np.bool_)
    for k in range(count):
        x, z, before = 0.5 * (segments[k, 0] + segments[k, 2]), 0.5 * (segments[k, 1] + segments[k, 3]), 0
        for s in range(count):
            if s != k and _is_before(segments[s], x, z):
                before += 1
        hidden[k] = before > 1
    return hidden


@njit(**_OPTIONS)
def _measure_depth(segments, low, cell, rows, columns, faces_away):
    """Return the depth (rows, columns) below the segments that an object turns to the jaw; negative outside.

    What lies behind the object is inside, as holes are: the face of a finger gets there through a thin wall only, and
    would be held there.
    """
    count, hidden = len(segments), _find_hidden(segments)
    nearest = np.empty((rows, columns))
    for i in range(rows):
        x = low[0] + cell * i
        for j in range(columns):
            z = low[1] + cell * j
            inside, best, best_turned = False, 1e9, 1e9
            for s in range(count):
                ax, az, bx, bz = segments[s, 0], segments[s, 1], segments[s, 2], segments[s, 3]
                inside |= _is_before(segments[s], x, z)
                ex, ez = bx - ax, bz - az
                square = ex * ex + ez * ez
                if square <= 0.0:
                    continue
                t = min(max(((x - ax) * ex + (z - az) * ez) / square, 0.0), 1.0)
                gap = (x - ax - t * ex) ** 2 + (z - az - t * ez) ** 2
                best = min(best, gap)
                # counterclockwise: the outward normal is (ez, -ex)
                if ez < faces_away * np.sqrt(square) and not hidden[s]:
                    best_turned = min(best_turned, gap)
            nearest[i, j] = np.sqrt(best_turned) if inside else -np.sqrt(best)
    return nearest


@njit(**_OPTIONS)
def _weigh(t):
    """Return the four weights of a uniform cubic B-spline at t in [0, 1)."""
    s = 1.0 - t
    return s * s * s / 6.0, 2.0 / 3.0 - t * t + 0.5 * t * t * t, 2.0 / 3.0 - s * s + 0.5 * s * s * s, t * t * t / 6.0


@njit(**_OPTIONS)
def _weigh_slopes(t):
    """Return the derivatives of these weights by t, and their second derivatives."""
    s = 1.0 - t
    slope = -0.5 * s * s, -2.0 * t + 1.5 * t * t, 2.0 * s - 1.5 * s * s, 0.5 * t * t
    return slope, (s, -2.0 + 3.0 * t, -2.0 + 3.0 * s, t)


@njit(**_OPTIONS)
def _blend(c, i, j, u, v):
    """Return the sum of the 4 x 4 coefficients about a cell with weights u along x and v along z."""
    out = u[0] * (c[i - 1, j - 1] * v[0] + c[i - 1, j] * v[1] + c[i - 1, j + 1] * v[2] + c[i - 1, j + 2] * v[3])
    out += u[1] * (c[i, j - 1] * v[0] + c[i, j] * v[1] + c[i, j + 1] * v[2] + c[i, j + 2] * v[3])
    out += u[2] * (c[i + 1, j - 1] * v[0] + c[i + 1, j] * v[1] + c[i + 1, j + 1] * v[2] + c[i + 1, j + 2] * v[3])
    return out + u[3] * (c[i + 2, j - 1] * v[0] + c[i + 2, j] * v[1] + c[i + 2, j + 1] * v[2] + c[i + 2, j + 2] * v[3])


@njit(**_OPTIONS)
def _read_value(coefficients, low, cell, x, z):
    """Return the depth [m] at one point, -1 mm beyond the grid, and where it is there, in cells."""
    rows, columns = coefficients.shape
    a, b = (x - low[0]) / cell, (z - low[1]) / cell
    i, j = int(np.floor(a)), int(np.floor(b))
    if i < 1 or j < 1 or i > rows - 3 or j > columns - 3:
        return -1e-3, a, b
    return _blend(coefficients, i, j, _weigh(a - i), _weigh(b - j)), a, b


@njit(**_OPTIONS)
def _read_slopes(coefficients, cell, a, b):
    """Return gradient (x, z) and second derivatives (xx, xz, zz) where `_read_value` has read the depth."""
    i, j = int(np.floor(a)), int(np.floor(b))
    u, v = _weigh(a - i), _weigh(b - j)
    (du, ddu), (dv, ddv) = _weigh_slopes(a - i), _weigh_slopes(b - j)
    gx, gz = _blend(coefficients, i, j, du, v) / cell, _blend(coefficients, i, j, u, dv) / cell
    gxx, gzz = _blend(coefficients, i, j, ddu, v) / cell**2, _blend(coefficients, i, j, u, ddv) / cell**2
    return gx, gz, gxx, _blend(coefficients, i, j, du, dv) / cell**2, gzz


@njit(**_OPTIONS)
def _trace_front(coefficients, low, cell, steps):
    """Return the first x [m] of depth zero at each height (n, 2) [m]; NaN where the object is not met."""
    rows, columns = coefficients.shape
    count = (columns - 4) * steps
    front = np.full((count, 2), np.nan)
    for n in range(count):
        z = low[1] + cell * (1.0 + n / steps)
        front[n, 1] = z
        for i in range(1, rows - 3):
            x = low[0] + cell * (i + 1)
            if i + 1 > rows - 3 or _read_value(coefficients, low, cell, x, z)[0] <= 0.0:
                continue
            outside, inside = x - cell, x
            for _ in range(_HALVINGS):
                middle = 0.5 * (outside + inside)
                if _read_value(coefficients, low, cell, middle, z)[0] > 0.0:
                    inside = middle
                else:
                    outside = middle
            front[n, 0] = inside
            break
    return front


@njit(**_OPTIONS)
def _turn(segment, c, s):
    """Return the ends x, z, x, z [m] of a segment (4,) turned by (cos, sin) of the tilt."""
    ax, az, bx, bz = segment
    return c * ax - s * az, s * ax + c * az, c * bx - s * bz, s * bx + c * bz


@njit(**_OPTIONS)
def _find_lead(ax, az, bx, bz, low, high):
    """Return the least x [m] of a segment from a to b between two heights [m], 1e9 where it is not there."""
    if max(az, bz) < low or min(az, bz) > high:
        return 1e9
    begin, end = 0.0, 1.0
    if bz != az:
        one, other = (low - az) / (bz - az), (high - az) / (bz - az)
        begin, end = max(0.0, min(one, other)), min(1.0, max(one, other))
    return min(ax + begin * (bx - ax), ax + end * (bx - ax))


@njit(**_OPTIONS)
def _find_leading(segments, c, s, low, high):
    """Return the least x [m] of segments (s, 4) turned by (cos, sin) of the tilt, between two heights, else 1e9."""
    least = 1e9
    for k in range(len(segments)):
        ax, az, bx, bz = _turn(segments[k], c, s)
        if min(ax, bx) < least:
            least = min(least, _find_lead(ax, az, bx, bz, low, high))
    return least


# The penalty rises quadratically over this depth [m] before it is linear, so that Newton's method sees no kink.
SMOOTH_DEPTH = 2e-5


@njit(**_OPTIONS)
def resist(depth, stiffness):
    """Return force [N] and its derivative [N/m] at a depth above zero [m]."""
    if depth < SMOOTH_DEPTH:
        return 0.5 * stiffness * depth * depth / SMOOTH_DEPTH, stiffness * depth / SMOOTH_DEPTH
    return stiffness * (depth - 0.5 * SMOOTH_DEPTH), stiffness


@njit(**_OPTIONS)
def _touch_cylinder(x, z, stiffness, centre_x, centre_z, radius):
    """Return the `Touch` of a cylinder on a point at x and z [m].

    With the penetration d = radius - r the force is stiffness d n (quadratic below 20 um), n from the axis outwards.
    """
    dx, dz = x - centre_x, z - centre_z
    square = dx * dx + dz * dz
    if square >= radius * radius or square < 1e-24:
        return Touch(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    r = np.sqrt(square)
    depth = radius - r
    nx, nz = dx / r, dz / r
    push, slope = resist(depth, stiffness)
    side = push / r
    xx, xz = slope * nx * nx - side * nz * nz, (slope + side) * nx * nz
    return Touch(push * nx, push * nz, xx, xz, slope * nz * nz - side * nx * nx, slope * nx, slope * nz)


@njit(**_OPTIONS)
def _touch_field(x, z, stiffness, coefficients, low, cell, origin_x, origin_z, c, s):
    """Return the `Touch` of an outline turned by (cos, sin) of its tilt.

    With the depth d(p) below the outline the force is -stiffness d grad d, and its springs follow from d's second
    derivatives. A tilt is positive from x towards z.
    """
    rx, rz = x - origin_x, z - origin_z
    depth, column, row = _read_value(coefficients, low, cell, c * rx + s * rz, c * rz - s * rx)
    if depth <= 0.0:
        return Touch(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    hx, hz, a, b, d = _read_slopes(coefficients, cell, column, row)
    push, slope = resist(depth, stiffness)
    gx, gz = c * hx - s * hz, s * hx + c * hz
    hxx = c * c * a - 2.0 * c * s * b + s * s * d
    hzz = s * s * a + 2.0 * c * s * b + c * c * d
    hxz = c * s * (a - d) + (c * c - s * s) * b
    fx, fz = -push * gx, -push * gz
    xx, xz, zz = slope * gx * gx + push * hxx, slope * gx * gz + push * hxz, slope * gz * gz + push * hzz
    # the object turns: its force turns along, and the point slides against it
    return Touch(fx, fz, xx, xz, zz, -fz - xx * rz + xz * rx, fx - xz * rz + zz * rx)


class FaceProfile(NamedTuple):
    """An undeformed inner surface for compiled code.

    Attributes:
        points: its x and z, rising (p, 2) [m]; of a flat one the first and the last suffice.
        is_flat: True if all x are the same.
        x: of the inner face, from which depths count [m].
    """

    points: NDArray
    is_flat: bool
    x: float


class IndenterPose(NamedTuple):
    """Pose of an object in a contact state (depth, shape, height).

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
def pose_object(pressed, face_x, x):
    """Return the `IndenterPose` in a contact state (3,)."""
    if pressed.is_round:
        radius = x[1]
        return IndenterPose(face_x + radius - x[0], x[2], radius, 1.0, 0.0)
    return IndenterPose(face_x + pressed.front - x[0], x[2], 0.0, np.cos(x[1]), np.sin(x[1]))


@njit(**_OPTIONS)
def is_clear_of(pressed, pose, x, z):
    """Return True if a point at x and z [m] is surely outside an object."""
    dx, dz = x - pose.x, z - pose.z
    if pressed.is_round:
        return dx * dx + dz * dz >= pose.radius * pose.radius
    rows, columns = pressed.coefficients.shape
    a = (pose.c * dx + pose.s * dz - pressed.low[0]) / CELL
    b = (pose.c * dz - pose.s * dx - pressed.low[1]) / CELL
    if a < 1.0 or b < 1.0 or a >= rows - 2 or b >= columns - 2:
        return True
    return pressed.coefficients[int(a), int(b)] < -_CLEAR  # then all coefficients about it are negative


@njit(**_OPTIONS)
def touch_object(pressed, pose, x, z, stiffness):
    """Return the `Touch` of one point at x and z [m], derivatives by its shape."""
    if pressed.is_round:
        touch = _touch_cylinder(x, z, stiffness, pose.x, pose.z, pose.radius)
        bx, bz = touch.bx + touch.kxx, touch.bz + touch.kxz
        return Touch(touch.fx, touch.fz, touch.kxx, touch.kxz, touch.kzz, bx, bz)
    field = pressed.coefficients, pressed.low, CELL
    return _touch_field(x, z, stiffness, *field, pose.x, pose.z, pose.c, pose.s)


@njit(**_OPTIONS)
def measure_gap(pressed, pose, points):
    """Return the least distance [m] of points (p, 3) [m] from an object, negative inside."""
    least = np.inf
    for p in range(len(points)):
        dx, dz = points[p, 0] - pose.x, points[p, 2] - pose.z
        if pressed.is_round:
            gap = np.sqrt(dx * dx + dz * dz) - pose.radius
        else:
            x, z = pose.c * dx + pose.s * dz, pose.c * dz - pose.s * dx
            gap = -_read_value(pressed.coefficients, pressed.low, CELL, x, z)[0]
        least = min(least, gap)
    return least


@njit(**_OPTIONS)
def find_first_touch(pressed, face, state):
    """Return the depth [m] at which an object with a contact state (3,) first touches an undeformed surface.

    `PressedObject` and `FaceProfile` are plain tuples, as for `linearize_reduced`.
    """
    pressed, face = PressedObject(*pressed), FaceProfile(*face)
    points = face.points
    if pressed.is_round:
        radius = state[1]
        least = 0.0 if face.is_flat else radius
        for p in range(0 if face.is_flat else len(points)):
            dz = points[p, 1] - state[2]
            if abs(dz) < radius:
                least = min(least, face.x + radius - np.sqrt(radius * radius - dz * dz) - points[p, 0])
        return least
    c, s = np.cos(state[1]), np.sin(state[1])
    if face.is_flat:
        low, high = points[0, 1] - state[2], points[-1, 1] - state[2]
        least = _find_leading(pressed.segments, c, s, low, high)
        return least + pressed.front if least < _OUTSIDE else 0.0
    least = np.inf
    for p in range(len(points)):
        z = points[p, 1] - state[2]
        lead = _find_leading(pressed.segments, c, s, z, z)
        if lead < _OUTSIDE:
            least = min(least, face.x + lead - points[p, 0])
    return least + pressed.front if np.isfinite(least) else 0.0


@njit(**_OPTIONS)
def find_clearances(pressed, x, heights):
    """Return the distances (m,) [m] of an outline in a state (3,) from a plane undeformed surface below heights (m,).

    It is negative behind the surface, and infinite where the outline is not at these heights.
    """
    least, c, s = np.full(len(heights), 1e9), np.cos(x[1]), np.sin(x[1])
    for k in range(len(pressed.segments)):
        ax, az, bx, bz = _turn(pressed.segments[k], c, s)
        for p in range(len(heights)):
            if min(ax, bx) < least[p]:
                least[p] = min(least[p], _find_lead(ax, az, bx, bz, -x[2], heights[p] - x[2]))
    for p in range(len(heights)):
        least[p] = least[p] + pressed.front - x[0] if least[p] < _OUTSIDE else np.inf
    return least


def flat_profile(low: float, high: float, x: float = 0.0) -> FaceProfile:
    """Return a plane inner surface x = const between two heights [m]."""
    return FaceProfile(np.array([[x, low], [x, high]]), True, x)


@njit(**_OPTIONS)
def _press_points(pressed, pose, traction, points, stiffness):
    """Return forces, springs and changes at points; see `PenaltyContact`."""
    count, out = len(points), np.zeros(POINT_SHAPE)
    forces, springs, changes = np.zeros((count, 3)), np.zeros((count, 3, 3)), np.zeros((count, 3, 4))
    for p in range(count):
        x, z = points[p, 0], points[p, 2]
        touch = touch_object(pressed, pose, x, z, stiffness[p])
        add_traction(traction, touch, p, x, z, stiffness[p], out)
        for a in range(2):
            forces[p, 2 * a], springs[p, 2 * a, 0], springs[p, 2 * a, 2] = out[a, 0], out[a, 1], out[a, 2]
            for i in range(4):
                changes[p, 2 * a, i] = out[a, 3 + i]
    return forces, springs, changes


class PenaltyContact(NamedTuple):
    """Contact at surface points.

    Attributes:
        forces: on the points (p, 3) [N].
        springs: negative derivatives of the forces by the points' positions (p, 3, 3) [N/m].
        changes: derivatives of the forces by the object's depth, shape and height and by a traction ratio of all forces
            (p, 3, 4).
    """

    forces: NDArray
    springs: NDArray
    changes: NDArray | None = None


class Indenter:
    """A rigid object, endless along y; one with corners may rock between them.

    Attributes:
        pressed: the object for compiled code.
        lowest: least shape, the second number of its contact states.
        highest: largest shape.
        largest_change: of the shape at once.
        settled_change: of the shape that no longer matters.
        has_corners: True if it has corners.
    """

    pressed: PressedObject
    lowest: float
    highest: float
    largest_change: float
    settled_change: float
    has_corners: bool

    def press(
        self, points: NDArray, stiffness: NDArray, face_x: float, x: NDArray, traction: Traction = FRICTIONLESS
    ) -> PenaltyContact:
        """Return the contact with surface points.

        Args:
            points: deformed positions (p, 3) [m].
            stiffness: of each point (p,) [N/m].
            face_x: from which depths count [m].
            x: state of the contact (3,).
            traction: traction along the surface.
        """
        pose = pose_object(self.pressed, face_x, x)
        return PenaltyContact(*_press_points(self.pressed, pose, traction, points, stiffness))

    def find_gap(self, points: NDArray, face_x: float, x: NDArray) -> float:
        """Return the least distance [m] of points (p, 3) [m] from the object in a state (3,), negative inside."""
        return float(measure_gap(self.pressed, pose_object(self.pressed, face_x, x), np.ascontiguousarray(points)))

    def find_touch(self, x: NDArray, face: FaceProfile) -> float:
        """Return the depth [m] of first touch with an undeformed surface, at the shape and height of a state (3,).

        An outline beyond the ends of a plane surface touches with its leading point all the same.
        """
        return find_first_touch(tuple(self.pressed), tuple(face), x)


class RoundIndenter(Indenter):
    """A cylinder of any radius, in states of depth [m], radius [m], and height of its axis [m].

    A larger radius moves the axis back, so that the depth stays.
    """

    lowest, highest, largest_change, settled_change = 3e-3, 0.2, 2e-3, 0.5e-3
    has_corners = False
    pressed = PressedObject(True, np.zeros((1, 1)), np.zeros(2), 0.0, np.zeros((0, 4)))


class OutlineIndenter(Indenter):
    """A known outline, in states of depth [m], tilt [rad], and height of its origin [m]; untilted it touches at 0."""

    lowest, highest, largest_change, settled_change = -1.0, 1.0, 0.03, 5e-3
    has_corners = True

    def __init__(self, polygons: tuple[NDArray, ...]) -> None:
        """Build the distance field of the polygons (n, 2) [m]; raises ContactError for one that is too small."""
        self.polygons = polygons
        self._size = np.ptp(np.concatenate(polygons), axis=0)
        self.pressed = build_outline(polygons)

    def describes(self, outline: ObjectOutline) -> bool:
        """Return True if an outline has this object's polygons."""
        return are_same_polygons(outline.polygons, self.polygons)

    def resembles(self, other: "OutlineIndenter") -> bool:
        """Return True if another outline has about the size of this one, as two cuts of one object do."""
        return other is self or bool((np.abs(np.log(self._size / other._size)) < np.log(_OTHER_SIZE)).all())


@dataclass(frozen=True, kw_only=True, eq=False)
class ExpectedObject:
    """The prior of a contact's object before any key point.

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
        settings: prior of objects.
        known: the object so far, taken over if it has the contact's outline.

    Raises:
        ContactError: The outline is too small.
    """
    outline = contact.outline
    if outline is None:
        height = np.average(contact.points[:, 2], weights=contact.weights)
        mean = np.array([settings.radius, height])
        own = np.array([settings.radius_stddev, settings.height_stddev])
        return ExpectedObject(indenter=RoundIndenter(), mean=mean, variance=own**2)
    same = isinstance(known, OutlineIndenter) and known.describes(outline)
    indenter = known if same else _build_outline(_Shape(outline.polygons))
    own = np.array([_TILT_STDDEV, settings.height_stddev])
    mean = np.array([outline.tilt, outline.origin[1]])
    return ExpectedObject(indenter=indenter, mean=mean, variance=outline.stddev[2:0:-1] ** 2 + own**2)
