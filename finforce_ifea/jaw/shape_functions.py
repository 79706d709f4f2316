"""Shape functions of the 4- and 10-node tetrahedron and the 8-node hexahedron, nodes in the VTK order."""

import numpy as np
from numpy.typing import NDArray

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
