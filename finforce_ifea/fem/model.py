"""What every mechanical model of a jaw offers to the solvers, and factorised stiffness matrices: banded or sparse."""

from dataclasses import dataclass
from typing import Any, Literal, Protocol

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.linalg.lapack import dpbtrf, dpbtrs
from scipy.sparse.linalg import SuperLU, splu

LARGEST_MOVE, LARGEST_TURN = 2e-3, 0.3
Across = Literal["middle", "half", "both"]


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


Factor = BandedFactor | SparseFactor  # of a symmetric matrix; `positive` when the state that it belongs to is stable


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


@dataclass(frozen=True, kw_only=True, eq=False)
class Linearization:
    """One state of a model.

    Attributes:
        force: internal force of the unknowns (n,) [N].
        energy: elastic energy [J].
        smallest_det: smallest det F of all elements [-]; at or below zero the mesh has turned inside out.
        tangent: stored tangent stiffness, to be passed to `stiffen` and `factorise`; None when not asked for.
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
        rotations: which unknowns are rotations (size,) bool; None when all are of one kind.
        reach: largest change of each unknown at once (size,), or of all: 2 mm, 0.3 rad.
    """

    size: int
    across: Across
    rotations: NDArray | None
    reach: NDArray | float

    def linearize(self, q: NDArray, *, tangent: bool = True) -> Linearization:
        """Evaluate internal force, energy and, unless `tangent` is False, the tangent stiffness at q."""
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
