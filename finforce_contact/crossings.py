"""Whether a surface of triangles crosses itself; knows no file and no object.

Two triangles without a common corner cross where an edge of one goes through the other (Moeller and Trumbore 1997).
Candidates are found by sweeping their boxes along the axis along which the surface is longest.
"""

import numpy as np
from numba import njit
from numpy.typing import NDArray

_OPTIONS = {"cache": True, "error_model": "numpy"}
# Of an edge's length and of a triangle's sides: what only touches does not cross.
_TOUCH = 1e-9


def crosses_itself(vertices: NDArray, triangles: NDArray) -> bool:
    """Returns whether a surface of triangles (m, 3) on vertices (n, 3) [m] crosses itself.

    Triangles that lie in one plane and overlap there do not count.
    """
    corners = np.ascontiguousarray(vertices[triangles], dtype=np.float64)
    low, high = corners.min(axis=1), corners.max(axis=1)
    axis = int(np.ptp(low, axis=0).argmax())
    order = np.argsort(low[:, axis], kind="stable")
    return bool(
        _sweep(
            corners[order],
            np.ascontiguousarray(triangles[order], dtype=np.int64),
            np.ascontiguousarray(np.roll(low[order], -axis, axis=1)),
            np.ascontiguousarray(np.roll(high[order], -axis, axis=1)),
        )
    )


@njit(**_OPTIONS)
def _sweep(corners, triangles, low, high):
    """Returns whether two triangles cross; their boxes are sorted by their lower end along the first axis."""
    for i in range(len(corners)):
        for j in range(i + 1, len(corners)):
            if low[j, 0] > high[i, 0]:
                break
            if low[j, 1] > high[i, 1] or low[i, 1] > high[j, 1] or low[j, 2] > high[i, 2] or low[i, 2] > high[j, 2]:
                continue
            if not _share_corner(triangles[i], triangles[j]) and _cross(corners[i], corners[j]):
                return True
    return False


@njit(**_OPTIONS)
def _share_corner(one, other):
    for a in range(3):
        for b in range(3):
            if one[a] == other[b]:
                return True
    return False


@njit(**_OPTIONS)
def _cross(one, other):
    """Returns whether an edge of either triangle (3, 3) goes through the other one."""
    for k in range(3):
        n = (k + 1) % 3
        if _pierces(one[k], one[n], other) or _pierces(other[k], other[n], one):
            return True
    return False


@njit(**_OPTIONS)
def _pierces(start, end, triangle):
    """Returns whether the way from start to end (3,) goes through a triangle (3, 3)."""
    ax, ay, az = end[0] - start[0], end[1] - start[1], end[2] - start[2]
    bx, by, bz = triangle[1, 0] - triangle[0, 0], triangle[1, 1] - triangle[0, 1], triangle[1, 2] - triangle[0, 2]
    cx, cy, cz = triangle[2, 0] - triangle[0, 0], triangle[2, 1] - triangle[0, 1], triangle[2, 2] - triangle[0, 2]
    px, py, pz = ay * cz - az * cy, az * cx - ax * cz, ax * cy - ay * cx
    volume = bx * px + by * py + bz * pz
    size = np.sqrt((ax * ax + ay * ay + az * az) * (bx * bx + by * by + bz * bz) * (cx * cx + cy * cy + cz * cz))
    if abs(volume) <= _TOUCH * size:
        return False  # parallel to its plane
    tx, ty, tz = start[0] - triangle[0, 0], start[1] - triangle[0, 1], start[2] - triangle[0, 2]
    u = (tx * px + ty * py + tz * pz) / volume
    qx, qy, qz = ty * bz - tz * by, tz * bx - tx * bz, tx * by - ty * bx
    v = (ax * qx + ay * qy + az * qz) / volume
    way = (cx * qx + cy * qy + cz * qz) / volume
    return u > _TOUCH and v > _TOUCH and u + v < 1.0 - _TOUCH and _TOUCH < way < 1.0 - _TOUCH
