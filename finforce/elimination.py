"""Small systems of linear equations for compiled code, without a library's checks and copies."""

from numpy.typing import NDArray

from finforce.compiled import njit

_OPTIONS = {"cache": True, "error_model": "numpy"}


@njit(**_OPTIONS)
def eliminate(A: NDArray, B: NDArray) -> None:
    """Solve A X = B in place, by Gaussian elimination with the largest pivot of each column.

    Args:
        A: (n, n), written over.
        B: (n, m), becomes X; not finite where A is singular.
    """
    size, columns = B.shape
    for k in range(size):
        _bring_largest(A, B, k)
        for i in range(k + 1, size):
            share = A[i, k] / A[k, k]
            if share != 0.0:
                for j in range(k + 1, size):
                    A[i, j] -= share * A[k, j]
                for c in range(columns):
                    B[i, c] -= share * B[k, c]
    for k in range(size - 1, -1, -1):
        for c in range(columns):
            value = B[k, c]
            for j in range(k + 1, size):
                value -= A[k, j] * B[j, c]
            B[k, c] = value / A[k, k]


@njit(**_OPTIONS)
def _bring_largest(A, B, k):
    """Exchange line k of A (n, n) and B (n, m) for the one below with the largest entry in column k."""
    pivot = k
    for i in range(k + 1, len(A)):
        if abs(A[i, k]) > abs(A[pivot, k]):
            pivot = i
    if pivot == k:
        return
    for j in range(len(A)):
        A[k, j], A[pivot, j] = A[pivot, j], A[k, j]
    for c in range(B.shape[1]):
        B[k, c], B[pivot, c] = B[pivot, c], B[k, c]
