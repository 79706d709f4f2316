"""Factorised stiffness matrices, banded where that is cheap and sparse elsewhere."""

from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.linalg.lapack import dpbtrf, dpbtrs
from scipy.sparse.linalg import SuperLU, splu


class Factor(Protocol):
    """A factorised symmetric matrix.

    Attributes:
        positive: whether the matrix is positive definite, and the state that it belongs to stable.
    """

    @property
    def positive(self) -> bool:
        """Whether the matrix is positive definite."""
        ...

    def solve(self, b: NDArray) -> NDArray:
        """Return K^-1 b for b of shape (n,) or (n, k)."""
        ...


class BandedFactor:
    """Cholesky factor of a positive definite banded matrix."""

    positive = True

    def __init__(self, factor: NDArray) -> None:
        self._factor = factor

    def solve(self, b: NDArray) -> NDArray:
        """Return K^-1 b for b of shape (n,) or (n, k)."""
        return dpbtrs(self._factor, b, lower=1)[0].reshape(b.shape)


class SparseFactor:
    """LU factor of any regular symmetric matrix, for wide bands and for states beyond a buckling point.

    Args:
        matrix: (n, n).
        ordered: whether its unknowns are numbered by `order_unknowns`.
    """

    def __init__(self, matrix: sparse.csc_matrix, *, ordered: bool = False) -> None:
        self._matrix, self._ordered = matrix, ordered
        self._lu = _factorise_sparse(matrix, 0.1, ordered)

    @property
    def positive(self) -> bool:
        """Whether the matrix is positive definite: elimination along the diagonal meets positive pivots alone."""
        plain = _factorise_sparse(self._matrix, 0.0, self._ordered)
        return bool((plain.perm_r == plain.perm_c).all() and (plain.U.diagonal() > 0.0).all())

    def solve(self, b: NDArray) -> NDArray:
        """Return K^-1 b for b of shape (n,) or (n, k)."""
        return self._lu.solve(np.asarray(b))


def _factorise_sparse(matrix: sparse.csc_matrix, pivoting: float, ordered: bool) -> SuperLU:
    """Return the LU factors; above zero, `pivoting` is the share of a column's largest entry that a pivot needs."""
    # the fill is small and so are supernodes: panels of more than one column only cost
    order = {"permc_spec": "NATURAL", "panel_size": 1} if ordered else {"permc_spec": "MMD_AT_PLUS_A"}
    return splu(matrix, diag_pivot_thresh=pivoting, options={"SymmetricMode": True}, **order)


def order_unknowns(row: NDArray, col: NDArray, size: int) -> NDArray:
    """Return the place of each unknown (size,) in the order of minimum degree, in which factors have little fill.

    To find it takes as long as a factorisation, and depends on the matrix' pattern alone.

    Args:
        row: of entries of the symmetric matrix, either triangle or both (k,).
        col: of the same (k,).
        size: of the matrix.
    """
    pattern = sparse.coo_matrix((np.ones(len(row)), (row, col)), (size, size)).tocsc()
    pattern = pattern + pattern.T
    pattern += 2.0 * abs(pattern).sum() * sparse.eye(size)  # positive definite, so that nothing is pivoted
    return _factorise_sparse(pattern.tocsc(), 0.0, ordered=False).perm_c


def factorise_banded(storage: NDArray) -> BandedFactor | None:
    """Factorise lower banded storage (width + 1, n); return None when the matrix is not positive definite."""
    factor, info = dpbtrf(storage, lower=1, overwrite_ab=0)
    return BandedFactor(factor) if info == 0 else None


def sparse_from_banded(storage: NDArray) -> sparse.csc_matrix:
    """Return the full symmetric matrix of lower banded storage (width + 1, n)."""
    width, n = storage.shape[0] - 1, storage.shape[1]
    lower = sparse.diags([storage[k, : n - k] for k in range(width + 1)], [-k for k in range(width + 1)], format="csc")
    full = lower + sparse.tril(lower, -1).T
    full.eliminate_zeros()
    return full.tocsc()
