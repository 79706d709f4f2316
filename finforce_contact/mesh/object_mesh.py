"""Object meshes from files and arrays: checked, repaired, and with few enough triangles for contact."""

from dataclasses import replace
from pathlib import Path

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray
from tqdm import tqdm

from finforce.files import FileError
from finforce.optional import import_open3d
from finforce.surfaces import read_surface
from finforce_contact.errors import ObjectMeshError, to_floats
from finforce_contact.mesh.repair import crosses_itself, repair
from finforce_contact.mesh.triangles import (
    ObjectMesh,
    compute_areas,
    solid_from_triangles,
    to_manifold,
    triangles_of_solid,
)

__all__ = ["FORMATS", "UNITS", "ObjectMesh", "load_object_mesh", "prepare_object_mesh", "read_triangles"]

UNITS = {"m": 1.0, "mm": 1e-3, "cm": 1e-2, "inch": 0.0254}
FORMATS = (".stl", ".obj", ".ply", ".glb")
SMALLEST, LARGEST = 0.005, 0.6  # [m], largest extent of what a gripper of 50 mm stroke holds by some part
THINNEST = 1e-4  # [m], a mesh that is thinner is a sheet, and has no inside
FARTHEST = 1.0  # [m], of a vertex from the origin of its frame; poses are of that origin, and turn about it
TRIANGLE_BOUND = 2_000_000  # a closed mesh of so many takes some ten seconds, an open one a minute
_CROSSING_LIMIT = 30_000  # triangles, whose pairs are compared in a fraction of a second
_COMMON = 0.1  # [m], the size that tells which unit is the likely one


def load_object_mesh(path: Path | str, *, unit: str = "m", triangle_limit: int = 20000) -> ObjectMesh:
    """Read an object's mesh, refuse what is no graspable object, repair and decimate the rest.

    Args:
        path: a file of `FORMATS`; the parts of a scene are put together by their transforms.
        unit: of the file's coordinates, one of `UNITS`; GLB is in metres by its standard, STL mostly in millimetres.
        triangle_limit: the most triangles that are kept.

    Returns:
        The mesh in metres, in the frame of the file.

    Raises:
        ObjectMeshError: The file cannot be read, its size fits no graspable object, it lies far from its origin, or it
            has no usable surface.
        MissingDependencyError: trimesh, manifold3d or open3d is not installed.
    """
    path = Path(path)
    if unit not in UNITS:
        raise ObjectMeshError(f"{path.name}: got unit {unit!r}, expected one of {', '.join(UNITS)}")
    vertices, triangles = read_triangles(path)
    _check_triangles(vertices, triangles, path.name)
    _check_size(vertices, triangles, path.name, unit)
    return prepare_object_mesh(vertices * UNITS[unit], triangles, name=path.name, triangle_limit=triangle_limit)


def read_triangles(path: Path | str) -> tuple[NDArray, NDArray]:
    """Return the vertices (n, 3) and triangles (m, 3) of a mesh file, in its own unit and frame, as they are.

    Raises:
        ObjectMeshError: The file is missing, of another format, too large, or cannot be read.
        MissingDependencyError: trimesh is not installed.
    """
    path = Path(path)
    formats = " ".join(FORMATS)
    if not _is_file(path):
        raise ObjectMeshError(f"{str(path)[:200]}: there is no such file, expected a mesh ({formats}); check the path")
    if path.suffix.lower() not in FORMATS:
        raise ObjectMeshError(f"{path.name}: got ending {path.suffix!r}, expected one of {formats}; convert the file")
    try:
        return read_surface(path)
    except FileError as error:
        raise ObjectMeshError(f"{path.name}: {error}") from error


def _is_file(path: Path) -> bool:
    """Say whether a file can be looked at; a name that no file can have is none."""
    try:
        return path.is_file()
    except OSError:
        return False


def prepare_object_mesh(
    vertices: ArrayLike, triangles: ArrayLike, *, name: str = "object", triangle_limit: int = 20000
) -> ObjectMesh:
    """Return a mesh that contact can be computed with: merged, closed where possible, turned outward, decimated.

    Args:
        vertices: (n, 3) [m], object frame.
        triangles: (m, 3) vertex indices from 0.
        name: what messages call the object.
        triangle_limit: the most triangles that are kept.

    Raises:
        ObjectMeshError: The arrays are no mesh, its size fits no graspable object, it lies far from its origin, or it
            has no body.
        MissingDependencyError: manifold3d or open3d is not installed.
    """
    vertices, triangles = to_floats(vertices, f"{name}: vertices", ObjectMeshError), np.asarray(triangles)
    _check_triangles(vertices, triangles, name)
    _check_size(vertices, triangles, name, "m")
    _check_origin(vertices, triangles, name)
    if not triangle_limit >= 100:
        raise ObjectMeshError(f"{name}: got triangle_limit {triangle_limit}, expected 100 at least; 20000 is usual")
    raw = ObjectMesh(vertices=vertices, triangles=triangles, watertight=False, name=name)
    mesh = repair(raw.with_triangles(vertices, triangles))
    _check_body(mesh)
    if len(mesh.triangles) > triangle_limit:
        mesh = decimate(mesh, triangle_limit)
    return _note_crossings(mesh)


def _check_triangles(vertices: NDArray, triangles: NDArray, name: str) -> None:
    """Refuse arrays that are no triangles (m, 3) on finite vertices (n, 3)."""
    if vertices.ndim != 2 or vertices.shape[1] != 3 or triangles.ndim != 2 or triangles.shape[1] != 3:
        problem = f"got vertices {vertices.shape} and triangles {triangles.shape}, expected (n, 3) and (m, 3)"
    elif not len(triangles):
        problem = f"got {len(vertices)} vertices and no triangles, expected a surface; export it whole"
    elif len(triangles) > TRIANGLE_BOUND:
        problem = f"got {len(triangles)} triangles, expected {TRIANGLE_BOUND} at most; decimate it in a mesh editor"
    elif not np.issubdtype(triangles.dtype, np.integer) or triangles.min() < 0 or triangles.max() >= len(vertices):
        problem = f"got triangles that name no vertex, expected indices from 0 to {len(vertices) - 1}; export it again"
    elif not np.isfinite(vertices[triangles]).all():
        problem = "got vertices that are NaN or infinite, expected finite coordinates; repair it in a mesh editor"
    else:
        return
    raise ObjectMeshError(f"{name}: {problem}")


def _check_size(vertices: NDArray, triangles: NDArray, name: str, unit: str) -> None:
    """Refuse an object that no gripper holds, and name the units in which it would be one."""
    extent = float(np.ptp(vertices[triangles].reshape(-1, 3), axis=0).max())
    if SMALLEST <= extent * UNITS[unit] <= LARGEST:
        return
    likely = sorted(_sizes_by_unit(extent).items(), key=lambda item: abs(np.log(item[1] / _COMMON)))
    if likely:
        named = ", or ".join(f'unit="{other}" ({size * 1e3:.0f} mm)' for other, size in likely)
        advice = f"the file is likely in another unit: {named}"
    else:
        advice = "no unit makes it so; scale it, or remove what lies far from the object"
    raise ObjectMeshError(
        f"{name}: got a largest extent of {extent * UNITS[unit] * 1e3:.6g} mm in unit {unit!r}, "
        f"expected {SMALLEST * 1e3:g} to {LARGEST * 1e3:g} mm for a graspable object; {advice}"
    )


def _check_origin(vertices: NDArray, triangles: NDArray, name: str) -> None:
    """Refuse an object that lies far from the origin of its own frame [m]."""
    away = float(np.linalg.norm(vertices[triangles], axis=-1).max())
    if away > FARTHEST:
        raise ObjectMeshError(
            f"{name}: got vertices up to {away:.3g} m from the origin of their frame, expected {FARTHEST:g} m at most; "
            "move the origin into the object, and give its poses for that origin"
        )


def _sizes_by_unit(extent: float) -> dict[str, float]:
    """Return the units in which a bare number is the extent of a graspable object, with that extent [m]."""
    sizes = {unit: extent * factor for unit, factor in UNITS.items()}
    return {unit: size for unit, size in sizes.items() if SMALLEST <= size <= LARGEST}


def _check_body(mesh: ObjectMesh) -> None:
    """Refuse a mesh without area, or thin as a sheet in some direction."""
    area = float(compute_areas(mesh.vertices, mesh.triangles).sum())
    if area < THINNEST**2:
        problem = f"got {len(mesh.triangles)} triangles of {area * 1e6:.2g} mm^2 in all, expected a surface"
    else:
        axes = np.linalg.eigh(np.cov(mesh.vertices.T))[1]
        thickness = float(np.ptp(mesh.vertices @ axes, axis=0).min())
        if thickness >= THINNEST:
            return
        problem = f"got a sheet {thickness * 1e3:.2g} mm thick, expected a body"
    raise ObjectMeshError(f"{mesh.name}: {problem}; export the whole object")


def _note_crossings(mesh: ObjectMesh) -> ObjectMesh:
    """Return the mesh, with a note if its surface crosses itself; not looked for in open or very fine ones."""
    if not mesh.watertight or len(mesh.triangles) > _CROSSING_LIMIT:
        return mesh
    if not crosses_itself(mesh.vertices, mesh.triangles):
        return mesh
    note = "The surface crosses itself; what is inside twice counts as inside."
    return replace(mesh, notes=(*mesh.notes, note))


def describe_mesh(mesh: ObjectMesh) -> str:
    """Return what an object's mesh is, and what was done to it, as sentences."""
    kind = "watertight" if mesh.watertight else "not watertight"
    return " ".join([f"{mesh.name}: {len(mesh.triangles)} triangles, {kind}.", *mesh.notes])


_INSIDE = 0.5


def surrounds(mesh: ObjectMesh, point: NDArray) -> bool:
    """Return whether a mesh, watertight or not, surrounds a point (3,) [m, object frame].

    The generalised winding number, the triangles' solid angles over 4 pi, exceeds a half (Jacobson et al. 2013).
    """
    low, high = mesh.bounds
    if ((point <= low) | (point >= high)).any():
        return False
    corners = np.ascontiguousarray(mesh.vertices[mesh.triangles] - point, dtype=float)
    return abs(_sum_solid_angles(corners)) / (4.0 * np.pi) > _INSIDE


@njit(cache=True, error_model="numpy")
def _sum_solid_angles(corners):
    """Return the sum of the solid angles of triangles (m, 3, 3) seen from the origin (Van Oosterom, Strackee 1983)."""
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
    warning = "" if deviation <= DEVIATION_LIMIT else ", more than contact should have: is this one object?"
    return (
        f"Decimated from {len(mesh.triangles)} to {len(thinned[1])} triangles; "
        f"the surface deviates by {deviation * 1e3:.3f} mm at most{warning}."
    )
