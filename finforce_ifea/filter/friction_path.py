"""Traction hypotheses of one object, and the path from which the mobilized friction of each one follows."""

from __future__ import annotations

from math import sqrt
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from finforce.compiled import njit
from finforce.kalman import Track, find_variance
from finforce_ifea.contact_mechanics.friction import Coefficient
from finforce_ifea.contact_mechanics.pressed_jaw import RigidContact
from finforce_ifea.filter.carried_object import CarriedObject
from finforce_ifea.filter.readout import LARGEST_RATIO
from finforce_ifea.filter.slip_path import PathState, SlipPath, find_turn, turn_path
from finforce_ifea.filter.state import DEPTH, HEIGHT

_OPTIONS = {"cache": True, "error_model": "numpy"}
# Number of hypotheses of the coefficient of friction.
NODES = 9
# Standard deviation of the coefficient up to which one hypothesis is enough [-].
_WELL_KNOWN = 0.05
# Half-width of the grid of coefficients [sigma].
_SPAN = 2.5
# Largest coefficient of the grid [-].
_LARGEST = 1.2
# Prior probability that an object between two jaws is held by them alone [-].
_HELD = 0.5
# Log odds of that before the object is lifted: it still lies where it lay.
_AT_REST = -4.0
# Largest log odds of that after a lift or a turn: the object may be a handle.
_PARTED = 4.0
# Reversals below this are noise [sigma], while the object moves.
_REVERSAL = 2.5
# The same where it has stopped [sigma].
_REVERSAL_AT_REST = 4.0
# Motion along the finger below this is noise of the object's pose [m].
_HEIGHT_PLAY = 1e-3
# Shortest step of the path [m].
_SHORTEST = 0.01e-3
# Probability of rest below which the object moves [-].
_MOVES = 0.2
_NO_PLACES = np.zeros((0, 2))
# A stop replaces the end of a motion once its standard deviation is smaller by this factor [-].
_STOPPED = 0.7
# Standard deviation of the depth of first touch [m].
_TOUCH_STDDEV = 0.1e-3
# Factor on the path's standard deviation while the whole contact slides [-].
_SLIDING = 0.3
# Probability of hypotheses at their cone from which the whole contact slides [-].
_MOST = 0.5
# Distance from the friction cone that counts as being at it [-].
_AT_CONE = 1e-6
_LEAST_PROBABILITY = 1e-6
# Length of the path that can be taken back [m].
_BRANCH = 1e-3


class _Mark(NamedTuple):
    """A point of the path: positions (M, 2) [m], state, and direction of motion."""

    places: NDArray
    path: PathState
    direction: float


class TractionHypotheses:
    """Coefficients of friction on a grid, and an object that only the jaws hold.

    An object that only the jaws hold does not slide along the finger: friction balances the inclination of their faces.

    Attributes:
        mu: coefficients of friction (M,) [-].
        upright: traction ratio of an object that only the jaws hold [-].
        pull_stddev: standard deviation of that by the object's weight [-].
        motion: of the object along the path since it was last asked for [m].
        stddev: of the traction ratio by errors of the path [-].
        unweighed: standard deviation of the coefficient of friction that no hypothesis stands for [-].
        carried: motion of an object that only the jaws hold.
    """

    def __init__(self, friction: Coefficient, held: str) -> None:
        """Start with the prior of the coefficient of friction; `held` as in `EstimatorSettings`."""
        self._held = {"yes": 1.0, "either": _HELD}.get(held, 0.0)
        mean, stddev = friction
        self.unweighed = stddev if stddev <= _WELL_KNOWN else 0.0
        if self.unweighed:
            self.mu, self._cell, prior = np.array([mean]), 0.0, np.ones(1)
        else:
            low = max(mean - _SPAN * stddev, 0.0)
            self.mu = np.linspace(low, max(min(mean + _SPAN * stddev, _LARGEST), low + 1e-3), NODES)
            self._cell = float(self.mu[1] - self.mu[0])
            prior = np.exp(-0.5 * ((self.mu - mean) / stddev) ** 2) + 1e-300
        self._prior = prior / prior.sum()
        self._path, self.carried = SlipPath(self.mu), CarriedObject()
        self.reset()

    def reset(self) -> None:
        """Reset to an object that does not touch yet."""
        self.upright, self._bears, self.motion = 0.0, 0.0, 0.0
        self.pull_stddev, self._parted, self._parting, self._is_at_rest = 0.0, 0.0, 0.0, False
        self.leave()

    def leave(self) -> None:
        """Reset the path, as after a release."""
        self._path.reset()
        self.carried.leave()
        self._anchor: NDArray | None = None
        self._anchor_stddev, self._direction, self.stddev = _TOUCH_STDDEV, 1.0, 0.0
        self._marks: list[_Mark] = []

    @property
    def prior(self) -> NDArray:
        """Log prior probabilities (N,), those of the grid first."""
        return self._join(self._prior)

    def reweigh(self, log_weights: NDArray) -> NDArray:
        """Return log probabilities (N,) with "held" at its prior and the coefficients as they are known."""
        self._prior = self._find_coefficients(np.exp(log_weights))
        return self._join(self._prior)

    def _join(self, shares: NDArray) -> NDArray:
        """Return log probabilities (N,) for those of the coefficients (M,), given that the object is not held."""
        parts = [np.log((shares + 1e-300) * (1.0 - self._held))] if self._held < 1.0 else []
        return np.concatenate([*parts, [np.log(self._held)]]) if self._held > 0.0 else parts[0]

    @property
    def ratios(self) -> NDArray:
        """Traction ratio kappa of each hypothesis (N,) [-]."""
        return _bound(self._path.ratios, self._held, self.upright)

    @property
    def packed(self) -> tuple[tuple, tuple, tuple]:
        """Arguments of `preview` as plain tuples."""
        anchor = _NO_PLACES if self._anchor is None else self._anchor
        path = self.mu, self._path.parts, self._path.shares, self._path.rates, anchor
        return path, (self._direction, self._anchor_stddev, self.stddev), (self._held, self.upright)

    @property
    def follows_path(self) -> bool:
        """True if any hypothesis depends on the path."""
        return self._held < 1.0

    def estimate(self, weights: NDArray) -> Coefficient:
        """Return the estimated coefficient of friction for weights of the hypotheses (N,)."""
        if not self.follows_path:
            return Coefficient(0.0, np.inf)
        shares, variance = self._find_coefficients(weights), self._cell**2 / 12.0 + self.unweighed**2
        mean = float(shares @ self.mu)
        return Coefficient(mean, sqrt(max(float(shares @ self.mu**2) - mean**2, 0.0) + variance))

    def _find_coefficients(self, weights: NDArray) -> NDArray:
        """Return the probabilities of the coefficients (M,) for weights of the hypotheses (N,).

        An object that only the jaws hold tells no more of its friction than that it bears its traction ratio.
        """
        if not self.follows_path:
            return self._prior
        own, held = self._share(weights), float(weights[-1]) if self._held > 0.0 else 0.0
        bears = _bear(self.mu, self._prior, self._step, self.upright) + _LEAST_PROBABILITY * self._prior
        return (1.0 - held) * own + held * bears / bears.sum()

    @property
    def _step(self) -> float:
        """Width over which a coefficient of the grid comes to bear a ratio [-]."""
        return max(self._cell, 2.0 * self.unweighed)

    def _share(self, weights: NDArray) -> NDArray:
        """Return the probabilities of the coefficients (M,) where one of them holds, for all weights (N,)."""
        return _share(weights, len(self.mu))

    def part(self, parting: float, *, shows_lifts: bool) -> None:
        """Update the odds of "held" by a motion of the gripper, see `WristMove`; those by the object's end with it."""
        self._parted += parting
        self._is_at_rest = shows_lifts

    def bound_held(self, log_weights: NDArray) -> NDArray:
        """Return the log weights (N,) with the odds of "held" by motions and by the friction it needs.

        It bears a ratio with P(mu > |kappa|).
        """
        if not 0.0 < self._held < 1.0:
            return log_weights
        parting = min(self._parted + (_AT_REST if self._is_at_rest else 0.0), _PARTED)
        parting += 0.0 if self._parted else self.carried.log_odds
        known = self._bears, parting - self._parting
        bears = _bear(self.mu, self._prior, self._step, self.upright)
        weighed, self._bears = _bound_held(log_weights, bears, known)
        self._parting = parting
        return weighed

    def take_motion(self) -> float:
        """Return the motion [m] since the last call."""
        motion, self.motion = self.motion, 0.0
        return motion

    def shift(self, change: float) -> None:
        """Shift the depth by a change [m]."""
        if self._anchor is not None:
            self.carried.shift(change)
            self._anchor[:, 0] += change
            for mark in self._marks:
                mark.places[:, 0] += change

    def follow(
        self, contact: RigidContact, q: NDArray, x: NDArray, places: NDArray, track: Track, weights: NDArray
    ) -> None:
        """Extend the path to the object's present state.

        A motion back counts once it is no chance. What stopped short of where it seemed to be is taken back to where
        it is known best, and its path with it.

        Args:
            contact: of the jaw.
            q: its unknowns (size,).
            x: state of the contact (3,).
            places: depth and height of each hypothesis (N, 2) [m].
            track: of the depth.
            weights: of the hypotheses (N,).
        """
        if self._anchor is None:
            self._anchor = places[: len(self.mu)].copy()
            self._path.measure(contact, q, x)
        own, motion, deeper, is_along = _find_motion(self._anchor, places, weights)
        stddev = sqrt(max(track.variance, 0.0))
        if not is_along:
            if _is_chance(deeper, self._direction, stddev, self._anchor_stddev, track.rests):
                if stddev < _STOPPED * self._anchor_stddev:
                    self._take_back(contact, q, x, places[: len(self.mu)], own)
                    self._carry(own)
                    self._anchor_stddev = stddev
                return
            if abs(deeper) < _SHORTEST:
                return
        before, self._anchor_stddev, self._direction = self._direction, stddev, float(np.sign(deeper))
        if self._direction != before or is_along:
            self._marks = []
        elif self._marks and own @ np.abs(self._anchor[:, 0] - self._marks[0].places[:, 0]) > _BRANCH:
            del self._marks[0]
        self._marks.append(_Mark(self._anchor, self._path.state, before))
        self._anchor = self._anchor + motion
        self.motion += abs(deeper)
        self._path.move(contact, q, x, motion)
        self._carry(own)
        self.stddev = _find_stddev(self._path.ratios, self.mu, own, self._path.rates, self._path.shares, stddev)

    def _carry(self, own: NDArray) -> None:
        """Carry an object that only the jaws may hold to the end of the path, for weights of the coefficients (M,)."""
        if self._held > 0.0:
            self.carried.follow(float(own @ self._anchor[:, 0]), self.upright, self._path.rates, self._path.shares)

    def _take_back(self, contact: RigidContact, q: NDArray, x: NDArray, places: NDArray, own: NDArray) -> None:
        """Compute the path again from its last mark before the positions (M, 2); see `follow` for the arguments."""
        while self._marks:
            mark = self._marks.pop()
            motion = (places - mark.places) * [1.0, 0.0]
            ahead = own @ motion[:, 0]
            self._path.resume(mark.path)
            if not self._marks and ahead * self._direction < 0.0:
                self._direction = mark.direction
            if ahead * self._direction > 0.0:
                self._path.move(contact, q, x, motion)
                self._marks.append(mark)
                break
        self._anchor = places.copy()


@njit(**_OPTIONS)
def _bound(ratios, held, upright):
    """Return the traction ratio of each hypothesis (N,) for ratios of the path (M,); see `TractionHypotheses`."""
    count = len(ratios) if held < 1.0 else 0
    out = np.full(count + 1 if held > 0.0 else count, upright)
    out[:count] = ratios[:count]
    return np.minimum(np.maximum(out, -LARGEST_RATIO), LARGEST_RATIO)


@njit(**_OPTIONS)
def _share(weights, count):
    """Return the probabilities (M,) of the first `count` hypotheses, given one of them, for all weights (N,)."""
    own = weights[:count]
    return own / max(own.sum(), 1e-300)


@njit(**_OPTIONS)
def _find_motion(anchor, places, weights):
    """Return probabilities of the coefficients (M,), motion from the path's end (M, 2) [m], and its mean by depth [m].

    The height has some play; last comes whether any motion is along the finger. Of the hypotheses are places, depth
    and height (N, 2) [m], and weights (N,).
    """
    own, motion = _share(weights, len(anchor)), np.empty(anchor.shape)
    deeper, is_along = 0.0, False
    for i in range(len(anchor)):
        motion[i, 0], along = places[i, 0] - anchor[i, 0], places[i, 1] - anchor[i, 1]
        motion[i, 1] = along - min(max(along, -_HEIGHT_PLAY), _HEIGHT_PLAY)
        deeper += own[i] * motion[i, 0]
        is_along = is_along or motion[i, 1] != 0.0
    return own, motion, deeper, is_along


@njit(**_OPTIONS)
def _is_chance(deeper, direction, stddev, anchor_stddev, rests):
    """Return True if a reversal [m] is within the noise; `rests` is the probability of rest."""
    sigmas = _REVERSAL if rests < _MOVES else _REVERSAL_AT_REST
    return deeper * direction < 0.0 and abs(deeper) < sigmas * np.hypot(stddev, anchor_stddev)


@njit(**_OPTIONS)
def _find_stddev(ratios, mu, own, rates, shares, stddev):
    """Return the standard deviation of the traction ratio by that of the depth [m], at ratios of the path (M,)."""
    slides = ((np.abs(np.abs(ratios) - mu) < _AT_CONE) * own).sum()
    return (_SLIDING if slides > _MOST else 1.0) * find_turn(rates, shares, (own * ratios).sum()) * stddev


@njit(**_OPTIONS)
def find_places(x, shift):
    """Return depth and height (N, 2) [m] of hypotheses x (N, n), `shift` [m] deeper."""
    places = np.empty((len(x), 2))
    for i in range(len(x)):
        places[i, 0], places[i, 1] = x[i, DEPTH] + shift, x[i, HEIGHT]
    return places


@njit(**_OPTIONS)
def _bear(mu, prior, step, upright):
    """Return the probabilities (M,) that a coefficient holds and bears a ratio; their sum is P(mu > |upright|).

    Args:
        mu: coefficients of friction (M,).
        prior: their probabilities (M,).
        step: distance of the coefficients.
        upright: traction ratio of an object that only the jaws hold.
    """
    return prior * np.minimum(np.maximum((mu + 0.5 * step - abs(upright)) / step, 0.0), 1.0)


@njit(**_OPTIONS)
def _bound_held(log_weights, bears, known):
    """Return log weights (N,) and log P(mu > |upright|); see `TractionHypotheses.bound_held`.

    Args:
        log_weights: before (N,).
        bears: see `_bear`.
        known: the log probability that is counted already, and log odds by moves that are not.
    """
    before, parting = known
    bearing, weighed = np.log(max(bears.sum(), _LEAST_PROBABILITY)), log_weights.copy()
    weighed[-1] += bearing - before + parting
    return weighed - np.log(np.exp(weighed).sum()), bearing


@njit(**_OPTIONS)
def expect_coefficient(packed, weights):
    """Return the expected coefficient of friction, see `preview`; 0 if only the jaws hold the object."""
    mu, held = packed[0][0], packed[2][0]
    return (_share(weights, len(mu)) * mu).sum() if held < 1.0 else 0.0


@njit(**_OPTIONS)
def find_held(packed, weights):
    """Return the probability that only the jaws hold the object, for weights (N,) of the hypotheses; see `preview`."""
    return weights[-1] if packed[2][0] > 0.0 else 0.0


@njit(**_OPTIONS)
def preview(packed, x, shift, weights, track):
    """Return the traction ratio of each hypothesis (N,) at another state of the object, and its standard deviation.

    That is the change of the traction ratio if a motion back that may be chance is none; see `TractionHypotheses`.

    Args:
        packed: coefficients (M,), see `SlipPath` for parts, shares and rates, and the path's end (M, 2) [m], none
            before the path begins; direction of the path, standard deviation of its end [m], and of the traction ratio
            by its errors; probability that only the jaws hold the object, and its ratio then.
        x: means of the hypotheses (N, n).
        shift: how much deeper the object is [m].
        weights: of the hypotheses (N,).
        track: state of the depth, see `Track`.
    """
    (mu, parts, shares, rates, anchor), (direction, anchor_stddev, before), (held, upright) = packed
    if held >= 1.0 or len(anchor) == 0:  # it may stick either way
        return _bound(parts @ shares, held, upright), expect_coefficient(packed, weights)
    own, motion, deeper, is_along = _find_motion(anchor, find_places(x, shift), weights)
    stddev = np.sqrt(max(find_variance(track), 0.0))
    if not is_along and _is_chance(deeper, direction, stddev, anchor_stddev, track[0]):
        ratios = parts @ shares
        return _bound(ratios, held, upright), find_turn(rates, shares, (own * ratios).sum()) * abs(deeper)
    ratios = turn_path(parts, mu, rates, motion) @ shares
    doubt = np.sqrt(max(_find_stddev(ratios, mu, own, rates, shares, stddev) ** 2 - before**2, 0.0))
    return _bound(ratios, held, upright), doubt
