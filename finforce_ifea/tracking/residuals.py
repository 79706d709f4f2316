"""Compiled in-plane residuals of key points about a place, and how far each can be believed."""

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

_OPTIONS = {"cache": True, "error_model": "numpy"}
_MODEL_FLOOR = 0.02e-3
_LEAST_WEIGHT = 0.02
# Median of a squared distance in three axes; what more is chance; and fewer points do not tell a level.
_MEDIAN_SQUARE, _CHANCE, _FEWEST = 2.37, 1.5, 5
_BELIEVED = 0.25
# Beyond this level key points are not noisy but something else than key points.
_LOUDEST = 20.0


class Uncertainty(NamedTuple):
    """What is known of the errors of key points and mechanics.

    Attributes:
        noise: in-plane covariance of each point in a usual frame, its y known (K, 2, 2) [m^2].
        gain: regression of each point's noise on y (K, 2).
        width_variance: of each point in this frame along y (K,) [m^2].
        trust: usual variance of each point over that in this frame (K,).
        offset_variance: of each point's constant offset (K,) [m^2].
        depth_variance: of the predicted depth [m^2].
        model_error: of the mechanics, as a share of a point's way.
        gate: residual that keeps a quarter of its weight, in standard deviations.
    """

    noise: NDArray
    gain: NDArray
    width_variance: NDArray
    trust: NDArray
    offset_variance: NDArray
    depth_variance: float
    model_error: float
    gate: float


class Residuals(NamedTuple):
    """In-plane residuals about the reference place.

    Attributes:
        r: (K, 2) [m], zero where unused.
        modes: their derivatives by depth, log radius and height (K, 2, 3).
        weights: (K,) from 0 to 1, agreement times trust.
        noise: of each point, in plane, in a frame as noisy as this one (K, 2, 2) [m^2].
        bias: variance that no averaging removes (K,) [m^2].
        used: number of points with a weight.
        known: number of points that were measured.
        jump: median of the depths that the points ask for one by one, about the model's own place [m].
        agreed: number of points that have at least the weight of a residual at the gate.
    """

    r: NDArray
    modes: NDArray
    weights: NDArray
    noise: NDArray
    bias: NDArray
    used: int
    known: int
    jump: float
    agreed: int


@njit(**_OPTIONS)
def _square_distance(r0, r1, h0, h1, noise, bias, depth_variance):
    """Returns the squared Mahalanobis distance of an in-plane residual, the depth being uncertain along (h0, h1)."""
    s00 = noise[0, 0] + bias + h0 * h0 * depth_variance
    s11 = noise[1, 1] + bias + h1 * h1 * depth_variance
    s01 = noise[0, 1] + h0 * h1 * depth_variance
    return (s11 * r0 * r0 - 2.0 * s01 * r0 * r1 + s00 * r1 * r1) / (s00 * s11 - s01 * s01)


@njit(**_OPTIONS)
def weigh_residuals(measured, positions, rest, motions, moved, below, chance):
    """Returns the in-plane residuals about the reference place and the weights of key points; see `Residuals`.

    Weights are those of the residuals that are left at the model's own place: w = 1 / (1 + d^2 / gate^2)^2 (Geman and
    McClure), times the trust in a point of this frame. The motion along y, known to be none, tells of noise that x
    and z share.

    Args:
        measured: (K, 3) [m], NaN where unused.
        positions: of the deformed model (K, 3) [m].
        rest: of the undeformed model (K, 3) [m].
        motions: derivatives of the positions by the place (K, 3, 3).
        moved: the place at which the model stands minus the reference (3,).
        below: depth of the place below what the mechanics can reach [m].
        chance: see `Uncertainty`.
    """
    noise, gain, width_variance, trust, offset_variance, depth_variance, model_error, gate = chance
    count, used, known = len(measured), 0, 0
    r, modes, off = np.zeros((count, 2)), motions[:, ::2].copy(), np.zeros(count)
    weights, asked, say = np.zeros(count), np.zeros(count), np.zeros(count)
    way = ((positions - rest) ** 2).sum(axis=1)
    bias = _MODEL_FLOOR**2 + model_error**2 * way + offset_variance
    least = (noise[:, 0, 0] + noise[:, 1, 1]).min()
    for k in range(count):
        if not np.isfinite(measured[k, 0] + measured[k, 1] + measured[k, 2]):
            off[k] = np.nan
            continue
        off[k] = measured[k, 1] - positions[k, 1]
        r[k, 0] = measured[k, 0] - positions[k, 0] - gain[k, 0] * off[k] - modes[k, 0, 0] * below
        r[k, 1] = measured[k, 2] - positions[k, 2] - gain[k, 1] * off[k] - modes[k, 1, 0] * below
        h0, h1 = modes[k, 0, 0], modes[k, 1, 0]
        say[k] = h0 * h0 + h1 * h1
        asked[k] = (h0 * r[k, 0] + h1 * r[k, 1]) / max(say[k], 1e-12)
        say[k] *= trust[k] * least / (noise[k, 0, 0] + noise[k, 1, 1])
        known += 1
    jump = _weighted_median(asked, say)
    level = _find_noise_level(r, off, modes, jump, chance, bias)
    for k in range(count):
        if np.isnan(off[k]):
            continue
        square = off[k] * off[k] / (level * width_variance[k] + bias[k])
        spread = noise[k] * (level / trust[k])
        h0, h1 = modes[k, 0, 0], modes[k, 1, 0]
        square += _square_distance(r[k, 0], r[k, 1], h0, h1, spread, bias[k], depth_variance)
        r[k] += (modes[k] * moved).sum(axis=1)
        weight = 1.0 / (1.0 + square / gate**2) ** 2
        if weight >= _LEAST_WEIGHT:
            weights[k] = weight * trust[k]
            used += 1
        else:
            r[k, 0] = r[k, 1] = 0.0
    agreed = int((weights >= _BELIEVED * trust).sum())
    return Residuals(r, modes, weights, noise * level, bias, used, known, jump, agreed)


@njit(**_OPTIONS)
def _find_noise_level(r, off, modes, jump, chance, bias):
    """Returns the variance of this frame's residuals over what was expected of it, at least 1; 1 where it is garbage.

    The depth is first moved by the median of what the points ask for, for a forecast may be wrong. The median of the
    squared distances, 2.37 for three axes, is not moved by gross errors; half as much again is taken for chance.
    """
    squares, known = np.empty(len(r)), 0
    for k in range(len(r)):
        if np.isnan(off[k]):
            continue
        r0, r1 = r[k, 0] - modes[k, 0, 0] * jump, r[k, 1] - modes[k, 1, 0] * jump
        spread = chance.noise[k] / chance.trust[k]
        squares[known] = _square_distance(r0, r1, 0.0, 0.0, spread, bias[k], 0.0)
        squares[known] += off[k] * off[k] / (chance.width_variance[k] + bias[k])
        known += 1
    if known < _FEWEST:
        return 1.0
    level = max(1.0, np.median(squares[:known]) / (_MEDIAN_SQUARE * _CHANCE))
    return level if level < _LOUDEST else 1.0


@njit(**_OPTIONS)
def _weighted_median(values, weights):
    """Returns the value (of n) that has half of the weight on either side; 0 without any weight."""
    half, total = 0.5 * weights.sum(), 0.0
    for k in np.argsort(values):
        total += weights[k]
        if total >= half and weights[k] > 0.0:
            return values[k]
    return 0.0
