"""Measurement model: the key points of one image as functions of the state.

In the plane of the jaw's motion, with what the noise along y tells of that along x and z taken out,

    z_k = p_k(d, s, h, kappa) + camera_k + o_k + r_k |u_k| + n_k,

with p_k the mechanics' position and u_k its displacement. The noise n_k of neighbours is correlated, see
`finforce_ifea.tare.measure_correlation`. It is Student's t, whose weights

    w_k = (nu + 3) / (nu + D_k^2)

divide the covariance of a point whose squared normalised residual is D_k^2 (see Lange, Little and Taylor, 1989); what
they add to it is of the point alone.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from finforce.compiled import njit
from finforce_ifea.filter.state import (
    APPARENT,
    CAMERA_STRETCH,
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

# Degrees of freedom of a key point's noise [-].
FREEDOM = 4.0
# Weight below which a key point is a gross error [-].
_GROSS = 0.1
# Weight of a gross error [-].
NO_WEIGHT = 1e-9
# Variance of a median over that of a mean [-]: pi / 2.
_MEDIAN = 1.57
# Standard deviation of the mechanics' error along y [m].
LATERAL_ERROR = 0.1e-3


class Measurement(NamedTuple):
    """Two rows, x and z, of each of m key points of an image, linearised about a state.

    Attributes:
        H: derivatives by the shared entries of the state (2 m, SHARED).
        rows: number of each row among all rows of key points, 2 k + axis (2 m,).
        u: displacement of each row's key point [m] (2 m,).
        z: measured positions less the part of the linearised ones that does not depend on x (2 m,) [m].
        R: noise (m, 2, 2) [m^2].
        square: squared normalised residuals along y (m,).
        cross: covariances of the noise of different key points (2 m, 2 m) [m^2], zero within each.
    """

    H: NDArray
    rows: NDArray
    u: NDArray
    z: NDArray
    R: NDArray
    square: NDArray
    cross: NDArray


@njit(**_OPTIONS)
def find_seen(points):
    """Return which key points can be used (m,)."""
    seen = np.empty(len(points), np.int64)
    count = 0
    for k in range(len(points)):
        measured = points[k].measured
        if np.isfinite(measured[0] + measured[1] + measured[2]) and points[k].noise_ratio > 0.0:
            seen[count] = k
            count += 1
    return seen[:count].copy()


class DetectorErrors(NamedTuple):
    """Lasting errors of a detector.

    Attributes:
        share: of the variance of the key points' offsets [-].
        variance: median over the key points [m^2].
        height_variance: of the heights of the key points at rest [m^2].
    """

    share: float
    variance: float
    height_variance: float


@njit(**_OPTIONS)
def summarize_detector_errors(points):
    """Return the `DetectorErrors` of an image as a plain tuple."""
    variance, height, offsets = np.empty(len(points)), np.empty(len(points)), 0.0
    for k in range(len(points)):
        variance[k], height[k] = points[k].detector_variance, points[k].rest[2]
        offsets += points[k].offset_variance
    return variance.sum() / offsets, np.median(variance), height.var()


@njit(**_OPTIONS)
def observe(image, positions, motions, at, ratio):
    """Return the measurement by key points.

    Args:
        image: all key points (K,), see `KEYPOINT`; those that are used (m,); variance of the noise over that in the
            tare; its correlation (K, K).
        positions: of the mechanics (K, 3) [m].
        motions: their derivatives by depth, shape, height and traction ratio (K, 3, 4).
        at: depth, shape and height at which the mechanics stands (3,).
        ratio: traction ratio at which it stands.
    """
    points, seen, level, correlation = image
    m = len(seen)
    H, rows, u, z = np.zeros((2 * m, SHARED)), np.empty(2 * m, np.int64), np.empty(2 * m), np.empty(2 * m)
    R, square = np.empty((m, 2, 2)), np.empty(m)
    for i in range(m):
        k = seen[i]
        point, p = points[k], positions[k]
        lateral = point.measured[1] - p[1]
        noise = level * point.width_variance / point.noise_ratio
        square[i] = lateral * lateral / (noise + point.offset_variance + LATERAL_ERROR**2)
        size = np.hypot(p[0] - point.rest[0], p[2] - point.rest[2])
        for a in range(2):
            row, motion = 2 * i + a, motions[k, 2 * a]
            rows[row], u[row] = 2 * k + a, size
            H[row, DEPTH], H[row, SHAPE], H[row, HEIGHT] = motion[0], motion[1], motion[2]
            H[row, TRACTION] = H[row, APPARENT] = motion[3]
            z[row] = point.measured[2 * a] - p[2 * a] - point.gain[a] * lateral + motion[3] * ratio
            z[row] += motion[0] * at[0] + motion[1] * at[1] + motion[2] * at[2]
            for b in range(2):
                R[i, a, b] = level * point.tare_noise[a, b] / point.noise_ratio
        H[2 * i, CAMERA_X], H[2 * i + 1, CAMERA_Z] = 1.0, 1.0
        H[2 * i, CAMERA_TURN], H[2 * i + 1, CAMERA_TURN] = p[2], -p[0]
        H[2 * i + 1, CAMERA_STRETCH] = p[2]
    return Measurement(H, rows, u, z, R, square, _correlate(R, correlation, seen))


@njit(**_OPTIONS)
def _correlate(R, correlation, seen):
    """Return `cross` of a `Measurement`: rho_kl C_k C_l^T, with C_k C_k^T the noise R_k of each key point."""
    m = len(R)
    C, cross = np.zeros((m, 2, 2)), np.zeros((2 * m, 2 * m))
    for k in range(m):
        C[k, 0, 0] = np.sqrt(R[k, 0, 0])
        C[k, 1, 0] = R[k, 1, 0] / C[k, 0, 0]
        C[k, 1, 1] = np.sqrt(max(R[k, 1, 1] - C[k, 1, 0] ** 2, 0.0))
    for k in range(m):
        for j in range(k):
            rho = correlation[seen[k], seen[j]]
            if rho > 0.0:
                for a in range(2):
                    for b in range(2):
                        value = rho * (C[k, a, 0] * C[j, b, 0] + C[k, a, 1] * C[j, b, 1])
                        cross[2 * k + a, 2 * j + b] = cross[2 * j + b, 2 * k + a] = value
    return cross


@njit(**_OPTIONS)
def measure_distances(left, covariance, square):
    """Return D^2 (m,) of residuals (m, 2) with a covariance (m, 2, 2), `square` (m,) along y included."""
    distances = np.empty(len(left))
    for i in range(len(left)):
        r0, r1 = left[i]
        a, b, c = covariance[i, 0, 0], covariance[i, 0, 1], covariance[i, 1, 1]
        distances[i] = (c * r0 * r0 - 2.0 * b * r0 * r1 + a * r1 * r1) / (a * c - b * b) + square[i]
    return distances


@njit(**_OPTIONS)
def weigh(distances):
    """Return the weights (m,) for D^2 (m,)."""
    weights = np.minimum(1.0, (FREEDOM + 3.0) / (FREEDOM + distances))
    return np.where(weights > _GROSS, weights, NO_WEIGHT)


@njit(**_OPTIONS)
def find_depth_jump(H, R, nu):
    """Return the median [m] of the depths by each key point alone, and its variance [m^2].

    Args:
        H: see `Measurement`.
        R: see `Measurement`.
        nu: innovation (2 m,) [m].
    """
    m = len(R)
    asked, information = np.empty(m), np.empty(m)
    for i in range(m):
        a, b, c = R[i, 0, 0], R[i, 0, 1], R[i, 1, 1]
        h0, h1, r0, r1 = H[2 * i, DEPTH], H[2 * i + 1, DEPTH], nu[2 * i], nu[2 * i + 1]
        det = a * c - b * b
        information[i] = (c * h0 * h0 - 2.0 * b * h0 * h1 + a * h1 * h1) / det
        asked[i] = (c * h0 * r0 - b * (h0 * r1 + h1 * r0) + a * h1 * r1) / det / max(information[i], 1e-300)
    total, known = 0.0, max(information.sum(), 1e-300)
    for i in np.argsort(asked):
        total += information[i]
        if total >= 0.5 * known:
            return asked[i], _MEDIAN / known
    return 0.0, _MEDIAN / known
