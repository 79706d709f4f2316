"""Small-strain stiffness of single volume elements, and meshes of tetrahedra made from those of other elements."""

import numpy as np
from numpy.typing import NDArray

from finforce_ifea.jaw.mesh import EDGES_TET10, FACES_HEX, VolumeMesh, build_volume_mesh, shape_gradients, split_faces


def elasticity_matrix(young_modulus: float, poisson_ratio: float) -> NDArray:
    """Return the isotropic elasticity matrix D, shape (6, 6) [Pa], for strains (xx, yy, zz, 2xy, 2yz, 2zx)."""
    lame = young_modulus * poisson_ratio / ((1 + poisson_ratio) * (1 - 2 * poisson_ratio))
    shear = young_modulus / (2 * (1 + poisson_ratio))
    D = np.diag([2 * shear] * 3 + [shear] * 3)
    D[:3, :3] += lame
    return D


def _strain_displacement(gradient: NDArray) -> NDArray:
    """Return B, shape (..., 6, 3 n), from shape function gradients (..., n, 3) [1/m]."""
    n = gradient.shape[-2]
    B = np.zeros((*gradient.shape[:-2], 6, n, 3))
    x, y, z = gradient[..., 0], gradient[..., 1], gradient[..., 2]
    for row, entries in enumerate([[(0, x)], [(1, y)], [(2, z)], [(0, y), (1, x)], [(1, z), (2, y)], [(2, x), (0, z)]]):
        for axis, values in entries:
            B[..., row, :, axis] = values
    return B.reshape(*gradient.shape[:-2], 6, 3 * n)


def _physical_gradient(corners: NDArray, local: NDArray) -> tuple[NDArray, NDArray]:
    jacobian = np.einsum("pnk,mni->mpik", local, corners)
    return np.einsum("pnk,mpki->mpni", local, np.linalg.inv(jacobian)), np.linalg.det(jacobian)


def hex_stiffness(corners: NDArray, D: NDArray) -> NDArray:
    """Return the stiffness of 8-node hexahedra with incompatible modes.

    The three quadratic modes 1 - xi_k^2 of each displacement component are condensed; their gradients use the
    Jacobian at the centre, so that the constant-strain patch test holds on distorted elements.

    Args:
        corners: node coordinates (m, 8, 3) [m], VTK order.
        D: elasticity matrix (6, 6) [Pa].

    Returns:
        Symmetric stiffness (m, 24, 24) [N/m].

    Source: Taylor, Beresford, Wilson, A non-conforming element for stress analysis, IJNME 10 (1976).
    """
    points = np.array([[i, j, k] for i in (-1, 1) for j in (-1, 1) for k in (-1, 1)]) / np.sqrt(3)
    gradient, det = _physical_gradient(corners, shape_gradients(8, points))
    _, det_centre = _physical_gradient(corners, shape_gradients(8, np.zeros((1, 3))))
    jacobian_centre = np.einsum("pnk,mni->mpik", shape_gradients(8, np.zeros((1, 3))), corners)[:, 0]
    modes = -2 * points[:, :, None] * np.eye(3)
    modes = np.einsum("pak,mki->mpai", modes, np.linalg.inv(jacobian_centre)) * (det_centre / det)[..., None, None]
    B, G = _strain_displacement(gradient), _strain_displacement(modes)
    weigh = lambda left, right: np.einsum("mp,mpai,ab,mpbj->mij", det, left, D, right, optimize=True)  # noqa: E731
    coupling, internal = weigh(G, B), weigh(G, G)
    K = weigh(B, B) - np.einsum("mai,maj->mij", coupling, np.linalg.solve(internal, coupling))
    return 0.5 * (K + K.transpose(0, 2, 1))


def tet_stiffness(corners: NDArray, D: NDArray) -> NDArray:
    """Return the stiffness (m, 3 n, 3 n) [N/m] of tetrahedra with n = 4 or 10 nodes (m, n, 3) [m], meshio order.

    The 10-node element is integrated with four points, exact for its stiffness when its edges are straight.
    """
    if corners.shape[1] == 4:
        points, weight = np.full((1, 3), 0.25), 1 / 6
        local = shape_gradients(4, points)
    else:
        a, b = (5 - np.sqrt(5)) / 20, (5 + 3 * np.sqrt(5)) / 20
        points, weight = np.full((4, 3), a), 1 / 24
        points[[0, 1, 2], [0, 1, 2]] = b
        local = shape_gradients(10, points)
    gradient, det = _physical_gradient(corners, local)
    B = _strain_displacement(gradient)
    return weight * np.einsum("mp,mpai,ab,mpbj->mij", det, B, D, B, optimize=True)


def centre_gradient(corners: NDArray) -> NDArray:
    """Return the shape function gradients at the element centres, shape (m, n, 3) [1/m], that define rotation."""
    count = corners.shape[1]
    centre = np.zeros((1, 3)) if count == 8 else np.full((1, 3), 0.25)
    local = shape_gradients(count, centre)
    return _physical_gradient(corners, local)[0][:, 0]


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
