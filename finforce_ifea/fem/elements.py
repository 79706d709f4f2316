"""Small-strain stiffness of single volume elements."""

import numpy as np
from numpy.typing import NDArray

from finforce_ifea.jaw.mesh import shape_gradients


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
