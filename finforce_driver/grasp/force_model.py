"""The grasp force as a line over the opening, learnt while closing.

Between two images the opening changes by d (closing: d > 0) and the force by k d, where neither stays what it was:
fingers relax, contact spreads. A Kalman filter follows both,

    F <- F + k d,   k <- k,   Q_FF = drift^2 dt + (k s_d)^2,   Q_kk = growth^2 |d|,

with the variance s_d^2 of d, and measures F with a noise that it learns from its innovations.
"""

from __future__ import annotations

import math

LEAST_STIFFNESS = 50.0  # [N/m] a jaw that gives way more than this holds nothing

# Fingers of TPU lose up to 0.3 N/s just after a press of 5 N; half of that per sqrt(s) follows them within 0.3 s.
_DRIFT = 0.15  # [N/sqrt(s)]
# A finger stiffens from 0.4 to 1.3 N/mm within 5 mm.
_GROWTH = 9e3  # [N/m per sqrt(m)], 0.28 N/mm after one millimetre
_NOISE_MEMORY = 0.05  # share of a new innovation
_LEAST_NOISE, _LARGEST_NOISE = 0.02, 0.25  # [N]


class ForceModel:
    """What force the fingers have at the opening of the newest image, and how it would change with the opening.

    Args:
        stiffness: expected at first [N/m], better too large than too small.
        noise: standard deviation of the force expected at first [N].

    Attributes:
        force: [N] at `opening`.
        stiffness: change of the force per metre of closing [N/m].
        noise: standard deviation of one measured force [N], as learnt.
        opening: of the newest image [m]; NaN before the first.
    """

    def __init__(self, *, stiffness: float, noise: float) -> None:
        self.force = self.stamp = self.opening = math.nan
        self.stiffness = stiffness
        self._noise_variance = noise**2
        self._force_variance = noise**2
        self._stiffness_variance = (0.5 * stiffness) ** 2
        self._covariance = 0.0

    @property
    def noise(self) -> float:
        """Standard deviation of one measured force [N]."""
        return math.sqrt(self._noise_variance)

    @property
    def force_stddev(self) -> float:
        """Standard deviation of `force` [N]."""
        return math.sqrt(self._force_variance)

    @property
    def stiffness_stddev(self) -> float:
        """Standard deviation of `stiffness` [N/m]."""
        return math.sqrt(self._stiffness_variance)

    @property
    def safe_stiffness(self) -> float:
        """A stiffness that is hardly exceeded on the way to come [N/m]: two deviations and a tenth more."""
        return 1.1 * self.stiffness + 2.0 * self.stiffness_stddev

    @property
    def likely_stiffness(self) -> float:
        """A stiffness that a single step hardly exceeds [N/m]: a quarter of a deviation and a twentieth more."""
        return 1.05 * self.stiffness + 0.25 * self.stiffness_stddev

    def begin(self, opening: float, force: float, stamp: float) -> None:
        """Start from the force [N] of an image at `stamp` [s] and its opening [m]."""
        self.opening, self.force, self.stamp = opening, force, stamp
        self._force_variance = self._noise_variance

    def predict(self, opening: float) -> float:
        """Return the force [N] at another opening [m], never below zero."""
        return max(0.0, self.force + self.stiffness * (self.opening - opening))

    def surprise(self, opening: float, force: float) -> float:
        """Return by how much a force [N] differs from the predicted one beyond four standard deviations [N], signed."""
        way = self.opening - opening
        spread = self._force_variance + way**2 * self._stiffness_variance + self._noise_variance
        beyond = force - self.predict(opening)
        return math.copysign(max(0.0, abs(beyond) - 4.0 * math.sqrt(spread)), beyond)

    def update(self, opening: float, force: float, stamp: float, way_stddev: float) -> None:
        """Take the force [N] of a later image at `stamp` [s].

        Args:
            opening: at the time of the image [m].
            force: measured [N].
            stamp: time of the image [s].
            way_stddev: standard deviation of the change of the opening since the last image [m].
        """
        way, dt = self.opening - opening, max(0.0, stamp - self.stamp)
        forces, mixed, stiffnesses = self._force_variance, self._covariance, self._stiffness_variance
        forces += 2.0 * way * mixed + way**2 * stiffnesses + _DRIFT**2 * dt + (self.stiffness * way_stddev) ** 2
        mixed += way * stiffnesses
        stiffnesses += _GROWTH**2 * abs(way)
        innovation = force - (self.force + self.stiffness * way)
        self._learn_noise(innovation, forces)
        total = forces + self._noise_variance
        self.force += self.stiffness * way + forces / total * innovation
        self.stiffness = max(LEAST_STIFFNESS, self.stiffness + mixed / total * innovation)
        self._stiffness_variance = stiffnesses - mixed**2 / total
        self._covariance = mixed * (1.0 - forces / total)
        self._force_variance = forces * (1.0 - forces / total)
        self.opening, self.stamp = opening, stamp

    def _learn_noise(self, innovation: float, expected: float) -> None:
        """Move the noise towards what an innovation [N] leaves beyond its expected variance [N^2]."""
        seen = min(max(innovation**2 - expected, _LEAST_NOISE**2), _LARGEST_NOISE**2)
        self._noise_variance += _NOISE_MEMORY * (seen - self._noise_variance)
