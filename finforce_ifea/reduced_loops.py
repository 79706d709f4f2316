"""Compiled loops over the rows and points of a jaw of stored equilibria; knows no object."""

import numpy as np
from numba import njit

from finforce_ifea.manifold import blend, interpolate, interpolate_slopes

_OPTIONS = {"cache": True, "error_model": "numpy"}
# Loads below this share of the largest are nothing.
_NOTHING = 1e-14
# Every so manieth row tells how near a stored equilibrium is; m moves by at most so much at once.
WATCHED = 4
_LARGEST_GRID_STEP = 2.0
# Damping of the search for the nearest equilibrium, as a share of the largest curvature, and as squared metres.
_DAMPING, _DAMPING_FLOOR = 1e-6, 1e-12


@njit(**_OPTIONS)
def _deviate(loads, q, extra):
    """Writes extra (2 n,) [N]: the loads of q beyond those of its stored equilibrium; returns their first and end."""
    count = len(extra)
    interpolate(loads, q[count:], extra)
    largest = 0.0
    for k in range(count):
        extra[k] = q[k] - extra[k]
        largest = max(largest, abs(extra[k]))
    first, last, least = count, 0, _NOTHING * largest
    for k in range(count):
        if abs(extra[k]) > least:
            first, last = min(first, k), k + 1
    return min(first, last), last


@njit(**_OPTIONS)
def _follow(moves, compliance, loads, q, rows, out):
    """Writes the motions out (len(rows),) [m] of all `rows` of a table moves (T, Z, k) with its compliance."""
    count = loads.shape[2]
    extra, every = np.empty(count), np.empty(moves.shape[2])
    first, last = _deviate(loads, q, extra)
    interpolate(moves, q[count:], every)
    part = np.empty((1, last - first))
    for i in range(len(rows)):
        total = every[rows[i]]
        blend(compliance, q[count:], rows[i : i + 1], first, last, part)
        for j in range(last - first):
            total += part[0, j] * extra[first + j]
        out[i] = total


@njit(**_OPTIONS)
def place_rows(moves, compliance, loads, q):
    """Returns the motions (2 n,) [m] of all rows."""
    out = np.empty(moves.shape[2])
    _follow(moves, compliance, loads, q, np.arange(moves.shape[2]), out)
    return out


@njit(**_OPTIONS)
def place_points(points, shapes, compliance, loads, q):
    """Returns points (p, c) [m] moved as the table shapes (T, Z, p c) [m] and its compliance say."""
    out = np.empty(points.size)
    _follow(shapes, compliance, loads, q, np.arange(points.size), out)
    return points + out.reshape(points.shape)


@njit(**_OPTIONS)
def move_points(compliance, q, modes):
    """Returns the motions (p, 3, k) [m] of points whose compliance is (T, Z, 3 p, 2 n), for modes (2 n + 2, k)."""
    count, k = compliance.shape[3], modes.shape[1]
    first, last = count, 0
    for row in range(count):
        for c in range(k):
            if modes[row, c] != 0.0:
                first, last = min(first, row), row + 1
    first = min(first, last)
    rows = np.arange(compliance.shape[2])
    part = np.empty((len(rows), last - first))
    blend(compliance, q[count:], rows, first, last, part)
    out = np.zeros((len(rows), k))
    for i in range(len(rows)):
        for j in range(last - first):
            for c in range(k):
                out[i, c] += part[i, j] * modes[first + j, c]
    return out.reshape(len(rows) // 3, 3, k)


@njit(**_OPTIONS)
def find_grid_step(moves, now, m):
    """Returns the step (2,) from grid coordinates m towards the stored equilibrium nearest to motions now (2 n,) [m].

    A damped step of Gauss and Newton on the distance of every so manieth row; it does not leave the grid.
    """
    every = WATCHED
    count = (moves.shape[2] // 2 + every - 1) // every
    at, slopes = np.empty(moves.shape[2]), np.empty((2, 2 * count))
    interpolate(moves, m, at)
    interpolate_slopes(moves, m, every, slopes)
    a = b = c = u = v = 0.0
    for k in range(count):
        for axis in range(2):
            miss = now[2 * every * k + axis] - at[2 * every * k + axis]
            by_depth, by_height = slopes[0, 2 * k + axis], slopes[1, 2 * k + axis]
            a, b, c = a + by_depth * by_depth, b + by_depth * by_height, c + by_height * by_height
            u, v = u + by_depth * miss, v + by_height * miss
    damping = _DAMPING * max(a, c) + _DAMPING_FLOOR
    a, c = a + damping, c + damping
    det = a * c - b * b
    step = np.array([(c * u - b * v) / det, (a * v - b * u) / det])
    for axis in range(2):
        step[axis] = min(max(step[axis], -_LARGEST_GRID_STEP), _LARGEST_GRID_STEP)
        step[axis] = min(max(m[axis] + step[axis], 0.0), moves.shape[axis] - 1.0) - m[axis]
    return step


@njit(**_OPTIONS)
def place_contact(rest, low, share, moves):
    """Returns contact points (p, 3) [m] of the inner face: rest (p, 3) moved by the rows beside them.

    Args:
        rest: undeformed points (p, 3) [m].
        low: the row below each point (p,), -1 where there is none.
        share: of the row above (p,).
        moves: of the rows (2 n,) [m].
    """
    points = rest.copy()
    for p in range(len(rest)):
        for a in range(2):
            move = share[p] * moves[2 * (low[p] + 1) + a]
            if low[p] >= 0:
                move += (1.0 - share[p]) * moves[2 * low[p] + a]
            points[p, 2 * a] += move
    return points


@njit(**_OPTIONS)
def _gather(forces, springs, by_shape, low, share, known, loads, stiffness):
    """Adds contact at points to the rows: loads (2 n, 4) less what is `known`, and the band stiffness (2 n, 7).

    Columns of loads: now, by depth, by shape, by height. The band holds entries i - 3 ... i + 3 of each line i.
    """
    first, last = len(loads), 0
    for k in range(len(loads)):
        loads[k, 0] = -known[k]
        if known[k] != 0.0:
            first, last = min(first, k), max(last, k + 1)
    for p in range(len(forces)):
        if springs[p, 0, 0] == 0.0 and springs[p, 2, 2] == 0.0:
            continue
        for i in range(2):
            wi, row = (share[p] if i else 1.0 - share[p]), low[p] + i
            if row < 0:
                continue
            first, last = min(first, 2 * row), max(last, 2 * row + 2)
            for a in range(2):
                k = 2 * row + a
                loads[k, 0] += wi * forces[p, 2 * a]
                loads[k, 1] -= wi * springs[p, 2 * a, 0]
                loads[k, 2] += wi * by_shape[p, 2 * a]
                loads[k, 3] += wi * springs[p, 2 * a, 2]
                for j in range(2):
                    wj, other = (share[p] if j else 1.0 - share[p]), low[p] + j
                    if other < 0:
                        continue
                    for b in range(2):
                        stiffness[k, 3 + 2 * other + b - k] += wi * wj * springs[p, 2 * a, 2 * b]
    return min(first, last), last


@njit(**_OPTIONS)
def solve_contact(q, compliance, low, share, forces, springs, by_shape):
    """Returns the step of the loads to equilibrium with an object and their derivatives by its place (2 n, 4).

    With loads p(u) of the object at the rows, springs S = -dp/du and compliance C, one step of Newton's method on
    lambda = p(u(lambda)) solves

        (I + S C) [step, modes] = [p - lambda, dp/dplace].
    """
    count = compliance.shape[3]
    loads, stiffness = np.zeros((count, 4)), np.zeros((count, 7))
    first, last = _gather(forces, springs, by_shape, low, share, q[:count], loads, stiffness)
    size = last - first
    out = np.zeros((count, 4))
    if size == 0:
        return out
    C = np.empty((size, size))
    blend(compliance, q[count:], np.arange(first, last), first, last, C)
    A = np.eye(size)
    for i in range(size):
        for d in range(7):
            k = i + d - 3
            s = stiffness[first + i, d]
            if s != 0.0:
                for j in range(size):
                    A[i, j] += s * C[k, j]
    out[first:last] = np.linalg.solve(A, loads[first:last])
    return out
