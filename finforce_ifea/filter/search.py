"""The contact of one jaw with one object by the filter, image after image.

Each image: predict, linearise the equilibrium of jaw and object, look for jumps, update, and repeat about the updated
state until nothing changes that matters (iterated Kalman filter). What comes out is a `ContactState`.
"""

from __future__ import annotations

from math import sqrt
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from finforce.compiled import njit
from finforce.kalman import MotionNoise, Track, expect_position
from finforce_ifea.contact_mechanics.friction import Coefficient, constant_traction
from finforce_ifea.contact_mechanics.indenter import CELL, find_first_touch
from finforce_ifea.contact_mechanics.pressed_jaw import PressedState, RigidContact
from finforce_ifea.filter.filter import Posterior, reduce_covariance
from finforce_ifea.filter.friction_path import TractionHypotheses, find_places
from finforce_ifea.filter.jump import (
    ALIKE,
    BUMPED,
    JUMPS,
    LARGEST_MOVE,
    MISPLACED,
    NO_JUMP,
    NUDGED,
    OFFSET,
    UNDECIDED,
    JumpWatch,
    correct,
)
from finforce_ifea.filter.measurement import Measurement, Sight, find_seen, observe, summarize_sight
from finforce_ifea.filter.process import (
    APPARENT_SIGHT,
    APPARENT_TRACTION,
    BUMPED_SHIFT,
    BUMPED_TIME,
    BUMPED_TURN,
    CAMERA_SHIFT,
    CAMERA_TIME,
    CAMERA_TURN_STDDEV,
    PLACE_STRETCH,
    PLACE_TIME,
    PLACE_TURN,
    TRACTION_FLOOR,
    TRACTION_SHARE,
    Expectation,
    advance,
    start,
)
from finforce_ifea.filter.readout import find_held_ratio, judge_points, read_out
from finforce_ifea.filter.state import DEPTH, HEIGHT, SHAPE, TRACTION, state_size
from finforce_ifea.settings import EstimatorSettings
from finforce_ifea.tracking.contact_state import KEYPOINT, LEAST_DEPTH, LOADED_DEPTH, blank_contact_state

_OPTIONS = {"cache": True, "error_model": "numpy"}
# What is expected of an object, and what the search for its contact is allowed.
EXPECTATION = np.dtype(
    [
        ("mean", float, 2),  # of shape and height [m]
        ("variance", float, 2),  # of both
        ("lowest", float),  # shape
        ("highest", float),  # shape
        ("largest_change", float),  # of the shape at once
        ("settled_change", float),  # of the shape that no longer matters
        ("has_corners", bool),  # whether the object may rock
        ("shared", float),  # standard deviation of a shift that all key points of an image share [m]
        ("mount", float),  # standard deviation of the height at which the jaw is mounted [m]
    ],
    align=True,
)
# Process noise of the depth: drift at rest [m/s^0.5], changes of the speed in motion [m/s^1.5], speed at which motion
# starts [m/s], mean times of rest and motion [s]: jaws close at millimetres per second, and stop. Jumps [m] are images
# that were missed, or another object.
_DEPTH_NOISE = MotionNoise(
    drift=(0.01e-3) ** 2,
    acceleration=0.004**2,
    start=(5e-3) ** 2,
    rest_time=3.0,
    motion_time=1.0,
    jump=(5e-3) ** 2,
    jump_probability=1e-3,
)
# Mean time of rest of an object that hardly presses: jaws that are open are about to close [s].
_FREE_TIME = 0.15
# 1 sigma of the depth at the beginning [m].
_FIRST_DEPTH = 0.1e-3
# Standard deviation of a slide's length, relative to what the object's pose says [-].
_SLIDE = 0.3
# Images from which the noise is learnt, the largest change that one of them shows, and the largest noise, as variances
# over that in the tare; and the median of D^2 for three normal numbers, less what the contact takes up.
_LEVEL_IMAGES = 8.0
_LARGEST_CHANGE = 9.0
_LARGEST_LEVEL = 25.0
_MEDIAN_SQUARE = 2.05
# Images from which the scatter of the depths is learnt.
_SCATTER_IMAGES = 15.0
# Largest change of the height at once [m], and the changes that no longer matter [m].
_LARGEST_SHIFT = 0.3e-3
_SETTLED = 0.1e-3
# Of the model's reach.
_SETTLED_CORRECTION = 0.05
# Steps shortened to less than this factor are taken as they are: the key points cannot decide between two corners.
_UNDECIDED = 0.2
# Change of a traction ratio that does not matter [-].
_SAME_RATIO = 0.02
# 1 sigma of the inclination of a force by an edge that hardly touches [-].
_INCLINED = 0.5
# Depth up to which an edge is rounded [m]: half a cell of its field.
_EDGE = 0.5 * CELL
# Least force at which the inclination of the faces is asked for [N].
_LEAST_FORCE = 0.1
_LEAST_VARIANCE = 1e-14
# Weight at which a key point still agrees, and the share of them that has to.
_AGREES = 0.25
_MAJORITY = 0.5
# The largest bump of a camera that is believed [sigma].
_LARGEST_BUMP = 5.0
# Variances (4,) of the camera's motion where nobody touches it, and where it was bumped.
_STILL = np.array([CAMERA_SHIFT, CAMERA_SHIFT, CAMERA_TURN_STDDEV, 0.0]) ** 2
_BUMPED = np.array([BUMPED_SHIFT, BUMPED_SHIFT, BUMPED_TURN, 0.0]) ** 2


class _Place(NamedTuple):
    """State of the contact (3,), where the mechanics stands for it (3,), and depth below first touch [m]."""

    x: NDArray
    x_model: NDArray
    depth: float


class ContactSearch:
    """The contact of one jaw with one object, image after image.

    Attributes:
        points: key points of the last image (K,), see `KEYPOINT`.
        state: of the contact in the last image in which it was found, see `CONTACT_STATE`.
        expectation: of the object, see `EXPECTATION`.
        q: unknowns of the jaw (size,).
        positions: of the key points in the model (K, 3) [m].
        hypotheses: of the object's traction.
        x: means of the hypotheses (N, n); None before the first image.
        P: covariance (n, n).
        weights: probabilities of the hypotheses (N,).
        track: of the depth.
        pull: of the weight along the finger, if only the jaws hold the object, and its standard deviation [N].
    """

    def __init__(self, count: int, settings: EstimatorSettings) -> None:
        """Prepare the filter for `count` key points."""
        self.settings, self.pull = settings, (0.0, 0.0)
        self.points, self.positions = np.zeros(count, KEYPOINT), np.zeros((count, 3))
        self.state, self.expectation = blank_contact_state(), np.zeros((), EXPECTATION)
        self._count, self._sight = count, Sight(0.0, 0.0, 1.0)
        self._watches = [JumpWatch(jump, state_size(count)) for jump in (NUDGED, OFFSET)]
        self.expect_friction(Coefficient(settings.friction, settings.friction_stddev))

    def begin(self, contact: RigidContact, mean: NDArray) -> None:
        """Begin with the undeformed jaw and an object of expected shape and height (2,) that just touches."""
        self.state = blank_contact_state()
        self.state["x"][1:] = mean
        self.state["x"][DEPTH] = contact.find_touch(self.state["x"])
        self.resume(contact.begin(mean[1]))
        self._misplaced = False
        self.restart()
        self.hypotheses.reset()

    def resume(self, q: NDArray) -> None:
        """Continue from another shape of the jaw (size,), whose motions are not known yet."""
        self.q, self._modes = q, np.zeros((len(q), 3))

    def forget(self, expected_mean: NDArray) -> None:
        """Expect an object of any shape and height about a mean (2,) again; key points and friction stay."""
        self.state["x"][1:] = expected_mean
        self._misplaced = False
        self.hypotheses.leave()
        if self.x is None:
            return
        expected = self._expect()
        means, variances = np.r_[expected.mean, 0.0], np.r_[expected.variance, expected.traction_variance]
        self.x[:] = self.mean
        for i, mean, variance in zip((SHAPE, HEIGHT, TRACTION), means, variances, strict=True):
            self._return_entry(i, mean, variance, 1.0)

    def _return_entry(self, i: int, mean: float, variance: float, share: float) -> None:
        """Let an entry of the state lose a share of what is known of it beyond its prior, in variance."""
        kept = sqrt(1.0 - share)
        self.x[:, i] = mean + kept * (self.x[:, i] - mean)
        self.P[i, :] *= kept
        self.P[:, i] *= kept
        self.P[i, i] += share * variance

    def restart(self) -> None:
        """Start anew where the contact is now, as after another tare; what is known of friction stays."""
        self.x: NDArray | None = None
        self._bumped, self._smooth, self._level, self._scatter = False, 0.0, 1.0, 1.0
        self._raw = np.full(2, np.nan)
        self._forget_innovations()

    def _forget_innovations(self) -> None:
        for watch in self._watches:
            watch.reset()

    def expect_friction(self, friction: Coefficient) -> None:
        """Expect an object of another coefficient of friction, of which nothing was seen."""
        self.hypotheses = TractionHypotheses(friction, self.settings.held)
        self.log_weights = self.hypotheses.prior
        self.restart()

    def let_go(self) -> None:
        """Weigh anew whether only the jaws hold the object."""
        if self.x is not None:
            self.x[:] = self.mean
            self.log_weights = self.hypotheses.reweigh(self.log_weights)
            self.hypotheses.reset()

    def lead(self, change: NDArray) -> None:
        """Take shape and height along by a change (2,), which lessens what is known beyond the object's pose."""
        self.state["x"][1:] += change
        if self.x is None:
            return
        expected = self._expect()
        for i, each, mean, variance in zip((SHAPE, HEIGHT), change, expected.mean, expected.variance, strict=True):
            self.x[:, i] += each
            self._return_entry(i, mean, variance, min((_SLIDE * each) ** 2 / variance, 1.0))

    def shift(self, change: float) -> None:
        """Count the depth `change` [m] more, as of an object that was cut anew."""
        self.state["x"][DEPTH] += change
        self.state["x_model"][DEPTH] += change
        if self.x is not None:
            self.x[:, DEPTH] += change
            self.track.shift(change)
            self._raw += change
            self.hypotheses.shift(change)

    def lose(self, stddev: float) -> None:
        """Widen the search for the next image by a standard deviation of the depth [m]."""
        if self.x is not None:
            self.track.widen(stddev**2)
            self.hypotheses.motion += stddev

    @property
    def log_weights(self) -> NDArray:
        """Log probabilities of the hypotheses (N,)."""
        return self._log_weights

    @log_weights.setter
    def log_weights(self, log_weights: NDArray) -> None:
        self._log_weights, self.weights = log_weights, np.exp(log_weights)

    @property
    def mean(self) -> NDArray:
        """Mean of the state over the hypotheses (n,)."""
        return self.weights @ self.x

    @property
    def friction(self) -> Coefficient:
        """The estimate of the coefficient of friction."""
        return self.hypotheses.estimate(self.weights)

    @property
    def ratio(self) -> float:
        """Expected traction ratio [-]."""
        return float(self.weights @ self.hypotheses.ratios)

    def _expect(self) -> Expectation:
        """Return what the state returns to."""
        mu, variance = self.friction.mean, self.expectation["variance"].copy()
        variance[1] += (float(MISPLACED.stddev[0]) ** 2 if self._misplaced else 0.0) + self.expectation["mount"] ** 2
        traction = TRACTION_FLOOR**2 + (TRACTION_SHARE * mu) ** 2 + min(self.hypotheses.stddev, mu) ** 2
        shared = float(self.expectation["shared"])
        camera, time = (_BUMPED, BUMPED_TIME) if self._bumped else (_STILL, CAMERA_TIME)
        if shared > 0.0:
            camera, time = camera + np.array([shared, shared, PLACE_TURN, PLACE_STRETCH]) ** 2, PLACE_TIME
        mean, traction = self.expectation["mean"].copy(), traction + self.hypotheses.unweighed**2
        apparent = APPARENT_TRACTION**2 + APPARENT_SIGHT**2 * self._sight.variance
        return Expectation(mean, variance, traction, apparent, camera, time)

    def _predict(self, dt: float) -> None:
        """Predict the state of an image dt [s] after the last one."""
        expected, positions, passed = self._expect(), self.positions, (dt, self.hypotheses.take_motion())
        if self.x is None:
            m, self._V = start(expected, self.points, self.state["x"])
            self.x, self.P = np.tile(m, (len(self.log_weights), 1)), np.diag(self._V)
            self.track = Track(_DEPTH_NOISE, float(m[DEPTH]), _FIRST_DEPTH**2)
            positions, passed = np.ascontiguousarray(self.points["rest"]), (0.0, 0.0)
        self.track.predict(dt, _FREE_TIME if self.state["depth"] < LOADED_DEPTH else None)
        known, responses = (self.track.x, self.weights), tuple(watch.F for watch in self._watches)
        advance(self.x, self.P, self._V, tuple(expected), self.points, positions, passed, *known, responses)

    def find(self, contact: RigidContact, probe: Any, dt: float, *, iterations: int) -> bool:
        """Find the contact in the image of `points`; False, all as it was, where too few key points agree.

        Args:
            contact: of the jaw with the object.
            probe: of its key points.
            dt: time since the last image [s].
            iterations: at most; the next image goes on from there.
        """
        points, expectation, seen = self.points, self.expectation, find_seen(self.points)
        self._sight = Sight(*summarize_sight(points))
        self._predict(dt)
        if len(seen) < max(self.settings.minimum_keypoints, 3):
            return False
        self.log_weights = self.hypotheses.bound_held(self.log_weights)
        ratios, x = self._preview(self.x, 0.0), self.mean[: HEIGHT + 1]
        x[0], x[1] = self.track.x, min(max(x[1], expectation["lowest"]), expectation["highest"])
        ratio, place = float(self.weights @ ratios), _Place(x, *find_x_model(contact, x))
        q = self.q + self._modes @ (place.x_model - self.state["x_model"])
        settled, iteration, last = False, 0, (np.zeros(3), 1.0)
        posterior, found, jump, P = None, UNDECIDED, NO_JUMP, self.P.copy()
        possible = self._find_possible_jumps()
        image = points, seen, self._level, expectation
        known = contact.packed_object, contact.reach, self.track.state, self._scatter
        prior = ratios, self.x, self.log_weights, P
        while iteration < iterations and not settled:
            iteration += 1
            at = place.x_model
            pressed, positions, motions = contact.linearize_points(probe, q, at, constant_traction(ratio))
            if not pressed.touches:
                q = q + contact.approach(q, pressed.correction, at)
                continue
            q, mechanics = q + pressed.correction, (positions, motions, at, ratio, pressed.modes, pressed.size)
            given = np.empty(0) if found == UNDECIDED else posterior.weight
            step = _iterate(image, mechanics, prior, given, possible, known, place.x, last)
            (measured, posterior, found), place, (moved, change), last, settled = step
            jump, q, place, made = max(jump, found), q + change, _Place(*place), (pressed, positions, at)
        if posterior is None or not _is_believed(posterior.mean, posterior.weight, self._V):
            return False
        (pressed, positions, at), weight = made, posterior.weight
        before, ratios = ratios, self._preview(posterior.x, place.x[0] - posterior.mean[DEPTH])
        if np.abs(ratios - before).max() > _SAME_RATIO:
            posterior, _ = correct(measured, weight, ratios, *prior[1:], possible, at[DEPTH])
        self.q, self._modes, self.positions = q, pressed.modes[:, :3], positions
        self._take_jump(jump)
        self._level = _follow_level(self._level, posterior.distances)
        self.x, self.P, self.log_weights = posterior.x, reduce_covariance(P, posterior.A), posterior.log_weights
        if settled:
            self._watch(measured, posterior)
        self._read_out(pressed, at, place, posterior, (ratios, ratio))
        judge_points(self.state, points, seen, posterior.mean, self._V, posterior.left, weight, expectation["mean"][1])
        self.state["iterations"], self.state["converged"] = iteration, settled
        self.state["ambiguity"] = 0.0 if settled else np.linalg.norm(pressed.force_modes[:, :3] @ moved)
        return True

    def _preview(self, x: NDArray, shift: float) -> NDArray:
        """Return the traction ratios (N,) with the object where hypotheses x (N, n) have it, `shift` [m] deeper."""
        return self.hypotheses.preview(x, shift, self.track, self.weights)

    def _find_possible_jumps(self) -> tuple[bool, bool]:
        """Return which of `JUMPS` are possible now."""
        return True, bool(self.state["depth"] > LOADED_DEPTH) and not self._misplaced

    def _take_jump(self, index: int) -> None:
        """Remember which of `JUMPS` was seen, or `NO_JUMP`."""
        if index != NO_JUMP:
            self._forget_innovations()
            self._bumped |= JUMPS[index] is BUMPED
            self._misplaced |= JUMPS[index] is MISPLACED

    def _watch(self, measured: Measurement, posterior: Posterior) -> None:
        """Look for jumps that show over several images only."""
        shift = ALIKE * self._sight.variance
        common = np.array([shift, shift, shift / self._sight.height_variance]), np.zeros(1)
        for watch, is_possible, alike in zip(self._watches, (True, not self._misplaced), common, strict=True):
            change = watch.update(measured, posterior, self._sight.share, alike) if is_possible else None
            if change is not None:
                self.x, self.P = self.x + change[0], self.P + change[1]
                self._bumped |= watch is self._watches[0]
                self._misplaced |= watch is self._watches[1]
                self._forget_innovations()
                return

    def _smooth_depth(self, raw: float, variance: float) -> float:
        """Smooth a depth [m] of some variance [m^2]; return by which factor that lessens its standard deviation."""
        own = max(variance, _LEAST_VARIANCE)
        self._scatter = _follow_scatter(self._scatter, self._raw, raw, self._scatter * own)
        self._raw = np.array([self._raw[1], raw])
        self.track.update(raw, self._scatter * own)
        self._smooth = self.track.x - raw
        return sqrt(min(self.track.variance / own, self._scatter))

    def _read_out(
        self, pressed: PressedState, at: NDArray, place: _Place, posterior: Posterior, traction: tuple[NDArray, float]
    ) -> None:
        """Fill in the contact state.

        Args:
            pressed: the last linearisation.
            at: where that was (3,).
            place: of the contact.
            posterior: of the image.
            traction: ratio of each hypothesis (N,), and that of the linearisation.
        """
        s = blank_contact_state()
        lessened = self._smooth_depth(float(self.weights @ self.x[:, DEPTH]), float(posterior.own[0, 0]))
        s["x"], s["x_model"], s["depth"] = place
        s["pressure_point"], s["pressure_location"] = pressed.pressure_point, pressed.pressure_location
        s["extrapolation"], s["sound"] = pressed.extrapolation, pressed.smallest_det > 0.0
        s["mistaken"] = self._misplaced
        force, modes, (ratios, ratio) = pressed.force, np.ascontiguousarray(pressed.force_modes), traction
        shift = self._smooth + place.x_model[0] - place.x[0]
        # an edge is rounded by more than it sinks in at first
        inclined = _INCLINED * max(1.0 - place.depth / _EDGE, 0.0) if self.expectation["has_corners"] else 0.0
        spread, held = self.hypotheses.doubt**2 + inclined**2, self.hypotheses.find_held(self.weights)
        spread += held * self.hypotheses.pull_stddev**2
        smoothing = posterior.own, lessened
        read_out(s, force, modes, self.x, self.log_weights, self.P, shift, smoothing, at, ratios, ratio, spread)
        self.state = s
        if s["magnitude"] > _LEAST_FORCE:
            pull, stddev = self.pull
            self.hypotheses.upright, slope = find_held_ratio(force, ratio, pull)
            self.hypotheses.pull_stddev = slope * stddev

    def follow_path(self, contact: RigidContact) -> None:
        """Follow how the object uses its friction, which the force of the image did not wait for."""
        if self.x is None or not self.hypotheses.follows_path:
            return
        if self.state["depth"] <= 0.0:
            self.hypotheses.leave()
            return
        places = find_places(self.x, self._smooth)
        self.hypotheses.follow(contact, self.q, self.state["x_model"], places, self.track, self.weights)

    def contact_covariance(self) -> NDArray:
        """Return the covariance of depth, shape and height (3, 3)."""
        return self.P[: HEIGHT + 1, : HEIGHT + 1]


def find_x_model(contact: RigidContact, x: NDArray) -> tuple[NDArray, float]:
    """Return the state (3,) at which the mechanics stands for x, never above the surface, and the depth below [m]."""
    return _find_x_model(contact.packed_object, x)


@njit(**_OPTIONS)
def _find_x_model(touching, x):
    """See `find_x_model`; `touching` are object and surface, see `find_first_touch`."""
    x_model, touch = x.copy(), find_first_touch(*touching, x)
    x_model[DEPTH] = max(x[DEPTH], touch + LEAST_DEPTH)
    return x_model, x[DEPTH] - touch


@njit(**_OPTIONS)
def _iterate(image, at, prior, weight, possible, known, x, last):
    """Return what one image makes of one linearisation: the step that it asks for.

    Args:
        image: `points`, `seen` and `level` of `observe`; see `EXPECTATION`.
        at: `positions`, `motions`, `at` and `ratio` of `observe`; modes (size, 4) and size of the `PressedState`.
        prior: `ratios`, `x`, `log_weights` and `P` of `correct`.
        weight: see `correct`.
        possible: see `correct`.
        known: object and surface, see `find_first_touch`; reach of the model (size,); state of the depth's `Track`, and
            the variance of depths over that by the noise.
        x: state of the contact (3,).
        last: step (3,), and the share of a step that this one may have.

    Returns:
        Measurement, posterior and jump; the next `_Place`; the motion of the mechanics (3,) and of its unknowns
        (size,); this step, and the next share; whether it changes nothing that matters.
    """
    (points, seen, level, expectation), (positions, motions, x_model, ratio, modes, size) = image, at
    (touching, reach, track, scatter), (before, share) = known, last
    measured = observe(points, seen, positions, motions, x_model, ratio, level)
    posterior, found = correct(measured, weight, *prior, possible, x_model[DEPTH])
    aim, variance = posterior.mean[: HEIGHT + 1] - x, max(posterior.own[0, 0], _LEAST_VARIANCE) * scatter
    aim[0] = expect_position(track, posterior.mean[DEPTH], variance, _DEPTH_NOISE) - x[0]
    x, step, share = _take_step(x, aim, before, share, expectation)
    after, depth = _find_x_model(touching, x)
    moved = after - x_model
    change = modes[:, 0] * moved[0] + modes[:, 1] * moved[1] + modes[:, 2] * moved[2]
    change /= max((np.abs(change) / reach).max(), 1.0)
    is_settled = size < _SETTLED_CORRECTION and _is_settled(moved, aim - step, share, expectation)
    return (measured, posterior, found), (x, after, depth), (moved, change), (step, share), is_settled


@njit(**_OPTIONS)
def _take_step(x, aim, last, share, expectation):
    """Return x (3,) after a step (3,) within a share of where the linearisation holds, the step, and the next share.

    Between two corners of an object the linearisation changes its mind: meet in the middle.
    """
    expectation, step = expectation[()], np.empty(3)
    most = (LARGEST_MOVE, share * expectation.largest_change, share * _LARGEST_SHIFT)
    for i in range(3):
        step[i] = min(max(aim[i], -most[i]), most[i])
    if expectation.has_corners and step[1] * last[1] + step[2] * last[2] < 0.0:
        step[1:] *= 0.5
        share *= 0.5
    moved = x + step
    moved[1] = min(max(moved[1], expectation.lowest), expectation.highest)
    return moved, step, share


@njit(**_OPTIONS)
def _follow_level(level, distances):
    """Return the variance of the noise over that in the tare, for what was expected and D^2 (m,) of the residuals."""
    seen = min(np.median(distances) / _MEDIAN_SQUARE, _LARGEST_CHANGE)
    return min(max(level * (1.0 + (seen - 1.0) / _LEVEL_IMAGES), 1.0), _LARGEST_LEVEL)


@njit(**_OPTIONS)
def _follow_scatter(scatter, before, z, R):
    """Return the variance of the depths over that by the noise.

    Noise sends the depth back after each step: the product of two steps is less than zero by its variance, while
    steps of a motion have the same sign, or any. Those that are far larger are no noise.

    Args:
        scatter: as it was expected.
        before: the last two depths (2,) [m], NaN if there are none.
        z: depth [m].
        R: its variance, `scatter` included [m^2].
    """
    step, last = z - before[1], before[1] - before[0]
    largest = np.sqrt(2.0 * _LARGEST_LEVEL * R)
    if not (abs(step) <= largest and abs(last) <= largest):
        return scatter
    return min(max(scatter * (1.0 - (1.0 + step * last / R) / _SCATTER_IMAGES), 1.0), _LARGEST_LEVEL)


@njit(**_OPTIONS)
def _is_settled(moved, missing, share, expectation):
    """Return True if a step that moved the model by (3,), and left (3,) out, changed nothing that matters."""
    tolerance = (_SETTLED, expectation[()].settled_change, _SETTLED)
    for i in range(3):
        if abs(moved[i]) >= tolerance[i] or (share > _UNDECIDED and abs(missing[i]) >= tolerance[i]):
            return False
    return True


@njit(**_OPTIONS)
def _is_believed(mean, weight, V):
    """Return True if most key points, by their weight (m,), agree, and the camera has moved as far as a bump may do.

    Where V (n,) allows more, it may have moved farther by the mean of the state (n,).
    """
    for i in range(len(BUMPED.entries)):
        entry = BUMPED.entries[i]
        if not abs(mean[entry]) < _LARGEST_BUMP * max(BUMPED.stddev[i], np.sqrt(V[entry])):
            return False
    return (weight > _AGREES).mean() > _MAJORITY
