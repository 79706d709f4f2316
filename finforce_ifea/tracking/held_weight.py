"""What a held object weighs along the finger and across it, told by what changes once it is held.

A force along the finger moves the key points by tenths of a millimetre, as errors of the place, of the mechanics and
of the key points do; those stay as they are while an object is held, what is lifted does not. So does a force across
it: the finger bends sideways, and the side on which the key points are turns in its own plane. So every key point's
residual is remembered from when the hold began, and the change since then is explained by

    depth of the object, free,
    shape and height, by which a lifted object settles a little,
    a force T along the finger, a force S across it, and a moment M that twists it, for what is held by two flat faces
    does not roll with either,

where T and S rise or fall steadily over the images that are averaged. Where gravity's direction is known, T and S are
expected as it points: its share along the finger and across, and beside it what little acts from outside. Once a
change of T or S is beyond chance the object is lifted, and every change counts until the hold ends. Where the jaws move
on far, or the object slides, the memory begins anew, and T and S are what they were.
"""

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from finforce_ifea.contact_mechanics.indenter import DEPTH
from finforce_ifea.tracking.place_update import Residuals

_OPTIONS = {"cache": True, "error_model": "numpy"}
# Frames that make a memory, time over which changes since are averaged [s], and how fast forces change meanwhile [N/s].
_REMEMBERED, _AVERAGED, _RISES = 24, 0.25, 1.0
# A hold has ended once the object is so much deeper or higher [m]: a weight that goes over from one jaw to the other
# moves the object by a millimetre. Standard deviation of what the mechanics errs by on the way there, as a share of it.
_DEEPER, _HIGHER, _BEYOND = 2.5e-3, 1.5e-3, 0.05
# What is seen of a force across is off by this share of it: the finger's side turns before the camera.
_TURNED = 0.1
# Standard deviations of how a lifted object settles, as a share of what shape and height were expected to be off, and
# of the weight [N].
_SETTLES, _WEIGHT = 0.05, 0.7
# And of T and S beside what a weight makes of them in a known direction [N].
_OUTSIDE = 0.1
# And of how far it has slid or tilted, as a share of what its pose says. A tilt [rad] after which a hold begins anew,
# and how far from its axis a tilted object presses [m].
_SLIDES, _TILTED, _ARM = 0.3, 0.05, 0.01
# [N m], keeps the moment's variance above zero where nobody knows the finger's width.
_LEAST_MOMENT = 1e-6
# The errors of so many successive frames count for one. A change of so many standard deviations is no chance.
_ALIKE, _SURE = 1.5, 3.0
# Fewer points than these say nothing.
_FEWEST = 6
# What changes: shape, height, T, S, M, and the speeds of T and S.
_T, _S, _UNKNOWN = 2, 3, 7


class HeldFrame(NamedTuple):
    """One frame of a hold.

    Attributes:
        data: residuals about the reference place.
        modes: of the key points by the place and a lean of the force (K, 2, 4).
        normal: force [N].
        lean: of the force, with which the residuals were found, beyond that with which it has nothing along [-].
        moved: the place that was found minus the reference (3,).
        place: that was found (3,).
        aside: what the residuals show of a force across the finger, along x, y and z (K, 3) [m/N].
        across: force with which they were found [N].
        twist: what the residuals show of a moment that twists the finger (K, 3) [m/(N m)].
        arm: standard deviation of the place along y at which the normal force acts [m].
    """

    data: Residuals
    modes: NDArray
    normal: float
    lean: float
    moved: NDArray
    place: NDArray
    aside: NDArray
    across: float
    twist: NDArray
    arm: float


class HeldWeight:
    """Follows one object.

    Attributes:
        force: along the finger [N].
        stddev: of it [N]; infinite before there is a memory.
        leverage: depth of the object that such a force is taken for, as long as nobody knows of it [m/N].
        across: force across the finger [N].
        across_stddev: of it [N]; infinite before anything is lifted.
    """

    def __init__(self) -> None:
        """Starts with an object that is not held yet."""
        self._gravity: NDArray | None = None
        self.reset()

    def reset(self) -> None:
        """Forgets the object."""
        self.force, self.stddev, self.leverage = 0.0, np.inf, 0.0
        self.across, self.across_stddev = 0.0, np.inf
        self._begin()

    def _begin(self) -> None:
        """Starts to remember."""
        self._frames, self._place = 0, np.zeros(3)
        self._information, self._vector = np.zeros((_UNKNOWN, _UNKNOWN)), np.zeros(_UNKNOWN)
        self._before, self._changed, self._led = (self.force, self.across), False, np.zeros(2)

    def lead(self, way: NDArray) -> None:
        """Takes the object for one whose shape and height (2,) have changed by `way`: what that moves is no force."""
        if self._frames < _REMEMBERED:
            self._begin()
            return
        self._led += way
        self._information, self._vector = np.zeros((_UNKNOWN, _UNKNOWN)), np.zeros(_UNKNOWN)

    def update(self, frame: HeldFrame, prior: NDArray, dt: float, gravity: NDArray | None = None) -> float:
        """Takes one frame of something that presses and returns the force along the finger [N].

        Args:
            frame: see `HeldFrame`.
            prior: variance of shape and height (2,).
            dt: time since the last one [s].
            gravity: its direction (3,) in the jaw's frame; None where nobody knows.
        """
        self._gravity = gravity
        away = frame.place - self._place
        has_slid = abs(away[2]) > _HIGHER or abs(self._led[0]) > _TILTED
        if self._frames and (abs(away[DEPTH]) > _DEEPER or has_slid):
            if has_slid and self._frames == _REMEMBERED:
                self._compare(frame, away, prior, dt)
            self._begin()
        if not self._frames:
            self._place, away = frame.place.copy(), np.zeros(3)
            self._memory, self._counts = np.zeros((len(frame.data.weights), 3)), np.zeros(len(frame.data.weights))
        if self._frames < _REMEMBERED:
            self._frames += 1
            left, seen = _find_left(frame, away, self._before), frame.data.weights > 0.0
            self._counts += seen
            self._memory += np.where(seen[:, None], left - self._memory, 0.0) / np.maximum(self._counts, 1.0)[:, None]
        else:
            self._compare(frame, away, prior, dt)
        return self.force

    def _compare(self, frame: HeldFrame, away: NDArray, prior: NDArray, dt: float) -> None:
        """Explains what has changed since the memory, at a place that is `away` (3,) from there."""
        known = np.where(self._counts > 0.5 * _REMEMBERED, frame.data.weights, 0.0)
        if np.count_nonzero(known) < _FEWEST:
            return
        left = _find_left(frame, away, self._before) - self._memory
        beyond = _BEYOND**2 * (away[DEPTH] ** 2 + away[2] ** 2 + (_ARM * self._led[0]) ** 2)
        self._information, self._vector = _age(self._information, self._vector, dt)
        self.leverage = _accumulate(frame, left, known, beyond, self._information, self._vector)
        settles = np.array([0.0, 0.0, _WEIGHT, _WEIGHT, frame.arm * frame.normal + _LEAST_MOMENT, _RISES, _RISES]) ** 2
        settles[:2] = _SETTLES**2 * prior + (_SLIDES * self._led) ** 2
        expected = np.diag(1.0 / settles)
        if self._gravity is not None:
            expected[_T : _S + 1, _T : _S + 1] = _expect_weight(self._gravity)
        spread = np.linalg.inv(self._information / _ALIKE + expected)
        asked = self._vector / _ALIKE
        asked[:2] += self._led / settles[:2]
        changes, stddev = (spread @ asked)[_T : _S + 1], np.sqrt(np.diag(spread))[_T : _S + 1]
        self._changed |= bool((np.abs(changes) > _SURE * stddev).any())
        self.stddev = float(stddev[0])
        if self._changed:
            self.force, self.across = float(self._before[0] + changes[0]), float(self._before[1] + changes[1])
            self.across_stddev = float(stddev[1])


def _expect_weight(gravity: NDArray) -> NDArray:
    """Returns the inverse covariance (2, 2) [1/N^2] of T and S before anything is seen of them."""
    pulls = gravity[[2, 1]]
    return np.linalg.inv(_WEIGHT**2 * np.outer(pulls, pulls) + _OUTSIDE**2 * np.eye(2))


@njit(**_OPTIONS)
def _age(information, vector, dt):
    """Returns information (7, 7) and vector (7,) a time later, when T and S have gone on at their speeds."""
    kept = np.exp(-dt / _AVERAGED)
    aged, later = kept * information, kept * vector
    for force in range(2):
        now, speed = _T + force, _UNKNOWN - 2 + force
        later[speed] -= dt * later[now]
        for i in range(len(vector)):
            aged[i, speed] -= dt * aged[i, now]
        for i in range(len(vector)):
            aged[speed, i] -= dt * aged[now, i]
    return aged, later


@njit(**_OPTIONS)
def _find_left(frame, away, before):
    """Returns the residuals (K, 3) [m] at the place of the memory with the forces along and across that there were.

    Their depth is the one that was found.
    """
    left = np.empty((len(frame.data.r), 3))
    for k in range(len(left)):
        left[k, 0], left[k, 1], left[k, 2] = frame.data.r[k, 0], frame.data.off[k], frame.data.r[k, 1]
        for a in range(3):
            left[k, a] += frame.aside[k, a] * (frame.across - before[1])
        for a in range(2):
            left[k, 2 * a] += frame.modes[k, a, 3] * (frame.lean - before[0] / frame.normal)
            left[k, 2 * a] -= frame.modes[k, a, 0] * frame.moved[0]
            for i in range(1, 3):
                left[k, 2 * a] += frame.modes[k, a, i] * (away[i] - frame.moved[i])
    return left


@njit(**_OPTIONS)
def _accumulate(frame, left, weights, beyond, information, vector):
    """Adds one frame, its depth eliminated, to information (7, 7) and vector (7,) on what changes.

    `beyond` is the variance of each coordinate of a key point that comes on top of its noise [m^2]. Returns the depth
    that a force along the finger is taken for [m/N].
    """
    A, g = np.zeros((6, 6)), np.zeros(6)
    rows = np.zeros((6, 2))
    for k in range(len(weights)):
        if weights[k] <= 0.0:
            continue
        noise = frame.data.noise[k]
        turned = _TURNED**2 * frame.across**2 * (frame.aside[k] ** 2).sum()
        n00, n11 = noise[0, 0] + beyond + turned, noise[1, 1] + beyond + turned
        det = n00 * n11 - noise[0, 1] ** 2
        w00, w11, w01 = weights[k] * n11 / det, weights[k] * n00 / det, -weights[k] * noise[0, 1] / det
        for a in range(2):
            rows[0, a], rows[1, a], rows[2, a] = frame.modes[k, a, 0], frame.modes[k, a, 1], frame.modes[k, a, 2]
            rows[3, a], rows[4, a] = frame.modes[k, a, 3] / frame.normal, frame.aside[k, 2 * a]
            rows[5, a] = frame.twist[k, 2 * a]
        for i in range(6):
            q0, q1 = w00 * rows[i, 0] + w01 * rows[i, 1], w01 * rows[i, 0] + w11 * rows[i, 1]
            g[i] += q0 * left[k, 0] + q1 * left[k, 2]
            for j in range(6):
                A[i, j] += q0 * rows[j, 0] + q1 * rows[j, 1]
        certain = weights[k] / (frame.data.off_noise[k] + beyond + turned)
        h0, h1 = frame.aside[k, 1], frame.twist[k, 1]
        A[4, 4] += certain * h0 * h0
        A[4, 5] += certain * h0 * h1
        A[5, 4] += certain * h0 * h1
        A[5, 5] += certain * h1 * h1
        g[4] += certain * h0 * left[k, 1]
        g[5] += certain * h1 * left[k, 1]
    for i in range(5):
        vector[i] += g[i + 1] - A[i + 1, 0] * g[0] / A[0, 0]
        for j in range(5):
            information[i, j] += A[i + 1, j + 1] - A[i + 1, 0] * A[0, j + 1] / A[0, 0]
    return A[0, 3] / A[0, 0]
