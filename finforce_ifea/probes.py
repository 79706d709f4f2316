"""Compiled loops over material points given as weighted sums of unknowns; knows no elements."""

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy import sparse

_OPTIONS = {"cache": True, "error_model": "numpy"}


@njit(**_OPTIONS)
def scatter_lower(values, source, row, col, storage):
    """Adds values[source[i]] to storage[row[i], col[i]] for all i."""
    for i in range(len(source)):
        storage[row[i], col[i]] += values[source[i]]


@njit(**_OPTIONS)
def probe_positions(points, dof, weights, q):
    """Returns points (p, 3) moved by sum_m weights (p, m, 3) q[dof (p, m, 3)], shape (p, 3)."""
    out = points.copy()
    n = len(q)
    for p in range(dof.shape[0]):
        for m in range(dof.shape[1]):
            for a in range(3):
                if dof[p, m, a] < n:
                    out[p, a] += weights[p, m, a] * q[dof[p, m, a]]
    return out


@njit(**_OPTIONS)
def probe_motions(dof, weights, modes):
    """Returns the motions (p, 3, k) of the points for changes modes (n, k) of the unknowns."""
    n, k = modes.shape
    out = np.zeros((dof.shape[0], 3, k))
    for p in range(dof.shape[0]):
        for m in range(dof.shape[1]):
            for a in range(3):
                d = dof[p, m, a]
                if d < n:
                    for c in range(k):
                        out[p, a, c] += weights[p, m, a] * modes[d, c]
    return out


@njit(**_OPTIONS)
def probe_loads(dof, weights, forces, n):
    """Returns the generalised load (n,) of forces (p, 3)."""
    out = np.zeros(n)
    for p in range(dof.shape[0]):
        if forces[p, 0] == 0.0 and forces[p, 1] == 0.0 and forces[p, 2] == 0.0:
            continue
        for m in range(dof.shape[1]):
            for a in range(3):
                if dof[p, m, a] < n:
                    out[dof[p, m, a]] += weights[p, m, a] * forces[p, a]
    return out


@njit(**_OPTIONS)
def _add_banded_springs(dof, weights, blocks, n, storage):
    for p in range(dof.shape[0]):
        if blocks[p, 0, 0] == 0.0 and blocks[p, 1, 1] == 0.0 and blocks[p, 2, 2] == 0.0:
            continue
        for m in range(dof.shape[1]):
            for a in range(3):
                row = dof[p, m, a]
                if row >= n or weights[p, m, a] == 0.0:
                    continue
                for k in range(dof.shape[1]):
                    for b in range(3):
                        col = dof[p, k, b]
                        if col <= row and weights[p, k, b] != 0.0:
                            storage[row - col, col] += weights[p, m, a] * blocks[p, a, b] * weights[p, k, b]


def add_probe_springs(dof: NDArray, weights: NDArray, blocks: NDArray, size: int, tangent) -> None:
    """Adds sum_p W_p^T blocks_p W_p, blocks (p, 3, 3) [N/m], to a lower tangent, banded or sparse, in place."""
    if isinstance(tangent, np.ndarray):
        _add_banded_springs(dof, weights, blocks, size, tangent)
        return
    active = np.flatnonzero(np.abs(blocks).max((1, 2)) > 0)
    rows = dof[active].reshape(len(active), -1)
    values = np.einsum("pma,pab,pkb->pmakb", weights[active], blocks[active], weights[active])
    values = values.reshape(*rows.shape, rows.shape[1])
    row, col = np.broadcast_arrays(rows[:, :, None], rows[:, None, :])
    keep = (row < size) & (col <= row)
    extra = sparse.coo_matrix((values[keep], (row[keep], col[keep])), (size, size)).tocsc()
    total = tangent + extra
    tangent.data, tangent.indices, tangent.indptr = total.data, total.indices, total.indptr
