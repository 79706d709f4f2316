"""Compiled update of an object's place by the key points of one image, and how sure it is.

The depth is corrected by a Kalman filter on this image's residuals. Log radius and height are the maximum a posteriori
for the residuals averaged over the last images, whose bias (errors of mechanics and of offsets) does not average out.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

_OPTIONS = {"cache": True, "error_model": "numpy"}
# Beyond this many of its standard deviations the prior of a place lets go.
PRIOR_REACH = 4.0
# A height that is given is that of another contact once in so many times, and then anywhere within this [m].
_MISTAKEN = 0.01
_ANYWHERE = 0.03


@njit(**_OPTIONS)
def invert_symmetric(A):
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
    for i in range(3):
        for j in range(3):
            out[i, j] /= det
    return out


@njit(**_OPTIONS)
def measure_condition(covariance):
    """Returns the condition number of a covariance (3, 3) scaled to a unit diagonal, by its eigenvalues in closed form.

    With C = 1 + O, O without diagonal: l = 1 + 2 p cos(t + 2 k pi / 3), p = sqrt(|O|^2 / 6), cos 3 t = det O / (2 p^3).
    """
    sx, sy = np.sqrt(max(covariance[0, 0], 1e-300)), np.sqrt(max(covariance[1, 1], 1e-300))
    sz = np.sqrt(max(covariance[2, 2], 1e-300))
    a, b, c = covariance[0, 1] / sx / sy, covariance[0, 2] / sx / sz, covariance[1, 2] / sy / sz
    p = np.sqrt((a * a + b * b + c * c) / 3.0)
    if not p > 1e-12:
        return 1.0
    angle = np.arccos(min(max(a * b * c / p**3, -1.0), 1.0)) / 3.0
    largest, least = 1.0 + 2.0 * p * np.cos(angle), 1.0 + 2.0 * p * np.cos(angle + 2.0 * np.pi / 3.0)
    return largest / max(least, 1e-16)


@njit(**_OPTIONS)
def doubt_place(away: float, spread: float, prior_variance: float, offset: float) -> tuple[float, float]:
    """Returns the probability that a contact is not where it was said to be, and what that adds to its variance [m^2].

    The key points alone have it D = away from there, with the variance s^2 = spread. It is another contact, N(0, R^2),
    with the probability p:

        p / (1 - p) = p0 N(D; 0, v + s^2 + R^2) / N(D; 0, v + s^2) / (1 - p0).

    What exceeds p0 of it adds the distance of that contact from the place that was found, `offset` from the given one.

    Args:
        away: D [m].
        spread: s^2 [m^2].
        prior_variance: v, of the given place [m^2].
        offset: of the place that was found [m].
    """
    near, far = prior_variance + spread, prior_variance + spread + _ANYWHERE**2
    odds = 0.5 * away**2 * (1.0 / near - 1.0 / far) + 0.5 * np.log(near / far) + np.log(_MISTAKEN / (1.0 - _MISTAKEN))
    mistaken = 1.0 / (1.0 + np.exp(-min(max(odds, -50.0), 50.0)))
    shrunk = _ANYWHERE**2 / (_ANYWHERE**2 + spread)
    variance = max(0.0, mistaken - _MISTAKEN) * ((shrunk * away - offset) ** 2 + shrunk * spread)
    return mistaken, variance


@njit(**_OPTIONS)
def doubt_height(
    hessian: NDArray, gradient: NDArray, offset: float, prior_variance: float
) -> tuple[float, float, float]:
    """Returns the height that the key points alone ask for [m], the probability of a mistake, and its variance [m^2].

    Args:
        hessian: of the log posterior (3, 3).
        gradient: of the same (3,).
        offset: of the reference height from the expected one [m].
        prior_variance: of the height [m^2].
    """
    pull = 1.0 / (prior_variance + (offset / PRIOR_REACH) ** 2)
    data, slope = hessian.copy(), gradient.copy()
    # a millionth is left of the prior, for where the key points tell nothing
    data[2, 2] -= (1.0 - 1e-6) * pull
    slope[2] += (1.0 - 1e-6) * pull * offset
    covariance = invert_symmetric(data)
    away, spread = offset, max(covariance[2, 2], 0.0)
    for i in range(3):
        away += covariance[2, i] * slope[i]
    mistaken, variance = doubt_place(away, spread, prior_variance, offset)
    return away, mistaken, variance


@njit(**_OPTIONS)
def find_leverage(data: Residuals, deeper: float, information: float) -> float:
    """Returns how far the depth would move if points that are half believed were not believed at all [m].

    With w the weights, h the motions by depth, r what is left of the residuals and I the information,

        leverage = sum_k w_k (1 - w_k) h_k^T N_k^-1 r_k / I.

    Chance cancels in it; points that are wrong together do not.

    Args:
        data: see `Residuals`.
        deeper: change of the depth since the residuals [m].
        information: on the depth [1/m^2].
    """
    leverage = 0.0
    for k in range(len(data.weights)):
        n00, n11, n01 = data.noise[k, 0, 0], data.noise[k, 1, 1], data.noise[k, 0, 1]
        h0, h1 = data.modes[k, 0, 0], data.modes[k, 1, 0]
        r0, r1 = data.r[k, 0] - h0 * deeper, data.r[k, 1] - h1 * deeper
        score = (h0 * (n11 * r0 - n01 * r1) + h1 * (n00 * r1 - n01 * r0)) / (n00 * n11 - n01 * n01)
        leverage += data.weights[k] * (1.0 - data.weights[k]) * score
    return leverage / information


# Depth has no prior; this share of one frame's information keeps the posterior regular while nothing was averaged.
_DEPTH_SHARE = 1e-3
# Innovations beyond this many standard deviations are no chance: where the speed is known, and where it is not.
_MANOEUVRE_SIGMA, _ONSET_SIGMA = 3.0, 2.5
# No speed is believed for longer than this [s].
_LONGEST_SIGHT = 0.2
# Of a longer jump [m/s] the rest is taken for one of the place alone.
_FASTEST = 0.05


class Forecast(NamedTuple):
    """The place that is expected in a frame.

    Attributes:
        place: depth [m], log radius, height [m].
        speed: of the depth [m/s].
        spread: covariance of depth and speed (2, 2).
        unsure: time since the last frame if that did not show the speed, because nothing pressed or the depth jumped;
            else 0 [s].
    """

    place: NDArray
    speed: float
    spread: NDArray
    unsure: float


class Average(NamedTuple):
    """Residuals averaged over the last frames.

    A frame in which the finger was hardly pressed tells hardly anything of radius and height: what the average says of
    them are its own averaged derivatives, not those of the last frame.

    Attributes:
        residuals: (K, 2) [m].
        modes: derivatives by depth, log radius and height, averaged alike (K, 2, 3).
        count: frames that they stand for (K,).
    """

    residuals: NDArray
    modes: NDArray
    count: NDArray


def blank_average(count: int) -> Average:
    """Returns the average of `count` key points over no frame."""
    return Average(np.zeros((count, 2)), np.zeros((count, 2, 3)), np.zeros(count))


class PlaceUpdate(NamedTuple):
    """The place after one frame.

    Attributes:
        place: depth [m], log radius, height [m].
        speed: of the depth [m/s].
        spread: covariance of depth and speed (2, 2).
        jumped: whether the depth changed beyond what was expected.
        average: of the residuals, about the new place.
        covariance: of the place (3, 3).
        depth_variance: of the depth, by this frame and what was before [m^2].
        kkt: what is left of the objective's gradient, relative to the gradient before.
        residual: weighted root mean square residual [m].
        misfit: root mean square of the averaged residuals over their standard deviations; about 1 where the model fits.
        away: height that the key points alone ask for beyond the expected one [m].
        mistaken: probability that the height is not the expected one at all.
        condition: of the covariance, scaled to a unit diagonal.
    """

    place: NDArray
    speed: float
    spread: NDArray
    jumped: bool
    average: Average
    covariance: NDArray
    depth_variance: float
    kkt: float
    residual: float
    misfit: float
    away: float
    mistaken: float
    condition: float


@njit(**_OPTIONS)
def _averaged_spread(data, count, k):
    """Returns the entries 00, 11 and 01 of the covariance of point k's averaged residual [m^2]."""
    share = 1.0 / max(count[k], 1.0)
    noise = data.noise[k]
    return noise[0, 0] * share + data.bias[k], noise[1, 1] * share + data.bias[k], noise[0, 1] * share


@njit(**_OPTIONS)
def _posterior(data, average, offset, prior_variance, information):
    """Returns Hessian and gradient of the log posterior of the place for averaged residuals."""
    hessian, gradient = np.zeros((3, 3)), np.zeros(3)
    mean, modes, count = average
    for k in range(len(count)):
        if count[k] <= 0.5:
            continue
        s00, s11, s01 = _averaged_spread(data, count, k)
        det = s00 * s11 - s01 * s01
        for i in range(3):
            a = (s11 * modes[k, 0, i] - s01 * modes[k, 1, i]) / det
            b = (s00 * modes[k, 1, i] - s01 * modes[k, 0, i]) / det
            gradient[i] += a * mean[k, 0] + b * mean[k, 1]
            for j in range(3):
                hessian[i, j] += a * modes[k, 0, j] + b * modes[k, 1, j]
    for i in range(2):
        # far from its mean the prior lets go (Cauchy), for an object may touch first elsewhere than it was said to
        variance = prior_variance[i] + (offset[i] / PRIOR_REACH) ** 2
        hessian[i + 1, i + 1] += 1.0 / variance
        gradient[i + 1] -= offset[i] / variance
    hessian[0, 0] += _DEPTH_SHARE * information
    return hessian, gradient


@njit(**_OPTIONS)
def _weigh_depth(data, mean, count):
    """Returns information on the depth, its weighted innovation, and the pull (3,) of radius and height on it.

    The averaged residuals are taken off as each point's bias; what they have in common along the depth is no bias.
    """
    p00, p11, p01 = np.empty(len(count)), np.empty(len(count)), np.empty(len(count))
    along, norm = 0.0, 1e-300
    for k in range(len(count)):
        n00, n11, n01 = data.noise[k, 0, 0], data.noise[k, 1, 1], data.noise[k, 0, 1]
        det = n00 * n11 - n01 * n01
        p00[k], p11[k], p01[k] = n11 / det, n00 / det, -n01 / det
        h0, h1 = data.modes[k, 0, 0], data.modes[k, 1, 0]
        along += count[k] * ((p00[k] * h0 + p01[k] * h1) * mean[k, 0] + (p01[k] * h0 + p11[k] * h1) * mean[k, 1])
        norm += count[k] * (p00[k] * h0 * h0 + 2.0 * p01[k] * h0 * h1 + p11[k] * h1 * h1)
    along /= norm
    information, innovation, pull = 0.0, 0.0, np.zeros(3)
    for k in range(len(count)):
        h0, h1 = data.modes[k, 0, 0], data.modes[k, 1, 0]
        w0 = data.weights[k] * (p00[k] * h0 + p01[k] * h1)
        w1 = data.weights[k] * (p01[k] * h0 + p11[k] * h1)
        information += w0 * h0 + w1 * h1
        innovation += w0 * (data.r[k, 0] - mean[k, 0] + along * h0) + w1 * (data.r[k, 1] - mean[k, 1] + along * h1)
        for i in range(1, 3):
            pull[i] += w0 * data.modes[k, 0, i] + w1 * data.modes[k, 1, i]
    return information, innovation, pull


@njit(**_OPTIONS)
def _extend(average, data, deeper, memory):
    """Returns the average with this frame's residuals, its depth changed by `deeper` [m]."""
    mean, modes, count = average
    n = len(count)
    new_mean, new_modes, new_count = np.empty((n, 2)), np.empty((n, 2, 3)), np.empty(n)
    for k in range(n):
        share = data.weights[k] / (min(count[k], memory) + 1.0)
        new_count[k] = min(count[k] * (1.0 - 1.0 / memory) + data.weights[k], memory)
        for a in range(2):
            new_mean[k, a] = mean[k, a] + share * (data.r[k, a] - data.modes[k, a, 0] * deeper - mean[k, a])
            for i in range(3):
                new_modes[k, a, i] = modes[k, a, i] + share * (data.modes[k, a, i] - modes[k, a, i])
    return Average(new_mean, new_modes, new_count)


@njit(**_OPTIONS)
def _move_residuals(data, average, moved, deeper):
    """Takes averaged residuals to the new place and returns this frame's weighted root mean square there [m].

    The place has moved by `moved` (3,) since this frame's residuals, the depth by `deeper` [m] since the average.
    """
    mean, modes, _ = average
    total, weight = 0.0, 0.0
    for k in range(len(mean)):
        weight += data.weights[k]
        for a in range(2):
            left = data.r[k, a]
            mean[k, a] -= modes[k, a, 0] * deeper
            for i in range(3):
                left -= data.modes[k, a, i] * moved[i]
                if i > 0:
                    mean[k, a] -= modes[k, a, i] * moved[i]
            total += data.weights[k] * left * left
    return np.sqrt(total / (2.0 * weight))


@njit(**_OPTIONS)
def _allow_for_manoeuvre(forecast, innovation, noise):
    """Returns the covariance of expected depth and speed (2, 2), widened where the innovation is beyond chance.

    The depth is widened by what chance leaves of the innovation, g = innovation^2 - noise - spread. Where the last
    frame did not show the speed, the way was made at a new one within the time dt since,

        spread += g [[1, 1/dt], [1/dt, 1/dt^2]].

    Args:
        forecast: see `Forecast`.
        innovation: of the depth [m].
        noise: its variance by the key points of this frame [m^2].
    """
    spread = forecast.spread.copy()
    limit = _ONSET_SIGMA if forecast.unsure > 0.0 else _MANOEUVRE_SIGMA
    expected = max(spread[0, 0], 0.0) + noise
    if innovation**2 > limit**2 * expected:
        grown = innovation**2 - expected
        spread[0, 0] += grown
        if forecast.unsure > 0.0:
            time = max(forecast.unsure, abs(innovation) / _FASTEST)
            spread[0, 1] += grown / time
            spread[1, 0] = spread[0, 1]
            spread[1, 1] += grown / time**2
    return spread


@njit(**_OPTIONS)
def forecast_place(
    motion: NDArray, covariance: NDArray, slow: NDArray, dt: float, acceleration: float, drift: float, sudden: bool
) -> Forecast:
    """Returns the place dt [s] later: constant speed of the depth under white acceleration; see `Forecast`.

    Args:
        motion: depth [m] and speed [m/s] (2,).
        covariance: of both (2, 2).
        slow: log radius and height [m] (2,).
        dt: [s].
        acceleration: standard deviation [m/s^2].
        drift: standard deviation of the depth beside that [m].
        sudden: whether the last frame did not show the speed.
    """
    a, b, c, power = covariance[0, 0], covariance[0, 1], covariance[1, 1], acceleration**2
    mixed = b + dt * c + power * dt**3 / 2.0
    spread, place = np.empty((2, 2)), np.empty(3)
    spread[0, 0] = a + 2.0 * dt * b + dt**2 * c + power * dt**4 / 4.0 + drift**2
    spread[0, 1] = spread[1, 0] = mixed
    spread[1, 1] = c + power * dt**2
    place[0], place[1], place[2] = motion[0] + min(dt, _LONGEST_SIGHT) * motion[1], slow[0], slow[1]
    return Forecast(place, motion[1], spread, dt if sudden else 0.0)


@njit(**_OPTIONS)
def update_place(
    data: Residuals,
    average: Average,
    forecast: Forecast,
    prior: NDArray,
    prior_variance: NDArray,
    memory: float,
    largest: NDArray,
) -> PlaceUpdate:
    """Returns the place after one frame; see `PlaceUpdate`.

    Args:
        data: residuals about the reference place.
        average: of the residuals so far.
        forecast: predicted depth and speed, last log radius and height.
        prior: of log radius and height (2,).
        prior_variance: (2,).
        memory: longest average [frames].
        largest: changes of log radius and height allowed at once (2,).
    """
    information, innovation, pull = _weigh_depth(data, average.residuals, average.count)
    innovation /= information
    reference, spread = forecast.place, _allow_for_manoeuvre(forecast, innovation, 1.0 / information)
    jumped = spread[0, 0] > forecast.spread[0, 0]
    expected = 1.0 / information + max(spread[0, 0], 0.0)
    gain_depth, gain_speed = spread[0, 0] / expected, spread[0, 1] / expected
    depth = reference[0] + gain_depth * innovation
    new = _extend(average, data, depth - reference[0], memory)
    away_before = (reference[1] - prior[0], reference[2] - prior[1])
    hessian, gradient = _posterior(data, new, away_before, prior_variance, information)
    covariance = invert_symmetric(hessian)
    away, mistaken, doubt = doubt_height(hessian, gradient, away_before[1], prior_variance[1])
    shift, kkt = _find_shift(hessian, covariance, gradient)
    place = reference.copy()
    place[0] = depth
    for i in range(1, 3):
        step = min(max(shift[i], -largest[i - 1]), largest[i - 1])
        place[i] += step
        # radius and height leave the depth that this frame's key points ask for
        place[0] -= pull[i] * step / information
    moved = np.empty(3)
    for i in range(3):
        moved[i] = place[i] - reference[i]
    residual = _move_residuals(data, new, moved, place[0] - depth)
    condition = measure_condition(covariance)
    covariance[2, 2] += doubt
    misfit = _compute_misfit(data, new.residuals, new.count)
    speed = forecast.speed + gain_speed * innovation
    # what chance leaves of the innovation may be a motion that was not expected; the gain has followed a part of it
    beyond = max(0.0, innovation**2 - 1.0 / information - max(forecast.spread[0, 0], 0.0))
    known = gain_depth / information + (1.0 - gain_depth) ** 2 * beyond
    known += find_leverage(data, depth - reference[0], information) ** 2
    left = np.empty((2, 2))
    for j in range(2):
        left[0, j] = spread[0, j] - gain_depth * spread[0, j]
        left[1, j] = spread[1, j] - gain_speed * spread[0, j]
    return PlaceUpdate(
        place, speed, left, jumped, new, covariance, known, kkt, residual, misfit, away, mistaken, condition
    )


@njit(**_OPTIONS)
def _find_shift(hessian, covariance, gradient):
    """Returns what a gradient (3,) asks for, and what is left of it there as a share of what it was."""
    shift, left, largest = np.zeros(3), 0.0, 1e-30
    for i in range(3):
        for j in range(3):
            shift[i] += covariance[i, j] * gradient[j]
    for i in range(3):
        rest = -gradient[i]
        for j in range(3):
            rest += hessian[i, j] * shift[j]
        left, largest = max(left, abs(rest)), max(largest, abs(gradient[i]))
    return shift, left / largest


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
        off: residuals along y (K,) [m], zero where unused.
        off_noise: variance of these in a frame as noisy as this one (K,) [m^2].
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
    off: NDArray
    off_noise: NDArray
    used: int
    known: int
    jump: float
    agreed: int


def blank_residuals(count: int) -> Residuals:
    """Returns the residuals of `count` key points of which none is used."""
    r, modes, noise = np.zeros((count, 2)), np.zeros((count, 2, 3)), np.zeros((count, 2, 2))
    weights, bias, off, off_noise = (np.zeros(count) for _ in range(4))
    return Residuals(r, modes, weights, noise, bias, off, off_noise, 0, 0, 0.0, 0)


@njit(**_OPTIONS)
def _square_distance(r0, r1, h0, h1, noise, level, bias, depth_variance):
    """Returns the squared Mahalanobis distance of an in-plane residual, the depth being uncertain along (h0, h1).

    The point's noise (2, 2) [m^2] counts `level` times.
    """
    s00 = noise[0, 0] * level + bias + h0 * h0 * depth_variance
    s11 = noise[1, 1] * level + bias + h1 * h1 * depth_variance
    s01 = noise[0, 1] * level + h0 * h1 * depth_variance
    return (s11 * r0 * r0 - 2.0 * s01 * r0 * r1 + s00 * r1 * r1) / (s00 * s11 - s01 * s01)


@njit(**_OPTIONS)
def weigh_residuals(
    measured: NDArray,
    positions: NDArray,
    rest: NDArray,
    motions: NDArray,
    moved: NDArray,
    below: float,
    chance: Uncertainty,
) -> Residuals:
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
    r, modes, off = np.zeros((count, 2)), np.empty((count, 2, 3)), np.zeros(count)
    weights, asked, say = np.zeros(count), np.zeros(count), np.zeros(count)
    bias, least = np.empty(count), np.inf
    for k in range(count):
        bias[k] = offset_variance[k] + _MODEL_FLOOR**2
        for a in range(3):
            bias[k] += model_error**2 * (positions[k, a] - rest[k, a]) ** 2
            modes[k, 0, a], modes[k, 1, a] = motions[k, 0, a], motions[k, 2, a]
        least = min(least, noise[k, 0, 0] + noise[k, 1, 1])
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
    agreed = 0
    for k in range(count):
        if np.isnan(off[k]):
            off[k] = 0.0
            continue
        square = off[k] * off[k] / (level * width_variance[k] + bias[k])
        h0, h1 = modes[k, 0, 0], modes[k, 1, 0]
        square += _square_distance(r[k, 0], r[k, 1], h0, h1, noise[k], level / trust[k], bias[k], depth_variance)
        for a in range(2):
            r[k, a] += modes[k, a, 0] * moved[0] + modes[k, a, 1] * moved[1] + modes[k, a, 2] * moved[2]
        weight = 1.0 / (1.0 + square / gate**2) ** 2
        if weight >= _LEAST_WEIGHT:
            weights[k] = weight * trust[k]
            used += 1
            agreed += weights[k] >= _BELIEVED * trust[k]
        else:
            r[k, 0] = r[k, 1] = off[k] = 0.0
    loud, wide = _scale_noise(noise, width_variance, level)
    return Residuals(r, modes, weights, loud, bias, off, wide, used, known, jump, agreed)


@njit(**_OPTIONS)
def _scale_noise(noise, width_variance, level):
    """Returns the noise (K, 2, 2) and the variance along the width (K,) [m^2] of an image, `level` times the usual."""
    loud, wide = np.empty(noise.shape), np.empty(len(noise))
    for k in range(len(noise)):
        wide[k] = width_variance[k] * level
        for a in range(2):
            for b in range(2):
                loud[k, a, b] = noise[k, a, b] * level
    return loud, wide


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
        squares[known] = _square_distance(r0, r1, 0.0, 0.0, chance.noise[k], 1.0 / chance.trust[k], bias[k], 0.0)
        squares[known] += off[k] * off[k] / (chance.width_variance[k] + bias[k])
        known += 1
    if known < _FEWEST:
        return 1.0
    order = _sort(squares, known)
    median = 0.5 * (squares[order[(known - 1) // 2]] + squares[order[known // 2]])
    level = max(1.0, median / (_MEDIAN_SQUARE * _CHANCE))
    return level if level < _LOUDEST else 1.0


@njit(**_OPTIONS)
def _sort(values, count):
    """Returns the indices that sort the first `count` of a few values, by insertion."""
    order = np.empty(count, np.int64)
    for k in range(count):
        at = k
        while at > 0 and values[order[at - 1]] > values[k]:
            order[at] = order[at - 1]
            at -= 1
        order[at] = k
    return order


@njit(**_OPTIONS)
def _weighted_median(values, weights):
    """Returns the value (of n) that has half of the weight on either side; 0 without any weight."""
    half, total = 0.0, 0.0
    for k in range(len(weights)):
        half += 0.5 * weights[k]
    for k in _sort(values, len(values)):
        total += weights[k]
        if total >= half and weights[k] > 0.0:
            return values[k]
    return 0.0
