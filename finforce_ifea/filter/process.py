"""Process model: how the state changes from one image to the next.

The depth may be any in each image; `finforce.kalman.Track` smooths it afterwards. All other entries are first-order
Gauss-Markov processes about what is expected of them,

    x <- m + a (x - m) + w,    Var w = (1 - a^2) V,    a = exp(-dt / T - |delta| / L),

with the motion delta of the object, so that a prior counts once and never again.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from finforce.compiled import njit
from finforce_ifea.filter.state import APPARENT, CAMERA_STRETCH, CAMERA_X, DEPTH, HEIGHT, SHAPE, SHARED, TRACTION

_OPTIONS = {"cache": True, "error_model": "numpy"}

# Prior standard deviation of the depth in each image [m]: larger than any motion between two images.
FREE_DEPTH = 2e-3
# Correlation time of the error of an object's pose [s]: trackers see an object from one side.
OBJECT_TIME = 10.0
# Standard deviation of the mechanics' error at a key point, at least [m].
MODEL_FLOOR = 0.02e-3
# The same in one shape, relative to the displacement [-].
MODEL_SHAPE = 0.004
# The same in all shapes [-]: the default mesh is within 1 % of an independent program.
MODEL_RELATIVE = 0.01
# Correlation length of a key point's offset [m].
MODEL_LENGTH = 10e-3
# Correlation time of that offset, and of traction beyond friction [s].
MODEL_TIME = 60.0
# Correlation length of a detector's lasting error [m]: half a pixel.
DETECTOR_LENGTH = 0.1e-3
# Correlation time of the error in all shapes [s].
RELATIVE_TIME = 200.0
# Standard deviation of the traction ratio beyond friction, at least [-].
TRACTION_FLOOR = 0.04
# The same relative to the coefficient of friction [-].
TRACTION_SHARE = 0.15
# Correlation length of that traction [m].
TRACTION_LENGTH = 2e-3
# Standard deviation of the traction ratio that errors of the mechanics look like [-].
APPARENT_TRACTION = 0.2
# The same for a detector's lasting errors, relative to their standard deviation [1/m].
APPARENT_DETECTOR = 1e3
# Correlation time of apparent traction [s].
APPARENT_TIME = 10.0
# Standard deviation of the camera's shift since the tare [m].
CAMERA_SHIFT = 0.02e-3
# Standard deviation of its rotation [rad].
CAMERA_TURN_STDDEV = 0.3e-3
# Correlation time of both [s].
CAMERA_TIME = 20.0
# Standard deviation of the shift of a bumped camera [m].
BUMPED_SHIFT = 1e-3
# Standard deviation of its rotation [rad].
BUMPED_TURN = 10e-3
# Correlation time of both [s]: it stays where it is.
BUMPED_TIME = 1e4
# Standard deviation of the rotation of a jaw whose pose in the image is uncertain [rad].
PLACE_TURN = 0.07
# Standard deviation of its scale [-].
PLACE_STRETCH = 0.02
# Correlation time of both [s].
PLACE_TIME = 1.0


class Expectation(NamedTuple):
    """The prior that the state returns to.

    Attributes:
        mean: of shape and height (2,).
        variance: of both (2,).
        traction_variance: of the traction ratio beyond friction.
        apparent_variance: of the traction ratio that errors look like.
        camera_variance: of the camera's motion (4,).
        camera_time: over which that stays the same [s].
    """

    mean: NDArray
    variance: NDArray
    traction_variance: float
    apparent_variance: float
    camera_variance: NDArray
    camera_time: float


@njit(**_OPTIONS)
def expect_state(expected, offset_variance, displacement):
    """Return mean m (n,) and variance V (n,) to which the state returns.

    Args:
        expected: see `Expectation`.
        offset_variance: of the key points' offsets (K,) [m^2].
        displacement: of the key points (K,) [m].
    """
    count = len(displacement)
    n = SHARED + 4 * count
    m, V = np.zeros(n), np.zeros(n)
    m[SHAPE : HEIGHT + 1], V[SHAPE : HEIGHT + 1] = expected.mean, expected.variance
    V[TRACTION], V[APPARENT] = expected.traction_variance, expected.apparent_variance
    V[CAMERA_X : CAMERA_STRETCH + 1] = expected.camera_variance
    for k in range(count):
        own = offset_variance[k] + MODEL_FLOOR**2 + (MODEL_SHAPE * displacement[k]) ** 2
        V[SHARED + 2 * k] = V[SHARED + 2 * k + 1] = own
    V[SHARED + 2 * count :] = MODEL_RELATIVE**2
    return m, V


@njit(**_OPTIONS)
def find_decay(detector_share, dt, motion, camera_time):
    """Return a (n,) after a time dt [s] and a motion of the object [m].

    Args:
        detector_share: share of each key point's offset that a detector errs by in the view of one shape (K,) [-].
        dt: see above.
        motion: see above.
        camera_time: see `Expectation`.
    """
    keypoints = len(detector_share)
    a = np.ones(SHARED + 4 * keypoints)
    a[SHAPE] = a[HEIGHT] = np.exp(-dt / OBJECT_TIME)
    a[TRACTION] = np.exp(-motion / TRACTION_LENGTH - dt / MODEL_TIME)
    a[APPARENT] = np.exp(-dt / APPARENT_TIME)
    a[CAMERA_X : CAMERA_STRETCH + 1] = np.exp(-dt / camera_time)
    lasts, seen = np.exp(-motion / MODEL_LENGTH - dt / MODEL_TIME), np.exp(-motion / DETECTOR_LENGTH)
    for k in range(keypoints):
        a[SHARED + 2 * k : SHARED + 2 * k + 2] = lasts * (1.0 - detector_share[k] + detector_share[k] * seen)
    a[SHARED + 2 * keypoints :] = np.exp(-dt / RELATIVE_TIME)
    return a


@njit(**_OPTIONS)
def find_growth(before, after, keypoints):
    """Return the ratio (n,) of the stationary standard deviations of the offsets after and before a step, else 1."""
    growth = np.ones(len(after))
    for i in range(SHARED, SHARED + 2 * keypoints):
        growth[i] = np.sqrt(after[i] / before[i])
    return growth


@njit(**_OPTIONS)
def start(expected, points, x):
    """Return mean (n,) and stationary variance (n,) before the first image.

    Args:
        expected: see `Expectation`.
        points: see `KEYPOINT` (K,).
        x: depth, shape and height to begin with (3,).
    """
    m, V = expect_state(expected, points.offset_variance, np.zeros(len(points)))
    m[DEPTH], m[SHAPE], m[HEIGHT] = x
    return m, V


@njit(**_OPTIONS)
def advance(x, P, V, expected, points, positions, passed, depth, weights, responses):
    """Predict the state of an image in place.

    Args:
        x: means of the hypotheses (N, n).
        P: covariance (n, n).
        V: stationary variance in the last image (n,); becomes that in this one.
        expected: see `Expectation`.
        points: see `KEYPOINT` (K,).
        positions: of the key points in the model (K, 3) [m].
        passed: time [s] and motion of the object [m] since the last image.
        depth: predicted [m].
        weights: of the hypotheses (N,).
        responses: of the state to a jump (n, j), see `JumpWatch`.
    """
    (dt, motion), count = passed, len(points)
    displacement, detector_share = np.empty(count), np.empty(count)
    for k in range(count):
        displacement[k] = np.hypot(positions[k, 0] - points[k].rest[0], positions[k, 2] - points[k].rest[2])
    m, after = expect_state(expected, points.offset_variance, displacement)
    growth = find_growth(V, after, count)
    for k in range(count):
        detector_share[k] = points[k].detector_variance / after[SHARED + 2 * k]
    a = find_decay(detector_share, dt, motion, expected.camera_time)
    predict(x, P, a, m, after, growth)
    V[:] = after
    x[:, DEPTH] += depth - (weights * x[:, DEPTH]).sum()
    for response in responses:
        for i in range(len(a)):
            response[i] *= a[i] * growth[i]


@njit(**_OPTIONS)
def predict(x, P, a, m, V, growth):
    """Predict means (N, n) and covariance (n, n) in place.

    Args:
        x: means of the hypotheses (N, n).
        P: covariance (n, n).
        a: see the module (n,); 1 for the depth.
        m: mean to which x returns (n,).
        V: stationary variance after the step (n,).
        growth: ratio of the stationary standard deviations after and before the step (n,).
    """
    n, f = len(P), a * growth
    for i in range(len(x)):
        for j in range(1, n):
            x[i, j] = m[j] + f[j] * (x[i, j] - m[j])
    for i in range(n):
        for j in range(n):
            P[i, j] *= f[i] * f[j]
    for j in range(1, n):
        P[j, j] += (1.0 - a[j] ** 2) * V[j]
        P[DEPTH, j] = P[j, DEPTH] = 0.0
    P[DEPTH, DEPTH] = FREE_DEPTH**2
