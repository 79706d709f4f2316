"""Repair of object meshes: merged, closed, of one sense, turned outward; and whether a surface crosses itself.

Two triangles without a common corner cross where an edge of one goes through the other (Moeller and Trumbore 1997).
Candidates are found by sweeping their boxes along the axis along which the surface is longest.
"""

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from finforce.optional import import_manifold3d, import_open3d
from finforce_contact.errors import ObjectMeshError
from finforce_contact.mesh.triangles import ObjectMesh, compute_volumes, solid_from_triangles, triangles_of_solid


def chain_loops(starts: NDArray, stops: NDArray) -> list[NDArray]:
    """Return closed loops that together run along each edge once.

    Edges that do not close are left out; where every node has as many edges in as out, none is.

    Args:
        starts: (e,) node at which each edge begins.
        stops: (e,) node at which it ends.

    Returns:
        Node indices (n,) of each loop in its order; the last is joined to the first.
    """
    ways: dict[int, list[int]] = {}
    for start, stop in zip(starts.tolist(), stops.tolist(), strict=True):
        ways.setdefault(start, []).append(stop)
    loops = []
    for start in list(ways):
        while ways[start]:
            loop = _follow(ways, start)
            if loop:
                loops.append(np.array(loop))
    return loops


def _follow(ways: dict[int, list[int]], start: int) -> list[int]:
    """Take edges from the ways until back at the start; nothing when the way ends before."""
    loop, node = [], start
    while True:
        loop.append(node)
        onward = ways.get(node)
        if not onward:
            return []
        node = onward.pop()
        if node == start:
            return loop


_OPTIONS = {"cache": True, "error_model": "numpy"}
# Of an edge's length and of a triangle's sides: what only touches does not cross.
_TOUCH = 1e-9


def crosses_itself(vertices: NDArray, triangles: NDArray) -> bool:
    """Return whether a surface of triangles (m, 3) on vertices (n, 3) [m] crosses itself.

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
    """Return whether two triangles cross; their boxes are sorted by their lower end along the first axis."""
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
    """Return whether an edge of either triangle (3, 3) goes through the other one."""
    for k in range(3):
        n = (k + 1) % 3
        if _pierces(one[k], one[n], other) or _pierces(other[k], other[n], one):
            return True
    return False


@njit(**_OPTIONS)
def _pierces(start, end, triangle):
    """Return whether the way from start to end (3,) goes through a triangle (3, 3)."""
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


if TYPE_CHECKING:
    from manifold3d import Manifold

CRACK = 1e-5  # [m], vertices of an open mesh this close are one; below what contact can tell
HOLE_SHARE = 0.1  # [-], radius of the holes that are filled, of the largest extent; an opening to grasp into is larger
MOST_OPEN = 0.75  # [-], share of edges with one triangle only; a closed surface has none
_GRID_BITS = 21  # three coordinates in one integer of 64 bits
_MOST_BODIES = 1000  # beyond, the mesh is fragments and its bodies mean nothing


def repair(mesh: ObjectMesh) -> ObjectMesh:
    """Return the mesh with its vertices merged, closed where its holes are small, and its triangles facing outward.

    `watertight` of the result is what manifold3d says; a mesh that stays open is kept and noted.

    Raises:
        ObjectMeshError: The triangles are fragments.
        MissingDependencyError: manifold3d is not installed, or the mesh is open and open3d is not.
    """
    mesh = merge_vertices(mesh)
    if not mesh.edges.is_balanced:
        mesh = close(mesh)
    if not len(mesh.triangles):
        return mesh
    mesh = turn_outward(mesh)
    solid = solid_from_triangles(mesh.vertices, mesh.triangles) if mesh.edges.is_balanced else None
    if solid is not None:
        return unite_bodies(replace(mesh, watertight=True), solid)
    note = "The surface is not closed: its outline bridges the gaps, and booleans of solids are not possible."
    return replace(mesh, watertight=False, notes=(*mesh.notes, note))


def merge_vertices(mesh: ObjectMesh) -> ObjectMesh:
    """Return the mesh with equal vertices as one, without the triangles that have a corner twice."""
    low = mesh.vertices.min(axis=0)
    # An even number of cells: the middle, where symmetric objects have their poles, is no rounding boundary.
    cell = np.ptp(mesh.vertices, axis=0).max() / (2**_GRID_BITS - 2)
    x, y, z = np.round((mesh.vertices - low) / cell).astype(np.int64).T
    _, first, place = np.unique((x << 2 * _GRID_BITS) | (y << _GRID_BITS) | z, return_index=True, return_inverse=True)
    merged = _drop_repeated_corners(place[mesh.triangles])
    dropped = len(mesh.triangles) - len(merged)
    note = f"{dropped} triangles without area were removed." if dropped else ""
    return mesh.with_triangles(mesh.vertices[first], merged, note)


def close(mesh: ObjectMesh) -> ObjectMesh:
    """Return an open mesh with cracks merged, repeated triangles removed, in one sense, its small holes filled.

    Raises:
        ObjectMeshError: The triangles are fragments, of which hardly any have neighbours.
    """
    open3d = import_open3d()
    geometry = open3d.geometry.TriangleMesh(
        open3d.utility.Vector3dVector(mesh.vertices), open3d.utility.Vector3iVector(mesh.triangles)
    )
    geometry.merge_close_vertices(CRACK)
    geometry.remove_degenerate_triangles()
    geometry.remove_duplicated_triangles()
    before = len(mesh.triangles)
    triangles = np.asarray(geometry.triangles)
    note = f"Vertices within {CRACK * 1e3:g} mm were merged; {before - len(triangles)} of {before} triangles fell away."
    merged = mesh.with_triangles(np.asarray(geometry.vertices), triangles, note)
    if len(triangles) > 1 and merged.edges.open_share > MOST_OPEN:
        share = 100.0 * merged.edges.open_share
        raise ObjectMeshError(
            f"{mesh.name}: got {len(triangles)} triangles with no neighbour at {share:.0f} % of their edges, expected "
            "a connected surface; merge its vertices in a mesh editor"
        )
    if merged.edges.is_branching:
        note = "More than two triangles meet at an edge; their sense was left and holes were not filled."
        return replace(merged, notes=(*merged.notes, note))
    if not merged.edges.is_consistent:
        if not geometry.orient_triangles():
            return replace(merged, notes=(*merged.notes, "The surface has one side only, and so no outside."))
        merged = merged.with_triangles(np.asarray(geometry.vertices), np.asarray(geometry.triangles))
    return merged if merged.edges.is_balanced else fill_holes(merged)


def fill_holes(mesh: ObjectMesh) -> ObjectMesh:
    """Return the mesh with a fan of triangles in each hole that a small sphere about its middle covers."""
    surplus = mesh.edges.surplus
    ends = mesh.edges.ends[surplus != 0.0]
    # A fan runs against its neighbour, whose sense is the sign of the surplus.
    ends = np.where(surplus[surplus != 0.0, None] > 0.0, ends[:, ::-1], ends)
    vertices, fans, left = [mesh.vertices], [mesh.triangles], 0
    limit = HOLE_SHARE * np.ptp(mesh.vertices, axis=0).max()
    for loop in chain_loops(ends[:, 0], ends[:, 1]):
        middle = mesh.vertices[loop].mean(axis=0)
        if np.linalg.norm(mesh.vertices[loop] - middle, axis=1).max() > limit:
            left += 1
            continue
        apex = np.full(len(loop), len(mesh.vertices) + len(vertices) - 1)
        vertices.append(middle[None])
        fans.append(np.stack([loop, np.roll(loop, -1), apex], axis=1))
    note = f"{len(fans) - 1} holes up to {limit * 1e3:.1f} mm in radius were filled, {left} larger ones were left."
    return mesh.with_triangles(np.concatenate(vertices), np.concatenate(fans), note)


def turn_outward(mesh: ObjectMesh) -> ObjectMesh:
    """Return the mesh with inside-out bodies turned, each together with the cavities in it."""
    body = label_bodies(mesh)
    count = int(body.max()) + 1
    volumes = np.bincount(body, weights=compute_volumes(mesh.vertices, mesh.triangles), minlength=count)
    turned = (volumes[_find_containers(mesh, body, count)] < 0.0)[body]
    if not turned.any():
        return mesh
    triangles = np.where(turned[:, None], mesh.triangles[:, ::-1], mesh.triangles)
    note = f"{turned.sum()} of {len(turned)} triangles were inside-out and were turned."
    return mesh.with_triangles(mesh.vertices, triangles, note)


def label_bodies(mesh: ObjectMesh) -> NDArray:
    """Return for each triangle the number (m,) of its connected body; one body for mere fragments."""
    ends, count = mesh.edges.ends, len(mesh.vertices)
    graph = coo_array((np.ones(len(ends), dtype=bool), (ends[:, 0], ends[:, 1])), shape=(count, count))
    bodies, label = connected_components(graph, directed=False)
    return label[mesh.triangles[:, 0]] if bodies <= _MOST_BODIES else np.zeros(len(mesh.triangles), dtype=int)


def unite_bodies(mesh: ObjectMesh, solid: "Manifold") -> ObjectMesh:
    """Return a watertight mesh, given as solid too, with overlapping bodies made one; their number is noted."""
    bodies = solid.decompose()
    if len(bodies) == 1:
        return mesh
    mesh = replace(mesh, notes=(*mesh.notes, f"The object consists of {len(bodies)} separate surfaces."))
    if len(bodies) > _MOST_BODIES or any(body.volume() < 0.0 for body in bodies):
        return mesh  # a union would fill the cavities
    manifold3d = import_manifold3d()
    union = manifold3d.Manifold.batch_boolean(bodies, manifold3d.OpType.Add)
    if union.volume() > (1.0 - 1e-6) * solid.volume():
        return mesh
    return mesh.with_triangles(*triangles_of_solid(union), "Bodies that overlap were united.")


def _drop_repeated_corners(triangles: NDArray) -> NDArray:
    """Return the triangles whose three corners differ."""
    return triangles[(triangles != np.roll(triangles, 1, axis=1)).all(axis=1)]


def _find_containers(mesh: ObjectMesh, body: NDArray, count: int) -> NDArray:
    """Return for each body the one (count,) whose box is the largest around its own, or itself."""
    low, high = np.full((count, 3), np.inf), np.full((count, 3), -np.inf)
    corners = mesh.vertices[mesh.triangles]
    np.minimum.at(low, body, corners.min(axis=1))
    np.maximum.at(high, body, corners.max(axis=1))
    contains = (low[:, None] <= low[None]).all(axis=2) & (high[:, None] >= high[None]).all(axis=2)
    return np.argmax(contains * np.linalg.norm(high - low, axis=1)[:, None], axis=0)
