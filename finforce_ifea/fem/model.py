"""The interface of every mechanical model of a jaw, and factorised stiffness matrices: banded or sparse."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal, Protocol

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.linalg.lapack import dpbtrf, dpbtrs
from scipy.sparse.linalg import SuperLU, splu

from finforce.compiled import njit

LARGEST_MOVE, LARGEST_TURN = 2e-3, 0.3
Across = Literal["middle", "half", "both"]


class Factor:
    """Factors of a symmetric stiffness matrix K; `positive` when the state that it belongs to is stable."""

    positive = True
    solve: Callable[[NDArray], NDArray]

    def condense(self, b: sparse.csr_matrix) -> NDArray:
        """Return b^T K^-1 b (k, k), symmetric, for sparse b of shape (n, k)."""
        found = b.T @ self.solve(b.toarray())
        return 0.5 * (found + found.T)


class BandedFactor(Factor):
    """Cholesky factor of a positive definite banded matrix."""

    def __init__(self, factor: NDArray) -> None:
        self._factor = factor

    def solve(self, b: NDArray) -> NDArray:
        """Return K^-1 b for b of shape (n,) or (n, k)."""
        return dpbtrs(self._factor, b, lower=1)[0].reshape(b.shape)


class SparsePlan:
    """The entries of L and D in the factors L D L^T of all symmetric matrices with one pattern.

    Args:
        pointer: where each column of the upper triangle begins (n + 1,).
        index: the rows of its entries, rising, the diagonal's last (k,).
    """

    def __init__(self, pointer: NDArray, index: NDArray) -> None:
        self._pattern = pointer, index
        first = np.concatenate([[0], np.cumsum(_find_rows(pointer, index, pointer, np.zeros(0, np.int64)))])
        rows = np.zeros(first[-1], np.int64)
        _find_rows(pointer, index, first, rows)
        lower = sparse.csr_matrix((np.ones(len(rows)), rows, first), (len(first) - 1,) * 2)
        lower.sort_indices()
        columns = lower.tocsc()
        self.rows, self.columns = (lower.indptr, lower.indices), (columns.indptr, columns.indices)
        lengths = np.append(np.diff(columns.indptr), -1)
        self._twins = _find_twins(*self.rows) & (lengths[:-1] == lengths[1:] + 1)

    def factorise(self, upper: NDArray) -> "DiagonalFactor | None":
        """Factorise a matrix by its upper entries (k,); return None where that loses digits without exchanging rows.

        Positive definite ones never do.
        """
        values, pivots = np.empty(len(self.rows[1])), np.empty(len(self._twins))
        _eliminate((*self._pattern, upper), self.rows, self.columns, self._twins, values, pivots)
        factor = DiagonalFactor(self, values, pivots)
        is_exact = factor.positive or np.abs(values).max(initial=0.0) < _LARGEST_GROWTH
        return factor if is_exact else None


class DiagonalFactor(Factor):
    """Factors L D L^T of a sparse symmetric matrix."""

    def __init__(self, plan: SparsePlan, values: NDArray, pivots: NDArray) -> None:
        self._parts = (*plan.columns, values, pivots)
        self.positive = bool((pivots > 0.0).all())

    def solve(self, b: NDArray) -> NDArray:
        """Return K^-1 b for b of shape (n,) or (n, k)."""
        x = np.array(b, float, order="C").reshape(len(b), -1)
        _substitute(*self._parts, x)
        return x.reshape(b.shape)

    def condense(self, b: sparse.csr_matrix) -> NDArray:
        """Return b^T K^-1 b (k, k), symmetric: with Y = L^-1 b, most rows of which are zero, Y^T D^-1 Y."""
        x, reached = b.toarray(), np.diff(b.indptr) > 0
        _substitute_forward(*self._parts[:3], x, reached)
        x = x[reached]
        return x.T @ (self._parts[3][reached, None] * x)


# Entries of L up to which an indefinite matrix keeps half of its digits.
_LARGEST_GROWTH = 1e8
_OPTIONS = {"cache": True, "error_model": "numpy", "fastmath": {"contract", "nsz"}}


@njit(**_OPTIONS)
def _find_rows(pointer, index, first, rows):
    """Write the columns of the entries of L, row by row from `first` (n + 1,) on; return how many each row has (n,).

    Source: Davis, Direct Methods for Sparse Linear Systems (2006), chapter 4.1. Nothing is written to `rows` of no
    length.
    """
    n = len(pointer) - 1
    parent, mark, count = np.full(n, -1), np.full(n, -1), np.zeros(n, np.int64)
    for k in range(n):
        mark[k] = k
        for p in range(pointer[k], pointer[k + 1]):
            i = index[p]
            while mark[i] != k:
                if parent[i] < 0:
                    parent[i] = k
                if len(rows):
                    rows[first[k] + count[k]] = i
                count[k] += 1
                mark[i] = k
                i = parent[i]
    return count


@njit(**_OPTIONS)
def _find_twins(pointer, index):
    """Return which rows of L (n,) the next one repeats, and adds one entry to."""
    n = len(pointer) - 1
    twins = np.zeros(n, np.bool_)
    for k in range(n - 1):
        first, last, end = pointer[k], pointer[k + 1], pointer[k + 2]
        twins[k] = end - last == last - first + 1 and (index[first:last] == index[last : end - 1]).all()
    return twins


@njit(**_OPTIONS)
def _eliminate(upper, by_rows, by_columns, twins, values, pivots):
    """Write L's values (k,) by columns, and 1 / D (n,), by rows: those of one node, `twins` (n,), two at a time.

    The upper triangle comes by columns, the pattern of L by rows and by columns: pointers, indices, and values.
    """
    (pointer, index, data), (row_pointer, row_index), (first, rows) = upper, by_rows, by_columns
    n = len(pivots)
    row, end = np.zeros((n + 1, 2)), first[:n].copy()
    k = 0
    while k < n:
        wide = 2 if twins[k] else 1
        for side in range(wide):
            for p in range(pointer[k + side], pointer[k + side + 1]):
                row[index[p], side] = data[p]
        q, last = row_pointer[k], row_pointer[k + 1]
        while q < last:
            i = row_index[q]
            a, b, c, d, further = row[i, 0], row[i, 1], 0.0, 0.0, 0
            pair = 2 if twins[i] and q + 1 < last and row_index[q + 1] == i + 1 else 1
            if pair == 2:
                c, d = row[i + 1, 0] - values[first[i]] * a, row[i + 1, 1] - values[first[i]] * b
                row[i + 1, 0], row[i + 1, 1] = c, d
                further = first[i + 1] - first[i] - 1
            for p in range(first[i] + pair - 1, end[i]):
                there, one, other = rows[p], values[p], values[p + further]
                row[there, 0] -= one * a + other * c
                row[there, 1] -= one * b + other * d
            for j in range(i, i + pair):
                a, b = row[j, 0], row[j, 1]
                row[j, 0], row[j, 1] = 0.0, 0.0
                values[end[j]] = a * pivots[j]
                if wide == 2:
                    values[end[j] + 1] = b * pivots[j]
                row[k, 0] -= a * a * pivots[j]
                row[k, 1] -= a * b * pivots[j]
                row[k + 1, 1] -= b * b * pivots[j]
                end[j] += wide
            q += pair
        pivots[k] = 1.0 / row[k, 0]
        if wide == 2:
            values[end[k]] = row[k, 1] * pivots[k]
            pivots[k + 1] = 1.0 / (row[k + 1, 1] - row[k, 1] * values[end[k]])
            end[k] += 1
        row[k : k + 2] = 0.0
        k += wide


@njit(**_OPTIONS)
def _substitute_forward(first, rows, values, x, reached):
    """Replace x (n, k) by L^-1 x, all of whose rows are zero but those that are reached (n,), which are added to."""
    n, columns = x.shape
    for i in range(n):
        if not reached[i]:
            continue
        here = x[i]
        for p in range(first[i], first[i + 1]):
            there, value = x[rows[p]], values[p]
            reached[rows[p]] = True
            for c in range(columns):
                there[c] -= value * here[c]


@njit(**_OPTIONS)
def _substitute(first, rows, values, pivots, x):
    """Replace x (n, k) by (L D L^T)^-1 x."""
    n, columns = x.shape
    _substitute_forward(first, rows, values, x, np.ones(n, np.bool_))
    for i in range(n - 1, -1, -1):
        here = x[i]
        for c in range(columns):
            here[c] *= pivots[i]
        for p in range(first[i], first[i + 1]):
            there, value = x[rows[p]], values[p]
            for c in range(columns):
                here[c] -= value * there[c]


class SparseFactor(Factor):
    """LU factor of any regular symmetric matrix (n, n)."""

    def __init__(self, matrix: sparse.csc_matrix) -> None:
        self._matrix, self._lu = matrix, _factorise_sparse(matrix, 0.1)

    @property
    def positive(self) -> bool:
        """True if the matrix is positive definite: elimination along the diagonal meets positive pivots alone."""
        plain = _factorise_sparse(self._matrix, 0.0)
        return bool((plain.perm_r == plain.perm_c).all() and (plain.U.diagonal() > 0.0).all())

    def solve(self, b: NDArray) -> NDArray:
        """Return K^-1 b for b of shape (n,) or (n, k)."""
        return self._lu.solve(np.asarray(b))


def _factorise_sparse(matrix: sparse.csc_matrix, pivoting: float) -> SuperLU:
    """Return the LU factors; above zero, `pivoting` is the share of a column's largest entry that a pivot needs."""
    return splu(matrix, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=pivoting, options={"SymmetricMode": True})


def order_unknowns(row: NDArray, col: NDArray, size: int) -> NDArray:
    """Return the place of each unknown (size,) in the order of minimum degree, in which factors have little fill.

    Args:
        row: of entries of the symmetric matrix, either triangle or both (k,).
        col: of the same (k,).
        size: of the matrix.
    """
    pattern = sparse.coo_matrix((np.ones(len(row)), (row, col)), (size, size)).tocsc()
    pattern = pattern + pattern.T
    pattern += 2.0 * abs(pattern).sum() * sparse.eye(size)  # positive definite, so that nothing is pivoted
    return _factorise_sparse(pattern.tocsc(), 0.0).perm_c


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


@dataclass(frozen=True, kw_only=True, eq=False)
class Linearization:
    """One state of a model.

    Attributes:
        force: internal force of the unknowns (n,) [N].
        energy: elastic energy [J].
        smallest_det: smallest det F of all elements [-]; at or below zero the mesh has turned inside out.
        tangent: stored tangent stiffness, to be passed to `stiffen` and `factorise`.
    """

    force: NDArray
    energy: float
    smallest_det: float
    tangent: Any


class JawModel(Protocol):
    """A geometrically nonlinear jaw with unknowns q, shape (size,) [m or rad].

    Attributes:
        size: number of unknowns.
        across: where along y contact points stand: in the "middle" of a planar model, on "half" of the width where each
            stands for its mirror image too, or on "both" halves.
        rotations: mask of the unknowns that are rotations (size,) bool; None when all are of one kind.
        reach: largest change of each unknown at once (size,), or of all: 2 mm, 0.3 rad.
    """

    size: int
    across: Across
    rotations: NDArray | None
    reach: NDArray | float

    def linearize(self, q: NDArray) -> Linearization:
        """Evaluate internal force, energy and tangent stiffness at q."""
        ...

    def attach(self, points: NDArray, max_distance: float) -> Any:
        """Return a probe of material points (p, 3) [m, undeformed, jaw frame]; raises MeshError when off the jaw."""
        ...

    def positions(self, probe: Any, q: NDArray) -> NDArray:
        """Return the deformed positions (p, 3) [m] of a probe."""
        ...

    def project(self, probe: Any, q: NDArray, modes: NDArray) -> NDArray:
        """Return the motions (p, 3, k) [m] of a probe for changes modes (size, k) of the unknowns."""
        ...

    def load(self, probe: Any, q: NDArray, forces: NDArray) -> NDArray:
        """Return the generalised load (size,) of forces (p, 3) [N] at a probe's points."""
        ...

    def stiffen(self, tangent: Any, probe: Any, q: NDArray, blocks: NDArray) -> None:
        """Add springs blocks (p, 3, 3) [N/m] at a probe's points to a stored tangent, in place."""
        ...

    def factorise(self, tangent: Any) -> Factor:
        """Factorise a stored tangent."""
        ...

    def vertices(self, q: NDArray) -> NDArray:
        """Return the deformed mesh vertices (v, 3) [m], in mesh order."""
        ...
