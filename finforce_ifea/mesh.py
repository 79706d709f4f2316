"""A volume mesh with its checks and its surface; knows neither drawings nor files."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import cKDTree

from finforce_ifea.errors import MeshError
from finforce_ifea.mesh_pieces import check_overlaps, check_pieces
from finforce_ifea.shape_functions import EDGES_TET10, shape_gradients

FACES_HEX = np.array([[0, 3, 2, 1], [4, 5, 6, 7], [0, 1, 5, 4], [1, 2, 6, 5], [2, 3, 7, 6], [3, 0, 4, 7]])
FACES_TET = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]])
# Where the Jacobian of each kind of element is checked: corners, middles of edges and faces, centre.
_PLACES_HEX = np.stack(np.meshgrid(*[[-1.0, 0.0, 1.0]] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
_CORNERS_TET = np.vstack([np.zeros(3), np.eye(3)])
_PLACES_TET = np.concatenate([[*_CORNERS_TET], _CORNERS_TET[EDGES_TET10].mean(axis=1), [[0.25] * 3]])
_MIRROR_HEX = [4, 5, 6, 7, 0, 1, 2, 3]
_MIRROR_TET10 = [0, 2, 1, 3, 6, 5, 4, 7, 9, 8]


@dataclass(frozen=True, kw_only=True, eq=False)
class VolumeMesh:
    """A volume mesh of one kind of element; build it with `build_volume_mesh`, which checks it.

    Attributes:
        nodes: (n, 3) [m], jaw frame.
        hexes: (m, 8) node indices in the VTK order with positive Jacobians, or None.
        tets: (m, 4) or (m, 10) node indices in the VTK order with positive Jacobians, or None.
        clamped: (c,) indices of the nodes that do not move, rising.
        surface: (t, 3) node indices of the boundary's triangles, outward normals; corner nodes only.
    """

    nodes: NDArray
    hexes: NDArray | None
    tets: NDArray | None
    clamped: NDArray
    surface: NDArray

    @property
    def elements(self) -> NDArray:
        """The node indices of the elements, shape (m, 4 | 8 | 10)."""
        return self.hexes if self.hexes is not None else self.tets

    def mirrored(self) -> "VolumeMesh":
        """Return the mirror image y -> -y, with the same node numbers and positive Jacobians."""
        hexes = None if self.hexes is None else self.hexes[:, _MIRROR_HEX]
        tets = None if self.tets is None else self.tets[:, _MIRROR_TET10[: self.tets.shape[1]]]
        return VolumeMesh(
            nodes=self.nodes * [1.0, -1.0, 1.0],
            hexes=hexes,
            tets=tets,
            clamped=self.clamped,
            surface=self.surface[:, [0, 2, 1]],
        )


def build_volume_mesh(
    *, nodes: NDArray, hexes: NDArray | None = None, tets: NDArray | None = None, clamped: Iterable[int]
) -> VolumeMesh:
    """Check a mesh and add its surface.

    Args:
        nodes: (n, 3) [m], jaw frame.
        hexes: (m, 8) node indices in the VTK order; or
        tets: (m, 4) or (m, 10) node indices in the VTK order.
        clamped: indices of the clamped nodes.

    Returns:
        The mesh.

    Raises:
        MeshError: No elements or two kinds of them, wrong shapes, indices out of range or not whole, NaN, millimetres
            for metres, duplicate or unused nodes, inverted or repeated elements, no clamped nodes.
    """
    if (hexes is None) == (tets is None):
        raise MeshError("expected either hexahedra or tetrahedra, got both or neither")
    nodes = np.ascontiguousarray(nodes, dtype=float)
    elements = _to_indices(tets if hexes is None else hexes, "elements")
    clamped = np.unique(_to_indices(list(clamped), "clamped nodes"))
    _check_nodes(nodes)
    _check_elements(elements, len(nodes), (4, 10) if hexes is None else (8,))
    _check_numbering(nodes, elements)
    check_jacobians(nodes, elements)
    _check_clamped(clamped, len(nodes))
    check_overlaps(elements, elements[:, _faces_of(elements)])
    return VolumeMesh(
        nodes=nodes,
        hexes=None if hexes is None else elements,
        tets=None if tets is None else elements,
        clamped=clamped,
        surface=surface_triangles(elements),
    )


def check_connection(mesh: VolumeMesh) -> None:
    """Refuse a mesh that is not one piece, or of which a part can turn freely.

    Raises:
        MeshError: Parts share no node, or hang together by nodes on one line; or the clamped nodes lie on one.
    """
    elements = mesh.elements
    check_pieces(mesh.nodes, elements, elements[:, _faces_of(elements)], mesh.clamped)


def surface_triangles(elements: NDArray) -> NDArray:
    """Return the boundary triangles (t, 3) of elements (m, 4 | 8 | 10), outward normals.

    A face that belongs to one element only is boundary. Quadrilaterals are split along the diagonal from
    their smallest node index; of 10-node tetrahedra the corners are used.
    """
    table = _faces_of(elements)
    faces = elements[:, table].reshape(-1, table.shape[1])
    _, first, count = np.unique(np.sort(faces, axis=1), axis=0, return_index=True, return_counts=True)
    return split_faces(faces[np.sort(first[count == 1])])


def _faces_of(elements: NDArray) -> NDArray:
    """Return which corners of elements (m, 4 | 8 | 10) make their faces."""
    return FACES_HEX if elements.shape[1] == 8 else FACES_TET


def split_faces(faces: NDArray) -> NDArray:
    """Split faces (f, 3 | 4) into triangles along the diagonal from their smallest node index."""
    if faces.shape[1] == 3:
        return faces
    turn = (faces.argmin(axis=1)[:, None] + np.arange(4)) % 4
    turned = np.take_along_axis(faces, turn, axis=1)
    return turned[:, [[0, 1, 2], [0, 2, 3]]].reshape(-1, 3)


def compute_volume(mesh: VolumeMesh) -> float:
    """Compute the volume [m^3] that the surface encloses: the sum of a . (b x c) / 6 over its triangles."""
    a, b, c = np.moveaxis(mesh.nodes[mesh.surface] - mesh.nodes.mean(axis=0), 1, 0)
    return float(np.einsum("ij,ij->", a, np.cross(b, c)) / 6.0)


def check_jacobians(nodes: NDArray, elements: NDArray) -> None:
    """Refuse elements whose Jacobian is not positive at every corner, in the middle of edges and faces, and inside.

    Raises:
        MeshError: Elements are inverted; the message says how many and names the first.
    """
    local = _PLACES_HEX if elements.shape[1] == 8 else _PLACES_TET
    gradients = shape_gradients(elements.shape[1], local)
    jacobians = np.einsum("mni,pnj->mpij", nodes[elements], gradients)
    smallest = np.linalg.det(jacobians).min(axis=1)
    scale = np.abs(np.ptp(nodes[elements], axis=1)).max(axis=1) ** 3
    inverted = np.flatnonzero(~(smallest > 1e-12 * scale))
    if len(inverted):
        centre = np.round(1e3 * nodes[elements[inverted[0]]].mean(axis=0), 2).tolist()
        raise MeshError(
            f"{len(inverted)} of {len(elements)} elements are inverted or flat (first: element {inverted[0]} "
            f"at {centre} mm, Jacobian {smallest[inverted[0]]:.3g}); "
            "expected positive Jacobians with the nodes in the VTK order: repair or reorder these elements"
        )


def _to_indices(numbers: ArrayLike, name: str) -> NDArray:
    """Return node indices as integers after having refused what would be rounded or is a mask."""
    given = np.asarray(numbers)
    if given.dtype == bool or not np.issubdtype(given.dtype, np.number) and given.size:
        raise MeshError(f"{name}: got {given.dtype}, expected node indices")
    if given.size and not (np.isfinite(given).all() and (given == np.rint(given)).all()):
        raise MeshError(f"{name}: got numbers that are not whole, expected node indices")
    return np.ascontiguousarray(given, dtype=np.int64)


def _check_nodes(nodes: NDArray) -> None:
    """Refuse coordinates of the wrong shape, not finite, or in millimetres."""
    if nodes.ndim != 2 or nodes.shape[1] != 3 or len(nodes) == 0:
        raise MeshError(f"nodes: got shape {nodes.shape}, expected (n, 3)")
    bad = np.flatnonzero(~np.isfinite(nodes).all(axis=1))
    if len(bad):
        raise MeshError(f"{len(bad)} of {len(nodes)} nodes are NaN or infinite (first: node {bad[0]})")
    extent = np.ptp(nodes, axis=0).max()
    if extent > 1.0:
        raise MeshError(
            f"the mesh is {extent:.4g} m long, expected at most 1 m: it looks like millimetres; give scale: 0.001"
        )
    if extent < 1e-3:
        raise MeshError(f"the mesh is {extent:.4g} m long, expected at least 1 mm: check its scale")


def _check_elements(elements: NDArray, node_count: int, corners: tuple[int, ...]) -> None:
    """Refuse element tables of the wrong shape or with indices out of range."""
    if elements.ndim != 2 or elements.shape[1] not in corners or len(elements) == 0:
        expected = " or ".join(f"(m, {n})" for n in corners)
        raise MeshError(f"elements: got shape {elements.shape}, expected {expected}, at least one")
    bad = np.flatnonzero(((elements < 0) | (elements >= node_count)).any(axis=1))
    if len(bad):
        raise MeshError(
            f"{len(bad)} elements name nodes out of 0..{node_count - 1} (first: element {bad[0]}: "
            f"{elements[bad[0]].tolist()})"
        )


def _check_numbering(nodes: NDArray, elements: NDArray) -> None:
    """Refuse nodes that lie on each other and nodes that no element uses."""
    tolerance = 1e-7 * np.ptp(nodes, axis=0).max()
    pairs = cKDTree(nodes).query_pairs(tolerance, output_type="ndarray")
    if len(pairs):
        first, second = pairs[np.lexsort(pairs.T[::-1])[0]]
        at = np.round(1e3 * nodes[first], 3).tolist()
        raise MeshError(
            f"{len(pairs)} pairs of duplicate nodes (first: {first} and {second} at {at} mm): "
            "parts would come apart there; merge the nodes"
        )
    unused = np.setdiff1d(np.arange(len(nodes)), elements)
    if len(unused):
        raise MeshError(
            f"{len(unused)} of {len(nodes)} nodes belong to no element (first: node {unused[0]}); remove them"
        )


def _check_clamped(clamped: NDArray, node_count: int) -> None:
    """Refuse a mesh that nothing holds."""
    if len(clamped) == 0:
        raise MeshError("no clamped nodes: nothing holds the mesh; check `clamped` and the scale")
    if clamped[0] < 0 or clamped[-1] >= node_count:
        raise MeshError(f"clamped nodes {clamped[0]}..{clamped[-1]}: expected 0..{node_count - 1}")
    if len(clamped) < 3:
        raise MeshError(f"{len(clamped)} clamped nodes: expected at least three, else the mesh can turn")
    if len(clamped) == node_count:
        raise MeshError("all nodes are clamped: nothing can move; check `clamped` and the scale")
