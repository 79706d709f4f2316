"""Frictionless contact of surface points with a rigid object by a smoothed penalty.

The penetration into an outline is a smooth field, twice differentiable: signed distances to the polygons are the
coefficients of a uniform cubic B-spline, which smooths over half a cell, so that corners and the facets of a mesh do
not make the contact rattle.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from finforce_ifea.errors import ContactError

CELL = 0.6e-3
# What can be touched: this far behind the leading point, and not what faces away from the jaw.
_REACH = 25e-3
_MARGIN = 4 * CELL
_FACES_AWAY = 0.6
# Steps per cell of the traced front, and halvings of a cell that place it.
_TRACE = 3
_HALVINGS = 14
_OPTIONS = {"cache": True, "error_model": "numpy"}


@dataclass(frozen=True, kw_only=True, eq=False)
class DistanceField:
    """A field over a grid in the outline's own frame.

    Attributes:
        coefficients: depth below the outline, negative outside (a, b) [m].
        low: x and z of the first coefficient (2,) [m].
        front: distance from the origin to the leading point, against x [m].
        segments: of the side that faces the jaw, as the field has it (s, 4): x, z of begin and end [m].
    """

    coefficients: NDArray
    low: NDArray
    front: float
    segments: NDArray


def build_distance_field(polygons: tuple[NDArray, ...]) -> DistanceField:
    """Return the field of an outline's polygons, (n, 2) [m] each, about its origin.

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
    return DistanceField(coefficients=depth, low=low, front=-float(traced[:, 0].min()), segments=front)


@njit(**_OPTIONS)
def _measure_depth(segments, low, cell, rows, columns, faces_away):
    """Return the depth (rows, columns) below the segments that an object turns to the jaw; negative outside."""
    count = len(segments)
    nearest = np.empty((rows, columns))
    for i in range(rows):
        x = low[0] + cell * i
        for j in range(columns):
            z = low[1] + cell * j
            inside, best, best_turned = 0, 1e9, 1e9
            for s in range(count):
                ax, az, bx, bz = segments[s, 0], segments[s, 1], segments[s, 2], segments[s, 3]
                if (az > z) != (bz > z) and x < ax + (bx - ax) * (z - az) / (bz - az):
                    inside += 1 if bz > az else -1
                ex, ez = bx - ax, bz - az
                square = ex * ex + ez * ez
                if square <= 0.0:
                    continue
                t = min(max(((x - ax) * ex + (z - az) * ez) / square, 0.0), 1.0)
                gap = (x - ax - t * ex) ** 2 + (z - az - t * ez) ** 2
                best = min(best, gap)
                # counterclockwise: the outward normal is (ez, -ex)
                if ez < faces_away * np.sqrt(square):
                    best_turned = min(best_turned, gap)
            nearest[i, j] = np.sqrt(best_turned) if inside != 0 else -np.sqrt(best)
    return nearest


@njit(**_OPTIONS)
def _weigh(t, value, slope, bend):
    """Fill the four weights of a uniform cubic B-spline and of its derivatives by t in [0, 1)."""
    s = 1.0 - t
    value[0], value[3] = s * s * s / 6.0, t * t * t / 6.0
    value[1], value[2] = 2.0 / 3.0 - t * t + 0.5 * t * t * t, 2.0 / 3.0 - s * s + 0.5 * s * s * s
    slope[0], slope[3] = -0.5 * s * s, 0.5 * t * t
    slope[1], slope[2] = -2.0 * t + 1.5 * t * t, 2.0 * s - 1.5 * s * s
    bend[0], bend[3] = s, t
    bend[1], bend[2] = -2.0 + 3.0 * t, -2.0 + 3.0 * s


@njit(**_OPTIONS)
def read_value(coefficients, low, cell, x, z, weights):
    """Return the depth [m] at one point, -1 mm beyond the grid, and fill in weights (6, 4) of x and z there."""
    rows, columns = coefficients.shape
    a, b = (x - low[0]) / cell, (z - low[1]) / cell
    i, j = int(np.floor(a)), int(np.floor(b))
    if i < 1 or j < 1 or i > rows - 3 or j > columns - 3:
        return -1e-3, i, j
    _weigh(a - i, weights[0], weights[1], weights[2])
    _weigh(b - j, weights[3], weights[4], weights[5])
    depth = 0.0
    for k in range(4):
        for m in range(4):
            depth += coefficients[i - 1 + k, j - 1 + m] * weights[0, k] * weights[3, m]
    return depth, i, j


@njit(**_OPTIONS)
def _read_slopes(coefficients, cell, i, j, weights):
    """Return gradient (x, z) and second derivatives (xx, xz, zz) where `read_value` has read the depth."""
    gx, gz, gxx, gxz, gzz = 0.0, 0.0, 0.0, 0.0, 0.0
    for k in range(4):
        for m in range(4):
            c = coefficients[i - 1 + k, j - 1 + m]
            gx += c * weights[1, k] * weights[3, m] / cell
            gz += c * weights[0, k] * weights[4, m] / cell
            gxx += c * weights[2, k] * weights[3, m] / cell**2
            gxz += c * weights[1, k] * weights[4, m] / cell**2
            gzz += c * weights[0, k] * weights[5, m] / cell**2
    return gx, gz, gxx, gxz, gzz


@njit(**_OPTIONS)
def read_depth(coefficients, low, cell, points):
    """Return depth, gradient (x, z) and second derivatives (xx, xz, zz) at points (p, 2) [m] as (p, 6).

    Beyond the grid the depth is that of a point a millimetre outside.
    """
    out, weights = np.zeros((len(points), 6)), np.zeros((6, 4))
    for p in range(len(points)):
        out[p, 0], i, j = read_value(coefficients, low, cell, points[p, 0], points[p, 1], weights)
        if out[p, 0] != -1e-3:
            out[p, 1:] = _read_slopes(coefficients, cell, i, j, weights)
    return out


@njit(**_OPTIONS)
def _trace_front(coefficients, low, cell, steps):
    """Return the first x [m] of depth zero at each height (n, 2) [m]; NaN where the object is not met."""
    rows, columns = coefficients.shape
    weights = np.zeros((6, 4))
    count = (columns - 4) * steps
    front = np.full((count, 2), np.nan)
    for n in range(count):
        z = low[1] + cell * (1.0 + n / steps)
        front[n, 1] = z
        for i in range(1, rows - 3):
            x = low[0] + cell * (i + 1)
            if i + 1 > rows - 3 or read_value(coefficients, low, cell, x, z, weights)[0] <= 0.0:
                continue
            outside, inside = x - cell, x
            for _ in range(_HALVINGS):
                middle = 0.5 * (outside + inside)
                if read_value(coefficients, low, cell, middle, z, weights)[0] > 0.0:
                    inside = middle
                else:
                    outside = middle
            front[n, 0] = inside
            break
    return front


@njit(**_OPTIONS)
def find_leading(segments, c, s, low, high):
    """Return the least x [m] of segments (s, 4) turned by (cos, sin) of the tilt, between two heights, else 1e9."""
    least = 1e9
    for k in range(len(segments)):
        ax, az = c * segments[k, 0] - s * segments[k, 1], s * segments[k, 0] + c * segments[k, 1]
        bx, bz = c * segments[k, 2] - s * segments[k, 3], s * segments[k, 2] + c * segments[k, 3]
        if max(az, bz) < low or min(az, bz) > high:
            continue
        begin, end = 0.0, 1.0
        if bz != az:
            one, other = (low - az) / (bz - az), (high - az) / (bz - az)
            begin, end = max(0.0, min(one, other)), min(1.0, max(one, other))
        least = min(least, ax + begin * (bx - ax), ax + end * (bx - ax))
    return least


# The penalty rises quadratically over this depth [m] before it is linear, so that Newton's method sees no kink.
SMOOTH_DEPTH = 2e-5


class PenaltyContact(NamedTuple):
    """Contact at surface points.

    Attributes:
        forces: on the points (p, 3) [N].
        springs: negative derivatives of the forces by the points' positions (p, 3, 3) [N/m].
        by_shape: derivatives of the forces by the shape of the object's place (p, 3) [N or N/rad].
    """

    forces: NDArray
    springs: NDArray
    by_shape: NDArray


@njit(**_OPTIONS)
def resist(depth, stiffness):
    """Return force [N] and its derivative [N/m] at a depth above zero [m]."""
    if depth < SMOOTH_DEPTH:
        return 0.5 * stiffness * depth * depth / SMOOTH_DEPTH, stiffness * depth / SMOOTH_DEPTH
    return stiffness * (depth - 0.5 * SMOOTH_DEPTH), stiffness


class Touch(NamedTuple):
    """What an object does to one surface point.

    Attributes:
        fx: force along x [N].
        fz: along z [N].
        kxx: negative derivative of the force along x by the point's x [N/m].
        kxz: of either by the other [N/m].
        kzz: of the force along z by z [N/m].
        bx: derivative of the force along x by the object's size [N/m], its centre held, or by its tilt [N/rad].
        bz: of that along z.
    """

    fx: float
    fz: float
    kxx: float
    kxz: float
    kzz: float
    bx: float
    bz: float


@njit(**_OPTIONS)
def touch_cylinder(x, z, stiffness, centre_x, centre_z, radius):
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
def touch_field(x, z, stiffness, coefficients, low, cell, origin_x, origin_z, c, s, weights):
    """Return the `Touch` of an outline turned by (cos, sin) of its tilt; `weights` is (6, 4).

    With the depth d(p) below the outline the force is -stiffness d grad d, and its springs follow from d's second
    derivatives. A tilt is positive from x towards z.
    """
    rx, rz = x - origin_x, z - origin_z
    depth, i, j = read_value(coefficients, low, cell, c * rx + s * rz, c * rz - s * rx, weights)
    if depth <= 0.0:
        return Touch(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    hx, hz, a, b, d = _read_slopes(coefficients, cell, i, j, weights)
    push, slope = resist(depth, stiffness)
    gx, gz = c * hx - s * hz, s * hx + c * hz
    hxx = c * c * a - 2.0 * c * s * b + s * s * d
    hzz = s * s * a + 2.0 * c * s * b + c * c * d
    hxz = c * s * (a - d) + (c * c - s * s) * b
    fx, fz = -push * gx, -push * gz
    xx, xz, zz = slope * gx * gx + push * hxx, slope * gx * gz + push * hxz, slope * gz * gz + push * hzz
    # the object turns: its force turns along, and the point slides against it
    return Touch(fx, fz, xx, xz, zz, -fz - xx * rz + xz * rx, fx - xz * rz + zz * rx)
