"""Distances between a line along a jaw and the outline of an object, both in the x-z plane."""

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

_OPTIONS = {"cache": True, "error_model": "numpy"}
# A wall whose far side lies no deeper than this in the jaw is still taken for what the jaw touches [m].
_THROUGH = 2e-3
_MOST_CROSSINGS = 64


@dataclass(frozen=True, kw_only=True, eq=False)
class Edges:
    """The edges of an outline's polygons.

    Attributes:
        starts: (e, 2) x and z [m].
        ends: (e, 2) x and z [m].
    """

    starts: NDArray
    ends: NDArray


def edges_of(polygons: tuple[NDArray, ...]) -> Edges:
    """Returns the edges of closed polygons (n, 2) [m]."""
    if not polygons:
        return Edges(starts=np.empty((0, 2)), ends=np.empty((0, 2)))
    ends = [np.roll(polygon, -1, axis=0) for polygon in polygons]
    return Edges(starts=np.concatenate(polygons).astype(float), ends=np.concatenate(ends).astype(float))


def place_edges(edges: Edges, origin: NDArray, tilt: float) -> Edges:
    """Returns edges turned by a tilt [rad], positive from x to z, and moved to an origin (2,) [m]."""
    c, s = np.cos(tilt), np.sin(tilt)
    turn = np.array([[c, s], [-s, c]])
    return Edges(starts=edges.starts @ turn + origin, ends=edges.ends @ turn + origin)


def compute_gaps(line: NDArray, edges: Edges) -> NDArray:
    """Returns the way along x from a line (h, 2) [m] to the object's near side (h,) [m].

    Negative where the point lies in the object, infinite where nothing of the object stands before the point. What
    lies behind the point by more than a wall's thickness, as the far wall of a cup around the finger, does not count.
    """
    return _compute_gaps(line, edges.starts, edges.ends)


def count_inside(points: NDArray, edges: Edges) -> int:
    """Returns how many of points (p, 2) [m] lie within the outline, by the even-odd rule."""
    return int(_count_inside(points, edges.starts, edges.ends))


def distances_to(line: NDArray, edges: Edges) -> NDArray:
    """Returns the distance of each point of a line (h, 2) [m] to the outline's boundary (h,) [m]."""
    along = edges.ends - edges.starts
    offset = line[:, None] - edges.starts
    share = np.clip((offset * along).sum(-1) / np.maximum((along**2).sum(-1), 1e-30), 0.0, 1.0)
    return np.sqrt(((offset - share[..., None] * along) ** 2).sum(-1).min(axis=1))


@njit(**_OPTIONS)
def _cross(z, starts, ends, crossings):
    """Fills in the sorted x where the outline crosses the height z; returns their number."""
    count = 0
    for e in range(len(starts)):
        z0, z1 = starts[e, 1], ends[e, 1]
        if (z0 <= z) == (z1 <= z) or count == _MOST_CROSSINGS:
            continue
        x = starts[e, 0] + (z - z0) / (z1 - z0) * (ends[e, 0] - starts[e, 0])
        k = count
        while k > 0 and crossings[k - 1] > x:
            crossings[k] = crossings[k - 1]
            k -= 1
        crossings[k] = x
        count += 1
    return count


@njit(**_OPTIONS)
def _compute_gaps(line, starts, ends):
    gaps, crossings = np.full(len(line), np.inf), np.empty(_MOST_CROSSINGS)
    for h in range(len(line)):
        count = _cross(line[h, 1], starts, ends, crossings)
        for k in range(0, count - 1, 2):
            if crossings[k + 1] > line[h, 0] - _THROUGH:
                gaps[h] = crossings[k] - line[h, 0]
                break
    return gaps


@njit(**_OPTIONS)
def _count_inside(points, starts, ends):
    inside, crossings = 0, np.empty(_MOST_CROSSINGS)
    for p in range(len(points)):
        count, before = _cross(points[p, 1], starts, ends, crossings), 0
        for k in range(count):
            before += crossings[k] <= points[p, 0]
        inside += before % 2
    return inside
