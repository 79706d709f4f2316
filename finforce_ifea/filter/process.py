"""Process model: how the state changes from one image to the next.

The depth may be any in each image; `finforce.kalman.Track` smooths it afterwards. All other entries are first-order
Gauss-Markov processes about what is expected of them,

    x <- m + a (x - m) + w,    Var w = (1 - a^2) V,    a = exp(-dt / T - |delta| / L),

with the motion delta of the object, so that a prior counts once and never again.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from finforce_ifea.filter.state import (
    APPARENT,
    CAMERA,
    DEPTH,
    HEIGHT,
    SHAPE,
    TRACTION,
    offset_entries,
    relative_entries,
)

_OPTIONS = {"cache": True, "error_model": "numpy"}

# 1 sigma of the depth in an image before it is seen [m]: wider than any motion between two images.
FREE_DEPTH = 2e-3
# Time over which the error of an object's pose stays the same [s]; trackers see an object from one side.
OBJECT_TIME = 10.0
# Error of the mechanics at a key point, 1 sigma: constant [m], of a shape [-], and of all shapes [-], the last two
# relative to the displacement: the default mesh is within 1 % of an independent program.
MODEL_FLOOR = 0.02e-3
MODEL_SHAPE = 0.004
MODEL_RELATIVE = 0.01
# Motion [m] and time [s] over which such an error stays the same.
MODEL_LENGTH = 10e-3
MODEL_TIME = 60.0
# Time over which the relative error stays the same [s].
RELATIVE_TIME = 200.0
# 1 sigma of the traction ratio beyond friction: at least [-], and relative to the coefficient of friction.
TRACTION_FLOOR = 0.04
TRACTION_SHARE = 0.15
# Motion over which it stays the same [m].
TRACTION_LENGTH = 2e-3
# 1 sigma of the traction ratio that errors of the mechanics look like [-], and the time over which it stays [s].
APPARENT_TRACTION = 0.2
APPARENT_TIME = 10.0
# 1 sigma of the shift [m] and turn [rad] of a camera that nobody touches, and the time over which they stay [s].
CAMERA_SHIFT = 0.02e-3
CAMERA_TURN_STDDEV = 0.3e-3
CAMERA_TIME = 20.0
# Time over which a bumped camera stays where it is [s].
BUMPED_TIME = 1e4


def expect_state(
    size: int,
    mean: NDArray,
    variance: NDArray,
    offset_variance: NDArray,
    displacement: NDArray,
    traction_variance: float,
    camera_variance: NDArray,
) -> tuple[NDArray, NDArray]:
    """Return mean m (n,) and variance V (n,) to which the state returns.

    Args:
        size: n.
        mean: of shape and height (2,).
        variance: of both (2,).
        offset_variance: of the key points' offsets (K,) [m^2].
        displacement: of the key points (K,) [m].
        traction_variance: of the traction ratio beyond friction.
        camera_variance: of the camera's motion (3,).
    """
    m, V, count = np.zeros(size), np.zeros(size), len(displacement)
    m[SHAPE], m[HEIGHT] = mean
    V[SHAPE], V[HEIGHT] = variance
    V[TRACTION], V[APPARENT] = traction_variance, APPARENT_TRACTION**2
    V[CAMERA] = camera_variance
    V[offset_entries(count)] = np.repeat(offset_variance + MODEL_FLOOR**2 + (MODEL_SHAPE * displacement) ** 2, 2)
    V[relative_entries(count)] = MODEL_RELATIVE**2
    return m, V


def find_decay(size: int, keypoints: int, dt: float, motion: float, *, bumped: bool) -> NDArray:
    """Return a (n,) after a time dt [s] and a motion of the object [m]; `bumped` after the camera was."""
    a = np.ones(size)
    a[[SHAPE, HEIGHT]] = np.exp(-dt / OBJECT_TIME)
    a[TRACTION] = np.exp(-motion / TRACTION_LENGTH - dt / MODEL_TIME)
    a[APPARENT] = np.exp(-dt / APPARENT_TIME)
    a[CAMERA] = np.exp(-dt / (BUMPED_TIME if bumped else CAMERA_TIME))
    a[offset_entries(keypoints)] = np.exp(-motion / MODEL_LENGTH - dt / MODEL_TIME)
    a[relative_entries(keypoints)] = np.exp(-dt / RELATIVE_TIME)
    return a


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
