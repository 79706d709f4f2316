"""The distance between two meshes."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from finforce_contact.mesh.object_mesh import ObjectMesh
from finforce_contact.mesh.views import MeshView, sample_surface

SAMPLE_COUNT = 20000


@dataclass(frozen=True, kw_only=True)
class Chamfer:
    """The Chamfer distance between two surfaces A and B [m].

    d(a, B) is the Euclidean (L2) distance of a point of A to the nearest point of the surface B.

    Attributes:
        mean: (mean of d(a, B) + mean of d(b, A)) / 2.
        rms: square root of (mean of d(a, B)^2 + mean of d(b, A)^2) / 2.
    """

    mean: float
    rms: float


def compute_chamfer(mesh_a: ObjectMesh, mesh_b: ObjectMesh, *, count: int = SAMPLE_COUNT, seed: int = 0) -> Chamfer:
    """Return the Chamfer distance of two meshes in the same frame.

    Points are drawn evenly on one surface and compared with the whole other surface, not with points of it, whose
    spacing would be a floor under the result.

    Args:
        mesh_a: one mesh.
        mesh_b: the other one.
        count: points drawn on each.
        seed: of the drawing.
    """
    rng = np.random.default_rng(seed)
    there = _distances(sample_surface(mesh_a, count, rng).points, mesh_b)
    back = _distances(sample_surface(mesh_b, count, rng).points, mesh_a)
    return Chamfer(
        mean=float(0.5 * (there.mean() + back.mean())),
        rms=float(np.sqrt(0.5 * ((there**2).mean() + (back**2).mean()))),
    )


def _distances(points: NDArray, mesh: ObjectMesh) -> NDArray:
    """Return the distances (n,) of points to a mesh."""
    return np.linalg.norm(points - MeshView(mesh).closest(points, np.eye(4)).points, axis=1)
