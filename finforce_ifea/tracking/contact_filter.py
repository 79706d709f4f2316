"""The filter: from the key points of one image to the state of the contact and its uncertainty, compiled.

The depth is corrected by a Kalman filter with constant velocity on this image's residuals. Shape and height change
slowly: they are the maximum a posteriori for the residuals averaged over the last images, so that their priors count
once and what does not average out, errors of the mechanics and of the offsets, is no information.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

_OPTIONS = {"cache": True, "error_model": "numpy"}
# What is expected of an object, and what the search for its contact is allowed.
EXPECTATION = np.dtype(
    [
        ("mean", float, 2),  # of shape and height [m]
        ("variance", float, 2),  # of both
        ("lowest", float),  # shape
        ("highest", float),  # shape
        ("largest_change", float),  # of the shape at once
        ("settled_change", float),  # of the shape that no longer matters
        ("farthest", float),  # of the height from its mean [m]
        ("gate", float),  # residual that keeps a quarter of its weight, in standard deviations
        ("stiffness", float),  # of the jaw at first touch [N/m], 0 where unknown
        ("has_corners", bool),  # whether the object may rock
        ("shared", float),  # standard deviation of a shift that all key points of an image share [m]
    ],
    align=True,
)

# The state that is expected in an image.
FORECAST = np.dtype(
    [
        ("x", float, 3),
        ("speed", float),  # of the depth [m/s]
        ("spread", float, (2, 2)),  # covariance of depth and speed
        ("unsure", float),  # time since the last image if that did not show the speed, else 0 [s]
    ]
)

# Change of the height that is allowed at once [m].
LARGEST_SHIFT = 0.3e-3
# Images over which residuals are averaged while the contact holds still.
LONGEST_AVERAGE = 45.0
# Expected acceleration of the object into the jaw, one standard deviation [m/s^2].
_ACCELERATION = 0.02
# Standard deviation of the depth per image in addition to its acceleration [m].
_DEPTH_DRIFT = 0.01e-3
# No speed is believed for longer than this [s].
_LONGEST_FORECAST = 0.2


@njit(**_OPTIONS)
def forecast_state(state, dt, is_sudden, expectation, forecast):
    """Write the state of the contact dt [s] later to forecast: constant speed of the depth under white acceleration.

    Args:
        state: of the last image, see `CONTACT_STATE`.
        dt: [s].
        is_sudden: whether the last image did not show the speed: nothing pressed, or the depth jumped.
        expectation: see `EXPECTATION`.
        forecast: see `FORECAST`.
    """
    state, expectation, forecast = state[()], expectation[()], forecast[()]
    spread, power = state.spread, _ACCELERATION**2
    a, b, c = spread[0, 0], spread[0, 1], spread[1, 1]
    mixed = b + dt * c + power * dt**3 / 2.0
    forecast.spread[0, 0] = a + 2.0 * dt * b + dt**2 * c + power * dt**4 / 4.0 + _DEPTH_DRIFT**2
    forecast.spread[0, 1] = mixed
    forecast.spread[1, 0] = mixed
    forecast.spread[1, 1] = c + power * dt**2
    for i in range(3):
        forecast.x[i] = state.x[i]
    forecast.x[0] += min(dt, _LONGEST_FORECAST) * state.speed
    forecast.speed = state.speed
    forecast.unsure = dt if is_sudden else 0.0


# Error of the mechanics, as a share of a key point's displacement, and at least [m].
_MODEL_ERROR, _MODEL_FLOOR = 0.01, 0.02e-3
_LEAST_WEIGHT = 0.02
# Median of a squared distance in three axes; what more is chance; and fewer points do not tell the noise.
MEDIAN_SQUARE, _CHANCE, _FEWEST = 2.37, 1.5, 5
_BELIEVED = 0.25
# One standard deviation: by how much a holder gives (bolts of a real one turn by 4 to 6 degrees under 8 to 12 N) and a
# network has a bent finger turned (1.5 degrees) [rad], and by how much longer a side seems that leans [-]. Rounds of
# weights: points that are not believed must not tell what all share.
_SHARED_TURN, _SHARED_STRETCH, _SHARED_ROUNDS = 0.07, 0.02, 3
# Columns: shift along x and z, turn, stretch; residual; derivatives by the state and the traction ratio.
_SHARED, _SHARED_COLUMNS = 4, 9
# Beyond this noise key points are not noisy but something else than key points.
_LOUDEST = 20.0
# A forecast is never wider than this [m].
_WIDEST_FORECAST = 1e-3


@njit(**_OPTIONS)
def weigh_keypoints(points, positions, motions, x, x_model, forecast, expectation, state):
    """Fill in the residuals about the forecast and the weights of the key points of an image.

    Weights are those of the residuals that are left at the model's own state: w = 1 / (1 + d^2 / gate^2)^2 (Geman and
    McClure), times the trust in a point of this image. The motion along y, known to be none, tells of noise that x
    and z share.

    Args:
        points: (K,), see `KEYPOINT`.
        positions: of the deformed model (K, 3) [m].
        motions: derivatives of the positions by the state and the traction ratio (K, 3, 4).
        x: the state at which the model is asked (3,).
        x_model: the state at which it stands, never above the surface (3,).
        forecast: see `FORECAST`.
        expectation: see `EXPECTATION`.
        state: see `CONTACT_STATE`; gets the numbers of key points and the jump.
    """
    state, expectation, forecast = state[()], expectation[()], forecast[()]
    for k in range(len(points)):
        points[k].weight = points[k].trust
    for _ in range(_SHARED_ROUNDS if expectation.shared > 0.0 else 1):
        state.known, state.jump = _measure_residuals(points, positions, motions, x[0] - x_model[0], expectation)
        _weigh_residuals(points, x, forecast, expectation, state)


@njit(**_OPTIONS)
def _weigh_residuals(points, x, forecast, expectation, state):
    """Fill in the weights of measured residuals, and take these to the forecast; see `weigh_keypoints`."""
    depth_variance = min(forecast.spread[0, 0], _WIDEST_FORECAST**2)
    level = _measure_noise_level(points, state.jump)
    state.used = state.agreed = 0
    for k in range(len(points)):
        point = points[k]
        point.weight = 0.0
        for a in range(2):
            for b in range(2):
                point.noise[a, b] = point.tare_noise[a, b] * level
        point.lateral_noise = point.width_variance * level
        if np.isnan(point.lateral):
            point.lateral = 0.0
            continue
        square = point.lateral * point.lateral / (level * point.width_variance + point.bias)
        square += _square_distance(point, point.r[0], point.r[1], level / point.trust, depth_variance)
        for a in range(2):
            for i in range(3):
                point.r[a] += point.modes[a, i] * (x[i] - forecast.x[i])
        weight = 1.0 / (1.0 + square / expectation.gate**2) ** 2
        if weight >= _LEAST_WEIGHT:
            point.weight = weight * point.trust
            state.used += 1
            state.agreed += point.weight >= _BELIEVED * point.trust
        else:
            point.r[0] = point.r[1] = point.lateral = 0.0


@njit(**_OPTIONS)
def _measure_residuals(points, positions, motions, below, expectation):
    """Fill in the residuals at the model's own state, NaN along y where unused; the depth asked for is `below` it [m].

    Returns:
        The number of points that were measured, and the median of the depths that they ask for one by one [m].
    """
    count, known, least = len(points), 0, np.inf
    asked, information = np.zeros(count), np.zeros(count)
    for k in range(count):
        point = points[k]
        point.bias = point.offset_variance + _MODEL_FLOOR**2
        for a in range(3):
            point.bias += _MODEL_ERROR**2 * (positions[k, a] - point.rest[a]) ** 2
        for i in range(4):
            point.modes[0, i], point.modes[1, i] = motions[k, 0, i], motions[k, 2, i]
        least = min(least, point.tare_noise[0, 0] + point.tare_noise[1, 1])
    for k in range(count):
        point = points[k]
        point.r[0] = point.r[1] = 0.0
        if not np.isfinite(point.measured[0] + point.measured[1] + point.measured[2]):
            point.lateral = np.nan
            continue
        h0, h1 = point.modes[0, 0], point.modes[1, 0]
        point.lateral = point.measured[1] - positions[k, 1]
        point.r[0] = point.measured[0] - positions[k, 0] - point.gain[0] * point.lateral - h0 * below
        point.r[1] = point.measured[2] - positions[k, 2] - point.gain[1] * point.lateral - h1 * below
    if expectation.shared > 0.0:
        take_shared_out(points, positions, expectation.shared)
    for k in range(count):
        point = points[k]
        if np.isnan(point.lateral):
            continue
        h0, h1 = point.modes[0, 0], point.modes[1, 0]
        information[k] = h0 * h0 + h1 * h1
        asked[k] = (h0 * point.r[0] + h1 * point.r[1]) / max(information[k], 1e-12)
        information[k] *= point.trust * least / (point.tare_noise[0, 0] + point.tare_noise[1, 1])
        known += 1
    return known, _weighted_median(asked, information)


@njit(**_OPTIONS)
def _collect_shared(points, positions, shared):
    """Return B, residual and derivatives of each point (K, 2, 9), zero where unused, and its information (K, 2, 2)."""
    rows, metric = np.zeros((len(points), 2, _SHARED_COLUMNS)), np.zeros((len(points), 2, 2))
    for k in range(len(points)):
        point = points[k]
        if np.isnan(point.lateral):
            continue
        s00, s11, s01 = point.tare_noise[0, 0] + point.bias, point.tare_noise[1, 1] + point.bias, point.tare_noise[0, 1]
        scale = point.weight / (s00 * s11 - s01 * s01)
        metric[k, 0, 0], metric[k, 1, 1], metric[k, 0, 1] = s11 * scale, s00 * scale, -s01 * scale
        metric[k, 1, 0] = metric[k, 0, 1]
        rows[k, 0, 0] = rows[k, 1, 1] = shared
        rows[k, 0, 2], rows[k, 1, 2] = _SHARED_TURN * positions[k, 2], -_SHARED_TURN * positions[k, 0]
        rows[k, 1, 3] = _SHARED_STRETCH * positions[k, 2]
        for a in range(2):
            rows[k, a, _SHARED] = point.r[a]
            rows[k, a, _SHARED + 1 :] = point.modes[a]
    return rows, metric


@njit(**_OPTIONS)
def take_shared_out(points, positions, shared):
    """Weigh residuals and their derivatives r against shift, turn and stretch that all points of an image share.

    With N the covariance of the points, and B b, b ~ N(0, I), what the shared motion adds,

        r <- N^1/2 (N + B B^T)^-1/2 r,

    so that they count as if the points erred independently; one column q of N^-1/2 B after the other,

        (I + q q^T)^-1/2 = I - q q^T (1 - (1 + q^T q)^-1/2) / (q^T q).

    Args:
        points: (K,), measured.
        positions: of the deformed model (K, 3) [m].
        shared: standard deviation of the shift [m].
    """
    rows, metric = _collect_shared(points, positions, shared)
    for j in range(_SHARED):
        inner = np.zeros(_SHARED_COLUMNS)
        for k in range(len(points)):
            for a in range(2):
                inner += (metric[k, a, 0] * rows[k, 0, j] + metric[k, a, 1] * rows[k, 1, j]) * rows[k, a]
        inner *= (1.0 - 1.0 / np.sqrt(1.0 + inner[j])) / max(inner[j], 1e-300)
        for i in range(j + 1, _SHARED_COLUMNS):
            rows[:, :, i] -= inner[i] * rows[:, :, j]
    for k in range(len(points)):
        for a in range(2):
            if np.isfinite(points[k].lateral):
                points[k].r[a] = rows[k, a, _SHARED]
                points[k].modes[a, :] = rows[k, a, _SHARED + 1 :]


@njit(**_OPTIONS)
def _square_distance(point, r0, r1, level, depth_variance):
    """Return the squared Mahalanobis distance of a residual in the plane whose depth is uncertain.

    The point's noise in the tare counts `level` times.
    """
    noise, h0, h1 = point.tare_noise, point.modes[0, 0], point.modes[1, 0]
    s00 = noise[0, 0] * level + point.bias + h0 * h0 * depth_variance
    s11 = noise[1, 1] * level + point.bias + h1 * h1 * depth_variance
    s01 = noise[0, 1] * level + h0 * h1 * depth_variance
    return (s11 * r0 * r0 - 2.0 * s01 * r0 * r1 + s00 * r1 * r1) / (s00 * s11 - s01 * s01)


@njit(**_OPTIONS)
def _measure_noise_level(points, jump):
    """Return the variance of this image's residuals over what was expected of it, at least 1; 1 where it is garbage.

    The depth is first moved by the median of what the points ask for, for a forecast may be wrong. The median of the
    squared distances, 2.37 for three axes, is not moved by gross errors; half as much again is taken for chance.
    """
    squares, known = np.empty(len(points)), 0
    for k in range(len(points)):
        point = points[k]
        if np.isnan(point.lateral):
            continue
        r0, r1 = point.r[0] - point.modes[0, 0] * jump, point.r[1] - point.modes[1, 0] * jump
        squares[known] = _square_distance(point, r0, r1, 1.0 / point.trust, 0.0)
        squares[known] += point.lateral * point.lateral / (point.width_variance + point.bias)
        known += 1
    if known < _FEWEST:
        return 1.0
    order = _sort(squares, known)
    median = 0.5 * (squares[order[(known - 1) // 2]] + squares[order[known // 2]])
    level = max(1.0, median / (MEDIAN_SQUARE * _CHANCE))
    return level if level < _LOUDEST else 1.0


@njit(**_OPTIONS)
def _sort(values, count):
    """Return the indices that sort the first `count` of a few values, by insertion."""
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
    """Return the value (of n) that has half of the weight on either side; 0 without any weight."""
    half, total = 0.0, 0.0
    for k in range(len(weights)):
        half += 0.5 * weights[k]
    for k in _sort(values, len(values)):
        total += weights[k]
        if total >= half and weights[k] > 0.0:
            return values[k]
    return 0.0


@njit(**_OPTIONS)
def update_state(points, average, extended, forecast, expectation, state):
    """Write the state that the key points ask for, and how sure it is, to state.

    Args:
        points: (K,), weighed; see `weigh_keypoints`.
        average: of the residuals so far (K,), see `AVERAGE`.
        extended: the same with this image's, about the new state (K,).
        forecast: see `FORECAST`.
        expectation: see `EXPECTATION`.
        state: see `CONTACT_STATE`.
    """
    state, expectation, forecast = state[()], expectation[()], forecast[()]
    information, innovation, pull = _weigh_depth(points, average)
    innovation /= information
    spread = widen_forecast(forecast, innovation, 1.0 / information)
    state.jumped = spread[0, 0] > forecast.spread[0, 0]
    expected = 1.0 / information + max(spread[0, 0], 0.0)
    gain_depth, gain_speed = spread[0, 0] / expected, spread[0, 1] / expected
    depth = forecast.x[0] + gain_depth * innovation
    deeper = depth - forecast.x[0]
    _extend_average(average, points, deeper, LONGEST_AVERAGE, extended)
    offset = (forecast.x[1] - expectation.mean[0], forecast.x[2] - expectation.mean[1])
    white = _whiten_averages(points, extended)
    hessian, gradient = _compute_posterior(white, offset, expectation.variance, information)
    covariance = invert_symmetric(hessian)
    height_variance = _question_height(hessian, gradient, offset[1], expectation.variance[1], state)
    shift = _find_shift(hessian, covariance, gradient, state)
    largest = (expectation.largest_change, LARGEST_SHIFT)
    for i in range(3):
        state.x_asked[i] = forecast.x[i]
    state.x_asked[0] = depth
    for i in range(1, 3):
        step = min(max(shift[i], -largest[i - 1]), largest[i - 1])
        state.x_asked[i] += step
        # shape and height leave the depth that this image's key points ask for
        state.x_asked[0] -= pull[i] * step / information
    for i in range(3):
        state.moved[i] = state.x_asked[i] - forecast.x[i]
    state.residual = _move_residuals(points, extended, state.moved, state.x_asked[0] - depth)
    covariance[2, 2] += height_variance
    moved = np.array([state.x_asked[0] - depth, state.moved[1], state.moved[2]])
    state.misfit, state.scatter = _measure_misfit(points, extended, white, moved)
    state.speed = forecast.speed + gain_speed * innovation
    # what chance leaves of the innovation may be a motion that was not expected; the gain has followed a part of it
    beyond = max(0.0, innovation**2 - 1.0 / information - max(forecast.spread[0, 0], 0.0))
    state.depth_variance = gain_depth / information + (1.0 - gain_depth) ** 2 * beyond
    state.depth_variance += _find_leverage(points, deeper, information) ** 2
    for j in range(2):
        state.spread[0, j] = spread[0, j] - gain_depth * spread[0, j]
        state.spread[1, j] = spread[1, j] - gain_speed * spread[0, j]
    for i in range(3):
        for j in range(3):
            state.covariance[i, j] = covariance[i, j]


@njit(**_OPTIONS)
def _weigh_depth(points, average):
    """Return information on the depth, its weighted innovation, and the pull (3,) of shape and height on it.

    The averaged residuals are taken off as each point's bias; what they have in common along the depth is not a bias.
    """
    count = len(points)
    p00, p11, p01 = np.empty(count), np.empty(count), np.empty(count)
    along, norm = 0.0, 1e-300
    for k in range(count):
        noise, mean, frames = points[k].noise, average[k].residual, average[k].count
        det = noise[0, 0] * noise[1, 1] - noise[0, 1] * noise[0, 1]
        p00[k], p11[k], p01[k] = noise[1, 1] / det, noise[0, 0] / det, -noise[0, 1] / det
        h0, h1 = points[k].modes[0, 0], points[k].modes[1, 0]
        along += frames * ((p00[k] * h0 + p01[k] * h1) * mean[0] + (p01[k] * h0 + p11[k] * h1) * mean[1])
        norm += frames * (p00[k] * h0 * h0 + 2.0 * p01[k] * h0 * h1 + p11[k] * h1 * h1)
    along /= norm
    information, innovation, pull = 0.0, 0.0, np.zeros(3)
    for k in range(count):
        point, mean = points[k], average[k].residual
        h0, h1 = point.modes[0, 0], point.modes[1, 0]
        w0 = point.weight * (p00[k] * h0 + p01[k] * h1)
        w1 = point.weight * (p01[k] * h0 + p11[k] * h1)
        information += w0 * h0 + w1 * h1
        innovation += w0 * (point.r[0] - mean[0] + along * h0) + w1 * (point.r[1] - mean[1] + along * h1)
        for i in range(1, 3):
            pull[i] += w0 * point.modes[0, i] + w1 * point.modes[1, i]
    return information, innovation, pull


# Innovations beyond this many standard deviations are no chance: where the speed is known, and where it is not.
_MANOEUVRE_SIGMA, _ONSET_SIGMA = 3.0, 2.5
# Of a longer jump [m/s] the rest is taken for one of the depth alone.
_FASTEST = 0.05


@njit(**_OPTIONS)
def widen_forecast(forecast: np.void, innovation: float, noise: float) -> NDArray:
    """Return the covariance of expected depth and speed (2, 2), widened where the innovation is beyond chance.

    The depth is widened by what chance leaves of the innovation, g = innovation^2 - noise - spread. Where the last
    image did not show the speed, the displacement was made at a new one within the time dt since,

        spread += g [[1, 1/dt], [1/dt, 1/dt^2]].

    Args:
        forecast: see `FORECAST`.
        innovation: of the depth [m].
        noise: its variance by the key points of this image [m^2].
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
def _extend_average(average, points, deeper, memory, extended):
    """Write the average with this image's residuals, the depth changed by `deeper` [m], to extended."""
    for k in range(len(points)):
        point, old, new = points[k], average[k], extended[k]
        share = point.weight / (min(old.count, memory) + 1.0)
        new.count = min(old.count * (1.0 - 1.0 / memory) + point.weight, memory)
        for a in range(2):
            left = point.r[a] - point.modes[a, 0] * deeper
            new.residual[a] = old.residual[a] + share * (left - old.residual[a])
            for i in range(4):
                new.modes[a, i] = old.modes[a, i] + share * (point.modes[a, i] - old.modes[a, i])


# Beyond this many of its standard deviations the prior of a state lets go.
_PRIOR_REACH = 4.0
# Depth has no prior; this share of one image's information keeps the posterior regular while nothing was averaged.
_DEPTH_SHARE = 1e-3


# Errors that are others in each shape, as shares of the variance that a detector states beyond the scatter of the tare:
# alike for neighbours, and each point for itself. Measured on rendered images of four bent fingers: the shipped
# networks err by less than they state.
_ALIKE, _ALONE = 0.2, 0.05
# Distance along a side of the finger over which such errors stay alike [m]: a network sees its points in patches of
# such a size, which overlap.
_PATCH = 15e-3


def link_neighbours(points, rest):
    """Say which key points err alike in one sight: each and the nearest below it that is no other's next.

    Args:
        points: (K,), see `KEYPOINT`.
        rest: of the undeformed jaw (K, 3) [m].
    """
    points["likeness"], points["above"] = 0.0, 0
    for k in np.argsort(rest[:, 2]):
        free = (points["above"] == 0) & (rest[:, 2] < rest[k, 2])
        distances = np.where(free, np.linalg.norm(rest - rest[k], axis=1), np.inf)
        below = int(np.argmin(distances))
        if distances[below] < _PATCH:
            points["likeness"][k], points["above"][below] = np.exp(-distances[below] / _PATCH), k + 1


@njit(**_OPTIONS)
def _whiten_averages(points, average):
    """Return averaged residuals and their derivatives (K, 2, 5) as if all erred independently, by one; zero where none.

    What a point errs by in one sight, s u with s^2 its variance, is like that of the point below,

        u_k = c u_(k-1) + sqrt(1 - c^2) v,    v ~ N(0, 1) along x and z,

    so that a Kalman filter from the base to the tip tells what the points below leave to be expected, and the
    innovations are independent.

    Args:
        points: (K,), see `KEYPOINT`.
        average: of their residuals (K,), see `AVERAGE`.
    """
    white = np.zeros((len(points), 2, 5))
    row, known = np.empty((2, 5)), np.empty((2, 5))
    for first in range(len(points)):
        k = first if points[first].likeness == 0.0 else -1
        known[:] = 0.0
        p00, p11, p01 = 1.0, 1.0, 0.0
        while k >= 0:
            point, mean, out = points[k], average[k], white[k]
            square = point.likeness**2
            known *= point.likeness
            p00, p11, p01 = square * p00 + 1.0 - square, square * p11 + 1.0 - square, square * p01
            k = point.above - 1
            if mean.count <= 0.5:
                continue
            noise, share, s = point.noise, 1.0 / max(mean.count, 1.0), np.sqrt(_ALIKE * point.sight)
            own = point.bias - (1.0 - _ALONE) * point.sight
            s00, s11 = noise[0, 0] * share + own + s * s * p00, noise[1, 1] * share + own + s * s * p11
            s01 = noise[0, 1] * share + s * s * p01
            for axis in range(2):
                row[axis, 0], row[axis, 1:] = mean.residual[axis], mean.modes[axis]
            row -= s * known
            scale, mixed = np.sqrt(s00), s01 / np.sqrt(s00)
            out[0] = row[0] / scale
            out[1] = (row[1] - mixed * out[0]) / np.sqrt(s11 - mixed * mixed)
            gain = s / (s00 * s11 - s01 * s01)
            g00, g01 = gain * (p00 * s11 - p01 * s01), gain * (p01 * s00 - p00 * s01)
            g10, g11 = gain * (p01 * s11 - p11 * s01), gain * (p11 * s00 - p01 * s01)
            known[0] += g00 * row[0] + g01 * row[1]
            known[1] += g10 * row[0] + g11 * row[1]
            p00, p11, p01 = (
                p00 - s * (g00 * p00 + g01 * p01),
                p11 - s * (g10 * p01 + g11 * p11),
                p01 - s * (g00 * p01 + g01 * p11),
            )
    return white


@njit(**_OPTIONS)
def sum_averages(points, average):
    """Return what averaged residuals tell of depth, shape, height and traction ratio: normal equations (4, 4), (4,).

    Args:
        points: (K,), see `KEYPOINT`.
        average: of their residuals (K,), see `AVERAGE`.
    """
    return _sum_whitened(_whiten_averages(points, average))


@njit(**_OPTIONS)
def _sum_whitened(white):
    """Return the normal equations (4, 4), (4,) of whitened residuals and their derivatives (K, 2, 5)."""
    normal, right = np.zeros((4, 4)), np.zeros(4)
    for rows in white:
        for row in rows:
            for i in range(4):
                right[i] += row[i + 1] * row[0]
                for j in range(4):
                    normal[i, j] += row[i + 1] * row[j + 1]
    return normal, right


@njit(**_OPTIONS)
def _compute_posterior(white, offset, prior_variance, information):
    """Return Hessian and gradient of the log posterior of the state for whitened residuals (K, 2, 5)."""
    normal, right = _sum_whitened(white)
    hessian, gradient = normal[:3, :3].copy(), right[:3].copy()
    for i in range(2):
        # far from its mean the prior lets go (Cauchy), for an object may touch first elsewhere than was stated
        variance = prior_variance[i] + (offset[i] / _PRIOR_REACH) ** 2
        hessian[i + 1, i + 1] += 1.0 / variance
        gradient[i + 1] -= offset[i] / variance
    hessian[0, 0] += _DEPTH_SHARE * information
    return hessian, gradient


@njit(**_OPTIONS)
def invert_symmetric(A):
    """Return the inverse of a symmetric 3 x 3 matrix."""
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


# A stated height is that of another contact once in so many times, and then anywhere within this [m].
_MISTAKEN = 0.01
_ANYWHERE = 0.03


@njit(**_OPTIONS)
def question_location(offset: float, spread: float, prior_variance: float, found: float) -> tuple[float, float]:
    """Return the probability that a stated contact location is wrong, and what that adds to its variance [m^2].

    The key points alone have the contact D = offset from there, with the variance s^2 = spread. It is another one,
    N(0, R^2), with the probability p:

        p / (1 - p) = p0 N(D; 0, v + s^2 + R^2) / N(D; 0, v + s^2) / (1 - p0).

    What exceeds p0 of it adds the distance of that contact from the location that was found.

    Args:
        offset: D [m].
        spread: s^2 [m^2].
        prior_variance: v, of the stated location [m^2].
        found: distance of the location that was found from the stated one [m].
    """
    near, far = prior_variance + spread, prior_variance + spread + _ANYWHERE**2
    odds = 0.5 * offset**2 * (1.0 / near - 1.0 / far) + 0.5 * np.log(near / far) + np.log(_MISTAKEN / (1.0 - _MISTAKEN))
    mistaken = 1.0 / (1.0 + np.exp(-min(max(odds, -50.0), 50.0)))
    shrunk = _ANYWHERE**2 / (_ANYWHERE**2 + spread)
    variance = max(0.0, mistaken - _MISTAKEN) * ((shrunk * offset - found) ** 2 + shrunk * spread)
    return mistaken, variance


@njit(**_OPTIONS)
def _question_height(hessian, gradient, offset, prior_variance, state):
    """Return the variance of the height by a wrong location [m^2]; the state gets its offset and probability.

    Args:
        hessian: of the log posterior (3, 3).
        gradient: of the same (3,).
        offset: of the forecast height from the expected one [m].
        prior_variance: of the height [m^2].
        state: see `CONTACT_STATE`.
    """
    pull = 1.0 / (prior_variance + (offset / _PRIOR_REACH) ** 2)
    data, slope = hessian.copy(), gradient.copy()
    # a millionth is left of the prior, for where the key points tell nothing
    data[2, 2] -= (1.0 - 1e-6) * pull
    slope[2] += (1.0 - 1e-6) * pull * offset
    covariance = invert_symmetric(data)
    state.offset = offset
    for i in range(3):
        state.offset += covariance[2, i] * slope[i]
    state.mistaken, variance = question_location(state.offset, max(covariance[2, 2], 0.0), prior_variance, offset)
    return variance


@njit(**_OPTIONS)
def _find_shift(hessian, covariance, gradient, state):
    """Return what a gradient asks for (3,); the state gets what is left of it there as a share of what it was."""
    shift, left, largest = np.zeros(3), 0.0, 1e-30
    for i in range(3):
        for j in range(3):
            shift[i] += covariance[i, j] * gradient[j]
    for i in range(3):
        remainder = -gradient[i]
        for j in range(3):
            remainder += hessian[i, j] * shift[j]
        left, largest = max(left, abs(remainder)), max(largest, abs(gradient[i]))
    state.kkt = left / largest
    return shift


@njit(**_OPTIONS)
def _move_residuals(points, average, moved, deeper):
    """Take averaged residuals to the new state and return this image's weighted root mean square there [m].

    The state has moved by `moved` (3,) since this image's residuals, the depth by `deeper` [m] since the average.
    """
    total, weight = 0.0, 0.0
    for k in range(len(points)):
        point, mean = points[k], average[k]
        weight += point.weight
        for a in range(2):
            left = point.r[a]
            mean.residual[a] -= mean.modes[a, 0] * deeper
            for i in range(3):
                left -= point.modes[a, i] * moved[i]
                if i > 0:
                    mean.residual[a] -= mean.modes[a, i] * moved[i]
            total += point.weight * left * left
    return np.sqrt(total / (2.0 * weight))


@njit(**_OPTIONS)
def _measure_misfit(points, average, white, moved):
    """Return the root mean square of averaged residuals over their standard deviations: as stated, and as whitened.

    Args:
        points: (K,), see `KEYPOINT`.
        average: of their residuals (K,), see `AVERAGE`, at the new state.
        white: the same before, whitened, with their derivatives (K, 2, 5).
        moved: change of the state since (3,).
    """
    total, freedom, square = 0.0, -3.0, 0.0
    for k in range(len(points)):
        if average[k].count <= 0.5:
            continue
        noise, bias, share = points[k].noise, points[k].bias, 1.0 / max(average[k].count, 1.0)
        s00, s11, s01 = noise[0, 0] * share + bias, noise[1, 1] * share + bias, noise[0, 1] * share
        m0, m1 = average[k].residual[0], average[k].residual[1]
        total += (s11 * m0 * m0 - 2.0 * s01 * m0 * m1 + s00 * m1 * m1) / (s00 * s11 - s01 * s01)
        freedom += 2.0
    for rows in white:
        for row in rows:
            left = row[0] - row[1] * moved[0] - row[2] * moved[1] - row[3] * moved[2]
            square += left * left
    return np.sqrt(total / max(freedom, 1.0)), np.sqrt(square / max(freedom, 1.0))


@njit(**_OPTIONS)
def _find_leverage(points, deeper, information):
    """Return how far the depth would move if points that are half believed were not believed at all [m].

    With w the weights, h the motions by depth, r what is left of the residuals and I the information,

        leverage = sum_k w_k (1 - w_k) h_k^T N_k^-1 r_k / I.

    Chance cancels in it; points that are wrong together do not.
    """
    leverage = 0.0
    for k in range(len(points)):
        point, noise = points[k], points[k].noise
        n00, n11, n01 = noise[0, 0], noise[1, 1], noise[0, 1]
        h0, h1 = point.modes[0, 0], point.modes[1, 0]
        r0, r1 = point.r[0] - h0 * deeper, point.r[1] - h1 * deeper
        score = (h0 * (n11 * r0 - n01 * r1) + h1 * (n00 * r1 - n01 * r0)) / (n00 * n11 - n01 * n01)
        leverage += point.weight * (1.0 - point.weight) * score
    return leverage / information
