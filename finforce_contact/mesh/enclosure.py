"""Whether a mesh surrounds a point or a jaw, which no real object does."""

import numpy as np
from numba import njit
from numpy.typing import NDArray

from finforce_contact.mesh.triangles import ObjectMesh

_INSIDE = 0.5


def surrounds(mesh: ObjectMesh, point: NDArray) -> bool:
    """Whether a mesh, watertight or not, surrounds a point (3,) [m, object frame].

    The generalised winding number, the triangles' solid angles over 4 pi, exceeds a half (Jacobson et al. 2013).
    """
    low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
    if ((point <= low) | (point >= high)).any():
        return False
    corners = np.ascontiguousarray(mesh.vertices[mesh.triangles] - point, dtype=float)
    return abs(_sum_solid_angles(corners)) / (4.0 * np.pi) > _INSIDE


@njit(cache=True, error_model="numpy")
def _sum_solid_angles(corners):
    """Returns the sum of the solid angles of triangles (m, 3, 3) seen from the origin (Van Oosterom, Strackee 1983)."""
    total = 0.0
    for m in range(len(corners)):
        a, b, c = corners[m, 0], corners[m, 1], corners[m, 2]
        la, lb, lc = np.sqrt((a * a).sum()), np.sqrt((b * b).sum()), np.sqrt((c * c).sum())
        volume = (
            a[0] * (b[1] * c[2] - b[2] * c[1]) + a[1] * (b[2] * c[0] - b[0] * c[2]) + a[2] * (b[0] * c[1] - b[1] * c[0])
        )
        below = la * lb * lc + (a * b).sum() * lc + (b * c).sum() * la + (c * a).sum() * lb
        total += 2.0 * np.arctan2(volume, below)
    return total
