"""Noisy, late and rare poses of an object in a jaw's frame into one smooth trajectory."""

from collections import deque
from dataclasses import dataclass
from math import isfinite

import numpy as np
from numpy.typing import NDArray

from finforce.errors import PoseError
from finforce.transforms import check_pose, move_pose, step_between
from finforce_contact.parameters import ContactSettings

_X = 0
# Random walks of the object along the jaw [m/s^0.5], of its rotation [rad/s^0.5] and of its closing speed [m/s^1.5];
# what moves more is noticed and followed.
_DRIFT, _ROTATION_DRIFT, _ACCELERATION = 0.1e-3, 2e-3, 2e-3
_GATE = 5.0  # [sigma]; a pose farther off is not believed at once
_JUMP_POSES = 3  # in a row off the trajectory that agree with each other are believed
# Samples over which noise is learnt, and how many the assumed noise counts for.
_NOISE_MEMORY, _NOISE_PRIOR = 60.0, 6.0
_NOISE_RANGE = (1e-2, 1e2)
# An average of innovations, one share of each new, that is so many of its standard deviations off calls for a turn.
_TREND_SHARE, _TREND_SIGMA = 0.35, 3.5
_TREND_STDDEV = float(np.sqrt(_TREND_SHARE / (2.0 - _TREND_SHARE)))
_SPEED_SURPRISE = 5e-3
_LONGEST_FORECAST = 0.2
# Noise of poses by which a trajectory is widened while an object slides: it follows them by four fifths.
_SLIDING = 4.0


@dataclass(frozen=True, kw_only=True, eq=False)
class FilteredPose:
    """Where the object is.

    Attributes:
        T: T_jaw_object (4, 4).
        stddev: (6,) of x, y, z [m] and the rotations about the jaw's x, y, z [rad].
        speed: of the object along x [m/s].
    """

    T: NDArray
    stddev: NDArray
    speed: float


class PoseFilter:
    """Kalman filter of a pose: x moves at constant speed, all else hardly moves in the frame of a closing jaw.

    Each of the six numbers has a variance of its own. How noisy they are is learnt from the innovations: r = v^2 - p. A
    pose far off the trajectory is rejected until some in a row agree with each other; a trend in the innovations
    widens the search at once.
    """

    def __init__(self, settings: ContactSettings) -> None:
        """Keep what noise is expected."""
        self._timeout = settings.pose_timeout
        noise = np.repeat([settings.pose_noise, settings.rotation_noise], 3)
        self._assumed = noise**2
        self._drift = np.repeat([_DRIFT, _ROTATION_DRIFT], 3) ** 2
        self._drift[_X] = 0.0
        self.reset()

    def reset(self) -> None:
        """Forget every pose and what was learnt of their noise."""
        self.stamp: float | None = None
        self.believed = 0.0
        self.latest: NDArray | None = None
        self._scale = np.ones(6)
        self._learnt, self._slide = _NOISE_PRIOR, np.zeros(2)
        self._rejected: deque[tuple[float, NDArray]] = deque(maxlen=_JUMP_POSES)

    def update(self, stamp: float, T: NDArray, covariance: NDArray | None = None) -> str:
        """Take a pose and return what became of it: "used", "late", "rejected" or "jump".

        Args:
            stamp: image capture time [s].
            T: T_jaw_object (4, 4).
            covariance: (6, 6) of x, y, z [m] and the rotations about the jaw's axes [rad]; None: learn it.

        Raises:
            PoseError: Stamp or pose is none, or the covariance has another shape or no positive diagonal.
        """
        if not isfinite(stamp):
            raise PoseError(f"T_jaw_object: got stamp {stamp}, expected the capture time in seconds")
        T = check_pose(T, "T_jaw_object")
        noise = self._noise(covariance)
        if self.stamp is not None and stamp <= self.stamp:
            return "late"
        self.latest = T
        if self.stamp is None or stamp - self.stamp > self._timeout:
            self._begin(stamp, T, noise)
            return "used"
        self._predict(stamp)
        innovation = step_between(self._T, T)
        spread = self._P + noise
        if (innovation**2 > _GATE**2 * spread).any():
            return self._reject(stamp, T, noise)
        self._rejected.clear()
        self._learn(innovation, None if covariance is None else noise)
        self._follow_trend(innovation / np.sqrt(spread), noise)
        self._correct(innovation, noise)
        self.believed = stamp
        return "used"

    def carry(self, T: NDArray) -> None:
        """Take the motion of the frame itself: T (4, 4) leads from where it was to where it is."""
        if self.stamp is not None:
            self._T = T @ self._T
            self._rejected = deque(((stamp, T @ pose) for stamp, pose in self._rejected), maxlen=self._rejected.maxlen)

    def slide(self, T: NDArray, velocity: NDArray) -> None:
        """Take an object for one that slides: this pose, the last that came, is near it, and it goes on so.

        Args:
            T: T_jaw_object (4, 4).
            velocity: in the jaw's y and z (2,) [m/s], zero once it rests.
        """
        self._slide = velocity
        if velocity.any():
            noise = self._noise(None)
            self._P[1:] += _SLIDING * noise[1:]
            self._correct(step_between(self._T, T), noise)
            self.believed = self.stamp
            self._rejected.clear()

    def at(self, stamp: float) -> FilteredPose:
        """Return the pose at a time [s], continued at its speed for a fifth of a second at most.

        Raises:
            PoseError: No pose has come yet.
        """
        if self.stamp is None:
            raise PoseError("no pose of the object has come yet")
        ahead = max(stamp - self.stamp, 0.0)
        dt = min(ahead, _LONGEST_FORECAST)
        T = self._T.copy()
        T[:3, 3] += dt * np.array([self._speed, *self._slide])
        variance = self._P + self._drift * ahead
        variance[_X] += 2.0 * dt * self._cross + dt**2 * self._speed_variance
        return FilteredPose(T=T, stddev=np.sqrt(np.maximum(variance, 0.0)), speed=self._speed)

    def _noise(self, covariance: NDArray | None) -> NDArray:
        """Return the variances (6,) of a pose; stated ones are raised when the poses scatter more."""
        if covariance is None:
            return self._assumed * self._scale
        stated = np.asarray(covariance, dtype=float)
        if stated.shape != (6, 6) or not np.isfinite(stated).all() or not (np.diag(stated) > 0).all():
            raise PoseError(
                f"a pose covariance {stated.tolist()}, expected (6, 6) with finite numbers and variances above zero; "
                "leave it out if it is not known"
            )
        return np.diag(stated) * np.maximum(self._scale, 1.0)

    def _begin(self, stamp: float, T: NDArray, noise: NDArray, speed: float = 0.0) -> None:
        """Start the trajectory at a pose."""
        self.stamp, self.believed, self._T, self._speed = stamp, stamp, T.copy(), speed
        self._P, self._cross, self._speed_variance = noise.copy(), 0.0, _SPEED_SURPRISE**2
        self._trend = np.zeros(6)
        self._rejected.clear()

    def _predict(self, stamp: float) -> None:
        """Move the trajectory on to a time [s]: constant speed under white acceleration in x, a random walk else."""
        dt, power = stamp - self.stamp, _ACCELERATION**2
        self._T[:3, 3] += dt * np.array([self._speed, *self._slide])
        self._P = self._P + self._drift * dt
        self._P[_X] += 2.0 * dt * self._cross + dt**2 * self._speed_variance + power * dt**3 / 3.0
        self._cross += dt * self._speed_variance + power * dt**2 / 2.0
        self._speed_variance += power * dt
        self.stamp = stamp

    def _correct(self, innovation: NDArray, noise: NDArray) -> None:
        """Move the trajectory towards a pose by the Kalman gain p / (p + r)."""
        gain = self._P / (self._P + noise)
        speed_gain = self._cross / (self._P[_X] + noise[_X])
        self._T = move_pose(self._T, gain * innovation)
        self._speed += speed_gain * innovation[_X]
        self._speed_variance -= speed_gain * self._cross
        self._cross *= 1.0 - gain[_X]
        self._P = self._P * (1.0 - gain)

    def _learn(self, innovation: NDArray, stated: NDArray | None) -> None:
        """Average how much larger the noise is than assumed, or than stated."""
        base = self._assumed if stated is None else stated / np.maximum(self._scale, 1.0)
        seen = (innovation**2 - self._P) / base
        self._learnt = min(self._learnt + 1.0, _NOISE_MEMORY)
        self._scale = np.clip(self._scale + (seen - self._scale) / self._learnt, *_NOISE_RANGE)

    def _follow_trend(self, standard: NDArray, noise: NDArray) -> None:
        """Widen what the innovations, in standard deviations (6,), have been off for some while."""
        self._trend += _TREND_SHARE * (standard - self._trend)
        turning = np.abs(self._trend) > _TREND_SIGMA * _TREND_STDDEV
        if not turning.any():
            return
        self._P = np.where(turning, self._P + noise, self._P)
        self._trend[turning] = 0.0
        if turning[_X]:
            self._speed_variance += _SPEED_SURPRISE**2

    def _reject(self, stamp: float, T: NDArray, noise: NDArray) -> str:
        """Keep a pose off the trajectory; once enough in a row agree, the trajectory starts anew from them."""
        self._rejected.append((stamp, T))
        if len(self._rejected) < _JUMP_POSES or not self._agree(noise):
            return "rejected"
        (first, T_first), (last, T_last) = self._rejected[0], self._rejected[-1]
        self._begin(stamp, T_last, noise, speed=float((T_last - T_first)[_X, 3] / (last - first)))
        return "jump"

    def _agree(self, noise: NDArray) -> bool:
        """Return whether the rejected poses lie on one straight trajectory."""
        stamps = np.array([stamp for stamp, _ in self._rejected])
        steps = np.array([step_between(self._rejected[0][1], T) for _, T in self._rejected])
        line = np.outer((stamps - stamps[0]) / (stamps[-1] - stamps[0]), steps[-1])
        return bool(((steps - line) ** 2 <= _GATE**2 * 2.0 * noise).all())
