"""Compiled loops over the rows and points of a jaw of stored equilibria; knows no object."""

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from finforce_ifea.manifold import add_product, blend, interpolate, interpolate_slopes
from finforce_ifea.model import LARGEST_MOVE

_OPTIONS = {"cache": True, "error_model": "numpy"}
# Every so manieth row tells how near a stored equilibrium is; the grid coordinates move by at most so much at once.
_WATCHED = 4
LARGEST_GRID_STEP = 2.0
# Damping of the search for the nearest equilibrium, as a share of the largest curvature, and as squared metres.
_DAMPING, _DAMPING_FLOOR = 1e-6, 1e-12
# The grid coordinates wait until a correction is below this share of what is allowed: a shape far from equilibrium says
# little of the nearest one.
_CALM = 0.15
# A step of the grid coordinates that leads away from the stored equilibria is halved so often, then left out; by so much
# it may, as a share and in metres.
_HALVINGS, _SLACK, _SLACK_FLOOR = 4, 1e-2, 1e-8
# Below this grid coordinate of the depth a jaw is too little bent to tell the height by its shape.
_SHALLOW = 0.5


class FaceRows(NamedTuple):
    """The contact points of the inner face on the rows that move them.

    Attributes:
        points: undeformed (p, 3) [m].
        low: the row below each point (p,), -1 for the clamp.
        share: of the row above in each point (p,).
        rods: heights of the grid (Z,) [m].
    """

    points: NDArray
    low: NDArray
    share: NDArray
    rods: NDArray


class ContactStep(NamedTuple):
    """One linearised equilibrium; see `finforce_ifea.rolling.PressedState`.

    Attributes:
        correction: of the unknowns (2 n + 2,).
        modes: (2 n + 2, 3).
        force: (3,) [N].
        force_modes: (3, 3).
        pressure_point: (3,) [m], NaN without contact.
        pressure_place: (3,) [m], NaN without contact.
        size: of the whole correction, as a share of what is allowed at once.
        away: root mean square distance of the shape from the nearest stored one [m].
        touches: whether any point is in contact.
    """

    correction: NDArray
    modes: NDArray
    force: NDArray
    force_modes: NDArray
    pressure_point: NDArray
    pressure_place: NDArray
    size: float
    away: float
    touches: bool


@njit(**_OPTIONS)
def _find_ends(values):
    """Returns the first index of values (k,) that is not zero and the one after the last; (0, 0) without any."""
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
def follow(moves, compliance, loads, q):
    """Returns motions (k,) [m] of a table moves (T, Z, k) with its compliance (T, Z, k, 2 n) for unknowns q."""
    count = loads.shape[2]
    m, extra, out = q[count:], np.empty(count), np.empty(moves.shape[2])
    interpolate(loads, m, extra)
    for k in range(count):
        extra[k] = q[k] - extra[k]
    interpolate(moves, m, out)
    first, last = _find_ends(extra)
    add_product(compliance, m, extra, first, last, 1, out)
    return out


@njit(**_OPTIONS)
def place_points(points, shapes, compliance, loads, q):
    """Returns points (p, c) [m] moved as the table shapes (T, Z, p c) [m] and its compliance say."""
    return points + follow(shapes, compliance, loads, q).reshape(points.shape)


@njit(**_OPTIONS)
def move_points(compliance, q, modes):
    """Returns the motions (p, 3, k) [m] of points whose compliance is (T, Z, 3 p, 2 n), for modes (2 n + 2, k)."""
    count, k = compliance.shape[3], modes.shape[1]
    first, last = count, 0
    for c in range(k):
        begin, end = _find_ends(modes[:count, c])
        if end > 0:
            first, last = min(first, begin), max(last, end)
    first = min(first, last)
    size = compliance.shape[2]
    part = np.empty((size, last - first))
    blend(compliance, q[count:], 0, size, first, last, part)
    out = np.zeros((size, k))
    for i in range(size):
        for j in range(last - first):
            for c in range(k):
                out[i, c] += part[i, j] * modes[first + j, c]
    return out.reshape(size // 3, 3, k)


@njit(**_OPTIONS)
def find_grid_step(moves, now, m):
    """Returns the step from grid coordinates m (2,) towards the stored equilibrium nearest to motions now (2 n,) [m].

    A damped step of Gauss and Newton on the distance of every so manieth row; it does not leave the grid. The third
    number is the root mean square distance at m [m].
    """
    count = (moves.shape[2] // 2 + _WATCHED - 1) // _WATCHED
    at = np.empty((3, 2 * count))
    interpolate_slopes(moves, m, _WATCHED, at)
    a = b = c = u = v = square = 0.0
    for k in range(count):
        for axis in range(2):
            miss = now[2 * _WATCHED * k + axis] - at[0, 2 * k + axis]
            by_depth, by_height = at[1, 2 * k + axis], at[2, 2 * k + axis]
            a, b, c = a + by_depth * by_depth, b + by_depth * by_height, c + by_height * by_height
            u, v, square = u + by_depth * miss, v + by_height * miss, square + miss * miss
    damping = _DAMPING * max(a, c) + _DAMPING_FLOOR
    a, c = a + damping, c + damping
    det = a * c - b * b
    step = np.array([(c * u - b * v) / det, (a * v - b * u) / det, np.sqrt(square / count)])
    return _bound_grid_step(step, m, moves)


@njit(**_OPTIONS)
def _bound_grid_step(step, m, moves):
    """Returns a step of the grid coordinates that is not too long and does not leave the grid."""
    for axis in range(2):
        step[axis] = min(max(step[axis], -LARGEST_GRID_STEP), LARGEST_GRID_STEP)
        step[axis] = min(max(m[axis] + step[axis], 0.0), moves.shape[axis] - 1.0) - m[axis]
    return step


@njit(**_OPTIONS)
def _measure_miss(tables, loads, m):
    """Returns the root mean square distance [m] of a jaw under loads (2 n,) [N] from the equilibrium stored at m."""
    count = len(loads)
    extra, miss = np.empty(count), np.zeros(count)
    interpolate(tables[2], m, extra)
    for k in range(count):
        extra[k] = loads[k] - extra[k]
    first, last = _find_ends(extra)
    add_product(tables[1], m, extra, first, last, _WATCHED, miss)
    return np.sqrt((miss**2).sum() / ((count // 2 + _WATCHED - 1) // _WATCHED))


@njit(**_OPTIONS)
def _approach_grid(tables, loads, m, step):
    """Shortens a step (3,) of grid coordinates m (2,), see `find_grid_step`, until it leads nearer to the stored ones.

    The step takes the jaw to stay as it is, which it does not where compliances change fast, as at the base.
    """
    largest = (1.0 + _SLACK) * step[2] + _SLACK_FLOOR
    for _ in range(_HALVINGS):
        if _measure_miss(tables, loads, m + step[:2]) <= largest:
            return
        step[:2] *= 0.5
    step[:2] = 0.0


@njit(**_OPTIONS)
def place_contact(face, moves):
    """Returns the contact points (p, 3) [m], moved by the rows beside them, whose motions are (2 n,) [m]."""
    points = face.points.copy()
    for p in range(len(points)):
        low, share = face.low[p], face.share[p]
        for a in range(2):
            move = share * moves[2 * (low + 1) + a]
            if low >= 0:
                move += (1.0 - share) * moves[2 * low + a]
            points[p, 2 * a] += move
    return points


@njit(**_OPTIONS)
def _add_springs(spring, weight, row, low, share, stiffness):
    """Adds a point's springs (3, 3), seen from a row with a weight, to the band stiffness (2 n, 7)."""
    for j in range(2):
        other = low + j
        if other < 0:
            continue
        w = weight * (share if j else 1.0 - share)
        for a in range(2):
            for b in range(2):
                stiffness[2 * row + a, 3 + 2 * (other - row) + b - a] += w * spring[2 * a, 2 * b]


@njit(**_OPTIONS)
def _gather(face, contact, loads, stiffness):
    """Adds contact at points (forces, springs, by_shape) to the rows: loads (2 n, 4), band stiffness (2 n, 7).

    Columns of loads: now, by depth, by shape, by height. The band holds entries i - 3 ... i + 3 of each line i.
    """
    forces, springs, by_shape = contact
    for p in range(len(forces)):
        if springs[p, 0, 0] == 0.0 and springs[p, 2, 2] == 0.0:
            continue
        for i in range(2):
            row, w = face.low[p] + i, (face.share[p] if i else 1.0 - face.share[p])
            if row < 0:
                continue
            for a in range(2):
                k = 2 * row + a
                loads[k, 0] += w * forces[p, 2 * a]
                loads[k, 1] -= w * springs[p, 2 * a, 0]
                loads[k, 2] += w * by_shape[p, 2 * a]
                loads[k, 3] += w * springs[p, 2 * a, 2]
            _add_springs(springs[p], w, row, face.low[p], face.share[p], stiffness)


@njit(**_OPTIONS)
def _solve_rows(q, compliance, loads, stiffness):
    """Returns (2 n, 4): the step of the loads to equilibrium, and their derivatives by the place; and its motion [m].

    With loads p(u) of the object at the rows, springs S = -dp/du and compliance C, one step of Newton's method on
    lambda = p(u(lambda)) solves

        (I + S C) [step, modes] = [p - lambda, dp/dplace].
    """
    out, known = np.zeros(loads.shape), np.zeros(len(loads))
    for k in range(len(loads)):
        loads[k, 0] -= q[k]
        known[k] = abs(q[k]) + abs(stiffness[k, 3])
    first, last = _find_ends(known)
    size = last - first
    if size == 0:
        return out, 0.0
    C, A = np.empty((size, size)), np.eye(size)
    blend(compliance, q[len(loads) :], first, last, first, last, C)
    for i in range(size):
        for d in range(7):
            k, s = i + d - 3, stiffness[first + i, d]
            if s != 0.0:
                for j in range(size):
                    A[i, j] += s * C[k, j]
    out[first:last] = np.linalg.solve(A, loads[first:last])
    return out, np.abs(C @ out[first:last, 0]).max()


@njit(**_OPTIONS)
def step_contact(q, tables, face, moves, points, contact):
    """Returns one linearised equilibrium with an object; see `ContactStep`.

    Args:
        q: unknowns (2 n + 2,).
        tables: motions of the rows at the stored equilibria (T, Z, 2 n) [m], their compliance (T, Z, 2 n, 2 n) and
            their loads (T, Z, 2 n) [N].
        face: the contact points on the rows.
        moves: of the rows now (2 n,) [m].
        points: contact points now (p, 3) [m].
        contact: forces (p, 3), springs (p, 3, 3) and derivatives by the shape (p, 3).
    """
    count = len(moves)
    loads, stiffness = np.zeros((count, 4)), np.zeros((count, 7))
    _gather(face, contact, loads, stiffness)
    total, point, place = 0.0, np.zeros(3), np.zeros(3)
    for p in range(len(points)):
        size = np.hypot(contact[0][p, 0], contact[0][p, 2])
        if size > 0.0:
            total += size
            point += size * points[p]
            place += size * face.points[p]
    point, place = point / total, place / total
    steps, moved = _solve_rows(q, tables[1], loads, stiffness)
    size = moved / LARGEST_MOVE
    if total > 0.0 and size > 1.0:
        steps[:, 0] /= size
    correction, modes = np.zeros(count + 2), np.zeros((count + 2, 3))
    correction[:count], modes[:count] = steps[:, 0], steps[:, 1:]
    after = moves.copy()
    first, last = _find_ends(correction[:count])
    add_product(tables[1], q[count:], correction[:count], first, last, _WATCHED, after)
    nearest = find_grid_step(tables[0], after, q[count:])
    if size <= _CALM:
        _approach_grid(tables, q[:count] + correction[:count], q[count:], nearest)
    correction[count:] = nearest[:2]
    if q[count] < _SHALLOW and total > 0.0:
        step = np.array([correction[count], np.interp(place[2], face.rods, np.arange(len(face.rods))) - q[count + 1]])
        correction[count:] = _bound_grid_step(step, q[count:], tables[0])
    turned = np.abs(correction[count:]).max() / LARGEST_GRID_STEP
    if size > _CALM:
        correction[count:] = 0.0
    size = max(size, turned)
    force, force_modes = np.zeros(3), np.zeros((3, 3))
    for k in range(count):
        axis = 2 * (k % 2)
        force[axis] += q[k] + correction[k]
        force_modes[axis] += modes[k]
    return ContactStep(correction, modes, force, force_modes, point, place, size, nearest[2], total > 0.0)
