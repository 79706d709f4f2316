"""Solids of manifold3d made from object meshes, for booleans and cuts; the only module that makes them."""

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from finforce.optional import import_manifold3d

if TYPE_CHECKING:
    from manifold3d import Manifold

    from finforce_contact.mesh.triangles import ObjectMesh


def to_manifold(mesh: "ObjectMesh") -> "Manifold | None":
    """Return the solid that a mesh bounds, in metres and in the object frame; None where it is not watertight.

    Building it takes some 0.7 ms per thousand triangles: keep it.

    Raises:
        MissingDependencyError: manifold3d is not installed.
    """
    return solid_from_triangles(mesh.vertices, mesh.triangles) if mesh.watertight else None


def solid_from_triangles(vertices: NDArray, triangles: NDArray) -> "Manifold | None":
    """Return the solid that triangles (m, 3) on vertices (n, 3) [m] bound, or None where they bound none."""
    manifold3d = import_manifold3d()
    corners = np.ascontiguousarray(vertices, dtype=np.float64)
    solid = manifold3d.Manifold(manifold3d.Mesh64(corners, np.ascontiguousarray(triangles, dtype=np.uint64)))
    sound = solid.status() == manifold3d.Error.NoError and not solid.is_empty()
    return solid if sound else None


def triangles_of_solid(solid: "Manifold") -> tuple[NDArray, NDArray]:
    """Return the vertices (n, 3) [m] and the triangles (m, 3) int32 of a solid."""
    mesh = solid.to_mesh64()
    return np.array(mesh.vert_properties[:, :3]), np.array(mesh.tri_verts, dtype=np.int32)
