"""Slip of a held object over a jaw, by its poses.

Where jaw and object begin to touch, one point of the object is remembered. Its motion along the face, in the jaw frame,
is slip; its speed is the slope of the last samples. The object slides once its distance from where it rested exceeds
chance (a cumulative sum: every sample adds what it is off beyond one standard deviation, at most two more, until the
sum is above 4.5).
"""

from collections import deque
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from finforce_contact.parameters import ContactSettings

# CUSUM test for slip, in units of the sample's standard deviation.
_CHANCE = 1.0  # [sigma], allowance of each sample
_MOST = 3.0  # [sigma], largest contribution of one sample
_ALARM = 4.5  # [sigma], threshold of the sum
_REST_SAMPLES = 45.0  # samples over which the position of rest is averaged
_WINDOW = 0.2  # [s], over which a speed is fitted
_FEWEST = 3  # least samples of a speed
_SLIP_MEMORY = 60.0  # samples over which noise is learnt
_SLIP_PRIOR = 1.0  # samples that the expected noise counts for
_TOO_FEW = 16.0  # samples before which no slip is reported
# Slow samples in a row, after which an object that slid has come to rest.
_RESTING = 6
# A jaw closes or opens where the object moves along x faster than this [m/s] and than along the face: what slides there
# is no slip of a hold.
_CLOSING = 1.5e-3
# An odd pose that is farther than this [m] from the last one is wrong.
_FAR = 2e-3
# A contact that wanders by more than this [m] is followed anew.
_WANDERED = 8e-3
# A gap between samples that begins anew [s].
_LONGEST_GAP = 0.5


@dataclass(frozen=True, kw_only=True, eq=False)
class Slip:
    """The motion of an object over a jaw.

    Attributes:
        stamp: of the newest pose [s].
        velocity: of the object over the jaw, along the undeformed face where they touch (3,) [m/s], jaw frame.
        stddev: of its tangential parts [m/s].
        sliding: True if a held object slides beyond chance.
    """

    stamp: float
    velocity: NDArray
    stddev: float
    sliding: bool


@dataclass(frozen=True, kw_only=True, eq=False)
class TouchedFace:
    """The undeformed inner face where an object touches.

    Attributes:
        point: (3,) [m], jaw frame.
        tangent: unit vector along the finger (3,).
    """

    point: NDArray
    tangent: NDArray


def face_at(line: NDArray, height: float) -> TouchedFace:
    """Return the face at a height [m] of its line (h, 2) [m]."""
    row = int(np.clip(np.searchsorted(line[:, 1], height), 2, len(line) - 3))
    along = line[row + 2] - line[row - 2]
    along = along / float(np.hypot(*along))
    x = np.interp(height, line[:, 1], line[:, 0])
    return TouchedFace(point=np.array([x, 0.0, height]), tangent=np.array([along[0], 0.0, along[1]]))


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
        self._samples: deque[tuple[float, NDArray]] = deque()

    def follow(self, height: float) -> float:
        """Return the height [m] that is followed: that at which the contact began, near `height`."""
        if self._height is None or abs(self._height - height) > _WANDERED:
            self._height, self._on_object = height, None
        return self._height

    def update(
        self, stamp: float, T: NDArray, face: TouchedFace, *, closing: float = 0.0, odd: bool = False
    ) -> Slip | None:
        """Take a pose and the face where the object touches.

        The first poses of a slip, which the pose filter rejects, count unless they are far away.

        Args:
            stamp: of the pose [s].
            T: T_jaw_object (4, 4), as measured.
            face: at the followed height.
            closing: speed of the object along x, filtered [m/s].
            odd: True if the pose is not that of an object that goes on as it did.
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
        self._samples.append((stamp, offset))
        while stamp - self._samples[0][0] > _WINDOW and len(self._samples) > _FEWEST:
            self._samples.popleft()
        speed, stddev = self._fit_speed()
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

    def _fit_speed(self) -> tuple[NDArray, float]:
        """Return the slope of the last samples (2,) [m/s] and its standard deviation."""
        if len(self._samples) < _FEWEST:
            return np.zeros(2), np.inf
        stamps = np.array([sample[0] for sample in self._samples])
        times = stamps - stamps.mean()
        spread = float(times @ times)
        slopes = times @ np.array([sample[1] for sample in self._samples]) / spread
        return slopes, self._noise / np.sqrt(spread)

    def _judge(self, offset: NDArray, speed: NDArray, stddev: float, closing: float) -> None:
        """Decide whether the object slides."""
        along = float(np.hypot(*speed))
        if abs(closing) > max(_CLOSING, along) or self._learnt < _TOO_FEW:
            self._rest, self._count = offset.copy(), 1.0
            self._above[:] = self._below[:] = 0.0
            self._sliding = False
            return
        off = np.clip((offset - self._rest) / self._noise, -_MOST, _MOST)
        self._above = np.maximum(0.0, self._above + off - _CHANCE)
        self._below = np.maximum(0.0, self._below - off - _CHANCE)
        fast = along > max(self._settings.slip_speed, 2.0 * stddev)
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
