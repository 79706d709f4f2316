"""Whether the camera has moved against the jaw since the tare: then all key points have moved as a rigid body.

Neither a press nor a release moves the points next to the clamp; a bumped camera, a slipped mount or a wrong pose of
the jaw does. The key points of the last images, less the mean of those before, are explained by

    d_k = J_k y + t + w x (p_k - p),    noise N_k (1 / n + 1 / m) + (a d_k)^2,

with the change y of depth, shape, height, traction ratio, lateral force and moment, each within what a press may do at
once, and a translation t and a turn w of any size. They are significant once

    T = [t w] C^-1 [t w]^T

exceeds what chance gives, C being their covariance. Errors that all points of an image share, as of the pose of the
jaw, are no motion as long as they come back to where they were: T is taken relative to its mean.
"""

from collections import deque

import numpy as np
from numba import njit
from numpy.typing import NDArray

_OPTIONS = {"cache": True, "error_model": "numpy"}
# Images that are compared with the mean of those before, over so many.
_NEWEST, _MEMORY = 10, 30
# What a press may change within those: depth [m], shape, height [m], traction ratio, lateral force [N], moment [N m].
_CHANGES = np.array([3e-3, 0.1, 0.5e-3, 0.5, 1.0, 0.01])
# Error of the linear motion of a key point, as a share of it, and at least [m].
_NONLINEAR, _FLOOR = 0.1, 0.02e-3
# T that neither chance nor errors of the linear motions reach, and the least motion that matters [m].
_SIGNIFICANT, _LEAST_MOTION = 60.0, 0.3e-3
# Below this share of T, and half of that motion, the camera is back.
_BACK = 0.25
# Residuals of so many standard deviations keep a quarter of their weight; fits of the weights.
_GATE, _FITS = 3.0, 3
# Keeps a rigid motion that nothing shows finite.
_UNKNOWN = 1e-3
_FEWEST = 6
# Key points whose median distance from the mean is longer are those of something else [m].
_FARTHEST = 10e-3
# A key point so far from its mean is a gross error [m]; each makes the mean count by so much less.
_GROSS, _FADED = 6e-3, 0.8


class CameraWatch:
    """Watches the key points of one jaw.

    Attributes:
        motion: root mean square of the key points' rigid motion [m]; zero while there is none.
    """

    def __init__(self, keypoints: NDArray) -> None:
        """Keep the key points at rest (K, 3) [m]."""
        self._arms = keypoints - keypoints.mean(axis=0)
        self.reset()

    def reset(self) -> None:
        """Forget what was seen."""
        self.motion = 0.0
        self._newest: deque[NDArray] = deque(maxlen=_NEWEST)
        self._mean, self._count = np.zeros(self._arms.shape), np.zeros(len(self._arms))
        self._usual = 1.0

    def update(self, points: NDArray, noise: NDArray, motions: NDArray) -> bool:
        """Take one image; return whether the camera has moved.

        Args:
            points: (K, 3) [m], NaN where unused.
            noise: covariance of each in an image (K, 3, 3) [m^2].
            motions: derivatives of the key points by what a press changes (K, 3, 6), see the module.
        """
        if self._count.max() >= _NEWEST and _measure_distance(points, self._mean) > _FARTHEST:
            return False  # no image of this jaw
        if len(self._newest) == _NEWEST and not self.motion:
            _average(self._newest[0], self._mean, self._count)
        self._newest.append(points)
        if self._count.max() < _NEWEST:
            return False
        change, known = _compare(np.stack(tuple(self._newest)), self._mean, self._count)
        significance, moved = _fit_motion(change, known, self._count, noise, motions, self._arms)
        if self.motion:
            is_back = significance < _BACK * _SIGNIFICANT * self._usual and moved < 0.5 * _LEAST_MOTION
            self.motion = 0.0 if is_back else max(moved, _LEAST_MOTION)
        elif significance > _SIGNIFICANT * self._usual and moved > _LEAST_MOTION:
            self.motion = moved
        else:
            self._usual += (max(1.0, significance / motions.shape[2]) - self._usual) / _MEMORY
        return self.motion > 0.0


def _measure_distance(points: NDArray, mean: NDArray) -> float:
    """Return the median distance [m] of key points (K, 3) [m] from their means; infinite without any."""
    distances = np.linalg.norm(points - mean, axis=1)
    distances = distances[np.isfinite(distances)]
    return float(np.median(distances)) if len(distances) else np.inf


@njit(**_OPTIONS)
def _average(points, mean, count):
    """Take the key points (K, 3) of an image into the means, of at most `_MEMORY` images; gross errors fade them."""
    for k in range(len(points)):
        if np.isnan(points[k, 0]):
            continue
        if count[k] >= 1.0 and ((points[k] - mean[k]) ** 2).sum() > _GROSS**2:
            count[k] *= _FADED
            continue
        count[k] = min(count[k] + 1.0, _MEMORY)
        mean[k] += (points[k] - mean[k]) / count[k]


@njit(**_OPTIONS)
def _compare(newest, mean, count):
    """Return the median of the newest images (n, K, 3) less the mean before (K, 3), and how many show a point."""
    change, known = np.zeros(mean.shape), np.zeros(len(mean))
    for k in range(len(mean)):
        seen = newest[np.isfinite(newest[:, k, 0]), k]
        if not len(seen) or count[k] < 2.0:
            continue
        known[k] = len(seen)
        for a in range(3):
            change[k, a] = np.median(seen[:, a]) - mean[k, a]
    return change, known


@njit(**_OPTIONS)
def _fit_motion(change, known, count, noise, motions, arms):
    """Return T and the root mean square [m] of the rigid motion that explains changes (K, 3) best."""
    points, bends = len(change), motions.shape[2]
    size, weights = bends + 6, np.ones(points)
    rows, precision = _write_rows(motions, arms), np.zeros((points, 3, 3))
    for k in range(points):
        weights[k] = min(known[k], 1.0)
        if weights[k] > 0.0:
            covariance = noise[k] * (1.0 / known[k] + 1.0 / count[k])
            for a in range(3):
                covariance[a, a] += _NONLINEAR**2 * (change[k] ** 2).sum() + _FLOOR**2
            precision[k] = np.linalg.inv(covariance)
    if weights.sum() < _FEWEST:
        return 0.0, 0.0
    found, A = np.zeros(size), np.zeros((size, size))
    for _ in range(_FITS):
        A[:], right = 0.0, np.zeros(size)
        for i in range(size):
            A[i, i] = 1.0 / _CHANGES[i] ** 2 if i < bends else _UNKNOWN
        for k in range(points):
            weighed = weights[k] * (rows[k].T @ precision[k])
            A += weighed @ rows[k]
            right += weighed @ change[k]
        found = np.linalg.solve(A, right)
        for k in range(points):
            left = change[k] - rows[k] @ found
            weights[k] = min(known[k], 1.0) / (1.0 + (left @ precision[k] @ left) / _GATE**2) ** 2
    rigid, moved = found.copy(), 0.0
    rigid[:bends] = 0.0
    for k in range(points):
        moved += ((rows[k] @ rigid) ** 2).sum()
    spread = np.ascontiguousarray(np.linalg.inv(A)[bends:, bends:])
    return found[bends:] @ np.linalg.solve(spread, found[bends:]), np.sqrt(moved / points)


@njit(**_OPTIONS)
def _write_rows(motions, arms):
    """Return the derivatives of the key points by what a press changes and by a rigid motion (K, 3, 12)."""
    points, bends = len(motions), motions.shape[2]
    rows = np.zeros((points, 3, bends + 6))
    for k in range(points):
        x, y, z = arms[k]
        for a in range(3):
            rows[k, a, :bends] = motions[k, a]
            rows[k, a, bends + a] = 1.0
        rows[k, 0, bends + 4], rows[k, 0, bends + 5] = z, -y
        rows[k, 1, bends + 3], rows[k, 1, bends + 5] = -z, x
        rows[k, 2, bends + 3], rows[k, 2, bends + 4] = y, -x
    return rows
