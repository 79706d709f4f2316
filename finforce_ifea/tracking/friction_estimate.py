"""How rough an object is, told by the way that the key points differ between loading and unloading.

What is left of the key points' residuals at the expected place is explained by

    shape and height of the object, as far as they may differ from what was expected,
    mu m,  m the lean of the forces that the history of the contact predicts for a coefficient of one,
    b,     a lean that the mechanics or the calibration err by, whatever the motion,
    c,     a tangential force that errors of the tare look like,

with the depth of each frame free. m changes its sign when the motion does, b and c do not: loops tell mu from them.
What goes with m in the residuals without being a lean is no chance that frames average out: where it is larger than
chance would leave it, those frames say less by as much. Either the object is as smooth as those that the finger was
calibrated on, or mu is anything about the expected one.
"""

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from finforce.elimination import eliminate
from finforce_ifea.settings import EstimatorSettings
from finforce_ifea.tracking.place_update import Residuals

_OPTIONS = {"cache": True, "error_model": "numpy"}
# Standard deviations of b [-] and c [N].
_LEAN_ERROR, _FORCE_ERROR = 0.07, 0.1
# The errors of successive frames are not independent: so many count for one. Beyond this many frames old ones fade.
_ALIKE, _MEMORY = 3.0, 3000.0
_LARGEST = 1.5


class Coefficient(NamedTuple):
    """A coefficient of friction and its standard deviation."""

    mean: float
    stddev: float


# Of objects that show no friction, where no calibration says more.
SMOOTH = Coefficient(0.0, 0.02)


class FrictionFrame(NamedTuple):
    """What one frame may say of friction.

    Attributes:
        data: residuals about the reference place.
        modes: of the key points by the place and a lean of the force (K, 2, 4).
        normal: force [N].
        mobilised: how far friction is made use of, from -1 to 1.
        lean: of the force, with which the residuals were found [-].
        moved: the place that was found minus the reference (3,).
        away: shape and height that were found minus the expected ones (2,).
    """

    data: Residuals
    modes: NDArray
    normal: float
    mobilised: float
    lean: float
    moved: NDArray
    away: NDArray


class _Means(NamedTuple):
    """What goes with m in the frames, as regressions on it.

    Attributes:
        left: residuals (K, 2) [m].
        rows: their derivatives by depth, shape, height, mu, b and c (K, 6, 2).
        counts: sum of m^2 over the frames (K,).
        noise: of the key points in a frame (K, 2, 2) [m^2].
    """

    left: NDArray
    rows: NDArray
    counts: NDArray
    noise: NDArray


class FrictionEstimate:
    """Learns the coefficient of friction of one object.

    Attributes:
        coefficient: of friction, as far as it is known.
    """

    def __init__(self, settings: EstimatorSettings, smooth: Coefficient = SMOOTH) -> None:
        """Keeps what is expected of objects, that of those of the calibration included."""
        self._rough = Coefficient(settings.friction, settings.friction_stddev)
        self._smooth, self._share = smooth, settings.smooth_share
        self.reset()

    def reset(self) -> None:
        """Starts with an object of which nothing is known."""
        self._information, self._vector = np.zeros((5, 5)), np.zeros(5)
        self._means: _Means | None = None
        self._prior = np.ones(2)
        self.coefficient = self._judge(np.inf, 0.0)

    def update(self, frame: "FrictionFrame", prior: NDArray) -> Coefficient:
        """Takes one frame and returns the coefficient; `prior` is the variance of shape and height (2,)."""
        self._prior = prior
        count = len(frame.data.weights)
        if self._means is None or len(self._means.counts) != count:
            self._means = _Means(
                np.zeros((count, 2)), np.zeros((count, 6, 2)), np.zeros(count), np.zeros((count, 2, 2))
            )
        _accumulate(frame, self._information, self._vector, self._means)
        self.coefficient = self._judge(*self._see())
        return self.coefficient

    def _see(self) -> tuple[float, float]:
        """Returns variance and mean of the coefficient by the key points alone."""
        variance, mean, found = _solve(self._information, self._vector, self._prior)
        if self._means is None or not np.isfinite(variance):
            return variance, mean
        return variance * _find_excess(self._means, found), mean

    @property
    def seen(self) -> Coefficient:
        """What the key points alone say of the coefficient; its deviation is infinite where they say nothing."""
        variance, mean = self._see()
        return Coefficient(mean, float(np.sqrt(variance)))

    def _judge(self, variance: float, mean: float) -> Coefficient:
        """Returns the coefficient for what the key points alone say of it."""
        smooth, rough = (*self._smooth, self._share), (*self._rough, 1.0 - self._share)
        return Coefficient(*_judge(variance, mean, smooth, rough))


@njit(**_OPTIONS)
def _judge(variance, mean, smooth, rough):
    """Returns mean and standard deviation for two hypotheses (mean, standard deviation, probability)."""
    total, first, second = 0.0, 0.0, 0.0
    for expected, deviation, share in (smooth, rough):
        own = max(deviation, 1e-6) ** 2
        weight, middle, spread = share, expected, own
        if np.isfinite(variance):
            both = own + variance
            weight = share * np.exp(-0.5 * min((mean - expected) ** 2 / both, 1e3)) / np.sqrt(both) + 1e-300
            middle, spread = (expected * variance + mean * own) / both, own * variance / both
        middle = min(max(middle, 0.0), _LARGEST)
        total += weight
        first += weight * middle
        second += weight * (spread + middle * middle)
    first /= total
    return first, np.sqrt(max(second / total - first * first, 0.0))


@njit(**_OPTIONS)
def _explain(frame, k, row, left):
    """Fills in the derivatives (6, 2) of key point k by depth, shape, height, mu, b and c, and what is left to them."""
    data, modes, normal, mobilised, lean, moved, away = frame
    for a in range(2):
        leaning = modes[k, a, 3]
        row[0, a], row[1, a], row[2, a] = modes[k, a, 0], modes[k, a, 1], modes[k, a, 2]
        row[3, a], row[4, a], row[5, a] = mobilised * leaning, leaning, leaning / normal
        left[a] = data.r[k, a] + leaning * lean - row[0, a] * moved[0]
        left[a] += row[1, a] * (away[0] - moved[1]) + row[2, a] * (away[1] - moved[2])


@njit(**_OPTIONS)
def _accumulate(frame, information, vector, means):
    """Adds one frame, its depth eliminated, to information (5, 5) and vector (5,) on shape, height, mu, b and c."""
    data = frame.data
    A, g = np.zeros((6, 6)), np.zeros(6)
    row, left = np.zeros((6, 2)), np.zeros(2)
    for k in range(len(data.weights)):
        w = data.weights[k]
        if w <= 0.0:
            continue
        n00, n11, n01 = data.noise[k, 0, 0], data.noise[k, 1, 1], data.noise[k, 0, 1]
        det = n00 * n11 - n01 * n01
        p00, p11, p01 = w * n11 / det, w * n00 / det, -w * n01 / det
        _explain(frame, k, row, left)
        _remember(means, k, w, frame.mobilised, left, row, data.noise)
        for i in range(6):
            q0, q1 = p00 * row[i, 0] + p01 * row[i, 1], p01 * row[i, 0] + p11 * row[i, 1]
            g[i] += q0 * left[0] + q1 * left[1]
            for j in range(6):
                A[i, j] += q0 * row[j, 0] + q1 * row[j, 1]
    if not A[0, 0] > 0.0:
        return
    for i in range(5):
        vector[i] = (1.0 - 1.0 / _MEMORY) * vector[i] + (g[i + 1] - A[i + 1, 0] * g[0] / A[0, 0]) / _ALIKE
        for j in range(5):
            added = (A[i + 1, j + 1] - A[i + 1, 0] * A[0, j + 1] / A[0, 0]) / _ALIKE
            information[i, j] = (1.0 - 1.0 / _MEMORY) * information[i, j] + added


@njit(**_OPTIONS)
def _remember(means, k, weight, m, left, row, noise):
    """Takes what is left (2,) to key point k and its derivatives (6, 2) into the means, as far as they go with m."""
    means.counts[k] = (1.0 - 1.0 / _MEMORY) * means.counts[k] + weight * m * m
    if not means.counts[k] > 0.0:
        return
    share = weight * m / means.counts[k]
    for a in range(2):
        means.left[k, a] += share * (left[a] - m * means.left[k, a])
        for i in range(6):
            means.rows[k, i, a] += share * (row[i, a] - m * means.rows[k, i, a])
        for b in range(2):
            means.noise[k, a, b] += m * share * (noise[k, a, b] - means.noise[k, a, b])


@njit(**_OPTIONS)
def _solve(information, vector, prior):
    """Returns variance and mean of mu by the key points alone, infinite where they say nothing, and all unknowns."""
    A = information.copy()
    A[0, 0] += 1.0 / prior[0]
    A[1, 1] += 1.0 / prior[1]
    A[3, 3] += 1.0 / _LEAN_ERROR**2
    A[4, 4] += 1.0 / _FORCE_ERROR**2
    others = (0, 1, 3, 4)
    B, known = np.empty((4, 4)), np.empty((4, 2))
    for i in range(4):
        known[i, 0], known[i, 1] = vector[others[i]], A[2, others[i]]
        for j in range(4):
            B[i, j] = A[others[i], others[j]]
    eliminate(B, known)
    left, rest, found = A[2, 2], vector[2], np.zeros(5)
    for i in range(4):
        left -= A[2, others[i]] * known[i, 1]
        rest -= A[2, others[i]] * known[i, 0]
    if not left > 1e-9:
        return np.inf, 0.0, found
    found[2] = rest / left
    for i in range(4):
        found[others[i]] = known[i, 0] - known[i, 1] * found[2]
    return 1.0 / left, found[2], found


@njit(**_OPTIONS)
def _find_excess(means, found):
    """Returns how much larger what goes with m is than chance would leave it, squared, at least 1.

    They are those that the unknowns (5,) and one common depth leave, over their standard deviations.
    """
    count, unknown, rest = 0, 6, np.zeros(2)
    top, low = 0.0, 0.0
    for turn in range(2):
        depth = top / low if turn else 0.0
        square = 0.0
        for k in range(len(means.counts)):
            if means.counts[k] < 1.0:
                continue
            for a in range(2):
                rest[a] = means.left[k, a] - means.rows[k, 0, a] * depth
                for i in range(5):
                    rest[a] -= means.rows[k, i + 1, a] * found[i]
            noise, number = means.noise[k], means.counts[k] / _ALIKE
            det = (noise[0, 0] * noise[1, 1] - noise[0, 1] ** 2) / number
            h0, h1 = means.rows[k, 0, 0], means.rows[k, 0, 1]
            p0, p1 = noise[1, 1] * rest[0] - noise[0, 1] * rest[1], noise[0, 0] * rest[1] - noise[0, 1] * rest[0]
            if turn:
                square += (rest[0] * p0 + rest[1] * p1) / det
                count += 2
            else:
                top += (h0 * p0 + h1 * p1) / det
                low += (h0 * h0 * noise[1, 1] - 2.0 * h0 * h1 * noise[0, 1] + h1 * h1 * noise[0, 0]) / det
        if not low > 0.0:
            return 1.0
    return max(1.0, square / max(count - unknown, 1))
