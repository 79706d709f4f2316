"""Fewer triangles for the same object, with the deviation that it costs."""

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from finforce.optional import import_open3d
from finforce_contact.errors import ObjectMeshError
from finforce_contact.mesh.solids import solid_from_triangles, to_manifold, triangles_of_solid
from finforce_contact.mesh.triangles import ObjectMesh

DEVIATION_LIMIT = 1e-4  # [m], a fifth of the error of a good pose; more is said in the note
RUIN = 0.1  # [-], deviation of the largest extent; what deviates by more is another object
_FIRST_TOLERANCE = 1e-5  # [m]
_SAMPLES = 50_000  # points at which the deviation is measured


def decimate(mesh: ObjectMesh, triangle_limit: int) -> ObjectMesh:
    """Return the mesh with at most so many triangles, still watertight if it was, and a note with its deviation.

    Flat parts are thinned first within 0.01 mm; what is too much then goes by the quadric error (Garland and
    Heckbert 1997).

    Raises:
        ObjectMeshError: So few triangles cannot be this object.
        MissingDependencyError: manifold3d or open3d is not installed.
    """
    solid = to_manifold(mesh)
    if solid is None:
        thinned = thin_by_quadric(mesh.vertices, mesh.triangles, triangle_limit)
    else:
        thinned = triangles_of_solid(solid.simplify(_FIRST_TOLERANCE))
        if len(thinned[1]) > triangle_limit:
            thinned = thin_by_quadric(*thinned, triangle_limit)
        if solid_from_triangles(*thinned) is None:
            thinned = _simplify_within(solid, triangle_limit)
    note = _describe(mesh, thinned)
    return mesh.with_triangles(*thinned, note)


def thin_by_quadric(vertices: NDArray, triangles: NDArray, triangle_limit: int) -> tuple[NDArray, NDArray]:
    """Return vertices and triangles after edges were collapsed in the order of their quadric error."""
    open3d = import_open3d()
    geometry = open3d.geometry.TriangleMesh(
        open3d.utility.Vector3dVector(vertices), open3d.utility.Vector3iVector(triangles)
    )
    stages = np.ceil(np.log2(len(triangles) / triangle_limit)).astype(int)
    # One stage each time the number is halved, so that seconds of work show how far they are.
    for stage in tqdm(range(stages)[::-1], desc="decimating", disable=True if stages < 4 else None, leave=False):
        geometry = geometry.simplify_quadric_decimation(triangle_limit << int(stage))
    return np.asarray(geometry.vertices).copy(), np.asarray(geometry.triangles).copy()


def measure_deviation(mesh: ObjectMesh, vertices: NDArray, triangles: NDArray) -> float:
    """Return the largest distance [m] of a vertex of a mesh or of other triangles to the other's surface."""
    ways = ((vertices, mesh.vertices, mesh.triangles), (mesh.vertices, vertices, triangles))
    return max(_largest_distance(points, *surface) for points, *surface in ways)


def _largest_distance(points: NDArray, vertices: NDArray, triangles: NDArray) -> float:
    open3d = import_open3d()
    scene = open3d.t.geometry.RaycastingScene(nthreads=1)
    scene.add_triangles(vertices.astype(np.float32), triangles.astype(np.uint32))
    some = points[:: max(1, len(points) // _SAMPLES)].astype(np.float32)
    return float(scene.compute_distance(some, nthreads=1).numpy().max())


def _simplify_within(solid, triangle_limit: int) -> tuple[NDArray, NDArray]:
    """Return the triangles of the solid, simplified in growing steps that never open it."""
    tolerance = _FIRST_TOLERANCE
    while solid.num_tri() > triangle_limit:
        tolerance *= 2.0
        solid = solid.simplify(tolerance)
    return triangles_of_solid(solid)


def _describe(mesh: ObjectMesh, thinned: tuple[NDArray, NDArray]) -> str:
    deviation = measure_deviation(mesh, *thinned) if len(thinned[1]) else np.inf
    if deviation > RUIN * np.ptp(mesh.vertices, axis=0).max():
        raise ObjectMeshError(
            f"{mesh.name}: got {len(mesh.triangles)} triangles, of which {len(thinned[1])} are left that deviate by "
            f"{deviation * 1e3:.1f} mm, expected one object of connected parts; remove fragments in a mesh editor"
        )
    verdict = "" if deviation <= DEVIATION_LIMIT else ", more than contact should have: is this one object?"
    return (
        f"Decimated from {len(mesh.triangles)} to {len(thinned[1])} triangles; "
        f"the surface deviates by {deviation * 1e3:.3f} mm at most{verdict}."
    )
