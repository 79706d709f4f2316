"""Noisy, late and rare poses of an object in a jaw's frame into one smooth trajectory."""

from collections import deque
from dataclasses import dataclass
from math import exp, inf, isfinite
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from finforce.errors import PoseError
from finforce.transforms import check_pose, move_pose, step_between
from finforce_contact.parameters import ContactSettings
from finforce_contact.pose.symmetry import Symmetry

# For translation and rotation: random walk of an object [m/s^0.5, rad/s^0.5], of its speed while it moves [m/s^1.5,
# rad/s^1.5], standard deviations of the speed at which it starts [m/s, rad/s], and of the motion of one that is held.
_DRIFT = np.repeat([0.1e-3, 2e-3], 3) ** 2
_ACCELERATION = np.repeat([2e-3, 0.04], 3) ** 2
_START = np.repeat([8e-3, 0.15], 3) ** 2
_SHIFT = np.repeat([2e-3, 0.05], 3) ** 2
_RESTS = 20.0  # [s], mean time of rest
_MOVES = 5.0  # [s], mean time of motion
# [s] between two poses, from which on what nothing holds has rather started than the second one is wrong: it rests for
# 2 s in the mean, as seen from a hand that comes nearer, and fewer than 8 % of the poses are wrong.
_RARE = 0.16
_GATE = 5.0  # [sigma]; a pose farther off is not believed at once
_JUMP_POSES = 3  # in a row off the trajectory that agree with each other are believed
_NOISE_MEMORY = 60.0  # samples over which noise is learnt
_NOISE_PRIOR = 6.0  # samples that the assumed noise counts for
_NOISE_RANGE = (1e-2, 1e2)
_MOST_ALIKE = 0.9  # correlation of errors from one pose to the next
_LONGEST_FORECAST = 0.2
_REST, _MOTION = 0, 1


@dataclass(frozen=True, kw_only=True, eq=False)
class FilteredPose:
    """The pose of the object.

    Attributes:
        T: T_jaw_object (4, 4).
        stddev: (6,) of x, y, z [m] and the rotations about the jaw's x, y, z [rad].
        speed: of the object along x [m/s].
    """

    T: NDArray
    stddev: NDArray
    speed: float


class _Tracks(NamedTuple):
    """The two states of each coordinate of a pose, at rest and in motion; x, y, z [m] and rotations [rad].

    Attributes:
        probability: (2, 6) of rest and motion.
        step: (2, 6) from the trajectory.
        spread: (2, 6), variances of the steps.
        speed: (6,) in motion [1/s].
        cross: (6,), covariances of step and speed in motion.
        speed_spread: (6,), variances of the speed.
    """

    probability: NDArray
    step: NDArray
    spread: NDArray
    speed: NDArray
    cross: NDArray
    speed_spread: NDArray

    @property
    def mean(self) -> NDArray:
        """Expected step (6,)."""
        return (self.probability * self.step).sum(axis=0)

    @property
    def variance(self) -> NDArray:
        """Variance of the step (6,), that between the two included."""
        return (self.probability * (self.spread + (self.step - self.mean) ** 2)).sum(axis=0)

    def mix(self, dt: float) -> "_Tracks":
        """Let objects start and stop within a time [s]."""
        starts, stops = 1.0 - exp(-dt / _RESTS), 1.0 - exp(-dt / _MOVES)
        transition = np.array([[1.0 - starts, stops], [starts, 1.0 - stops]])
        shares = transition[:, :, None] * self.probability  # to, from, coordinate
        probability = shares.sum(axis=1)
        shares /= probability[:, None]
        step = (shares * self.step).sum(axis=1)
        begun, goes_on = shares[_MOTION]
        return _Tracks(
            probability=probability,
            step=step,
            spread=(shares * (self.spread + (self.step - step[:, None]) ** 2)).sum(axis=1),
            speed=goes_on * self.speed,
            cross=goes_on * (self.cross + begun * (self.step[_MOTION] - self.step[_REST]) * self.speed),
            speed_spread=goes_on * (self.speed_spread + begun * self.speed**2) + begun * _START,
        )

    def advance(self, dt: float) -> "_Tracks":
        """Move on by a time [s]."""
        spread = self.spread + _DRIFT * dt
        spread[_MOTION] += 2.0 * dt * self.cross + dt**2 * self.speed_spread + _ACCELERATION * dt**3 / 3.0
        return self._replace(
            step=self.step + np.array([np.zeros(6), dt * self.speed]),
            spread=spread,
            cross=self.cross + dt * self.speed_spread + _ACCELERATION * dt**2 / 2.0,
            speed_spread=self.speed_spread + _ACCELERATION * dt,
        )

    def correct(self, innovation: NDArray, noise: NDArray) -> "_Tracks":
        """Take a measured step (6,) of some variances (6,)."""
        left, total = innovation - self.step, self.spread + noise
        square = left**2 / total
        likelihood = self.probability * np.exp(-0.5 * (square - square.min(axis=0))) / np.sqrt(total)
        gain, speed_gain = self.spread / total, self.cross / total[_MOTION]
        return _Tracks(
            probability=likelihood / likelihood.sum(axis=0),
            step=self.step + gain * left,
            spread=self.spread * (1.0 - gain),
            speed=self.speed + speed_gain * left[_MOTION],
            cross=self.cross * (1.0 - gain[_MOTION]),
            speed_spread=self.speed_spread - speed_gain * self.cross,
        )


class PoseFilter:
    """Two Kalman filters for each coordinate of a pose, at rest and in motion, weighted by their probabilities.

    Interacting multiple models (Blom and Bar-Shalom, 1988): objects start and stop at random times. The noise of the
    poses is learnt from the innovations: r = v^2 - p. Poses whose errors are alike from one to the next, by a
    correlation c, tell less: they count as if of the variance r (1 + c) / (1 - c). A pose far off the trajectory is
    rejected until some in a row agree with each other, but that of a free object in motion is believed. Of poses that
    look alike, that is taken which is turned least from the trajectory; while poses are rejected, from the one before.

    Attributes:
        symmetry: of the object.
        latest: the newest pose as it was taken (4, 4).
    """

    def __init__(self, settings: ContactSettings, symmetry: Symmetry | None = None) -> None:
        """Keep what noise is expected."""
        self._timeout, self.symmetry = settings.pose_timeout, symmetry
        noise = np.repeat([settings.pose_noise, settings.rotation_noise], 3)
        self._assumed = noise**2
        self.reset()

    def reset(self) -> None:
        """Forget every pose and what was learnt of their noise."""
        self.stamp: float | None = None
        self.believed = 0.0
        self.latest: NDArray | None = None
        self._scale, self._alike = np.ones(6), np.zeros(6)
        self._learnt = np.full(6, _NOISE_PRIOR)
        self._rejected: deque[tuple[float, NDArray]] = deque(maxlen=_JUMP_POSES)

    def update(self, stamp: float, T: NDArray, covariance: NDArray | None = None, *, is_free: bool = False) -> str:
        """Take a pose and return what became of it: "used", "late", "rejected" or "jump".

        Args:
            stamp: image capture time [s].
            T: T_jaw_object (4, 4).
            covariance: (6, 6) of x, y, z [m] and the rotations about the jaw's axes [rad]; None: learn it.
            is_free: True if nothing holds the object, or what it is seen from: in motion, it may stop and turn at once.

        Raises:
            PoseError: Stamp or pose is none, or the covariance has another shape or no positive diagonal.
        """
        if not isfinite(stamp):
            raise PoseError(f"T_jaw_object: got stamp {stamp}, expected the capture time in seconds")
        T = check_pose(T, "T_jaw_object")
        noise = self._noise(covariance)
        if self.stamp is not None and stamp <= self.stamp:
            return "late"
        before, self.latest = self.latest, T if self.stamp is None else self._choose(T, self.at(stamp).T)
        if self.stamp is None or stamp - self.stamp > self._timeout:
            self._begin(stamp, self.latest, noise)
            return "used"
        dt, moves = stamp - self.stamp, (self._tracks.probability[_MOTION] > 0.5).any()
        self._tracks = self._tracks.mix(dt).advance(dt)
        self.stamp = stamp
        self._centre()
        innovation, spread = step_between(self._T, self.latest), self._tracks.variance
        if (innovation**2 > _GATE**2 * (spread + noise)).any():
            if is_free and (moves or dt > _RARE):
                self._begin(stamp, self.latest, noise, step_between(before, self.latest) / dt)
                self._tracks = self._tracks._replace(speed_spread=_START + self._tracks.speed**2)
                return "jump"
            return self._reject(stamp, T, noise)
        self._rejected.clear()
        self._learn(innovation, spread, noise, is_stated=covariance is not None)
        alike = np.clip(self._alike / self._scale, 0.0, _MOST_ALIKE)
        self._tracks = self._tracks.correct(innovation, noise * (1.0 + alike) / (1.0 - alike))
        self._centre()
        self.believed = stamp
        return "used"

    def carry(self, T: NDArray) -> None:
        """Take the motion of the frame itself: T (4, 4) leads from where it was to where it is."""
        if self.stamp is not None:
            self._T, self.latest = T @ self._T, T @ self.latest
            self._rejected = deque(((stamp, T @ pose) for stamp, pose in self._rejected), maxlen=self._rejected.maxlen)

    def at(self, stamp: float, held_since: float = inf) -> FilteredPose:
        """Return the pose at a time [s], continued at its speed for a fifth of a second at most.

        From then on the object may have stopped or not, until it is held [s]: then it hardly moves.

        Raises:
            PoseError: No pose has come yet.
        """
        if self.stamp is None:
            raise PoseError("no pose of the object has come yet")
        ahead = stamp - self.stamp if stamp > self.stamp else 0.0
        tracks, beyond = self._tracks.advance(min(ahead, _LONGEST_FORECAST)), max(ahead - _LONGEST_FORECAST, 0.0)
        goes_on = tracks.probability[_MOTION] * (tracks.speed**2 + tracks.speed_spread)
        free = min(beyond, max(held_since - self.stamp - _LONGEST_FORECAST, 0.0))
        moved = goes_on * free**2 + np.minimum(goes_on * (beyond - free) ** 2, _SHIFT)
        stddev = np.sqrt(tracks.variance + _DRIFT * beyond + moved)
        speed = float(tracks.probability[_MOTION, 0] * tracks.speed[0])
        return FilteredPose(T=move_pose(self._T, tracks.mean), stddev=stddev, speed=speed)

    def _choose(self, T: NDArray, T_last: NDArray) -> NDArray:
        return T if self.symmetry is None else self.symmetry.choose(T, T_last)

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

    def _centre(self) -> None:
        """Count the steps of the tracks from their mean."""
        mean = self._tracks.mean
        self._T = move_pose(self._T, mean)
        self._tracks = self._tracks._replace(step=self._tracks.step - mean)

    def _begin(self, stamp: float, T: NDArray, noise: NDArray, speed: NDArray | None = None) -> None:
        """Start the trajectory at a pose, with a speed (6,) where it is known to move."""
        self.stamp, self.believed, self._T, self._innovation = stamp, stamp, T.copy(), np.zeros(6)
        moves = _MOVES / (_MOVES + _RESTS) if speed is None else 0.5
        self._tracks = _Tracks(
            probability=np.repeat([[1.0 - moves], [moves]], 6, axis=1),
            step=np.zeros((2, 6)),
            spread=np.array([noise, noise]),
            speed=np.zeros(6) if speed is None else speed,
            cross=np.zeros(6),
            speed_spread=_START.copy(),
        )
        self._rejected.clear()

    def _learn(self, innovation: NDArray, spread: NDArray, noise: NDArray, *, is_stated: bool) -> None:
        """Average how much larger the noise (6,) that is seen is than assumed or stated, and how alike at rest.

        The square of an innovation of the variance p + r tells r with the variance 2 (p + r)^2: of an object whose
        motion is not known, hardly anything.
        """
        base = noise / np.maximum(self._scale, 1.0) if is_stated else self._assumed
        told = (noise / (noise + spread)) ** 2
        self._learnt = np.minimum(self._learnt + told, _NOISE_MEMORY)
        gain = told / self._learnt
        self._scale = np.clip(self._scale + gain * ((innovation**2 - spread) / base - self._scale), *_NOISE_RANGE)
        alike = innovation * self._innovation / base
        self._alike += self._tracks.probability[_REST] ** 2 * gain * (alike - self._alike)
        self._innovation = innovation

    def _reject(self, stamp: float, T: NDArray, noise: NDArray) -> str:
        """Keep a pose off the trajectory; once enough in a row agree, the trajectory starts anew from them."""
        if self._rejected:
            self.latest = self._choose(T, self._rejected[-1][1])
        self._rejected.append((stamp, self.latest))
        if len(self._rejected) < _JUMP_POSES or not self._agree(noise):
            return "rejected"
        (first, T_first), (last, T_last) = self._rejected[0], self._rejected[-1]
        self._begin(stamp, T_last, noise, step_between(T_first, T_last) / (last - first))
        return "jump"

    def _agree(self, noise: NDArray) -> bool:
        """Return whether the rejected poses lie on one straight trajectory."""
        stamps = np.array([stamp for stamp, _ in self._rejected])
        steps = np.array([step_between(self._rejected[0][1], T) for _, T in self._rejected])
        line = np.outer((stamps - stamps[0]) / (stamps[-1] - stamps[0]), steps[-1])
        return bool(((steps - line) ** 2 <= _GATE**2 * 2.0 * noise).all())
