"""The contact of one jaw with one object by the filter, image after image.

Each image: predict, linearise the equilibrium of jaw and object, look for jumps, update, and repeat about the updated
state until nothing changes that matters (iterated Kalman filter). What comes out is a `ContactState`.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from finforce.kalman import MotionNoise, Track
from finforce_ifea.contact_mechanics.friction import Traction, constant_traction
from finforce_ifea.contact_mechanics.pressed_jaw import PressedState, RigidContact, limit_step
from finforce_ifea.filter.filter import project_columns, reduce_covariance, update
from finforce_ifea.filter.friction_path import LARGEST_RATIO, TractionHypotheses
from finforce_ifea.filter.jump import BUMPED, MISPLACED, CameraWatch
from finforce_ifea.filter.measurement import linearize, take_noise, weigh, weigh_innovations, whiten
from finforce_ifea.filter.process import (
    CAMERA_SHIFT,
    CAMERA_TURN_STDDEV,
    TRACTION_FLOOR,
    TRACTION_SHARE,
    expect_state,
    find_decay,
    predict,
)
from finforce_ifea.filter.state import (
    CAMERA,
    CONTACT,
    DEPTH,
    HEIGHT,
    SHAPE,
    TRACTION,
    offset_entries,
    state_size,
)
from finforce_ifea.settings import EstimatorSettings
from finforce_ifea.tracking.contact_search import LOADED_DEPTH, TOUCH_DEPTH, ContactSearch, find_x_model
from finforce_ifea.tracking.contact_state import ContactState, blank_contact_state
from finforce_ifea.tracking.friction import Coefficient
from finforce_ifea.tracking.held_weight import find_upright_ratio

# Process noise of the depth: drift at rest [m/s^0.5], changes of the speed in motion [m/s^1.5], speed at which motion
# starts [m/s], mean times of rest and motion [s]: jaws close at millimetres per second, and stop.
_DEPTH_NOISE = MotionNoise(
    drift=(0.01e-3) ** 2, acceleration=0.004**2, start=(5e-3) ** 2, rest_time=3.0, motion_time=1.0
)
# 1 sigma of the depth at the beginning [m].
_FIRST_DEPTH = 0.1e-3
# Standard deviation of a slide's length, relative to what the object's pose says [-].
_SLIDE = 0.3
# Log probability below which no hypothesis falls, so that it can come back.
_LEAST_WEIGHT = -9.0
# Error of the force's direction [-]: it is considered and never estimated.
_MISDIRECTED = 0.03
# Largest change of the depth and of the height at once [m], and the changes that no longer matter [m].
_LARGEST_MOVE = 0.7e-3
_LARGEST_SHIFT = 0.3e-3
_SETTLED = 0.1e-3
# Of the model's reach.
_SETTLED_CORRECTION = 0.05
# Steps shortened to less than this factor are taken as they are: the key points cannot decide between two corners.
_UNDECIDED = 0.2
# Below this depth the force goes linearly to zero [m].
_LEAST_DEPTH = 3e-5
# Least force at which the inclination of the faces is asked for [N].
_LEAST_FORCE = 0.1
_LEAST_VARIANCE = 1e-14
# Weight at which a key point still agrees.
_AGREES = 0.25


class _Linearized(NamedTuple):
    """The mechanics at one state: where it stands (3,), its equilibrium, and the key points (K, 3) [m] with motions."""

    x: NDArray
    pressed: PressedState
    positions: NDArray
    motions: NDArray


class FilterSearch(ContactSearch):
    """Takes the place of `ContactSearch`.

    Attributes:
        hypotheses: of the object's traction.
        x: means of the hypotheses (N, n); None before the first image.
        P: covariance (n, n).
        log_weights: of the hypotheses (N,).
        track: of the depth.
    """

    def __init__(self, count: int, settings: EstimatorSettings) -> None:
        """Prepare the filter for `count` key points."""
        super().__init__(count, settings)
        self._size, self._count = state_size(count), count
        self._watch = CameraWatch(self._size)
        self.hypotheses = TractionHypotheses(Coefficient(settings.friction, settings.friction_stddev), settings.held)

    def begin(self, contact: RigidContact, mean: NDArray) -> None:
        """See `ContactSearch.begin`."""
        super().begin(contact, mean)
        self.x: NDArray | None = None
        self._V: NDArray | None = None
        self._smooth, self._misplaced, self._bumped = 0.0, False, False
        self._watch.reset()
        self.hypotheses.reset()

    def forget(self, mean: NDArray) -> None:
        """Expect an object of any shape and height about the mean (2,) again; key points and friction stay."""
        self.state["x"][1:] = mean
        self._misplaced = False
        self.hypotheses.leave()
        if self.x is None:
            return
        m, V = self._expect()
        self.x[:] = self.mean
        for i in (SHAPE, HEIGHT, TRACTION):
            self.x[:, i] = m[i]
            self.P[i, :] = self.P[:, i] = 0.0
            self.P[i, i] = V[i]

    def expect_friction(self, friction: Coefficient) -> None:
        """Expect an object of another coefficient of friction, of which nothing was seen."""
        self.hypotheses.expect(friction)
        if self.x is not None:
            self.x = np.tile(self.mean, (len(self.hypotheses.prior), 1))
            self.log_weights = self.hypotheses.prior

    def let_go(self) -> None:
        """Weigh anew whether only the jaws hold the object."""
        if self.x is not None:
            self.x[:] = self.mean
            self.log_weights = self.hypotheses.prior
            self.hypotheses.reset()

    def lead(self, change: NDArray, kept: float) -> None:
        """See `ContactSearch.lead`."""
        super().lead(change, kept)
        if self.x is None:
            return
        for i, each in zip((SHAPE, HEIGHT), change, strict=True):
            self.x[:, i] += each
            self.P[i, i] += (_SLIDE * each) ** 2

    def shift(self, change: float) -> None:
        """See `ContactSearch.shift`."""
        super().shift(change)
        if self.x is not None:
            self.x[:, DEPTH] += change
            self.track.shift(change)
            self.hypotheses.shift(change)

    def lose(self, stddev: float) -> None:
        """See `ContactSearch.lose`."""
        super().lose(stddev)
        if self.x is not None:
            self.track.widen(stddev**2)

    @property
    def weights(self) -> NDArray:
        """Probabilities of the hypotheses (N,)."""
        return np.exp(self.log_weights)

    @property
    def mean(self) -> NDArray:
        """Mean of the state over the hypotheses (n,)."""
        return self.weights @ self.x

    @property
    def friction(self) -> Coefficient:
        """What is known of the coefficient of friction."""
        return self.hypotheses.estimate(np.exp(self.hypotheses.prior) if self.x is None else self.weights)

    def _expect(self) -> tuple[NDArray, NDArray]:
        """Return mean and variance (n,) to which the state returns."""
        variance, mu = self.expectation["variance"].copy(), self.friction.mean
        variance[1] += float(MISPLACED.stddev[0]) ** 2 if self._misplaced else 0.0
        path = min(self.hypotheses.stddev, mu)
        bent = self.positions - self.points["rest"] if self._V is not None else np.zeros((self._count, 3))
        camera = BUMPED.stddev if self._bumped else np.array([CAMERA_SHIFT, CAMERA_SHIFT, CAMERA_TURN_STDDEV])
        return expect_state(
            self._size,
            self.expectation["mean"],
            variance,
            self.points["offset_variance"],
            np.hypot(bent[:, 0], bent[:, 2]),
            TRACTION_FLOOR**2 + (TRACTION_SHARE * mu) ** 2 + path**2 + self.hypotheses.unweighed**2,
            camera**2,
        )

    def _predict(self, dt: float) -> None:
        """Predict the state of an image dt [s] after the last one."""
        m, V = self._expect() if self.x is not None else self._begin_state()
        before, self._V = V if self._V is None else self._V, V
        growth, offsets = np.ones(self._size), offset_entries(self._count)
        growth[offsets] = np.sqrt(V[offsets] / before[offsets])
        a = find_decay(self._size, self._count, dt, self.hypotheses.take_motion(), bumped=self._bumped)
        self.track.predict(dt)
        self.x[:, DEPTH] += self.track.x - self.weights @ self.x[:, DEPTH]
        predict(self.x, self.P, a, m, V, growth)
        self._watch.predict(a * growth)

    def _begin_state(self) -> tuple[NDArray, NDArray]:
        """Start the filter where the contact begins; return mean and variance (n,) of the state."""
        self.log_weights = self.hypotheses.prior
        m, V = self._expect()
        x = m.copy()
        x[CONTACT] = self.state["x"]
        self.x, self.P = np.tile(x, (len(self.log_weights), 1)), np.diag(V)
        self.track = Track(_DEPTH_NOISE, float(x[DEPTH]), _FIRST_DEPTH**2)
        return m, V

    def find(
        self, contact: RigidContact, traction: Traction, probe: Any, dt: float, *, iterations: int, is_sudden: bool
    ) -> bool:
        """See `ContactSearch.find`; the filter knows traction and speed by itself."""
        self._predict(dt)
        points, expectation = self.points, self.expectation
        seen = np.flatnonzero(np.isfinite(points["measured"]).all(axis=1) & (points["trust"] > 0.0))
        if len(seen) < max(self.settings.minimum_keypoints, 3):
            return False
        rows, noise = (2 * seen[:, None] + np.arange(2)).ravel(), take_noise(points, seen)
        self.log_weights = self.hypotheses.bound_held(self.log_weights)
        ratios = self.hypotheses.ratios
        ratio = float(np.clip(self.weights @ ratios, -LARGEST_RATIO, LARGEST_RATIO))
        x = self.mean[CONTACT]
        x[0], x[1] = self.track.x, min(max(x[1], expectation["lowest"]), expectation["highest"])
        q = self.q + self._modes @ (find_x_model(contact, x)[0] - self.state["x_model"])
        settled, iteration, share, last = False, 0, 1.0, np.zeros(3)
        weight, at, moved = None, None, np.zeros(3)
        while iteration < iterations and not settled:
            iteration += 1
            q, made = self._linearize(contact, probe, q, x, ratio)
            if made is None:
                continue
            at = made
            H, u, left, square = linearize(points, seen, at.positions, at.motions)
            known = left.ravel() + H[:, :3] @ at.x + H[:, 3] * ratio
            expected = H[:, 3] * ratios[:, None]
            nu = known - project_columns(H, rows, u, self.x) - expected
            if weight is None:
                weight = self._detect_jumps(H, rows, u, self.weights @ nu, noise, square)
            R = noise / weight[:, None, None]
            means, log_weights, A, L, own = update(self.x, self.log_weights, H, rows, u, self.P, R, nu)
            w = np.exp(log_weights)
            mean = w @ means
            left = (known - project_columns(H, rows, u, mean[None])[0] - w @ expected).reshape(-1, 2)
            weight = weigh(left, noise, square)
            aim = mean[CONTACT] - x
            aim[0] = self.track.expect(mean[DEPTH], max(own[0, 0], _LEAST_VARIANCE)) - x[0]
            step = self._bound_step(aim, share)
            if expectation["has_corners"] and step[1:] @ last[1:] < 0.0:
                share *= 0.5
                step[1:] *= 0.5
            last, x = step, x + step
            x[1] = min(max(x[1], expectation["lowest"]), expectation["highest"])
            moved = find_x_model(contact, x)[0] - at.x
            q = q + limit_step(contact.model, at.pressed.modes[:, :3] @ moved)
            missing = aim - step if share > _UNDECIDED else np.zeros(3)
            settled = self._is_settled(moved, missing) and at.pressed.size < _SETTLED_CORRECTION
        if at is None:
            return False
        bump = self._watch.update(H, rows, u, A, L, self.weights @ nu) if settled else None
        self.x, self.P = means, reduce_covariance(self.P, A)
        if bump is not None:
            self.x, self.P, self._bumped = self.x + bump[0], self.P + bump[1], True
        self.log_weights = np.maximum(log_weights, _LEAST_WEIGHT)
        self.log_weights -= np.log(np.exp(self.log_weights).sum())
        self.q, self._modes, self.positions = q, at.pressed.modes[:, :3], at.positions
        points["weight"] = 0.0
        points["weight"][seen] = weight
        smoothing = self._smooth_depth(own)
        self.state = self._read_out(contact, at, x, moved, (ratios, ratio), smoothing)
        self.state["used"] = self.state["known"] = len(seen)
        self.state["agreed"] = np.count_nonzero(weight > _AGREES)
        self.state["residual"] = np.sqrt((weight[:, None] * left**2).sum() / (2.0 * weight.sum()))
        self.state["iterations"], self.state["converged"] = iteration, settled
        self.state["ambiguity"] = 0.0 if settled else np.linalg.norm(at.pressed.force_modes[:, :3] @ moved)
        return True

    def _linearize(
        self, contact: RigidContact, probe: Any, q: NDArray, x: NDArray, ratio: float
    ) -> tuple[NDArray, _Linearized | None]:
        """Return the unknowns (size,) nearer to equilibrium at x (3,), and the mechanics there, None without touch."""
        x_model, _ = find_x_model(contact, x)
        pressed = contact.linearize(q, x_model, constant_traction(ratio))
        if not pressed.touches:
            return q + contact.approach(q, pressed.correction, x_model), None
        q = q + pressed.correction
        motions = contact.model.project(probe, q, pressed.modes)
        return q, _Linearized(x_model, pressed, contact.model.positions(probe, q), motions)

    def _detect_jumps(
        self, H: NDArray, rows: NDArray, u: NDArray, nu: NDArray, noise: NDArray, square: NDArray
    ) -> NDArray:
        """Widen the prediction where the camera or the object has jumped; return weights of the key points (m,)."""
        weight, blocks = weigh_innovations(H, rows, u, self.P, noise, nu, square)
        white_H, white = whiten(H, rows, u, self.P, noise / weight[:, None, None], nu)
        information, score = white_H.T @ white_H, white_H.T @ white
        may_be_misplaced = not self._misplaced and self.state["depth"] > LOADED_DEPTH
        odds = {
            BUMPED: BUMPED.log_odds(information, score),
            MISPLACED: MISPLACED.log_odds(information, score) if may_be_misplaced else -np.inf,
        }
        jump = max(odds, key=odds.__getitem__)
        if odds[jump] <= 0.0:
            return weigh(nu.reshape(-1, 2), blocks, square)
        self.P[jump.entries, jump.entries] += jump.stddev**2
        self._watch.reset()
        self._bumped |= jump is BUMPED
        self._misplaced |= jump is MISPLACED
        return weight

    def _bound_step(self, aim: NDArray, share: float) -> NDArray:
        """Return a step (3,) within a share of where the linearisation holds."""
        most = np.array([_LARGEST_MOVE, share * float(self.expectation["largest_change"]), share * _LARGEST_SHIFT])
        return np.clip(aim, -most, most)

    def _is_settled(self, moved: NDArray, missing: NDArray) -> bool:
        """Whether a step that moved the model by (3,), and left (3,) out, changed nothing that matters."""
        tolerance = np.array([_SETTLED, float(self.expectation["settled_change"]), _SETTLED])
        return bool((np.abs(moved) < tolerance).all() and (np.abs(missing) < tolerance).all())

    def _smooth_depth(self, own: NDArray) -> NDArray:
        """Smooth the depth; return by how much that lessens the covariance of the first four entries (4, 4).

        Args:
            own: their covariance by the noise of this image alone (4, 4).
        """
        raw, variance = float(self.mean[DEPTH]), max(own[0, 0], _LEAST_VARIANCE)
        self.track.update(raw, variance)
        self._smooth, scale = self.track.x - raw, np.ones(4)
        scale[0] = np.sqrt(min(self.track.variance / variance, 1.0))
        return scale[:, None] * own * scale - own

    def _read_out(
        self,
        contact: RigidContact,
        at: _Linearized,
        x: NDArray,
        moved: NDArray,
        traction: tuple[NDArray, float],
        smoothing: NDArray,
    ) -> ContactState:
        """Return the force of the hypotheses and its covariance as a contact state.

        Args:
            contact: of the jaw.
            at: where the mechanics was linearised.
            x: state of the contact (3,).
            moved: of the model since (3,).
            traction: ratio of each hypothesis (N,), and that of the linearisation.
            smoothing: see `_smooth_depth` (4, 4).
        """
        s, (ratios, ratio) = blank_contact_state(), traction
        J, w, mean = at.pressed.force_modes, self.weights, self.mean
        x_model, depth = find_x_model(contact, x)
        offsets = self.x[:, CONTACT] - at.x
        offsets[:, 0] += self._smooth + x_model[0] - x[0]
        forces = at.pressed.force + offsets @ J[:, :3].T + np.outer(ratios + self.x[:, TRACTION] - ratio, J[:, 3])
        force = w @ forces
        covariance = J @ (self.P[:4, :4] + smoothing) @ J.T + (forces - force).T @ (w[:, None] * (forces - force))
        covariance += (self.hypotheses.spread_cells(w) + _MISDIRECTED**2) * np.outer(J[:, 3], J[:, 3])
        s["x"], s["x_model"], s["x_asked"], s["depth"] = x, x_model, x, depth
        s["force"] = force * min(1.0, max(0.0, depth / _LEAST_DEPTH))
        s["magnitude"] = magnitude = np.hypot(s["force"][0], s["force"][2])
        along = s["force"] / magnitude if magnitude > 0.0 else np.array([-1.0, 0.0, 0.0])
        s["pressing"], s["force_modes"], s["covariance"] = at.pressed.force, np.eye(3), covariance
        s["stddev"] = np.sqrt(max(float(along @ covariance @ along), 0.0))
        s["speed"], s["depth_variance"] = self.track.speed, self.P[DEPTH, DEPTH]
        s["height_stddev"] = np.sqrt(self.P[HEIGHT, HEIGHT])
        s["pressure_point"], s["pressure_location"] = at.pressed.pressure_point, at.pressed.pressure_location
        s["extrapolation"] = at.pressed.extrapolation
        s["sound"] = at.pressed.smallest_det > 0.0 and np.isfinite(covariance.sum() + force.sum())
        s["traction_ratio"] = w @ ratios + mean[TRACTION]
        offsets = offset_entries(self._count)
        s["misfit"] = np.sqrt((mean[offsets] ** 2 / self._V[offsets]).mean())
        s["offset"], s["mistaken"] = mean[HEIGHT] - self.expectation["mean"][1], self._misplaced
        s["motion"] = np.hypot(mean[CAMERA[0]], mean[CAMERA[1]])
        s["quiet"], s["loaded"] = depth < TOUCH_DEPTH, depth > LOADED_DEPTH
        if magnitude > _LEAST_FORCE:
            self.hypotheses.upright = float(
                np.clip(find_upright_ratio(at.pressed.force, ratio), -LARGEST_RATIO, LARGEST_RATIO)
            )
        return s

    def follow_path(self, contact: RigidContact) -> None:
        """Follow how the object uses its friction, which the force of the image did not wait for."""
        if self.x is None or not self.hypotheses.follows_path:
            return
        if self.state["depth"] <= 0.0:
            self.hypotheses.leave()
            return
        places = self.x[:, [DEPTH, HEIGHT]] + np.array([self._smooth, 0.0])
        self.hypotheses.follow(contact, self.q, self.state["x_model"], places, self.track, self.weights)

    def contact_covariance(self) -> NDArray:
        """Return the covariance of depth, shape and height (3, 3)."""
        return self.P[np.ix_(CONTACT, CONTACT)]
