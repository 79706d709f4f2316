"""The contact of one jaw with one object by the filter, image after image.

Each image: predict, linearise the equilibrium of jaw and object, look for jumps, update, and repeat about the updated
state until nothing changes that matters (iterated Kalman filter). What comes out is a `ContactState`.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from finforce.kalman import Track
from finforce_ifea.contact_mechanics.friction import Coefficient, constant_traction
from finforce_ifea.contact_mechanics.pressed_jaw import RigidContact
from finforce_ifea.filter.friction_path import TractionHypotheses, expect_coefficient, find_places
from finforce_ifea.filter.image_update import (
    DEPTH_NOISE,
    EXPECTATION,
    find_expectation,
    finish,
    is_believed,
    iterate,
    move_along,
    predict_image,
)
from finforce_ifea.filter.jump import (
    BUMPED,
    JUMPS,
    MISPLACED,
    NO_JUMP,
    NUDGED,
    OFFSET,
    UNDECIDED,
    forget,
    watch_for,
)
from finforce_ifea.filter.measurement import DetectorErrors, summarize_detector_errors
from finforce_ifea.filter.process import Expectation, start
from finforce_ifea.filter.state import DEPTH, HEIGHT, SHAPE, TRACTION, state_size
from finforce_ifea.settings import EstimatorSettings
from finforce_ifea.tracking.contact_state import KEYPOINT, LOADED_DEPTH, blank_contact_state

# Mean time of rest of jaws that are open or hardly pressed [s]: they are about to close.
_FREE_TIME = 0.15
# Standard deviation of the depth in the first image [m].
_FIRST_DEPTH = 0.1e-3
# Least force at which the inclination of the faces is read [N].
_LEAST_FORCE = 0.1


class _Place(NamedTuple):
    """State of the contact (3,), state of the mechanics (3,), and depth below first touch [m]."""

    x: NDArray
    x_model: NDArray
    depth: float


class ContactSearch:
    """The contact of one jaw with one object, image after image.

    Attributes:
        points: key points of the last image (K,), see `KEYPOINT`.
        correlation: of their noise (K, K), see `measure_correlation`.
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
        self.correlation = np.eye(count)
        self._count, self._detector_errors = count, DetectorErrors(0.0, 0.0, 1.0)
        self._watches = tuple(watch_for(jump, state_size(count)) for jump in (NUDGED, OFFSET))
        self._packed_watches = tuple((tuple(each.jump), *each[1:]) for each in self._watches)
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
        self.q, self._modes = q, np.zeros((len(q), 4))

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
            self.x[:, i] = mean
            self.P[i, :] = self.P[:, i] = 0.0
            self.P[i, i] = variance

    def restart(self) -> None:
        """Start anew where the contact is now, as after another tare; what is known of friction stays."""
        self.x: NDArray | None = None
        self._bumped, self._smooth, self._level, self._scatter = False, 0.0, 1.0, 1.0
        self._raw = np.full(2, np.nan)
        self._forget_innovations()

    def _forget_innovations(self) -> None:
        for each in self._watches:
            forget(each)

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
        """Take shape and height along by a change (2,)."""
        self.state["x"][1:] += change
        if self.x is not None:
            self.x[:, SHAPE : HEIGHT + 1] += change

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

    @property
    def _told(self) -> tuple[bool, bool, float, float]:
        """Argument `told` of `find_expectation`."""
        return self._misplaced, self._bumped, self.hypotheses.stddev, self.hypotheses.unweighed

    def _expect(self) -> Expectation:
        """Return the prior that the state returns to."""
        friction = expect_coefficient(self.hypotheses.packed, self.weights)
        return find_expectation(self.expectation, self._told, self._detector_errors.variance, friction)

    def _start(self) -> None:
        """Begin with the first image."""
        self._detector_errors = DetectorErrors(*summarize_detector_errors(self.points))
        m, self._V = start(self._expect(), self.points, self.state["x"])
        self.x, self.P = np.tile(m, (len(self.log_weights), 1)), np.diag(self._V)
        self.track = Track(DEPTH_NOISE, float(m[DEPTH]), _FIRST_DEPTH**2)

    def find(self, contact: RigidContact, probe: Any, dt: float, *, iterations: int) -> bool:
        """Find the contact in the image of `points`; False, with the contact as it was, if too few key points agree.

        Args:
            contact: of the jaw with the object.
            probe: of its key points.
            dt: time since the last image [s].
            iterations: at most; the next image goes on from there.
        """
        friction, touching = self.hypotheses.packed, contact.packed_object
        seen, (ratios, ratio), place = self._predict(dt, friction, touching)
        if len(seen) < max(self.settings.minimum_keypoints, 3):
            return False
        q = move_along(self.q, self._modes, place.x_model, self.state["x_model"])
        settled, iteration, last = False, 0, (np.zeros(3), 1.0)
        posterior, found, jump, P = None, UNDECIDED, NO_JUMP, self.P.copy()
        possible = True, bool(self.state["depth"] > LOADED_DEPTH) and not self._misplaced
        image = (self.points, seen, self._level, self.correlation), self.expectation
        known = touching, contact.reach, self.track.state, self._scatter
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
            step = iterate(image, mechanics, prior, given, possible, known, place.x, last)
            (measured, posterior, found), place, change, last, settled = step
            jump, q, place, made = max(jump, found), q + change, _Place(*place), (pressed, positions, at)
        if posterior is None or not is_believed(posterior.mean, posterior.weight, self._V):
            return False
        (pressed, self.positions, at), self.q, self._modes = made, q, made[0].modes
        self._take_jump(jump)
        results = tuple(measured), tuple(posterior)
        self._take(image, P, results, friction, pressed, at, ratio, tuple(place), settled=settled)
        self.state["iterations"], self.state["converged"] = iteration, settled
        return True

    def _predict(self, dt: float, friction: tuple, touching: tuple) -> tuple[NDArray, tuple[NDArray, float], _Place]:
        """Predict the state of an image dt [s] after the last one.

        Args:
            dt: see above.
            friction: see `preview`.
            touching: object and surface, see `find_first_touch`.

        Returns:
            Key points that are seen (m,); traction ratios of the hypotheses (N,), and their mean; place of the contact.
        """
        positions, passed = self.positions, (dt, self.hypotheses.take_motion())
        if self.x is None:
            self._start()
            positions, passed = np.ascontiguousarray(self.points["rest"]), (0.0, 0.0)
        filtered, weights = (self.x, self.P, self._V, self.track.state), self.weights
        self.log_weights = self.hypotheses.bound_held(self.log_weights)
        rest_time = _FREE_TIME if self.state["depth"] < LOADED_DEPTH else DEPTH_NOISE.rest_time
        image, expected, weights = (self.points, positions), (self.expectation, self._told), (weights, self.weights)
        times, watches = (dt, rest_time, passed), self._packed_watches
        seen, detector, ratios, place = predict_image(
            image, expected, filtered, weights, friction, times, watches, touching
        )
        self._detector_errors = DetectorErrors(*detector)
        return seen, ratios, _Place(*place)

    def _take(self, image, P, results, friction, pressed, at, ratio, place, *, settled: bool) -> None:
        """Store the update of an image; see `finish` for the arguments."""
        hypotheses, s = self.hypotheses, blank_contact_state()
        s["mistaken"] = self._misplaced
        made = pressed.force, np.ascontiguousarray(pressed.force_modes), at, ratio
        where = pressed.pressure_point, pressed.pressure_location, pressed.extrapolation, pressed.smallest_det
        weighed = friction, self.weights, (self.pull[0], hypotheses.pull_stddev)
        filtered = self.track.state, self._scatter, self._raw
        watching = tuple(self._detector_errors), self._packed_watches, settled
        means, (self._level, self._scatter, self._smooth), upright, jumped = finish(
            s, image, P, results, weighed, filtered, made, where, place, watching
        )
        self.x, self.P, self._log_weights, self.weights = means
        self._bumped |= jumped == 0
        self._misplaced |= jumped == 1
        if s["magnitude"] > _LEAST_FORCE:
            hypotheses.upright, hypotheses.pull_stddev = upright[0], upright[1] * self.pull[1]
        self.state = s

    def _take_jump(self, index: int) -> None:
        """Remember which of `JUMPS` was seen, or `NO_JUMP`."""
        if index != NO_JUMP:
            self._forget_innovations()
            self._bumped |= JUMPS[index] is BUMPED
            self._misplaced |= JUMPS[index] is MISPLACED

    def follow_path(self, contact: RigidContact) -> None:
        """Extend the friction path after the force of the image has been reported."""
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
