"""A watertight surface from one that is not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from finforce.optional import import_open3d
from finforce_contact.errors import ReconstructionError
from finforce_contact.mesh.chamfer import sample_surface
from finforce_contact.mesh.object_mesh import prepare_object_mesh
from finforce_contact.mesh.triangles import ObjectMesh
from finforce_contact.mesh.views import MeshView

POISSON_POINTS = 60000
POISSON_DEPTH = 7  # 128 cells along the largest extent: 0.9 mm for an object of 100 mm
POISSON_ROOMS = (1.1, 1.3, 1.6)  # where a hole is large, its cover swells and needs room to close


def close_mesh(mesh: ObjectMesh) -> ObjectMesh:
    """Return a watertight mesh: the given one where it is that already, else its Poisson surface.

    The Poisson surface rounds edges and fills what is thinner than its cells; a closed mesh is the better one as it is.
    """
    return mesh if mesh.watertight else build_poisson_mesh(mesh)


def build_poisson_mesh(mesh: ObjectMesh) -> ObjectMesh:
    """Return the Poisson surface (Kazhdan and Hoppe 2013) of points drawn evenly on a mesh in metres.

    Raises:
        ReconstructionError: it does not close, because too much of the mesh is missing.
        ObjectMeshError: it has no body.
        MissingDependencyError: Open3D is not installed.
    """
    points = sample_surface(mesh, POISSON_POINTS, np.random.default_rng(0))
    normals = MeshView(mesh).closest(points, np.eye(4)).normals
    for room in POISSON_ROOMS:
        vertices, triangles = solve_poisson(points, normals, room)
        closed = prepare_object_mesh(vertices, triangles, name=mesh.name)
        if closed.watertight:
            return replace(closed, notes=(*mesh.notes, "Closed by a Poisson surface.", *closed.notes))
    raise ReconstructionError(
        f"{mesh.name}: its surface is too open to be closed; fill its holes in a mesh editor, or leave it out"
    )


def solve_poisson(points: NDArray, normals: NDArray, room: float) -> tuple[NDArray, NDArray]:
    """Return vertices (n, 3) and triangles (m, 3) of the Poisson surface of points (k, 3) with outward normals.

    Of several pieces the largest is kept: the others are specks between walls that are nearly touching.

    Args:
        points: of the surface.
        normals: there.
        room: side of the cube that is solved in, over the largest extent of the points.
    """
    open3d = import_open3d()
    cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points))
    cloud.normals = open3d.utility.Vector3dVector(normals)
    solve = open3d.geometry.TriangleMesh.create_from_point_cloud_poisson
    surface, _ = solve(cloud, depth=POISSON_DEPTH, scale=room, n_threads=1)
    pieces, sizes, _ = surface.cluster_connected_triangles()
    return np.asarray(surface.vertices), np.asarray(surface.triangles)[np.asarray(pieces) == np.argmax(sizes)]
