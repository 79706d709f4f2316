"""Whether the object touches, and whether the grasp holds still."""

from math import erf, exp, pi, sqrt

import numpy as np
from numpy.typing import NDArray

# A surface that gave way by more [m] is surely bent.
SURELY_BENT = 1e-3
_NEGLIGIBLE = 1e-300
# Probability from which contact is believed, below which it is over, and images in a row below it until then.
_TOUCHES, _RELEASES, RELEASE_IMAGES = 0.93, 0.5, 3
_NOISE = 0.035e-3  # [m], standard deviation of the solver's surface at rest
# A surface that moves by no more than this [m] for so long [s] is held still: no new pose is needed.
_REST_MOTION, _REST_TIME = 0.2e-3, 1.0
# Images over which the restlessness of the surface before contact is learnt, and how much of it is believed.
_NOISE_MEMORY = 150.0
_MOST_NOISE = 3.0
# Images over which a constant error of the pose along x is learnt: from contacts bent by this much [m], and from
# objects that stand in a jaw which is not bent.
_BIAS_MEMORY = 60.0
_TEACHING_BEND = 0.3e-3


def contact_probability(depth: float, depth_stddev: float, bend: float, bend_stddev: float) -> float:
    """Return the probability that an object is in the jaw, given where it seems to be and how far the jaw is bent.

    The true depth u of the object beyond the undeformed surface has the density N(u; depth, depth_stddev), and the
    surface gives way by max(u, 0), seen as `bend` with a normal error. With s = depth_stddev, t = bend_stddev and the
    mean m of u that both ask for:

        P(u > 0) ~ N(bend; depth, s^2 + t^2) Phi(m (s^2 + t^2)^0.5 / (s t)),
        P(u <= 0) ~ N(bend; 0, t^2) Phi(-depth / s).

    Args:
        depth: of the object beyond the undeformed surface as the pose has it, negative before contact [m].
        depth_stddev: its standard deviation [m].
        bend: of the surface where the object is nearest [m].
        bend_stddev: its standard deviation [m].
    """
    s, t = depth_stddev**2, bend_stddev**2
    mean, spread = (depth * t + bend * s) / (s + t), sqrt(s * t / (s + t))
    touches = _normal(bend - depth, sqrt(s + t)) * _below(mean / spread)
    apart = _normal(bend, bend_stddev) * _below(-depth / depth_stddev)
    total = touches + apart
    if total > _NEGLIGIBLE:
        return touches / total
    return 1.0 if bend > 0.5 * abs(depth) or depth > 0.0 else 0.0


def describe_conflict(name: str, gap: float, bend: float) -> str:
    """Return how pose and bend contradict each other, empty where they do not.

    Args:
        name: of the object.
        gap: from the deformed surface to the object along x as the pose has it, far beyond its errors [m].
        bend: of the surface where the object is nearest [m].
    """
    if gap < 0.0:
        return f"this pose puts {name} {-1e3 * gap:.1f} mm into a jaw that is bent by {1e3 * bend:.1f} mm: is it right?"
    if bend < SURELY_BENT:
        return ""
    return f"the jaw is bent, but {name} is {1e3 * gap:.1f} mm away: is its pose right?"


class TouchBelief:
    """Believes in contact at once when it is probable, and in its end after some images without.

    It learns how restless the surface is while nothing touches, and the constant error of the pose along x.
    """

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Start anew, apart."""
        self.touching = False
        self.probability = 0.0
        self._images_apart = 0
        self._noise = _NOISE
        self._bias = 0.0

    def set(self, touching: bool) -> None:
        """Take over what a localizer says itself."""
        self.touching, self.probability, self._images_apart = touching, float(touching), 0

    def update(self, depth: float, depth_stddev: float, bend: float | None) -> bool:
        """Take one image and returns whether the object touches.

        Args:
            depth: of the object beyond the undeformed surface as the pose has it [m].
            depth_stddev: its standard deviation [m].
            bend: of the surface where the object is nearest [m]; None when nobody knows.
        """
        if bend is None:
            self.probability = _below(depth / depth_stddev)
        else:
            self.probability = contact_probability(depth - self._bias, depth_stddev, bend, self._noise)
        if self.probability >= _TOUCHES:
            self.touching = True
        self._images_apart = self._images_apart + 1 if self.probability < _RELEASES else 0
        if self._images_apart >= RELEASE_IMAGES:
            self.touching = False
        if bend is not None:
            self._learn(depth, depth_stddev, bend)
        return self.touching

    def _learn(self, depth: float, depth_stddev: float, bend: float) -> None:
        """Learn how deep [m] the pose has an object that is as deep as the jaw is bent, and the noise of a rest."""
        error = depth - self._bias - bend
        plausible = abs(error) < 3.0 * depth_stddev
        if plausible and (error > 0.0 or self.touching) and (not self.touching or bend > _TEACHING_BEND):
            self._bias += error / _BIAS_MEMORY
        if self.touching:
            return
        square = self._noise**2 + (bend**2 - self._noise**2) / _NOISE_MEMORY
        self._noise = min(max(sqrt(square), _NOISE), _MOST_NOISE * _NOISE)


def _normal(value: float, stddev: float) -> float:
    """Return the density of a normal distribution about zero."""
    return exp(-0.5 * (value / stddev) ** 2) / (sqrt(2.0 * pi) * stddev)


def _below(value: float) -> float:
    """Return the standard normal distribution function."""
    return 0.5 * (1.0 + erf(value / sqrt(2.0)))


class StillnessWatch:
    """Watches the deformed inner face while the object touches."""

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Start anew, moving."""
        self.still = False
        self.ended = -np.inf
        self._since = np.inf
        self._line: NDArray | None = None

    def update(self, stamp: float, line: NDArray | None) -> None:
        """Take the inner face (h, 2) [m] of an image [s] in contact; None without contact or surface."""
        held = self._line is not None and line is not None
        if not held or np.abs(line - self._line).max() > _REST_MOTION:
            if self.still:
                self.ended = stamp
            self._line, self._since = line, stamp
        self.still = line is not None and stamp - self._since >= _REST_TIME
