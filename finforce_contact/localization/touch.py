"""Whether the object touches, whether the grasp holds still, and whether the object slides.

Where the jaws come to rest on an object, one of its points and the point of the jaw at the same place are remembered.
What they move against each other along the face is slip. Its speed is the slope of the last samples. That an object
slides is said once their way from where they rested is no chance (a cumulative sum: every sample adds what it is off
beyond one standard deviation, at most two more, until the sum is above 4.5).
"""

from collections import deque
from dataclasses import dataclass
from math import erf, exp, pi, sqrt

import numpy as np
from numpy.typing import NDArray

from finforce_contact.parameters import ContactSettings

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


# The cumulative sum: what is chance of one sample, the most that one may count for, and where it becomes an alarm.
_CHANCE, _MOST, _ALARM = 1.0, 3.0, 4.5
# Samples over which the place of rest is averaged, time over which a speed is fitted [s], and fewest samples of it.
_REST_SAMPLES, _WINDOW, _FEWEST = 45.0, 0.2, 3
# Noise is learnt over so many samples; what is expected of it counts for some; before it is learnt, nothing slides.
_SLIP_MEMORY, _SLIP_PRIOR, _TOO_FEW = 60.0, 1.0, 16.0
# Slow samples in a row, after which an object that slid has come to rest.
_RESTING = 6
# A jaw that moves along its normal faster than this [m/s] closes or opens: what slides there is no slip of a hold.
_CLOSING = 1.5e-3
# An odd pose that is farther than this [m] from the last one is wrong.
_FAR = 2e-3
# A contact that wanders by more than this [m] is followed anew.
_WANDERED = 8e-3
# A gap between samples that begins anew [s].
_LONGEST_GAP = 0.5


@dataclass(frozen=True, kw_only=True, eq=False)
class Slip:
    """How an object moves over a jaw.

    Attributes:
        stamp: of the newest pose [s].
        velocity: of the object's surface over the jaw's where they touch (3,) [m/s], jaw frame.
        stddev: of its tangential parts [m/s].
        sliding: whether a held object slides beyond chance.
    """

    stamp: float
    velocity: NDArray
    stddev: float
    sliding: bool


@dataclass(frozen=True, kw_only=True, eq=False)
class TouchedFace:
    """The deformed inner face where an object touches.

    Attributes:
        point: (3,) [m], jaw frame.
        tangent: unit vector along the finger (3,).
    """

    point: NDArray
    tangent: NDArray


def face_at(line: NDArray, heights: NDArray, height: float) -> TouchedFace:
    """Return the face at a material height [m] of a deformed line (h, 2) [m] over heights (h,) [m]."""
    x, z = np.interp(height, heights, line[:, 0]), np.interp(height, heights, line[:, 1])
    row = int(np.clip(np.searchsorted(heights, height), 2, len(heights) - 3))
    along = line[row + 2] - line[row - 2]
    along = along / max(float(np.hypot(*along)), 1e-12)
    return TouchedFace(point=np.array([x, 0.0, z]), tangent=np.array([along[0], 0.0, along[1]]))


class SlipWatch:
    """Follows one contact, pose after pose."""

    def __init__(self, settings: ContactSettings) -> None:
        """Keep the noise that is expected of poses."""
        self._settings = settings
        self.reset()

    def reset(self) -> None:
        """Forget the contact."""
        self._noise, self._learnt = self._settings.pose_noise, _SLIP_PRIOR
        self.release()

    def release(self) -> None:
        """Take the object for let go; what is known of the noise stays."""
        self.slip: Slip | None = None
        self._height: float | None = None
        self._on_object: NDArray | None = None
        self._samples: deque[tuple[float, NDArray, float]] = deque()

    def follow(self, height: float) -> float:
        """Return the material height [m] that is followed: that at which the contact began, near `height`."""
        if self._height is None or abs(self._height - height) > _WANDERED:
            self._height, self._on_object = height, None
        return self._height

    def update(self, stamp: float, T: NDArray, face: TouchedFace, *, odd: bool = False) -> Slip | None:
        """Take a pose and the face where the object touches.

        The first poses of a slip are odd to who has seen the object rest: they count, unless they are far away.

        Args:
            stamp: of the pose [s].
            T: T_jaw_object (4, 4), as measured.
            face: at the followed height.
            odd: whether the pose is not that of an object that goes on as it did.
        """
        if odd and not self._samples:
            return self.slip
        if self._on_object is None or not self._samples or not 0.0 < stamp - self._samples[-1][0] < _LONGEST_GAP:
            self._begin(T, face)
        apart = T[:3, :3] @ self._on_object + T[:3, 3] - face.point
        offset = np.array([apart @ face.tangent, apart[1]])
        if odd and self._samples and np.abs(offset - self._samples[-1][1]).max() > _FAR:
            return self.slip
        if self._samples:
            change = (offset - self._samples[-1][1]) / np.sqrt(2.0)
            square = min(float(change @ change) / 2.0, (_MOST * self._noise) ** 2)
            self._learnt = min(self._learnt + 1.0, _SLIP_MEMORY)
            self._noise = float(np.sqrt(self._noise**2 + (square - self._noise**2) / self._learnt))
        self._samples.append((stamp, offset, float(face.point[0])))
        while stamp - self._samples[0][0] > _WINDOW and len(self._samples) > _FEWEST:
            self._samples.popleft()
        speed, stddev, closing = self._fit_speed()
        self._judge(offset, speed, stddev, closing)
        velocity = speed[0] * face.tangent + np.array([0.0, speed[1], 0.0])
        self.slip = Slip(stamp=stamp, velocity=velocity, stddev=stddev, sliding=self._sliding)
        return self.slip

    def _begin(self, T: NDArray, face: TouchedFace) -> None:
        """Remembers what touches, the offset of which is zero here."""
        self._on_object = T[:3, :3].T @ (face.point - T[:3, 3])
        self._samples.clear()
        self._rest, self._count = np.zeros(2), 0.0
        self._above, self._below, self._sliding, self._slow = np.zeros(2), np.zeros(2), False, 0

    def _fit_speed(self) -> tuple[NDArray, float, float]:
        """Return the slope of the last samples (2,), its standard deviation, and the speed of the face along x."""
        if len(self._samples) < _FEWEST:
            return np.zeros(2), np.inf, 0.0
        stamps = np.array([sample[0] for sample in self._samples])
        times = stamps - stamps.mean()
        spread = float(times @ times)
        slopes = times @ np.array([sample[1] for sample in self._samples]) / spread
        closing = float(times @ np.array([sample[2] for sample in self._samples]) / spread)
        return slopes, self._noise / np.sqrt(spread), closing

    def _judge(self, offset: NDArray, speed: NDArray, stddev: float, closing: float) -> None:
        """Decide whether the object slides."""
        if abs(closing) > _CLOSING or self._learnt < _TOO_FEW:
            self._rest, self._count = offset.copy(), 1.0
            self._above[:] = self._below[:] = 0.0
            self._sliding = False
            return
        off = np.clip((offset - self._rest) / self._noise, -_MOST, _MOST)
        self._above = np.maximum(0.0, self._above + off - _CHANCE)
        self._below = np.maximum(0.0, self._below - off - _CHANCE)
        fast = float(np.hypot(*speed)) > max(self._settings.slip_speed, 2.0 * stddev)
        self._slow = 0 if fast else self._slow + 1
        if max(self._above.max(), self._below.max()) > _ALARM:
            self._sliding = fast or self._sliding
            if self._slow >= _RESTING:  # it has come to rest elsewhere
                self._rest, self._count, self._sliding = offset.copy(), 1.0, False
                self._above[:] = self._below[:] = 0.0
            return
        self._sliding = False
        self._count = min(self._count + 1.0, _REST_SAMPLES)
        self._rest = self._rest + (offset - self._rest) / self._count
