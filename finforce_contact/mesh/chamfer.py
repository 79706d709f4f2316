"""The distance between two surfaces."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from finforce_contact.mesh.triangles import ObjectMesh
from finforce_contact.mesh.views import MeshView

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
    there = _distances(sample_surface(mesh_a, count, rng), mesh_b)
    back = _distances(sample_surface(mesh_b, count, rng), mesh_a)
    return Chamfer(
        mean=float(0.5 * (there.mean() + back.mean())),
        rms=float(np.sqrt(0.5 * ((there**2).mean() + (back**2).mean()))),
    )


def sample_surface(mesh: ObjectMesh, count: int, rng: np.random.Generator) -> NDArray:
    """Return points (count, 3), drawn evenly over the area of a mesh."""
    return sample_with_normals(mesh, count, rng)[0]


def sample_with_normals(mesh: ObjectMesh, count: int, rng: np.random.Generator) -> tuple[NDArray, NDArray]:
    """Return points (count, 3), drawn evenly over the area of a mesh, and the normals of their triangles there."""
    corners = mesh.vertices[mesh.triangles]
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    areas = np.linalg.norm(across, axis=1)
    which = rng.choice(len(areas), size=count, p=areas / areas.sum())
    chosen = corners[which]
    u, v = rng.random((2, count, 1))
    folds = u + v > 1.0
    u, v = np.where(folds, 1.0 - u, u), np.where(folds, 1.0 - v, v)
    points = chosen[:, 0] + u * (chosen[:, 1] - chosen[:, 0]) + v * (chosen[:, 2] - chosen[:, 0])
    return points, across[which] / areas[which, None]


def _distances(points: NDArray, mesh: ObjectMesh) -> NDArray:
    """Return the distances (n,) of points to a mesh."""
    return np.linalg.norm(points - MeshView(mesh).closest(points, np.eye(4)).points, axis=1)
