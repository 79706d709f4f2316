"""Kalman filter of one coordinate that is at rest or in motion: interacting multiple models.

At rest x drifts as a random walk; in motion it has a speed v whose changes are white. The object starts and stops at
random times. Means and covariances of both models are mixed before each step by the transition matrix, and each model
is weighted by the likelihood of its innovation (Blom and Bar-Shalom, 1988). Once a jump explains an innovation better
than both, the position begins anew.
"""

from __future__ import annotations

from copy import copy
from typing import NamedTuple

import numpy as np

from finforce.compiled import njit

_OPTIONS = {"cache": True, "error_model": "numpy"}


class MotionNoise(NamedTuple):
    """Process noise of a coordinate.

    Attributes:
        drift: variance per time at rest and in motion [1/s].
        acceleration: variance of the speed per time in motion [1/s^3].
        start: variance of the speed at which motion begins [1/s^2].
        rest_time: mean time of rest [s].
        motion_time: mean time of motion [s].
        jump: variance of a jump of the position.
        jump_probability: of one in a step [-].
    """

    drift: float
    acceleration: float
    start: float
    rest_time: float
    motion_time: float
    jump: float = 0.0
    jump_probability: float = 0.0


class Track:
    """State of one coordinate.

    Attributes:
        state: probability of rest; position at rest and in motion; speed in motion; variances of both positions; of
            motion, the covariance of position and speed, and the variance of the speed (8,).
    """

    def __init__(self, noise: MotionNoise, x: float, variance: float, speed: float = 0.0) -> None:
        """Start at x with a variance, at rest or at a speed."""
        self.noise = noise
        self.state = np.array([0.5, x, x, speed, variance, variance, 0.0, noise.start])

    @property
    def x(self) -> float:
        """Expected position."""
        return find_mean(self.state)

    @property
    def variance(self) -> float:
        """Variance of the position, that between the models included."""
        return find_variance(self.state)

    @property
    def speed(self) -> float:
        """Expected speed."""
        return float((1.0 - self.state[0]) * self.state[3])

    @property
    def rests(self) -> float:
        """Probability of rest."""
        return float(self.state[0])

    def shift(self, change: float) -> None:
        """Count the position from another origin."""
        self.state[1:3] += change

    def widen(self, variance: float) -> None:
        """Add a variance to the position."""
        self.state[4:6] += variance

    def stop(self) -> None:
        """Take it that nothing moves from where it is."""
        self.state[1:3] = self.x
        self.state[[0, 3]] = 1.0, 0.0

    def free(self, variance: float, speed_variance: float) -> None:
        """Add variances to position and speed in motion, as where the speed has changed at once."""
        self.state[5] += variance
        self.state[7] += speed_variance

    def after(self, dt: float) -> Track:
        """Return the track a time [s] later."""
        later = copy(self)
        later.state = self.state.copy()
        later.predict(dt)
        return later

    def predict(self, dt: float, rest_time: float | None = None) -> None:
        """Advance by a time [s]; a mean time of rest [s] goes before that of the noise."""
        predict(self.state, dt, rest_time or self.noise.rest_time, self.noise)

    def update(self, z: float, R: float) -> None:
        """Take a measured position z of a variance R."""
        correct(self.state, z, R, self.noise)


@njit(**_OPTIONS)
def find_mean(s):
    """Return the expected position of a state (8,)."""
    return s[0] * s[1] + (1.0 - s[0]) * s[2]


@njit(**_OPTIONS)
def find_variance(s):
    """Return the variance of the position of a state (8,)."""
    mean = find_mean(s)
    return s[0] * (s[4] + (s[1] - mean) ** 2) + (1.0 - s[0]) * (s[5] + (s[2] - mean) ** 2)


@njit(**_OPTIONS)
def predict(s, dt, rest_time, noise):
    """Advance a state (8,) by a time [s], for a mean time of rest [s] and a `MotionNoise`."""
    starts, stops = 1.0 - np.exp(-dt / rest_time), 1.0 - np.exp(-dt / noise.motion_time)
    _mix(s, starts, stops, noise.start)
    _advance(s, dt, noise.drift, noise.acceleration)


@njit(**_OPTIONS)
def _mix(s, starts, stops, start_variance):
    """Mix both models of a state (8,) by the probabilities that motion starts and stops."""
    rest, a, b, v, pa, pb, cross, pv = s
    stays, ends = (1.0 - starts) * rest, stops * (1.0 - rest)
    begins, goes_on = starts * rest, (1.0 - stops) * (1.0 - rest)
    to_rest, to_motion = stays + ends, begins + goes_on
    x0 = (stays * a + ends * b) / to_rest
    x1 = (begins * a + goes_on * b) / to_motion
    w = goes_on / to_motion
    s[0], s[1], s[2], s[3] = to_rest, x0, x1, w * v
    s[4] = (stays * (pa + (a - x0) ** 2) + ends * (pb + (b - x0) ** 2)) / to_rest
    s[5] = (begins * (pa + (a - x1) ** 2) + goes_on * (pb + (b - x1) ** 2)) / to_motion
    s[6] = w * (cross + (1.0 - w) * (b - a) * v)
    s[7] = w * (pv + (1.0 - w) * v * v) + (1.0 - w) * start_variance


@njit(**_OPTIONS)
def _advance(s, dt, drift, acceleration):
    """Advance a state (8,) by a time [s]."""
    s[2] += dt * s[3]
    s[4] += drift * dt
    s[5] += drift * dt + 2.0 * dt * s[6] + dt * dt * s[7] + acceleration * dt**3 / 3.0
    s[6] += dt * s[7] + acceleration * dt**2 / 2.0
    s[7] += acceleration * dt


@njit(**_OPTIONS)
def correct(s, z, R, noise):
    """Take a measured position z of a variance R into a state (8,), for a `MotionNoise`."""
    nu0, nu1, S0, S1 = z - s[1], z - s[2], s[4] + R, s[5] + R
    likely = s[0] * _density(nu0, S0) + (1.0 - s[0]) * _density(nu1, S1)
    if noise.jump_probability * _density(nu0, s[4] + noise.jump + R) > (1.0 - noise.jump_probability) * likely:
        s[:] = np.array([0.5, z, z, 0.0, R, R, 0.0, noise.start])
        return
    odds = 0.5 * (nu0 * nu0 / S0 - nu1 * nu1 / S1) + 0.5 * np.log(S0 / S1)
    motion = (1.0 - s[0]) * np.exp(min(max(odds, -50.0), 50.0))
    s[0] = s[0] / (s[0] + motion)
    gain, speed_gain, cross = s[5] / S1, s[6] / S1, s[6]
    s[1] += s[4] / S0 * nu0
    s[2] += gain * nu1
    s[3] += speed_gain * nu1
    s[4] *= R / S0
    s[5] *= R / S1
    s[6] -= gain * cross
    s[7] -= speed_gain * cross


@njit(**_OPTIONS)
def expect_position(s, z, R, noise):
    """Return the position that a measured one z of a variance R would leave of a state (8,)."""
    s = s.copy()
    correct(s, z, R, noise)
    return find_mean(s)


@njit(**_OPTIONS)
def _density(nu, S):
    """Return the normal density of a number nu of variance S, without the factor that all have."""
    return np.exp(-0.5 * nu * nu / S) / np.sqrt(S) if S > 0.0 else 0.0
