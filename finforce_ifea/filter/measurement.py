"""Measurement model: the key points of one image as functions of the state.

In the plane of the jaw's motion, with what the noise along y tells of that along x and z taken out,

    z_k = p_k(d, s, h, kappa) + camera_k + o_k + r_k |u_k| + n_k,

with p_k the mechanics' position and u_k its displacement. n_k is Student's t, whose weights

    w_k = (nu + 3) / (nu + D_k^2)

divide the covariance of a point whose squared normalised residual is D_k^2 (see Lange, Little and Taylor, 1989).
"""

from __future__ import annotations

import numpy as np
from numba import njit

from finforce_ifea.filter.filter import innovate, solve_lower

_OPTIONS = {"cache": True, "error_model": "numpy"}

# Degrees of freedom of a key point's noise [-].
FREEDOM = 4.0
# Error of the mechanics along y, one sigma [m].
LATERAL_ERROR = 0.1e-3


@njit(**_OPTIONS)
def linearize(points, seen, positions, motions):
    """Return H (2 m, 8), |u| (2 m,) [m], residuals (m, 2) [m], and squared normalised ones along y (m,).

    Args:
        points: all key points of the image (K,), see `KEYPOINT`.
        seen: those that are used (m,).
        positions: of the mechanics (K, 3) [m].
        motions: their derivatives by depth, shape, height and traction ratio (K, 3, 4).
    """
    m = len(seen)
    H, u, left, square = np.zeros((2 * m, 8)), np.empty(2 * m), np.empty((m, 2)), np.empty(m)
    for i in range(m):
        k = seen[i]
        point, p = points[k], positions[k]
        lateral = point.measured[1] - p[1]
        square[i] = lateral * lateral / (point.width_variance / point.trust + point.offset_variance + LATERAL_ERROR**2)
        size = np.hypot(p[0] - point.rest[0], p[2] - point.rest[2])
        for a in range(2):
            row = 2 * i + a
            left[i, a] = point.measured[2 * a] - p[2 * a] - point.gain[a] * lateral
            u[row] = size
            for c in range(4):
                H[row, c] = motions[k, 2 * a, c]
            H[row, 7] = motions[k, 2 * a, 3]
        H[2 * i, 4], H[2 * i + 1, 5] = 1.0, 1.0
        H[2 * i, 6], H[2 * i + 1, 6] = p[2], -p[0]
    return H, u, left, square


@njit(**_OPTIONS)
def take_noise(points, seen):
    """Return the covariance (m, 2, 2) [m^2] in the plane of key points that are used (m,)."""
    noise = np.empty((len(seen), 2, 2))
    for i in range(len(seen)):
        point = points[seen[i]]
        for a in range(2):
            for b in range(2):
                noise[i, a, b] = point.tare_noise[a, b] / point.trust
    return noise


@njit(**_OPTIONS)
def weigh(left, covariance, square):
    """Return the weights (m,) of residuals (m, 2) with a covariance (m, 2, 2), `square` (m,) along y included."""
    weights = np.empty(len(left))
    for i in range(len(left)):
        r0, r1 = left[i]
        a, b, c = covariance[i, 0, 0], covariance[i, 0, 1], covariance[i, 1, 1]
        distance = (c * r0 * r0 - 2.0 * b * r0 * r1 + a * r1 * r1) / (a * c - b * b) + square[i]
        weights[i] = min(1.0, (FREEDOM + 3.0) / (FREEDOM + distance))
    return weights


@njit(**_OPTIONS)
def weigh_innovations(H, rows, u, P, noise, nu, square):
    """Return weights (m,) of key points by the forecast, which may be off by a motion of the object.

    The median of the motions that the points ask for one by one is taken out first.
    """
    _, S = innovate(H, rows, u, P, noise)
    m = len(noise)
    blocks, asked, information = np.empty((m, 2, 2)), np.empty(m), np.empty(m)
    for i in range(m):
        blocks[i] = S[2 * i : 2 * i + 2, 2 * i : 2 * i + 2]
        a, b, c = noise[i, 0, 0], noise[i, 0, 1], noise[i, 1, 1]
        h0, h1, r0, r1 = H[2 * i, 0], H[2 * i + 1, 0], nu[2 * i], nu[2 * i + 1]
        det = a * c - b * b
        information[i] = (c * h0 * h0 - 2.0 * b * h0 * h1 + a * h1 * h1) / det
        asked[i] = (c * h0 * r0 - b * (h0 * r1 + h1 * r0) + a * h1 * r1) / det / max(information[i], 1e-300)
    order, total, jump = np.argsort(asked), 0.0, 0.0
    for i in order:
        total += information[i]
        if total >= 0.5 * information.sum():
            jump = asked[i]
            break
    left = np.empty((m, 2))
    for i in range(m):
        for a in range(2):
            left[i, a] = nu[2 * i + a] - H[2 * i + a, 0] * jump
    return weigh(left, blocks, square), blocks


@njit(**_OPTIONS)
def whiten(H, rows, u, P, R, nu):
    """Return L^-1 H (2 m, 8) and L^-1 nu (2 m,) with S = L L^T the covariance of the innovation nu (2 m,)."""
    _, S = innovate(H, rows, u, P, R)
    L = np.linalg.cholesky(S)
    return solve_lower(L, H), solve_lower(L, nu.reshape(-1, 1))[:, 0].copy()
