"""Equilibria of a jaw over depth and height of a pressing rod, each with its compliance.

Between the stored equilibria of the manifold everything is interpolated. A load that differs from the manifold's own,
as that of any other object does, moves the jaw by the compliance of the nearest equilibrium: with coordinates m (depth
and height on the grid), loads lambda on the inner face, stored loads lambda_m, shapes u_m and compliances C_m,

    u = u_m + C_m (lambda - lambda_m).

In a linear jaw that is exact for every load; large rotations enter by m alone.

Compiled search for the stored equilibrium that is nearest to a jaw's shape.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from finforce.compiled import njit

_OPTIONS = {"cache": True, "error_model": "numpy", "fastmath": {"contract", "reassoc", "nsz"}}
STENCIL = 4


@dataclass(frozen=True, kw_only=True, eq=False)
class Manifold:
    """Stored equilibria on a grid of T depths (the first is zero) by Z heights of the rod that made them.

    Loads and motions of the inner face belong to its n rows: x and z of each, interleaved (2 n,).

    Attributes:
        young_modulus: of the jaw that was pressed [Pa]; loads are in proportion to it.
        heights: of the clamp and the rows (n + 1,) [m].
        rods: heights of the rod (Z,) [m].
        depths: largest depth of the rod at each height (Z,) [m]; the grid divides it, denser where it begins.
        loads: (T, Z, 2 n) [N].
        moves: of the rows (T, Z, 2 n) [m].
        compliance: of the rows (T, Z, 2 n, 2 n) [m/N], in single precision.
        shapes: of the whole jaw in the basis (T, Z, r) [m].
        shape_compliance: (T, Z, r, 2 n) [m/N], in single precision.
        basis: the unknowns of the full model per shape (size, r), orthonormal.
    """

    young_modulus: float
    heights: NDArray
    rods: NDArray
    depths: NDArray
    loads: NDArray
    moves: NDArray
    compliance: NDArray
    shapes: NDArray
    shape_compliance: NDArray
    basis: NDArray


@njit(**_OPTIONS)
def _weigh_cubic(x: float, count: int, weights: NDArray, slopes: NDArray) -> int:
    """Write the four weights of cubic Lagrange interpolation at x on 0 ... count - 1 and their derivatives.

    Returns:
        The first of the four nodes.
    """
    first = min(max(int(np.floor(x)) - 1, 0), count - STENCIL)
    s = x - first
    a, b, c = s - 1.0, s - 2.0, s - 3.0
    weights[0], weights[1], weights[2], weights[3] = (
        -a * b * c / 6.0,
        s * b * c / 2.0,
        -s * a * c / 2.0,
        s * a * b / 6.0,
    )
    slopes[0] = -(b * c + a * c + a * b) / 6.0
    slopes[1] = (b * c + s * c + s * b) / 2.0
    slopes[2] = -(a * c + s * c + s * a) / 2.0
    slopes[3] = (a * b + s * b + s * a) / 6.0
    return first


@njit(**_OPTIONS)
def interpolate(table, m, out):
    """Write the values out (k,) of a table (T, Z, k) at grid coordinates m (2,)."""
    wt, wz, slope = np.empty(STENCIL), np.empty(STENCIL), np.empty(STENCIL)
    t, z = _weigh_cubic(m[0], table.shape[0], wt, slope), _weigh_cubic(m[1], table.shape[1], wz, slope)
    out[:] = 0.0
    for i in range(STENCIL):
        for j in range(STENCIL):
            weight, row = wt[i] * wz[j], table[t + i, z + j]
            for k in range(len(out)):
                out[k] += weight * row[k]


@njit(**_OPTIONS)
def _interpolate_slopes(table, m, step, out):
    """Write every `step`-th pair of a table (T, Z, 2 n) at grid coordinates m (2,), and derivatives, out (3, k)."""
    wt, wz, dt, dz = np.empty(STENCIL), np.empty(STENCIL), np.empty(STENCIL), np.empty(STENCIL)
    t, z = _weigh_cubic(m[0], table.shape[0], wt, dt), _weigh_cubic(m[1], table.shape[1], wz, dz)
    out[:] = 0.0
    for i in range(STENCIL):
        for j in range(STENCIL):
            weight, along_t, along_z = wt[i] * wz[j], dt[i] * wz[j], wt[i] * dz[j]
            row = table[t + i, z + j]
            for k in range(out.shape[1] // 2):
                for a in range(2):
                    value = row[2 * step * k + a]
                    out[0, 2 * k + a] += weight * value
                    out[1, 2 * k + a] += along_t * value
                    out[2, 2 * k + a] += along_z * value


@njit(**_OPTIONS)
def find_ends(values):
    """Return the first index of values (k,) that is not zero and the one after the last; (0, 0) without any."""
    first, last = 0, 0
    for k in range(len(values)):
        if values[k] != 0.0:
            first = k
            break
    for k in range(len(values) - 1, -1, -1):
        if values[k] != 0.0:
            last = k + 1
            break
    return first, last


@njit(**_OPTIONS)
def _find_cell(table, m):
    """Return the lower grid point of the cell at m (2,) and the weights of its corners 00, 01, 10, 11."""
    t = min(max(int(np.floor(m[0])), 0), table.shape[0] - 2)
    z = min(max(int(np.floor(m[1])), 0), table.shape[1] - 2)
    a, b = m[0] - t, m[1] - z
    return t, z, (1.0 - a) * (1.0 - b), (1.0 - a) * b, a * (1.0 - b), a * b


@njit(**_OPTIONS)
def blend(table, m, rows, columns, out):
    """Write rows from one to another, and columns, of a table (T, Z, p, q), linear between grid points, to out."""
    t, z, w00, w01, w10, w11 = _find_cell(table, m)
    (low, high), (first, last) = rows, columns
    for i in range(high - low):
        c00, c01 = table[t, z, low + i, first:last], table[t, z + 1, low + i, first:last]
        c10, c11 = table[t + 1, z, low + i, first:last], table[t + 1, z + 1, low + i, first:last]
        for k in range(last - first):  # an index from 0: others may be negative, and are not vectorised
            out[i, k] = w00 * c00[k] + w01 * c01[k] + w10 * c10[k] + w11 * c11[k]


@njit(**_OPTIONS)
def add_product(table, m, vector, step, out):
    """Add the product of a table (T, Z, p, q), linear between grid points, with a vector (q,) to out (p,).

    The vector may be zero at its ends; every `step`-th pair of rows is added to.
    """
    t, z, w00, w01, w10, w11 = _find_cell(table, m)
    first, last = find_ends(vector)
    known = vector[first:last]
    for pair in range(0, len(out), 2 * step):
        for i in range(pair, min(pair + 2, len(out))):
            c00, c01 = table[t, z, i, first:last], table[t, z + 1, i, first:last]
            c10, c11 = table[t + 1, z, i, first:last], table[t + 1, z + 1, i, first:last]
            total = 0.0
            for k in range(len(known)):
                total += (w00 * c00[k] + w01 * c01[k] + w10 * c10[k] + w11 * c11[k]) * known[k]
            out[i] += total


_EXACT = {"cache": True, "error_model": "numpy"}
# Every so manieth row tells how near a stored equilibrium is; the grid coordinates move by at most so much at once.
WATCHED = 4
LARGEST_GRID_STEP = 2.0
# Damping of the search for the nearest equilibrium.
_DAMPING = 1e-6  # [-], of the largest curvature
_DAMPING_FLOOR = 1e-12  # [m^2]
# A step of the grid coordinates that leads away from the stored equilibria is halved so often, then left out; by so
# much it may, as a share and in metres.
_HALVINGS, _SLACK, _SLACK_FLOOR = 4, 1e-2, 1e-8


@njit(**_EXACT)
def find_grid_step(moves, now, m):
    """Return the step from grid coordinates m (2,) towards the stored equilibrium nearest to motions now (2 n,) [m].

    A damped step of Gauss and Newton on the distance of every so manieth row; it does not leave the grid. The third
    number is the root mean square distance at m [m].
    """
    count = (moves.shape[2] // 2 + WATCHED - 1) // WATCHED
    at = np.empty((3, 2 * count))
    _interpolate_slopes(moves, m, WATCHED, at)
    a = b = c = u = v = square = 0.0
    for k in range(count):
        for axis in range(2):
            miss = now[2 * WATCHED * k + axis] - at[0, 2 * k + axis]
            by_depth, by_height = at[1, 2 * k + axis], at[2, 2 * k + axis]
            a, b, c = a + by_depth * by_depth, b + by_depth * by_height, c + by_height * by_height
            u, v, square = u + by_depth * miss, v + by_height * miss, square + miss * miss
    damping = _DAMPING * max(a, c) + _DAMPING_FLOOR
    a, c = a + damping, c + damping
    det = a * c - b * b
    step = np.empty(3)
    step[0], step[1], step[2] = (c * u - b * v) / det, (a * v - b * u) / det, np.sqrt(square / count)
    return bound_grid_step(step, m, moves)


@njit(**_EXACT)
def bound_grid_step(step, m, moves):
    """Return a step of the grid coordinates that is not too long and does not leave the grid."""
    for axis in range(2):
        step[axis] = min(max(step[axis], -LARGEST_GRID_STEP), LARGEST_GRID_STEP)
        step[axis] = min(max(m[axis] + step[axis], 0.0), moves.shape[axis] - 1.0) - m[axis]
    return step


@njit(**_EXACT)
def _measure_miss(tables, loads, m):
    """Return the root mean square distance [m] of a jaw under loads (2 n,) [N] from the equilibrium stored at m.

    Loads are of a jaw with the modulus of the stored ones.
    """
    count = len(loads)
    extra, miss = np.empty(count), np.zeros(count)
    interpolate(tables[2], m, extra)
    for k in range(count):
        extra[k] = loads[k] - extra[k]
    add_product(tables[1], m, extra, WATCHED, miss)
    square = 0.0
    for k in range(count):
        square += miss[k] * miss[k]
    return np.sqrt(square / ((count // 2 + WATCHED - 1) // WATCHED))


@njit(**_EXACT)
def approach_grid(tables, loads, m, step):
    """Shorten a step (3,) of grid coordinates m (2,), see `find_grid_step`, until it leads nearer to the stored ones.

    The step takes the jaw to stay as it is, which it does not where compliances change fast, as at the base.

    Returns:
        How long the step was if it is left out, else 0 [-].
    """
    largest, there = (1.0 + _SLACK) * step[2] + _SLACK_FLOOR, np.empty(2)
    for _ in range(_HALVINGS):
        there[0], there[1] = m[0] + step[0], m[1] + step[1]
        if _measure_miss(tables, loads, there) <= largest:
            return 0.0
        step[0], step[1] = 0.5 * step[0], 0.5 * step[1]
    left = 2.0**_HALVINGS * max(abs(step[0]), abs(step[1]))
    step[0] = step[1] = 0.0
    return left
