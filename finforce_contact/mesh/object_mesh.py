"""Object meshes: surfaces read from a file or arrays, checked, repaired and decimated."""

from __future__ import annotations

import os
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from finforce.files import FileError, read_json
from finforce.optional import import_manifold3d, import_open3d
from finforce.surfaces import read_surface
from finforce.triangle_surface import Surface, solid_from_triangles, triangles_of_solid
from finforce_contact.errors import ObjectMeshError

if TYPE_CHECKING:
    from manifold3d import Manifold

UNITS = {"m": 1.0, "mm": 1e-3, "cm": 1e-2, "inch": 0.0254}
FORMATS = (".stl", ".obj", ".ply", ".off", ".glb", ".3mf", ".step", ".stp")
POSE_ENDING = ".pose.json"  # of the file beside a reconstructed mesh
SMALLEST = 0.005  # [m], least largest extent of an object
LARGEST = 0.6  # [m], largest extent of an object that a gripper of 50 mm stroke holds by some part
THINNEST = 1e-4  # [m], a mesh that is thinner is a sheet, and has no inside
FARTHEST = 1.0  # [m], of a vertex from the origin of its frame; poses are of that origin, and turn about it
TRIANGLE_BOUND = 2_000_000  # a closed mesh of so many takes some ten seconds, an open one a minute
_COMMON = 0.1  # [m], the size that tells which unit is the likely one
CRACK = 1e-5  # [m], vertices of an open mesh this close are one; below what contact can tell
HOLE_SHARE = 0.1  # [-], radius of the holes that are filled, of the largest extent; an opening to grasp into is larger
MOST_OPEN = 0.75  # [-], share of edges with one triangle only; a closed surface has none
_MOST_BODIES = 1000  # beyond, the mesh is fragments and its bodies mean nothing
DEVIATION_LIMIT = 1e-4  # [m], a fifth of the error of a good pose; more is said in the note
RUIN = 0.1  # [-], deviation of the largest extent; what deviates by more is another object
_FIRST_TOLERANCE = 1e-5  # [m]
_SAMPLES = 50_000  # points at which the deviation is measured
_INSIDE = 0.5  # turns of a surface around a point, above which that is inside


@dataclass(frozen=True, kw_only=True, eq=False)
class ObjectMesh(Surface):
    """The surface of an object in its own frame.

    Attributes:
        watertight: the triangles bound solids without a gap.
        name: name of the object in messages.
        unseen_stddev: standard deviation of the middle's position, of an object of which one side was seen [m].
    """

    watertight: bool
    name: str
    unseen_stddev: float = 0.0


def to_manifold(mesh: ObjectMesh) -> Manifold | None:
    """Return the solid that a mesh bounds, in metres and in the object frame; None where it is not watertight.

    Building it takes some 0.7 ms per thousand triangles: keep it.

    Raises:
        MissingDependencyError: manifold3d is not installed.
    """
    return solid_from_triangles(mesh.vertices, mesh.triangles) if mesh.watertight else None


def surrounds(mesh: ObjectMesh, point: NDArray) -> bool:
    """Return whether a mesh, watertight or not, surrounds a point (3,) [m, object frame].

    The generalised winding number, the triangles' solid angles over 4 pi, exceeds a half (Jacobson et al. 2013).
    """
    low, high = mesh.bounds
    if ((point <= low) | (point >= high)).any():
        return False
    # the sum of the solid angles of the triangles (Van Oosterom, Strackee 1983)
    corners = mesh.vertices[mesh.triangles] - point
    (a, b, c), (la, lb, lc) = corners.transpose(1, 0, 2), np.linalg.norm(corners, axis=2).T
    volume = (a * np.cross(b, c)).sum(axis=1)
    below = la * lb * lc + (a * b).sum(axis=1) * lc + (b * c).sum(axis=1) * la + (c * a).sum(axis=1) * lb
    return bool(abs(2.0 * np.arctan2(volume, below).sum()) / (4.0 * np.pi) > _INSIDE)


def load_object_mesh(path: Path | str | ObjectMesh, *, unit: str = "m", triangle_limit: int = 20000) -> ObjectMesh:
    """Read the mesh of an object, repair and decimate it; reject what cannot be a graspable object.

    Args:
        path: a file of `FORMATS`; the parts of a scene are put together by their transforms. Or a mesh, which is kept.
        unit: of the file's coordinates, one of `UNITS`; GLB is in metres by its standard, STL mostly in millimetres.
        triangle_limit: maximum number of triangles after decimation.

    Returns:
        The mesh in metres, in the frame of the file.

    Raises:
        ObjectMeshError: The file cannot be read, its size fits no graspable object, it lies far from its origin, or it
            has no usable surface.
        MissingDependencyError: trimesh, manifold3d or open3d is not installed.
    """
    if isinstance(path, ObjectMesh):
        return path
    path = Path(path)
    if unit not in UNITS:
        raise ObjectMeshError(f"{path.name}: got unit {unit!r}, expected one of {', '.join(UNITS)}")
    mesh = prepare_object_mesh(*read_triangles(path), name=path.name, unit=unit, triangle_limit=triangle_limit)
    return replace(mesh, unseen_stddev=_read_unseen(path.with_suffix(POSE_ENDING)))


def _read_unseen(path: Path) -> float:
    """Return the deviation that a reconstruction states beside its mesh [m]; 0 where it states none.

    Raises:
        ObjectMeshError: the file is damaged, or states no length.
    """
    try:
        content = read_json(path) if path.is_file() else None
        stated = float(content.get("unseen_stddev_m", 0.0)) if isinstance(content, dict) else 0.0
    except (FileError, TypeError, ValueError) as error:
        raise ObjectMeshError(f"{path.name}: {error}; expected what finforce reconstruct writes, or no file") from error
    if not 0.0 <= stated <= LARGEST:
        raise ObjectMeshError(f"{path.name}: unseen_stddev_m is {stated:g}; expected 0 to {LARGEST:g}")
    return stated


def read_triangles(path: Path | str) -> tuple[NDArray, NDArray]:
    """Return the vertices (n, 3) and triangles (m, 3) of a mesh file, in its own unit and frame, as they are.

    Raises:
        ObjectMeshError: The file is missing, of another format, too large, or cannot be read.
        MissingDependencyError: trimesh is not installed.
    """
    path = Path(path)
    formats = " ".join(FORMATS)
    if not os.path.isfile(path):  # of a name that no file can have Path raises an error
        remedy = "give a path, not a URI" if ":/" in str(path) else "check the path"
        raise ObjectMeshError(f"{str(path)[:200]}: there is no such file, expected a mesh ({formats}); {remedy}")
    if path.suffix.lower() not in FORMATS:
        raise ObjectMeshError(f"{path.name}: got ending {path.suffix!r}, expected one of {formats}; convert the file")
    try:
        return read_surface(path)
    except FileError as error:
        raise ObjectMeshError(f"{path.name}: {error}") from error


def prepare_object_mesh(
    vertices: ArrayLike,
    triangles: ArrayLike,
    *,
    name: str = "object",
    unit: str = "m",
    triangle_limit: int = 20000,
) -> ObjectMesh:
    """Return a mesh that contact can be computed with: merged, closed where possible, turned outward, decimated.

    Args:
        vertices: (n, 3), object frame.
        triangles: (m, 3) vertex indices from 0.
        name: name of the object in messages.
        unit: of the vertices, one of `UNITS`.
        triangle_limit: the most triangles that are kept.

    Raises:
        ObjectMeshError: The arrays are no mesh, its size fits no graspable object, it lies far from its origin, or it
            has no body.
        MissingDependencyError: manifold3d or open3d is not installed.
    """
    vertices, triangles = np.asarray(vertices, dtype=float), np.asarray(triangles)
    _check_triangles(vertices, triangles, name)
    _check_size(vertices, triangles, name, unit)
    vertices = vertices * UNITS[unit]
    away = float(np.linalg.norm(vertices[triangles], axis=-1).max())
    if away > FARTHEST:
        raise ObjectMeshError(
            f"{name}: got vertices up to {away:.3g} m from the origin of their frame, expected {FARTHEST:g} m at most; "
            "move the origin into the object, and give its poses for that origin"
        )
    if not triangle_limit >= 100:
        raise ObjectMeshError(f"{name}: got triangle_limit {triangle_limit}, expected 100 at least; 20000 is usual")
    mesh = repair(ObjectMesh(vertices=vertices, triangles=triangles, watertight=False, name=name))
    _check_body(mesh)
    return decimate(mesh, triangle_limit) if len(mesh.triangles) > triangle_limit else mesh


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
    is_metric = name.lower().endswith(".glb")  # metres by the standard: what is no such size is of any scale
    sizes = {} if is_metric else {other: extent * factor for other, factor in UNITS.items()}
    likely = [(other, size) for other, size in sizes.items() if SMALLEST <= size <= LARGEST]
    likely.sort(key=lambda item: abs(np.log(item[1] / _COMMON)))
    advice = "no unit makes it so; scale it, or remove what lies far from the object"
    if is_metric:
        advice = "a GLB is in metres by its standard, this one has a scale of its own: scale it to the object's size"
    if likely:
        named = ", or ".join(f'unit="{other}" ({size * 1e3:.0f} mm)' for other, size in likely)
        advice = f"the file is likely in another unit: {named}; state it by --object-unit, to twin by --set unit"
    raise ObjectMeshError(
        f"{name}: got a largest extent of {extent * UNITS[unit] * 1e3:.6g} mm in unit {unit!r}, "
        f"expected {SMALLEST * 1e3:g} to {LARGEST * 1e3:g} mm for a graspable object; {advice}"
    )


def _check_body(mesh: ObjectMesh) -> None:
    """Refuse a mesh without area, or thin as a sheet in some direction."""
    area = float(mesh.areas.sum())
    if area < THINNEST**2:
        problem = f"got {len(mesh.triangles)} triangles of {area * 1e6:.2g} mm^2 in all, expected a surface"
    else:
        axes = np.linalg.eigh(np.cov(mesh.vertices.T))[1]
        thickness = float(np.ptp(mesh.vertices @ axes, axis=0).min())
        if thickness >= THINNEST:
            return
        problem = f"got a sheet {thickness * 1e3:.2g} mm thick, expected a body"
    raise ObjectMeshError(f"{mesh.name}: {problem}; export the whole object")


def describe_mesh(mesh: ObjectMesh) -> str:
    """Return what an object's mesh is, and what was done to it, as sentences."""
    kind = "watertight" if mesh.watertight else "not watertight"
    return " ".join([f"{mesh.name}: {len(mesh.triangles)} triangles, {kind}.", *mesh.notes])


def repair(mesh: ObjectMesh) -> ObjectMesh:
    """Return the mesh with its vertices merged, closed where its holes are small, and its triangles facing outward.

    `watertight` of the result is what manifold3d says; a mesh that stays open is kept and noted.

    Raises:
        ObjectMeshError: The triangles are fragments.
        MissingDependencyError: manifold3d is not installed.
    """
    merged = mesh.merge_vertices()
    dropped = len(mesh.triangles) - len(merged.triangles)
    mesh = merged.noted(f"{dropped} triangles without area were removed.") if dropped else merged
    if not mesh.edges.is_balanced:
        mesh = close(mesh)
    if not len(mesh.triangles):
        return mesh
    mesh = turn_outward(mesh)
    solid = solid_from_triangles(mesh.vertices, mesh.triangles) if mesh.edges.is_balanced else None
    if solid is not None:
        return unite_bodies(replace(mesh, watertight=True), solid)
    note = "The surface is not closed: its outline bridges the gaps, and booleans of solids are not possible."
    return mesh.noted(note)


def close(mesh: ObjectMesh) -> ObjectMesh:
    """Return an open mesh with cracks merged, repeated triangles removed, in one sense, its small holes filled.

    Raises:
        ObjectMeshError: The triangles are fragments, of which hardly any have neighbours.
    """
    merged = mesh.close_cracks(CRACK).drop_doubles()
    before, count = len(mesh.triangles), len(merged.triangles)
    merged = merged.noted(
        f"Vertices within {CRACK * 1e3:g} mm were merged; {before - count} of {before} triangles fell away."
    )
    uses = merged.edges.uses
    if count > 1 and (uses == 1).mean() > MOST_OPEN:
        raise ObjectMeshError(
            f"{mesh.name}: got {count} triangles with no neighbour at {100.0 * (uses == 1).mean():.0f} % of their "
            "edges, expected a connected surface; merge its vertices in a mesh editor"
        )
    if uses.max(initial=0) > 2:
        return merged.noted("More than two triangles meet at an edge; their sense was left and holes were not filled.")
    oriented = merged.orient()
    if oriented is None:
        return merged.noted("The surface has one side only, and so no outside.")
    limit = HOLE_SHARE * mesh.extents.max()
    mesh, filled, left = oriented.fill_holes(
        lambda hole: np.linalg.norm(hole - hole.mean(axis=0), axis=1).max() <= limit
    )
    note = f"{filled} holes up to {limit * 1e3:.1f} mm in radius were filled, {left} larger ones were left."
    return mesh.noted(note) if filled + left else mesh


def turn_outward(mesh: ObjectMesh) -> ObjectMesh:
    """Return the mesh with inside-out bodies turned, each together with the cavities in it; of fragments all as one."""
    body = mesh.label_bodies(np.inf)
    if body.max() >= _MOST_BODIES:
        body = np.zeros_like(body)
    volumes = np.bincount(body, weights=mesh.volumes)
    # around each body the one whose box is the largest around its own, or itself
    low, high = np.full((len(volumes), 3), np.inf), np.full((len(volumes), 3), -np.inf)
    corners = mesh.vertices[mesh.triangles]
    np.minimum.at(low, body, corners.min(axis=1))
    np.maximum.at(high, body, corners.max(axis=1))
    contains = (low[:, None] <= low[None]).all(axis=2) & (high[:, None] >= high[None]).all(axis=2)
    containers = np.argmax(contains * np.linalg.norm(high - low, axis=1)[:, None], axis=0)
    turned = (volumes[containers] < 0.0)[body]
    if not turned.any():
        return mesh
    return mesh.turn(turned).noted(f"{turned.sum()} of {len(turned)} triangles were inside-out and were turned.")


def unite_bodies(mesh: ObjectMesh, solid: Manifold) -> ObjectMesh:
    """Return a watertight mesh, given as solid too, with overlapping bodies made one; their number is noted."""
    bodies = solid.decompose()
    if len(bodies) == 1:
        return mesh
    mesh = mesh.noted(f"The object consists of {len(bodies)} separate surfaces.")
    if len(bodies) > _MOST_BODIES or any(body.volume() < 0.0 for body in bodies):
        return mesh  # a union would fill the cavities
    manifold3d = import_manifold3d()
    union = manifold3d.Manifold.batch_boolean(bodies, manifold3d.OpType.Add)
    if union.volume() > (1.0 - 1e-6) * solid.volume():
        return mesh
    return mesh.with_triangles(*triangles_of_solid(union)).noted("Bodies that overlap were united.")


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
        thinned = _thin_by_quadric(mesh, triangle_limit)
    else:
        thinned = mesh.with_triangles(*triangles_of_solid(solid.simplify(_FIRST_TOLERANCE)))
        if len(thinned.triangles) > triangle_limit:
            thinned = _thin_by_quadric(thinned, triangle_limit)
        if solid_from_triangles(thinned.vertices, thinned.triangles) is None:
            thinned = _simplify_within(mesh, solid, triangle_limit)
    count, left = len(mesh.triangles), len(thinned.triangles)
    deviation = _measure_deviation(mesh, thinned) if left else np.inf
    if deviation > RUIN * np.ptp(mesh.vertices, axis=0).max():
        raise ObjectMeshError(
            f"{mesh.name}: got {count} triangles, of which {left} are left that deviate by {deviation * 1e3:.1f} mm, "
            "expected one object of connected parts; remove fragments in a mesh editor"
        )
    warning = "" if deviation <= DEVIATION_LIMIT else ", more than contact should have: is this one object?"
    note = f"Decimated from {count} to {left} triangles; the surface deviates by {deviation * 1e3:.3f} mm at most"
    return thinned.noted(f"{note}{warning}.")


def _thin_by_quadric(mesh: ObjectMesh, triangle_limit: int) -> ObjectMesh:
    """Return the mesh after edges were collapsed in the order of their quadric error."""
    open3d = import_open3d()
    vectors = open3d.utility.Vector3dVector(mesh.vertices), open3d.utility.Vector3iVector(mesh.triangles)
    thinned = open3d.geometry.TriangleMesh(*vectors).simplify_quadric_decimation(triangle_limit)
    return mesh.with_triangles(np.asarray(thinned.vertices), np.asarray(thinned.triangles))


def _simplify_within(mesh: ObjectMesh, solid: Manifold, triangle_limit: int) -> ObjectMesh:
    """Return the mesh, given as solid too, simplified in growing steps that never open it."""
    tolerance = _FIRST_TOLERANCE
    while solid.num_tri() > triangle_limit:
        tolerance *= 2.0
        solid = solid.simplify(tolerance)
    return mesh.with_triangles(*triangles_of_solid(solid))


def _measure_deviation(one: ObjectMesh, other: ObjectMesh) -> float:
    """Return the largest distance [m] of a vertex of either mesh to the other's surface."""
    open3d, largest = import_open3d(), 0.0
    for mesh, points in ((one, other.vertices), (other, one.vertices)):
        scene = open3d.t.geometry.RaycastingScene(nthreads=1)
        scene.add_triangles(mesh.vertices.astype(np.float32), mesh.triangles.astype(np.uint32))
        some = points[:: max(1, len(points) // _SAMPLES)].astype(np.float32)
        largest = max(largest, float(scene.compute_distance(some, nthreads=1).numpy().max()))
    return largest
