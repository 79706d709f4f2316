"""Compiled update of an object's place by the key points of one frame; knows no mechanics.

The depth is corrected by a Kalman filter on this frame's residuals. Log radius and height are the maximum a posteriori
for the residuals averaged over the last frames, whose bias (errors of mechanics and of offsets) does not average out.
"""

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

_OPTIONS = {"cache": True, "error_model": "numpy"}
_MODEL_FLOOR = 0.02e-3
_LEAST_WEIGHT = 0.02
# Depth has no prior; this share of one frame's information keeps the posterior regular while nothing was averaged.
_DEPTH_SHARE = 1e-3
_PRIOR_REACH = 4.0
_MANOEUVRE_SIGMA = 3.0


class Residuals(NamedTuple):
    """In-plane residuals about the reference place.

    Attributes:
        r: (K, 2) [m], zero where unused.
        modes: their derivatives by depth, log radius and height (K, 2, 3).
        weights: (K,) from 0 to 1.
        noise: of one point in one frame, in plane, (2, 2) [m^2].
        bias: variance that no averaging removes (K,) [m^2].
        used: number of points with a weight.
        known: number of points that were measured.
        jump: median of the depths that the points ask for one by one, about the model's own place [m].
    """

    r: NDArray
    modes: NDArray
    weights: NDArray
    noise: NDArray
    bias: NDArray
    used: int
    known: int
    jump: float


class PlaceUpdate(NamedTuple):
    """The place after one frame.

    Attributes:
        place: depth [m], log radius, height [m].
        speed: of the depth [m/s].
        gain: Kalman gain of depth and speed (2,).
        mean: averaged residuals about the new place (K, 2) [m].
        count: frames that they stand for (K,).
        covariance: of the place (3, 3).
        depth_variance: of the depth, by this frame and what was before [m^2].
        kkt: what is left of the objective's gradient, relative to the gradient before.
        residual: weighted root mean square residual [m].
        misfit: root mean square of the averaged residuals over their standard deviations; about 1 where the model fits.
    """

    place: NDArray
    speed: float
    gain: NDArray
    mean: NDArray
    count: NDArray
    covariance: NDArray
    depth_variance: float
    kkt: float
    residual: float
    misfit: float


@njit(**_OPTIONS)
def weigh_residuals(
    measured,
    positions,
    rest,
    motions,
    moved,
    below,
    noise,
    offset_variance,
    depth_variance,
    model_error,
    gate,
):
    """Returns the in-plane residuals about the reference place and the weights of key points; see `Residuals`.

    Weights are those of the residuals that are left at the model's own place.

    The motion along y, known to be none, tells of noise that x and z share. A residual of `gate` standard deviations
    keeps a quarter of its weight, w = 1 / (1 + d^2 / gate^2)^2 (Geman and McClure).

    Args:
        measured: (K, 3) [m], NaN where unused.
        positions: of the deformed model (K, 3) [m].
        rest: of the undeformed model (K, 3) [m].
        motions: derivatives of the positions by the place (K, 3, 3).
        moved: the place at which the model stands minus the reference (3,).
        below: depth of the place below what the mechanics can reach [m].
        noise: covariance of one point in one frame (3, 3) [m^2].
        offset_variance: (K,) [m^2].
        depth_variance: of the predicted depth [m^2].
        model_error: share of a point's way.
        gate: in standard deviations.
    """
    count = len(measured)
    gain0, gain2 = noise[0, 1] / noise[1, 1], noise[2, 1] / noise[1, 1]
    plane = np.empty((2, 2))
    plane[0, 0] = noise[0, 0] - gain0 * noise[0, 1]
    plane[1, 1] = noise[2, 2] - gain2 * noise[2, 1]
    plane[0, 1] = plane[1, 0] = noise[0, 2] - gain0 * noise[2, 1]
    r, modes = np.zeros((count, 2)), np.empty((count, 2, 3))
    weights, bias = np.zeros(count), np.empty(count)
    asked, say = np.zeros(count), np.zeros(count)
    used, known = 0, 0
    for k in range(count):
        way = 0.0
        for a in range(3):
            way += (positions[k, a] - rest[k, a]) ** 2
            modes[k, 0, a], modes[k, 1, a] = motions[k, 0, a], motions[k, 2, a]
        bias[k] = _MODEL_FLOOR**2 + model_error**2 * way + offset_variance[k]
        if not np.isfinite(measured[k, 0] + measured[k, 1] + measured[k, 2]):
            continue
        off = measured[k, 1] - positions[k, 1]
        r[k, 0] = measured[k, 0] - positions[k, 0] - gain0 * off - modes[k, 0, 0] * below
        r[k, 1] = measured[k, 2] - positions[k, 2] - gain2 * off - modes[k, 1, 0] * below
        r0, r1 = r[k, 0], r[k, 1]
        for a in range(3):
            r[k, 0] += modes[k, 0, a] * moved[a]
            r[k, 1] += modes[k, 1, a] * moved[a]
        h0, h1 = modes[k, 0, 0], modes[k, 1, 0]
        s00 = plane[0, 0] + bias[k] + h0 * h0 * depth_variance
        s11 = plane[1, 1] + bias[k] + h1 * h1 * depth_variance
        s01 = plane[0, 1] + h0 * h1 * depth_variance
        square = (s11 * r0 * r0 - 2.0 * s01 * r0 * r1 + s00 * r1 * r1) / (s00 * s11 - s01 * s01)
        say[k] = h0 * h0 + h1 * h1
        asked[k] = (h0 * r0 + h1 * r1) / max(say[k], 1e-12)
        known += 1
        square += off * off / (noise[1, 1] + bias[k])
        weight = 1.0 / (1.0 + square / gate**2) ** 2
        if weight >= _LEAST_WEIGHT:
            weights[k] = weight
            used += 1
        else:
            r[k, 0] = r[k, 1] = 0.0
    return Residuals(r, modes, weights, plane, bias, used, known, _weighted_median(asked, say))


@njit(**_OPTIONS)
def _weighted_median(values, weights):
    """Returns the value (of n) that has half of the weight on either side; 0 without any weight."""
    half, total = 0.5 * weights.sum(), 0.0
    for k in np.argsort(values):
        total += weights[k]
        if total >= half and weights[k] > 0.0:
            return values[k]
    return 0.0


@njit(**_OPTIONS)
def _invert_symmetric(A):
    """Returns the inverse of a symmetric 3 x 3 matrix."""
    c00 = A[1, 1] * A[2, 2] - A[1, 2] * A[1, 2]
    c01 = A[0, 2] * A[1, 2] - A[0, 1] * A[2, 2]
    c02 = A[0, 1] * A[1, 2] - A[0, 2] * A[1, 1]
    det = A[0, 0] * c00 + A[0, 1] * c01 + A[0, 2] * c02
    out = np.empty((3, 3))
    out[0, 0], out[0, 1], out[0, 2] = c00, c01, c02
    out[1, 1] = A[0, 0] * A[2, 2] - A[0, 2] * A[0, 2]
    out[1, 2] = A[0, 1] * A[0, 2] - A[0, 0] * A[1, 2]
    out[2, 2] = A[0, 0] * A[1, 1] - A[0, 1] * A[0, 1]
    out[1, 0], out[2, 0], out[2, 1] = out[0, 1], out[0, 2], out[1, 2]
    return out / det


@njit(**_OPTIONS)
def _averaged_spread(data, count, k):
    """Returns the entries 00, 11 and 01 of the covariance of point k's averaged residual [m^2]."""
    share = 1.0 / max(count[k], 1.0)
    return data.noise[0, 0] * share + data.bias[k], data.noise[1, 1] * share + data.bias[k], data.noise[0, 1] * share


@njit(**_OPTIONS)
def _posterior(data, mean, count, offset, prior_variance, information):
    """Returns Hessian and gradient of the log posterior of the place for averaged residuals."""
    hessian, gradient = np.zeros((3, 3)), np.zeros(3)
    for k in range(len(count)):
        if count[k] <= 0.5:
            continue
        s00, s11, s01 = _averaged_spread(data, count, k)
        det = s00 * s11 - s01 * s01
        for i in range(3):
            a = (s11 * data.modes[k, 0, i] - s01 * data.modes[k, 1, i]) / det
            b = (s00 * data.modes[k, 1, i] - s01 * data.modes[k, 0, i]) / det
            gradient[i] += a * mean[k, 0] + b * mean[k, 1]
            for j in range(3):
                hessian[i, j] += a * data.modes[k, 0, j] + b * data.modes[k, 1, j]
    for i in range(2):
        # far from its mean the prior lets go (Cauchy), for an object may touch first elsewhere than it was said to
        variance = prior_variance[i] + (offset[i] / _PRIOR_REACH) ** 2
        hessian[i + 1, i + 1] += 1.0 / variance
        gradient[i + 1] -= offset[i] / variance
    hessian[0, 0] += _DEPTH_SHARE * information
    return hessian, gradient


@njit(**_OPTIONS)
def _weigh_depth(data, mean, count):
    """Returns information on the depth, its weighted innovation, and the pull (3,) of radius and height on it.

    The averaged residuals are taken off as each point's bias; what they have in common along the depth is no bias.
    """
    det = data.noise[0, 0] * data.noise[1, 1] - data.noise[0, 1] ** 2
    p00, p11, p01 = data.noise[1, 1] / det, data.noise[0, 0] / det, -data.noise[0, 1] / det
    along, norm = 0.0, 1e-300
    for k in range(len(count)):
        h0, h1 = data.modes[k, 0, 0], data.modes[k, 1, 0]
        along += count[k] * ((p00 * h0 + p01 * h1) * mean[k, 0] + (p01 * h0 + p11 * h1) * mean[k, 1])
        norm += count[k] * (p00 * h0 * h0 + 2.0 * p01 * h0 * h1 + p11 * h1 * h1)
    along /= norm
    information, innovation, pull = 0.0, 0.0, np.zeros(3)
    for k in range(len(count)):
        h0, h1 = data.modes[k, 0, 0], data.modes[k, 1, 0]
        w0, w1 = data.weights[k] * (p00 * h0 + p01 * h1), data.weights[k] * (p01 * h0 + p11 * h1)
        information += w0 * h0 + w1 * h1
        innovation += w0 * (data.r[k, 0] - mean[k, 0] + along * h0) + w1 * (data.r[k, 1] - mean[k, 1] + along * h1)
        for i in range(1, 3):
            pull[i] += w0 * data.modes[k, 0, i] + w1 * data.modes[k, 1, i]
    return information, innovation, pull


@njit(**_OPTIONS)
def update_place(data, mean, count, reference, speed, spread, prior, prior_variance, memory, largest):
    """Returns the place after one frame; see `PlaceUpdate`.

    Args:
        data: residuals about the reference place.
        mean: residuals averaged so far (K, 2) [m].
        count: frames that they stand for (K,).
        reference: predicted depth [m], last log radius and height [m].
        speed: predicted speed of the depth [m/s].
        spread: covariance of predicted depth and speed (2, 2).
        prior: of log radius and height (2,).
        prior_variance: (2,).
        memory: longest average [frames].
        largest: changes of log radius and height allowed at once (2,).
    """
    n = len(count)
    information, innovation, pull = _weigh_depth(data, mean, count)
    innovation /= information
    # an innovation beyond chance is a manoeuvre: believe the frame
    variance = max(spread[0, 0], 0.0)
    if innovation**2 > _MANOEUVRE_SIGMA**2 * (variance + 1.0 / information):
        variance = innovation**2
    gain = np.array([variance, spread[1, 0]]) / (1.0 / information + variance)
    depth = reference[0] + gain[0] * innovation
    new_mean, new_count = np.empty((n, 2)), np.empty(n)
    for k in range(n):
        share = data.weights[k] / (min(count[k], memory) + 1.0)
        new_count[k] = min(count[k] * (1.0 - 1.0 / memory) + data.weights[k], memory)
        for a in range(2):
            r = data.r[k, a] - data.modes[k, a, 0] * (depth - reference[0])
            new_mean[k, a] = mean[k, a] + share * (r - mean[k, a])
    hessian, gradient = _posterior(data, new_mean, new_count, reference[1:] - prior, prior_variance, information)
    covariance = _invert_symmetric(hessian)
    shift = covariance @ gradient
    kkt = np.abs(hessian @ shift - gradient).max() / max(np.abs(gradient).max(), 1e-30)
    place = reference.copy()
    place[0] = depth
    for i in range(1, 3):
        step = min(max(shift[i], -largest[i - 1]), largest[i - 1])
        place[i] += step
        # radius and height leave the depth that this frame's key points ask for
        place[0] -= pull[i] * step / information
    total, weight = 0.0, 0.0
    for k in range(n):
        weight += data.weights[k]
        for a in range(2):
            left = data.r[k, a]
            new_mean[k, a] += data.modes[k, a, 0] * (depth - place[0])
            for i in range(3):
                left -= data.modes[k, a, i] * (place[i] - reference[i])
                if i > 0:
                    new_mean[k, a] -= data.modes[k, a, i] * (place[i] - reference[i])
            total += data.weights[k] * left * left
    residual = np.sqrt(total / (2.0 * weight))
    misfit = _compute_misfit(data, new_mean, new_count)
    return PlaceUpdate(
        place,
        speed + gain[1] * innovation,
        gain,
        new_mean,
        new_count,
        covariance,
        gain[0] / information,
        kkt,
        residual,
        misfit,
    )


@njit(**_OPTIONS)
def _compute_misfit(data, mean, count):
    """Returns the root mean square of averaged residuals over their standard deviations."""
    total, freedom = 0.0, -3.0
    for k in range(len(count)):
        if count[k] <= 0.5:
            continue
        s00, s11, s01 = _averaged_spread(data, count, k)
        m0, m1 = mean[k, 0], mean[k, 1]
        total += (s11 * m0 * m0 - 2.0 * s01 * m0 * m1 + s00 * m1 * m1) / (s00 * s11 - s01 * s01)
        freedom += 2.0
    return np.sqrt(total / max(freedom, 1.0))
