"""Kalman filter of several hypotheses that share one covariance.

The hypotheses i differ in what they expect of the traction, kappa_i, alone. Their measurement is linear in x with the
same H and R, so that P, S and K are the same for all, and only the means x_i and the weights w_i differ:

    S = H P H^T + R,  K = P H^T S^-1,  x_i <- x_i + K nu_i,  P <- P - K S K^T,  w_i <- w_i N(nu_i; 0, S).

See Bar-Shalom, Li and Kirubarajan, Estimation with Applications to Tracking and Navigation, 2001, ch. 11.6 (static
multiple-model estimator).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from finforce.compiled import njit
from finforce_ifea.filter.measurement import measure_distances, weigh
from finforce_ifea.filter.state import SHARED, TRACTION

_OPTIONS = {"cache": True, "error_model": "numpy"}
# Lower bound of a hypothesis' log probability, so that it can recover.
_LEAST_WEIGHT = -9.0


class Posterior(NamedTuple):
    """Posterior of one image.

    Attributes:
        x: means of the hypotheses (N, n).
        log_weights: of the hypotheses (N,).
        mean: of the state over the hypotheses (n,).
        A: with P <- P - A^T A (2 m, n).
        L: Cholesky factor of S (2 m, 2 m).
        white: mean innovation, L^-1 nu (2 m,).
        own: covariance of the first four entries by the noise of this image alone, K R K^T (4, 4).
        left: residuals of the key points (m, 2) [m].
        distances: their squares, normalised (m,).
        weight: of the key points by these (m,).
    """

    x: NDArray
    log_weights: NDArray
    mean: NDArray
    A: NDArray
    L: NDArray
    white: NDArray
    own: NDArray
    left: NDArray
    distances: NDArray
    weight: NDArray


@njit(**_OPTIONS)
def multiply_rows(H, rows, u, P):
    """Return H P (2 m, n); see `Measurement` for the arguments."""
    m, n = len(rows), len(P)
    offset, relative = SHARED, SHARED + (n - SHARED) // 2
    out = np.empty((m, n))
    for i in range(m):
        own, r = P[offset + rows[i]], P[relative + rows[i]]
        for j in range(n):
            out[i, j] = own[j] + u[i] * r[j]
        for c in range(SHARED):
            h = H[i, c]
            if h != 0.0:
                for j in range(n):
                    out[i, j] += h * P[c, j]
    return out


@njit(**_OPTIONS)
def project_columns(H, rows, u, A):
    """Return A H^T (k, 2 m) for rows A (k, n) of a matrix; see `Measurement` for the other arguments."""
    m, n = len(rows), A.shape[1]
    offset, relative = SHARED, SHARED + (n - SHARED) // 2
    out = np.empty((len(A), m))
    for k in range(len(A)):
        for i in range(m):
            total = A[k, offset + rows[i]] + u[i] * A[k, relative + rows[i]]
            for c in range(SHARED):
                total += H[i, c] * A[k, c]
            out[k, i] = total
    return out


@njit(**_OPTIONS)
def innovate(measured, P):
    """Return H P (2 m, n) and S = H P H^T + R (2 m, 2 m) for a `Measurement`."""
    H, rows, u, R = measured.H, measured.rows, measured.u, measured.R
    HP = multiply_rows(H, rows, u, P)
    S = project_columns(H, rows, u, HP) + measured.cross
    for k in range(len(R)):
        for a in range(2):
            for b in range(2):
                S[2 * k + a, 2 * k + b] += R[k, a, b]
    return HP, S


@njit(**_OPTIONS)
def expect_innovations(measured, ratios, x):
    """Return the innovations (N, 2 m) [m] of hypotheses with traction ratios (N,) and means (N, n)."""
    nu = project_columns(measured.H, measured.rows, measured.u, x)
    for i in range(len(x)):
        for j in range(len(measured.z)):
            nu[i, j] = measured.z[j] - nu[i, j] - measured.H[j, TRACTION] * ratios[i]
    return nu


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
def divide_noise(R, weight):
    """Return the noise (m, 2, 2) of key points with weights (m,)."""
    out = R.copy()
    for k in range(len(R)):
        for a in range(2):
            for b in range(2):
                out[k, a, b] /= weight[k]
    return out


@njit(**_OPTIONS)
def update(measured, weight, ratios, x, log_weights, HP, S):
    """Return the posterior of one image.

    Args:
        measured: by the key points.
        weight: of the key points (m,).
        ratios: traction ratio of each hypothesis (N,).
        x: predicted means (N, n).
        log_weights: (N,).
        HP: see `innovate` (2 m, n).
        S: the same, for key points without weights (2 m, 2 m).
    """
    R, nu = divide_noise(measured.R, weight), expect_innovations(measured, ratios, x)
    L = np.linalg.cholesky(widen(S, R, measured.R))
    A, white = solve_lower(L, HP), solve_lower(L, np.ascontiguousarray(nu.T))
    updated, before = x + np.dot(np.ascontiguousarray(white.T), A), np.exp(log_weights)
    log_weights = normalize(log_weights - 0.5 * (white**2).sum(axis=0))
    w = np.exp(log_weights)
    left = np.dot(w, expect_innovations(measured, ratios, updated)).reshape(-1, 2)
    distances = measure_distances(left, measured.R, measured.square)
    return Posterior(
        updated,
        log_weights,
        np.dot(w, updated),
        A,
        L,
        np.dot(white, before),
        _spread_noise(A, L, R, measured.cross),
        left,
        distances,
        weigh(distances),
    )


@njit(**_OPTIONS)
def widen(S, R, before):
    """Return S (2 m, 2 m) with the noise replaced by R (m, 2, 2)."""
    out = S.copy()
    for k in range(len(R)):
        for a in range(2):
            for b in range(2):
                out[2 * k + a, 2 * k + b] += R[k, a, b] - before[k, a, b]
    return out


@njit(**_OPTIONS)
def normalize(log_weights):
    """Return normalised log weights (N,) with a lower bound."""
    out = log_weights - log_weights.max()
    out = np.maximum(out - np.log(np.exp(out).sum()), _LEAST_WEIGHT)
    return out - np.log(np.exp(out).sum())


@njit(**_OPTIONS)
def reduce_covariance(P, A):
    """Return P - A^T A, symmetric."""
    out = P.copy()
    for i in range(len(P)):
        row = out[i]
        for k in range(len(A)):
            factor = A[k, i]
            for j in range(i + 1):
                row[j] -= factor * A[k, j]
        for j in range(i):
            out[j, i] = row[j]
    return out


@njit(**_OPTIONS)
def _spread_noise(A, L, R, cross):
    """Return the covariance of the first four entries by the noise of this image alone, K R K^T (4, 4)."""
    m, gains = len(L), A[:, :4].copy()
    for i in range(m - 1, -1, -1):
        for c in range(4):
            gains[i, c] /= L[i, i]
        for j in range(i):
            for c in range(4):
                gains[j, c] -= L[i, j] * gains[i, c]
    out = np.dot(np.ascontiguousarray(gains.T), np.dot(cross, gains))
    for k in range(len(R)):
        for a in range(2):
            for b in range(2):
                for c in range(4):
                    for d in range(4):
                        out[c, d] += gains[2 * k + a, c] * R[k, a, b] * gains[2 * k + b, d]
    return out
