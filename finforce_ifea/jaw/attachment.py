"""Material points of a mesh as weighted sums of its nodes."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from finforce.optional import import_trimesh
from finforce_ifea.errors import MeshError
from finforce_ifea.jaw.mesh import VolumeMesh, shape_gradients, shape_values

# A step below the second leaves an error of about its square.
_NEWTON_STEPS, _SMALL_STEP = 12, 1e-8
_TOGETHER = 64  # points that are looked for at once
# A point this far [m] outside is taken to its element: outlines of a mesh miss curves by less.
_BESIDE = 1e-4


@dataclass(frozen=True, kw_only=True, eq=False)
class Attachment:
    """Material points as weighted sums of mesh nodes.

    Attributes:
        nodes: (p, m) node indices.
        weights: (p, m) [-], rows sum to one.
    """

    nodes: NDArray
    weights: NDArray

    def apply(self, values: NDArray) -> NDArray:
        """Interpolate nodal values (n, ...) at the points, shape (p, ...)."""
        return np.einsum("pm,pm...->p...", self.weights, values[self.nodes])


def attach_points(
    mesh: VolumeMesh, points: NDArray, max_distance: float, names: Sequence[str] | None = None
) -> Attachment:
    """Attach points to the elements that contain them, or to the closest point of the surface.

    The local coordinates xi solve sum_i N_i(xi) X_i = x by Newton's method; the weights are N_i(xi). Points outside by
    less than 0.1 mm are brought into their element.

    Args:
        mesh: the undeformed mesh.
        points: (p, 3) [m], jaw frame.
        max_distance: [m], how far outside the mesh a point may lie.
        names: (p,), what to call the points in messages.

    Returns:
        The attachment, with as many nodes per point as an element has.

    Raises:
        MeshError: A point is not finite or farther than `max_distance` from the mesh.
    """
    points = _check_points(points)
    names = names or [f"point {row}" for row in range(len(points))]
    nodes, weights = _weigh(mesh, points)
    gaps = np.linalg.norm(np.einsum("pm,pmi->pi", weights, mesh.nodes[nodes]) - points, axis=1)
    outside = np.flatnonzero(gaps > min(_BESIDE, max_distance))
    if len(outside):
        closest, distances = find_closest(mesh, points[outside])
        check_distances(points[outside], distances, max_distance, "mesh", [names[row] for row in outside])
        nodes[outside], weights[outside] = _weigh(mesh, closest)
    return Attachment(nodes=nodes, weights=weights)


def attach_surface_points(
    mesh: VolumeMesh, points: NDArray, max_distance: float, names: Sequence[str] | None = None
) -> Attachment:
    """Attach points that must lie on the surface, such as contacts.

    Args:
        mesh: the undeformed mesh.
        points: (p, 3) [m], jaw frame.
        max_distance: [m], how far from the surface a point may lie, to either side.
        names: (p,), what to call the points in messages.

    Returns:
        The attachment of the closest points of the surface.

    Raises:
        MeshError: A point is not finite or farther than `max_distance` from the surface.
    """
    points = _check_points(points)
    closest, distances = find_closest(mesh, points)
    check_distances(points, distances, max_distance, "surface", names)
    return attach_points(mesh, closest, max(max_distance, 1e-6))


def find_closest(mesh: VolumeMesh, points: NDArray) -> tuple[NDArray, NDArray]:
    """Return the closest points (p, 3) [m] of the surface to points (p, 3) [m], and how far they are (p,) [m]."""
    trimesh = import_trimesh()  # which loads for half a second, and most points lie in the mesh
    surface = trimesh.Trimesh(mesh.nodes, mesh.surface, process=False)
    closest, distances, _ = trimesh.proximity.closest_point_naive(surface, points)
    return closest, distances


def _weigh(mesh: VolumeMesh, points: NDArray) -> tuple[NDArray, NDArray]:
    """Return nodes and weights (p, m) of points in the element that contains each, or of those close by the best."""
    corners = mesh.nodes[mesh.elements]
    low, high = corners.min(axis=1), corners.max(axis=1)
    # curved 10-node elements bulge out of the box of their nodes
    margin = 0.1 * (high - low).max(axis=1, keepdims=True)
    low, high = low - margin, high + margin
    elements = np.zeros(len(points), dtype=np.int64)
    local = np.zeros((len(points), 3))
    for start in range(0, len(points), _TOGETHER):
        part = points[start : start + _TOGETHER]
        rows, near = np.nonzero((part[:, None, 2] >= low[:, 2]) & (part[:, None, 2] <= high[:, 2]))
        close = ((part[rows] >= low[near]) & (part[rows] <= high[near])).all(axis=1)
        rows, near = rows[close], near[close]
        found = _solve_local(corners[near], points[start + rows])
        beyond = _excess(found, corners.shape[1])
        # the first of those that a point leaves least; on a face they differ by rounding alone
        order = np.lexsort((near, beyond.round(12), rows))
        best = order[np.unique(rows[order], return_index=True)[1]]
        elements[start + rows[best]], local[start + rows[best]] = near[best], found[best]
    nodes = mesh.elements[elements]
    return nodes, shape_values(nodes.shape[1], _clamp(local, nodes.shape[1]))


def _solve_local(corners: NDArray, points: NDArray) -> NDArray:
    """Solve sum_i N_i(xi) X_i = x for xi, for points (n, 3) each in an element (n, m, 3), shape (n, 3)."""
    count = corners.shape[1]
    local = np.full((len(corners), 3), 0.0 if count == 8 else 0.25)
    going = np.arange(len(corners))
    for _ in range(_NEWTON_STEPS):
        nodes, start = corners[going], local[going]
        gap = points[going] - np.einsum("em,emi->ei", shape_values(count, start), nodes)
        jacobians = np.einsum("emi,emj->eij", nodes, shape_gradients(count, start))
        step = np.einsum("eij,ej->ei", _invert(jacobians), gap)
        # far outside, the mapping of a distorted element may fold; a point out there is only ever compared
        local[going] = np.clip(start + step, -3.0, 3.0)
        going = going[np.abs(step).max(axis=1) >= _SMALL_STEP]
        if not len(going):
            break
    return local


def _invert(matrices: NDArray) -> NDArray:
    """Return the inverses of matrices (n, 3, 3), of singular ones the pseudo-inverses."""
    size = np.abs(matrices).max(axis=(1, 2), initial=0.0)
    singular = np.abs(np.linalg.det(matrices)) <= 1e-9 * size**3
    inverse = np.empty_like(matrices)
    inverse[singular] = np.linalg.pinv(matrices[singular])
    inverse[~singular] = np.linalg.inv(matrices[~singular])
    return inverse


def _excess(local: NDArray, node_count: int) -> NDArray:
    """Return how far local (e, 3) lie outside the reference domain, 0 inside, shape (e,)."""
    if node_count == 8:
        return np.maximum(np.abs(local).max(axis=1) - 1.0, 0.0)
    return np.maximum(np.maximum(-local.min(axis=1), local.sum(axis=1) - 1.0), 0.0)


def _clamp(local: NDArray, node_count: int) -> NDArray:
    """Bring local (p, 3) into the reference domain."""
    if node_count == 8:
        return np.clip(local, -1.0, 1.0)
    weights = np.maximum(np.column_stack([1.0 - local.sum(axis=1), local]), 0.0)
    return weights[:, 1:] / weights.sum(axis=1, keepdims=True)


def _check_points(points: NDArray) -> NDArray:
    """Refuse points of the wrong shape or not finite."""
    points = np.asarray(points, dtype=float)
    if points.ndim != 2 or points.shape[1] != 3:
        raise MeshError(f"points: got shape {points.shape}, expected (p, 3)")
    bad = np.flatnonzero(~np.isfinite(points).all(axis=1))
    if len(bad):
        raise MeshError(f"point {bad[0]} is not finite: {points[bad[0]].tolist()}")
    return points


def check_distances(
    points: NDArray, distances: NDArray, max_distance: float, part: str, names: Sequence[str] | None = None
) -> None:
    """Refuse points (p, 3) [m] that are farther than allowed from a part, naming the farthest.

    Raises:
        MeshError: A distance (p,) [m] is above the largest, or no number.
    """
    if (distances <= max_distance).all():
        return
    worst = int(distances.argmax())
    name, at = names[worst] if names else f"point {worst}", np.round(1e3 * points[worst], 3).tolist()
    raise MeshError(
        f"{name} at {at} mm is {1e3 * distances[worst]:.3g} mm off the {part}, "
        f"expected at most {1e3 * max_distance:.3g} mm"
    )
