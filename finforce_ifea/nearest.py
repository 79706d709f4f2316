"""Compiled search for the stored equilibrium that is nearest to a jaw's shape; knows no object."""

import numpy as np
from numba import njit

from finforce_ifea.manifold import add_product, find_ends, interpolate, interpolate_slopes

_OPTIONS = {"cache": True, "error_model": "numpy"}
# Every so manieth row tells how near a stored equilibrium is; the grid coordinates move by at most so much at once.
WATCHED = 4
LARGEST_GRID_STEP = 2.0
# Damping of the search for the nearest equilibrium, as a share of the largest curvature, and as squared metres.
_DAMPING, _DAMPING_FLOOR = 1e-6, 1e-12
# A step of the grid coordinates that leads away from the stored equilibria is halved so often, then left out; by so
# much it may, as a share and in metres.
_HALVINGS, _SLACK, _SLACK_FLOOR = 4, 1e-2, 1e-8


@njit(**_OPTIONS)
def find_grid_step(moves, now, m):
    """Returns the step from grid coordinates m (2,) towards the stored equilibrium nearest to motions now (2 n,) [m].

    A damped step of Gauss and Newton on the distance of every so manieth row; it does not leave the grid. The third
    number is the root mean square distance at m [m].
    """
    count = (moves.shape[2] // 2 + WATCHED - 1) // WATCHED
    at = np.empty((3, 2 * count))
    interpolate_slopes(moves, m, WATCHED, at)
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
    step = np.array([(c * u - b * v) / det, (a * v - b * u) / det, np.sqrt(square / count)])
    return bound_grid_step(step, m, moves)


@njit(**_OPTIONS)
def bound_grid_step(step, m, moves):
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
    first, last = find_ends(extra)
    add_product(tables[1], m, extra, first, last, WATCHED, miss)
    return np.sqrt((miss**2).sum() / ((count // 2 + WATCHED - 1) // WATCHED))


@njit(**_OPTIONS)
def approach_grid(tables, loads, m, step):
    """Shortens a step (3,) of grid coordinates m (2,), see `find_grid_step`, until it leads nearer to the stored ones.

    The step takes the jaw to stay as it is, which it does not where compliances change fast, as at the base.
    """
    largest = (1.0 + _SLACK) * step[2] + _SLACK_FLOOR
    for _ in range(_HALVINGS):
        if _measure_miss(tables, loads, m + step[:2]) <= largest:
            return
        step[:2] *= 0.5
    step[:2] = 0.0
