"""Compiled loops over the rows and points of a jaw of stored equilibria."""

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from finforce_ifea.fem.model import LARGEST_MOVE
from finforce_ifea.reduced.equilibria import (
    LARGEST_GRID_STEP,
    WATCHED,
    add_product,
    approach_grid,
    blend,
    bound_grid_step,
    find_ends,
    find_grid_step,
    interpolate,
)

_OPTIONS = {"cache": True, "error_model": "numpy"}
# The grid coordinates wait until a correction is below this share of what is allowed: a shape far from equilibrium says
# little of the nearest one.
_CALM = 0.15
# Below this grid coordinate of the depth a jaw is too little bent to tell the height by its shape.
SHALLOW = 0.5


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
    """One linearised equilibrium; see `finforce_ifea.contact_mechanics.pressed_jaw.PressedState`.

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
def follow(moves, compliance, loads, q):
    """Returns motions (k,) [m] of a table moves (T, Z, k) with its compliance (T, Z, k, 2 n) for unknowns q."""
    count = loads.shape[2]
    m, extra, out = q[count:], np.empty(count), np.empty(moves.shape[2])
    interpolate(loads, m, extra)
    for k in range(count):
        extra[k] = q[k] - extra[k]
    interpolate(moves, m, out)
    first, last = find_ends(extra)
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
        begin, end = find_ends(modes[:count, c])
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
    first, last = find_ends(known)
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
    return out, np.abs(C @ np.ascontiguousarray(out[first:last, 0])).max()


@njit(**_OPTIONS)
def _hold_base(q, compliance, face, contact, steps):
    """Returns what of the contact force the clamp holds below the first row, and its derivatives (2, 4) [N]."""
    out, moved = np.zeros((2, 4)), np.zeros((2, 4))
    forces, springs, by_shape = contact
    if not ((face.low < 0) & (springs[:, 0, 0] + springs[:, 2, 2] > 0.0)).any():
        return out
    rows = np.empty((2, len(steps)))
    blend(compliance, q[len(steps) :], 0, 2, 0, len(steps), rows)
    moved = rows @ steps
    for p in range(len(forces)):
        held, spring = 1.0 - face.share[p], springs[p]
        if face.low[p] >= 0:
            continue
        for a in range(2):
            out[a, 0] += held * forces[p, 2 * a]
            out[a, 1] -= held * spring[2 * a, 0]
            out[a, 2] += held * by_shape[p, 2 * a]
            out[a, 3] += held * spring[2 * a, 2]
            for c in range(4):
                share = spring[2 * a, 0] * moved[0, c] + spring[2 * a, 2] * moved[1, c]
                out[a, c] -= held * face.share[p] * share
    return out


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
    first, last = find_ends(correction[:count])
    add_product(tables[1], q[count:], correction[:count], first, last, WATCHED, after)
    nearest = find_grid_step(tables[0], after, q[count:])
    if size <= _CALM:
        approach_grid(tables, q[:count] + correction[:count], q[count:], nearest)
    correction[count:] = nearest[:2]
    if q[count] < SHALLOW and total > 0.0:
        step = np.array([correction[count], np.interp(place[2], face.rods, np.arange(len(face.rods))) - q[count + 1]])
        correction[count:] = bound_grid_step(step, q[count:], tables[0])
    turned = np.abs(correction[count:]).max() / LARGEST_GRID_STEP
    if size > _CALM:
        correction[count:] = 0.0
    size = max(size, turned)
    held = _hold_base(q, tables[1], face, contact, steps)
    force, force_modes = np.zeros(3), np.zeros((3, 3))
    force[::2], force_modes[::2] = held[:, 0], held[:, 1:]
    for k in range(count):
        axis = 2 * (k % 2)
        force[axis] += q[k] + correction[k]
        force_modes[axis] += modes[k]
    return ContactStep(correction, modes, force, force_modes, point, place, size, nearest[2], total > 0.0)
