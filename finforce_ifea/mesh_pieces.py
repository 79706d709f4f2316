"""Whether a volume mesh is one piece that its clamp holds; knows no stiffness."""

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.csgraph import connected_components

from finforce_ifea.errors import MeshError

# Points count as lying on one line when they leave it by less than this share of the mesh.
_ON_LINE = 1e-6


def check_overlaps(elements: NDArray, faces: NDArray) -> None:
    """Refuses elements that lie on each other.

    Args:
        elements: (m, 4 | 8 | 10) node indices.
        faces: (m, f, 3 | 4) node indices of the corners of each element's faces.

    Raises:
        MeshError: Elements occur twice, or a face belongs to more than two; the message names the first of them.
    """
    _check_repeats(elements[:, : 8 if elements.shape[1] == 8 else 4])
    face = _number_faces(faces)
    crowded = np.flatnonzero(np.bincount(face.ravel()) > 2)
    if len(crowded):
        sharing = np.flatnonzero((face == crowded[0]).any(axis=1)).tolist()
        raise MeshError(
            f"{len(crowded)} faces belong to more than two elements (first: elements {sharing}): the elements overlap; "
            "remove all but two"
        )


def check_pieces(nodes: NDArray, elements: NDArray, faces: NDArray, clamped: NDArray) -> None:
    """Refuses a mesh that is not one piece, or of which a part can turn freely.

    Args:
        nodes: (n, 3) [m].
        elements: (m, 4 | 8 | 10) node indices.
        faces: (m, f, 3 | 4) node indices of the corners of each element's faces.
        clamped: (c,) node indices.

    Raises:
        MeshError: Elements hang together with the rest by nodes on one line or by none, or the clamped nodes lie on
            one line; the message names the first of them.
    """
    _check_one_piece(nodes, elements)
    if _on_one_line(nodes[clamped], nodes):
        raise MeshError(f"the {len(clamped)} clamped nodes lie on one line: the mesh can turn about it")
    _check_hinges(nodes, elements, _number_faces(faces), clamped)


def _number_faces(faces: NDArray) -> NDArray:
    """Returns a number (m, f) for each face, the same for the same corners."""
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
    number, piece = _number_pieces(np.repeat(np.arange(len(elements)), elements.shape[1]), elements.ravel(), elements)
    if number > 1:
        small = int(np.bincount(piece).argmin())
        lone = np.flatnonzero(piece == small)
        centre = np.round(1e3 * nodes[elements[lone[0]]].mean(axis=0), 2).tolist()
        raise MeshError(
            f"the mesh falls into {number} pieces that share no node (the smallest has {len(lone)} elements, first: "
            f"element {lone[0]} at {centre} mm), expected one; merge the nodes where they touch, or remove it"
        )


def _check_hinges(nodes: NDArray, elements: NDArray, face: NDArray, clamped: NDArray) -> None:
    """Refuses parts, elements joined by faces, that hang together with the rest by nodes on one line."""
    number, part = _number_pieces(np.repeat(np.arange(len(face)), face.shape[1]), face.ravel(), elements)
    if number == 1:
        return
    held = set(clamped.tolist())
    for index in range(number):
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


def _number_pieces(rows: NDArray, columns: NDArray, elements: NDArray) -> tuple[int, NDArray]:
    """Returns how many pieces the elements make that are joined by common columns, and each one's piece (m,)."""
    count = int(columns.max()) + 1
    incidence = sparse.coo_matrix((np.ones(len(rows)), (rows, columns)), (len(elements), count)).tocsr()
    return connected_components(incidence @ incidence.T, directed=False)


def _on_one_line(points: NDArray, nodes: NDArray) -> bool:
    """Whether points (p, 3) lie on one line, as fewer than three do."""
    if len(points) < 3:
        return True
    sizes = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    return bool(sizes[1] < _ON_LINE * np.ptp(nodes, axis=0).max())
