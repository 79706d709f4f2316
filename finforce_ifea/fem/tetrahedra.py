"""Meshes of tetrahedra made from meshes of hexahedra or of linear tetrahedra."""

import numpy as np
from numpy.typing import NDArray

from finforce_ifea.jaw.mesh import EDGES_TET10, FACES_HEX, VolumeMesh, build_volume_mesh, split_faces

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
    if mesh.hexes is not None:
        return build_volume_mesh(nodes=mesh.nodes, tets=split_hexes(mesh.hexes), clamped=mesh.clamped)
    if mesh.tets.shape[1] == 4:
        return mesh
    corners, tets = np.unique(mesh.tets[:, :4], return_inverse=True)
    clamped = np.flatnonzero(np.isin(corners, mesh.clamped))
    return build_volume_mesh(nodes=mesh.nodes[corners], tets=tets.reshape(-1, 4), clamped=clamped)


def to_tet10(mesh: VolumeMesh) -> VolumeMesh:
    """Return the mesh as 10-node tetrahedra: hexahedra split in six, a node in the middle of every edge.

    The nodes of the given mesh keep their indices. A middle node is clamped when both ends of its edge are.
    """
    if mesh.tets is not None and mesh.tets.shape[1] == 10:
        return mesh
    tets = mesh.tets if mesh.hexes is None else split_hexes(mesh.hexes)
    edges = np.sort(tets[:, EDGES_TET10], axis=2)
    ends, middle = np.unique(edges.reshape(-1, 2), axis=0, return_inverse=True)
    nodes = np.concatenate([mesh.nodes, mesh.nodes[ends].mean(axis=1)])
    middles = len(mesh.nodes) + middle.reshape(-1, 6)
    held = len(mesh.nodes) + np.flatnonzero(np.isin(ends, mesh.clamped).all(axis=1))
    return build_volume_mesh(nodes=nodes, tets=np.hstack([tets, middles]), clamped=np.concatenate([mesh.clamped, held]))
