"""Kalman filter of several hypotheses that share one covariance.

The hypotheses i differ in what they expect of the traction, kappa_i, alone. Their measurement is linear in x with the
same H and R, so that P, S and K are the same for all, and only the means x_i and the weights w_i differ:

    S = H P H^T + R,  K = P H^T S^-1,  x_i <- x_i + K nu_i,  P <- P - K S K^T,  w_i <- w_i N(nu_i; 0, S).

See Bar-Shalom, Li and Kirubarajan, Estimation with Applications to Tracking and Navigation, 2001, ch. 11.6 (static
multiple-model estimator).
"""

from __future__ import annotations

import numpy as np
from numba import njit

from finforce_ifea.filter.state import (
    APPARENT,
    CAMERA_TURN,
    CAMERA_X,
    CAMERA_Z,
    DEPTH,
    HEIGHT,
    SHAPE,
    SHARED,
    TRACTION,
)

_OPTIONS = {"cache": True, "error_model": "numpy"}
# Columns of a row of H that are not zero beside those of its own key point.
_COLUMNS = np.array([DEPTH, SHAPE, HEIGHT, TRACTION, CAMERA_X, CAMERA_Z, CAMERA_TURN, APPARENT])


@njit(**_OPTIONS)
def multiply_rows(H, rows, u, P):
    """Return H P (m, n).

    Args:
        H: rows of the measurement matrix by `_COLUMNS` (m, 8).
        rows: number of each row among all rows of key points, 2 k + axis (m,).
        u: displacement of each row's key point [m] (m,).
        P: covariance (n, n).
    """
    m, n = len(rows), len(P)
    offset, relative = SHARED, SHARED + (n - SHARED) // 2
    out = np.empty((m, n))
    for i in range(m):
        own, r = P[offset + rows[i]], P[relative + rows[i]]
        for j in range(n):
            out[i, j] = own[j] + u[i] * r[j]
        for c in range(len(_COLUMNS)):
            h = H[i, c]
            if h != 0.0:
                row = P[_COLUMNS[c]]
                for j in range(n):
                    out[i, j] += h * row[j]
    return out


@njit(**_OPTIONS)
def project_columns(H, rows, u, A):
    """Return A H^T (k, m) for rows A (k, n) of a matrix."""
    m, n = len(rows), A.shape[1]
    offset, relative = SHARED, SHARED + (n - SHARED) // 2
    out = np.empty((len(A), m))
    for k in range(len(A)):
        for i in range(m):
            total = A[k, offset + rows[i]] + u[i] * A[k, relative + rows[i]]
            for c in range(len(_COLUMNS)):
                total += H[i, c] * A[k, _COLUMNS[c]]
            out[k, i] = total
    return out


@njit(**_OPTIONS)
def innovate(H, rows, u, P, R):
    """Return H P (m, n) and S = H P H^T + R (m, m), R in blocks of two rows (m // 2, 2, 2)."""
    HP = multiply_rows(H, rows, u, P)
    S = project_columns(H, rows, u, HP)
    for k in range(len(R)):
        for a in range(2):
            for b in range(2):
                S[2 * k + a, 2 * k + b] += R[k, a, b]
    return HP, S


@njit(**_OPTIONS)
def solve_lower(L, B):
    """Return L^-1 B (m, k) by forward substitution."""
    out = B.copy()
    for i in range(len(L)):
        for j in range(i):
            factor = L[i, j]
            for k in range(out.shape[1]):
                out[i, k] -= factor * out[j, k]
        scale = 1.0 / L[i, i]
        for k in range(out.shape[1]):
            out[i, k] *= scale
    return out


@njit(**_OPTIONS)
def update(x, log_weights, H, rows, u, P, R, nu):
    """Return updated means (N, n), log weights (N,), A (m, n) with P <- P - A^T A, L (m, m), and K R K^T (4, 4).

    Args:
        x: predicted means (N, n).
        log_weights: (N,).
        H: see `multiply_rows`.
        rows: see `multiply_rows`.
        u: see `multiply_rows`.
        P: predicted covariance (n, n).
        R: noise (m // 2, 2, 2) [m^2].
        nu: innovations of the hypotheses (N, m) [m].
    """
    HP, S = innovate(H, rows, u, P, R)
    L = np.linalg.cholesky(S)
    A, white = solve_lower(L, HP), solve_lower(L, nu.T.copy())
    updated, weights = x + np.dot(white.T.copy(), A), np.empty(len(x))
    for i in range(len(x)):
        weights[i] = log_weights[i] - 0.5 * (white[:, i] ** 2).sum()
    top = weights.max()
    return updated, weights - top - np.log(np.exp(weights - top).sum()), A, L, _spread_noise(A, L, R)


@njit(**_OPTIONS)
def reduce_covariance(P, A):
    """Return P - A^T A, symmetric."""
    out = P - np.dot(A.T.copy(), A)
    return 0.5 * (out + out.T)


@njit(**_OPTIONS)
def _spread_noise(A, L, R):
    """Return the covariance of the first four entries by the noise of this image alone, K R K^T (4, 4)."""
    m, gains = len(L), A[:, :4].copy()
    for i in range(m - 1, -1, -1):
        for c in range(4):
            gains[i, c] /= L[i, i]
        for j in range(i):
            for c in range(4):
                gains[j, c] -= L[i, j] * gains[i, c]
    out = np.zeros((4, 4))
    for k in range(len(R)):
        for a in range(2):
            for b in range(2):
                for c in range(4):
                    for d in range(4):
                        out[c, d] += gains[2 * k + a, c] * R[k, a, b] * gains[2 * k + b, d]
    return out
