"""Whether a held object slides: its surface against the jaw's where they touch.

Where the jaws come to rest on an object, one of its points and the point of the jaw at the same place are remembered.
What they move against each other along the face is slip. Its speed is the slope of the last samples. That an object
slides is said once their way from where they rested is no chance (a cumulative sum: every sample adds what it is off
beyond one standard deviation, at most two more, until the sum is above 4.5).
"""

from collections import deque
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from finforce_contact.parameters import ContactSettings

# The cumulative sum: what is chance of one sample, the most that one may count for, and where it becomes an alarm.
_CHANCE, _MOST, _ALARM = 1.0, 3.0, 4.5
# Samples over which the place of rest is averaged, time over which a speed is fitted [s], and fewest samples of it.
_REST_MEMORY, _WINDOW, _FEWEST = 45.0, 0.2, 3
# Noise is learnt over so many samples; what is expected of it counts for some; before it is learnt, nothing slides.
_NOISE_MEMORY, _NOISE_PRIOR, _TOO_FEW = 60.0, 1.0, 16.0
# Slow samples in a row, after which an object that slid has come to rest.
_RESTING = 6
# A jaw that moves along its normal faster than this [m/s] closes or opens: what slides there is no slip of a hold.
_CLOSING = 1.5e-3
# An odd pose that is farther than this [m] from the last one is wrong.
_FAR = 2e-3
# A contact that wanders by more than this [m] is followed anew.
_REACH = 8e-3
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
        self._noise, self._learnt = self._settings.pose_noise, _NOISE_PRIOR
        self.release()

    def release(self) -> None:
        """Take the object for let go; what is known of the noise stays."""
        self.slip: Slip | None = None
        self._height: float | None = None
        self._on_object: NDArray | None = None
        self._samples: deque[tuple[float, NDArray, float]] = deque()

    def place(self, height: float) -> float:
        """Return the material height [m] that is followed: that at which the contact began, near `height`."""
        if self._height is None or abs(self._height - height) > _REACH:
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
        away = T[:3, :3] @ self._on_object + T[:3, 3] - face.point
        offset = np.array([away @ face.tangent, away[1]])
        if odd and self._samples and np.abs(offset - self._samples[-1][1]).max() > _FAR:
            return self.slip
        if self._samples:
            change = (offset - self._samples[-1][1]) / np.sqrt(2.0)
            square = min(float(change @ change) / 2.0, (_MOST * self._noise) ** 2)
            self._learnt = min(self._learnt + 1.0, _NOISE_MEMORY)
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
        self._count = min(self._count + 1.0, _REST_MEMORY)
        self._rest = self._rest + (offset - self._rest) / self._count
