"""A volume mesh, its checks, its surface, the shape functions of its elements, and other elements on its nodes."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from finforce.triangle_surface import number_pieces
from finforce_ifea.errors import MeshError

EDGES_TET10 = np.array([[0, 1], [1, 2], [2, 0], [0, 3], [1, 3], [2, 3]])
_SIGNS_HEX = np.array(
    [[-1, -1, -1], [1, -1, -1], [1, 1, -1], [-1, 1, -1], [-1, -1, 1], [1, -1, 1], [1, 1, 1], [-1, 1, 1]]
)
_BARYCENTRIC_GRADIENTS = np.array([[-1.0, -1.0, -1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])


def shape_values(node_count: int, local: NDArray) -> NDArray:
    """Evaluate shape functions: barycentric L_i, quadratic L_i (2 L_i - 1) and 4 L_i L_j, or trilinear.

    Args:
        node_count: 4, 10 or 8.
        local: (p, 3) [-], local coordinates: in [-1, 1] for hexahedra; for tetrahedra x, y, z >= 0 and
            x + y + z <= 1.

    Returns:
        (p, node_count) [-]; every row sums to one.
    """
    if node_count == 8:
        return np.prod(1.0 + _SIGNS_HEX * local[:, None, :], axis=2) / 8.0
    weights = np.column_stack([1.0 - local.sum(axis=1), local])
    if node_count == 4:
        return weights
    first, second = EDGES_TET10.T
    middles = 4.0 * weights[:, first] * weights[:, second]
    return np.concatenate([weights * (2.0 * weights - 1.0), middles], axis=1)


def shape_gradients(node_count: int, local: NDArray) -> NDArray:
    """Differentiate `shape_values` with respect to the local coordinates, shape (p, node_count, 3) [-]."""
    if node_count == 8:
        factors = 1.0 + _SIGNS_HEX * local[:, None, :]
        others = np.stack([factors[..., [1, 2]], factors[..., [0, 2]], factors[..., [0, 1]]], axis=2)
        return _SIGNS_HEX * others.prod(axis=3) / 8.0
    if node_count == 4:
        return np.broadcast_to(_BARYCENTRIC_GRADIENTS, (len(local), 4, 3))
    weights = np.column_stack([1.0 - local.sum(axis=1), local])[:, :, None]
    slopes = _BARYCENTRIC_GRADIENTS
    first, second = EDGES_TET10.T
    middles = 4.0 * (weights[:, first] * slopes[second] + weights[:, second] * slopes[first])
    return np.concatenate([(4.0 * weights - 1.0) * slopes, middles], axis=1)


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
        elements: node indices of hexahedra (m, 8) or tetrahedra (m, 4 | 10), in the VTK order with positive Jacobians.
        clamped: (c,) indices of the nodes that do not move, rising.
        surface: (t, 3) node indices of the boundary's triangles, outward normals; corner nodes only.
    """

    nodes: NDArray
    elements: NDArray
    clamped: NDArray
    surface: NDArray

    @property
    def is_hexahedral(self) -> bool:
        """True if it is made of hexahedra."""
        return self.elements.shape[1] == 8

    def mirrored(self) -> "VolumeMesh":
        """Return the mirror image y -> -y, with the same node numbers and positive Jacobians."""
        order = _MIRROR_HEX if self.is_hexahedral else _MIRROR_TET10[: self.elements.shape[1]]
        return VolumeMesh(
            nodes=self.nodes * [1.0, -1.0, 1.0],
            elements=self.elements[:, order],
            clamped=self.clamped,
            surface=self.surface[:, [0, 2, 1]],
        )


def build_volume_mesh(*, nodes: NDArray, elements: NDArray, clamped: Iterable[int]) -> VolumeMesh:
    """Check a mesh and add its surface.

    Args:
        nodes: (n, 3) [m], jaw frame.
        elements: node indices of hexahedra (m, 8) or tetrahedra (m, 4 | 10), in the VTK order.
        clamped: indices of the clamped nodes.

    Returns:
        The mesh.

    Raises:
        MeshError: No elements, wrong shapes, indices out of range or not whole, NaN, millimetres
            for metres, duplicate or unused nodes, inverted or repeated elements, no clamped nodes.
    """
    nodes = np.ascontiguousarray(nodes, dtype=float)
    elements = _to_indices(elements, "elements")
    clamped = np.unique(_to_indices(list(clamped), "clamped nodes"))
    _check_nodes(nodes)
    _check_elements(elements, len(nodes))
    _check_numbering(nodes, elements)
    _check_jacobians(nodes, elements)
    _check_clamped(clamped, len(nodes))
    _check_overlaps(elements, elements[:, _faces_of(elements)])
    return VolumeMesh(nodes=nodes, elements=elements, clamped=clamped, surface=surface_triangles(elements))


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


# Row v turns a hexahedron so that its corner v comes first.
_TURNS_HEX = np.array(
    [
        [0, 1, 2, 3, 4, 5, 6, 7],
        [1, 2, 3, 0, 5, 6, 7, 4],
        [2, 3, 0, 1, 6, 7, 4, 5],
        [3, 0, 1, 2, 7, 4, 5, 6],
        [4, 7, 6, 5, 0, 3, 2, 1],
        [5, 4, 7, 6, 1, 0, 3, 2],
        [6, 5, 4, 7, 2, 1, 0, 3],
        [7, 6, 5, 4, 3, 2, 1, 0],
    ]
)


def split_hexes(hexes: NDArray) -> NDArray:
    """Split each hexahedron into six tetrahedra on the same nodes.

    Each hexahedron is the union of the tetrahedra between its corner with the smallest node index and the
    triangles of its three far faces. Every face is split along the diagonal from its own smallest node index,
    so that neighbours agree.

    Args:
        hexes: (m, 8) node indices in the VTK order.

    Returns:
        (6 m, 4) node indices, positive volumes, the six of a hexahedron together.
    """
    turned = np.take_along_axis(hexes, _TURNS_HEX[hexes.argmin(axis=1)], axis=1)
    far = turned[:, FACES_HEX[[1, 3, 4]]].reshape(-1, 4)
    return np.column_stack([np.repeat(turned[:, 0], 6), split_faces(far)])


def to_tet4(mesh: VolumeMesh) -> VolumeMesh:
    """Return the mesh as 4-node tetrahedra: hexahedra split in six, 10-node tetrahedra without middle nodes.

    Linear tetrahedra lock in bending: they serve for comparison.
    """
    if mesh.is_hexahedral:
        return build_volume_mesh(nodes=mesh.nodes, elements=split_hexes(mesh.elements), clamped=mesh.clamped)
    if mesh.elements.shape[1] == 4:
        return mesh
    corners, tets = np.unique(mesh.elements[:, :4], return_inverse=True)
    clamped = np.flatnonzero(np.isin(corners, mesh.clamped))
    return build_volume_mesh(nodes=mesh.nodes[corners], elements=tets.reshape(-1, 4), clamped=clamped)


def to_tet10(mesh: VolumeMesh) -> VolumeMesh:
    """Return the mesh as 10-node tetrahedra: hexahedra split in six, a node in the middle of every edge.

    The nodes of the given mesh keep their indices. A middle node is clamped when both ends of its edge are.
    """
    if mesh.elements.shape[1] == 10:
        return mesh
    tets = split_hexes(mesh.elements) if mesh.is_hexahedral else mesh.elements
    edges = np.sort(tets[:, EDGES_TET10], axis=2)
    ends, middle = np.unique(edges.reshape(-1, 2), axis=0, return_inverse=True)
    nodes = np.concatenate([mesh.nodes, mesh.nodes[ends].mean(axis=1)])
    middles = len(mesh.nodes) + middle.reshape(-1, 6)
    held = len(mesh.nodes) + np.flatnonzero(np.isin(ends, mesh.clamped).all(axis=1))
    return build_volume_mesh(
        nodes=nodes, elements=np.hstack([tets, middles]), clamped=np.concatenate([mesh.clamped, held])
    )


def _check_jacobians(nodes: NDArray, elements: NDArray) -> None:
    """Refuse elements whose Jacobian is not positive at every corner, in the middle of edges and faces, and inside."""
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


def _check_elements(elements: NDArray, node_count: int) -> None:
    """Refuse element tables of the wrong shape or with indices out of range."""
    if elements.ndim != 2 or elements.shape[1] not in (4, 8, 10) or len(elements) == 0:
        raise MeshError(f"elements: got shape {elements.shape}, expected (m, 4), (m, 8) or (m, 10), at least one")
    bad = np.flatnonzero(((elements < 0) | (elements >= node_count)).any(axis=1))
    if len(bad):
        raise MeshError(
            f"{len(bad)} elements name nodes out of 0..{node_count - 1} (first: element {bad[0]}: "
            f"{elements[bad[0]].tolist()})"
        )


def _check_numbering(nodes: NDArray, elements: NDArray) -> None:
    """Refuse nodes that lie on each other and nodes that no element uses."""
    from scipy.spatial import cKDTree  # half a second that a drawing, checked by itself, need not wait

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


# Points count as lying on one line when they leave it by less than this share of the mesh.
_ON_LINE = 1e-6


def _check_overlaps(elements: NDArray, faces: NDArray) -> None:
    """Refuse elements that occur twice, and faces (m, f, 3 | 4) of more than two."""
    _check_repeats(elements[:, : 8 if elements.shape[1] == 8 else 4])
    face = _number_faces(faces)
    crowded = np.flatnonzero(np.bincount(face.ravel()) > 2)
    if len(crowded):
        sharing = np.flatnonzero((face == crowded[0]).any(axis=1)).tolist()
        raise MeshError(
            f"{len(crowded)} faces belong to more than two elements (first: elements {sharing}): the elements overlap; "
            "remove all but two"
        )


def check_connection(mesh: VolumeMesh) -> None:
    """Refuse a mesh that is not one piece, or of which a part can turn freely.

    Raises:
        MeshError: Parts share no node, or hang together by nodes on one line; or the clamped nodes lie on one.
    """
    nodes, elements, clamped = mesh.nodes, mesh.elements, mesh.clamped
    _check_one_piece(nodes, elements)
    if _on_one_line(nodes[clamped], nodes):
        raise MeshError(f"the {len(clamped)} clamped nodes lie on one line: the mesh can turn about it")
    _check_hinges(nodes, elements, _number_faces(elements[:, _faces_of(elements)]), clamped)


def _number_faces(faces: NDArray) -> NDArray:
    """Return a number (m, f) for each face, the same for the same corners."""
    rows = np.sort(faces, axis=2).reshape(-1, faces.shape[2])
    return np.unique(rows, axis=0, return_inverse=True)[1].reshape(faces.shape[:2])


def _check_repeats(elements: NDArray) -> None:
    rows = np.sort(elements, axis=1)
    _, first, number = np.unique(rows, axis=0, return_index=True, return_inverse=True)
    original = first[number.ravel()]
    repeats = np.flatnonzero(original != np.arange(len(rows)))
    if len(repeats):
        raise MeshError(
            f"{len(repeats)} elements occur twice (first: element {repeats[0]} is element {original[repeats[0]]}): "
            "they would count as twice as stiff; remove them"
        )


def _check_one_piece(nodes: NDArray, elements: NDArray) -> None:
    piece = number_pieces(np.repeat(np.arange(len(elements)), elements.shape[1]), elements.ravel(), len(elements))
    sizes = np.bincount(piece)
    if len(sizes) > 1:
        lone = np.flatnonzero(piece == sizes.argmin())
        centre = np.round(1e3 * nodes[elements[lone[0]]].mean(axis=0), 2).tolist()
        raise MeshError(
            f"the mesh falls into {len(sizes)} pieces that share no node (the smallest: {len(lone)} elements, first: "
            f"element {lone[0]} at {centre} mm), expected one; merge the nodes where they touch, or remove it"
        )


def _check_hinges(nodes: NDArray, elements: NDArray, face: NDArray, clamped: NDArray) -> None:
    """Refuse parts, elements joined by faces, that hang together with the rest by nodes on one line."""
    part = number_pieces(np.repeat(np.arange(len(face)), face.shape[1]), face.ravel(), len(face))
    if not part.any():
        return
    held = set(clamped.tolist())
    for index in range(part.max() + 1):
        inside = part == index
        own = np.unique(elements[inside])
        shared = np.intersect1d(own, elements[~inside])
        support = np.union1d(shared, [node for node in own.tolist() if node in held]).astype(int)
        if _on_one_line(nodes[support], nodes):
            first = int(np.flatnonzero(inside)[0])
            centre = np.round(1e3 * nodes[elements[first]].mean(axis=0), 2).tolist()
            raise MeshError(
                f"a part of {int(inside.sum())} elements (first: element {first} at {centre} mm) is held by nodes on "
                f"one line ({support[:4].tolist()}): it can turn about it; join it by faces"
            )


def _on_one_line(points: NDArray, nodes: NDArray) -> bool:
    """Return True if points (p, 3) lie on one line, as fewer than three do."""
    if len(points) < 3:
        return True
    sizes = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    return bool(sizes[1] < _ON_LINE * np.ptp(nodes, axis=0).max())
