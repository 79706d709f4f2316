"""Depth, radius and height of the pressing object from key points, frame after frame, on the deformed jaw.

Depth changes fast and is tracked by a Kalman filter with constant velocity. Radius and height change slowly: they are
the maximum a posteriori for the residuals averaged over the last frames, so that their priors count once and errors
of the mechanics are not mistaken for information.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from finforce_ifea.observation import Contact
from finforce_ifea.rolling import DEPTH, HEIGHT, LOG_RADIUS, PressedState, RollingContact, limit_step
from finforce_ifea.settings import EstimatorSettings
from finforce_ifea.tare import Tare

# The mechanics is evaluated at this depth [m] at least; below it shapes and forces are continued linearly.
_LEAST_DEPTH = 3e-5
_TOUCH_DEPTH = 0.15e-3
_LOADED_DEPTH = 0.5e-3
_MODEL_FLOOR = 0.02e-3
_DEPTH_DRIFT = 0.01e-3
_LARGEST_CHANGE = np.array([0.7e-3, 0.15, 0.3e-3])
_SETTLED_CHANGE = np.array([1e-4, 5e-2, 1e-4])
_SETTLED_CORRECTION = 1e-4
_RADIUS_RANGE = np.log([3e-3, 0.2])
_LEAST_WEIGHT = 0.02
_FRAMES_RELEASED = 15
_LOST_STDDEV = 1e-3
# Standard deviation of an offset that all key points share [m]: a depth scale wrong by 1 % at 0.15 m.
_COMMON_OFFSET = 1.5e-3


@dataclass(frozen=True, kw_only=True, eq=False)
class Track:
    """The outcome of one frame.

    Attributes:
        covariance: of what was estimated (m, m): depth [m], log radius and height [m], or a given contact's force [N].
        force: elastic contact force on the jaw (3,) [N].
        force_modes: derivative of the force by what was estimated (3, m).
        pressure_point: pressure centre on the deformed surface (3,) [m].
        pressure_place: the same on the undeformed surface (3,) [m].
        weights: of the key points (K,), 0 for what was not used.
        residual: weighted root mean square residual [m].
        kkt: gradient of the objective that is left, relative to its parts.
        iterations: Newton iterations.
        converged: whether the last one changed nothing that matters.
        sound: whether the mesh is in order and the numbers are finite.
        quiet: whether nothing seems to press.
        loaded: whether something surely presses.
    """

    covariance: NDArray
    force: NDArray
    force_modes: NDArray
    pressure_point: NDArray
    pressure_place: NDArray
    weights: NDArray
    residual: float
    kkt: float
    iterations: int
    converged: bool
    sound: bool
    quiet: bool
    loaded: bool


@dataclass(frozen=True, kw_only=True, eq=False)
class _Residuals:
    """In-plane residuals r (K, 2) [m] about the predicted place, their derivatives and weights."""

    r: NDArray
    modes: NDArray
    weights: NDArray
    noise: NDArray
    bias: NDArray


class PlaceTracker:
    """Tracks the place of the pressing object; holds the jaw in equilibrium with it."""

    def __init__(self, contact: RollingContact, keypoints: NDArray, settings: EstimatorSettings) -> None:
        """Attaches key points (K, 3) [m, undeformed] to the contact's model; raises MeshError when one is off it."""
        self.contact = contact
        self.settings = settings
        self.probe = contact.model.attach(keypoints, 1e-3)
        self._rest = contact.model.positions(self.probe, np.zeros(contact.model.size))
        self._prior_stddev = np.array([settings.radius_log_stddev, settings.height_stddev])
        self.reset()

    def reset(self, height: float | None = None) -> None:
        """Starts anew, unloaded, with an object that will first touch at `height` [m], the middle if None."""
        self._given = height
        height = float(np.median(self.contact.surface.heights)) if height is None else height
        self.q = np.zeros(self.contact.model.size)
        self._prior = np.array([np.log(self.settings.radius), height])
        self._motion, self._motion_covariance = np.zeros(2), np.diag([0.1e-3, 1e-3]) ** 2
        self._modes, self._reached = np.zeros((self.contact.model.size, 3)), np.zeros(3)
        self._released = 0
        self._forget_place()

    def _forget_place(self) -> None:
        self._slow = self._prior.copy()
        self._mean = np.zeros((len(self._rest), 2))
        self._count = np.zeros(len(self._rest))

    def update(self, points: NDArray, tare: Tare, dt: float) -> Track | None:
        """Takes the key points (K, 3) [m], NaN where unused, dt [s] after the last; None when too few agree."""
        motion, spread = self._predict(dt)
        reference = np.r_[motion[0], self._slow]
        place, q = reference.copy(), self.q + self._modes @ (_reachable(reference) - self._reached)
        measured = points - tare.offsets
        for iteration in range(1, self.settings.iterations + 1):
            mechanical = _reachable(place)
            state = self.contact.linearize(q, mechanical)
            if not state.forces.any():
                q = q + self.contact.approach(q, state.correction, mechanical)
                continue
            q = q + limit_step(state.correction)
            data = self._residuals(q, state, measured, tare, place - reference, spread[0, 0], place[0] - mechanical[0])
            if (data.weights > 0).sum() < self.settings.minimum_keypoints:
                return self._lose()
            step = self._solve(data, reference, motion, spread)
            change = np.clip(step.place - place, -_LARGEST_CHANGE, _LARGEST_CHANGE)
            complete = np.array_equal(change, step.place - place)
            place = place + change
            place[LOG_RADIUS] = np.clip(place[LOG_RADIUS], *_RADIUS_RANGE)
            moved = _reachable(place) - mechanical
            q = q + limit_step(state.modes @ moved)
            settled = (np.abs(moved) < _SETTLED_CHANGE).all() and np.abs(state.correction).max() < _SETTLED_CORRECTION
            if complete and settled:
                break
        else:
            settled = False
            if not state.forces.any():
                return self._lose()
        self._keep(q, place, step, spread, state.modes)
        return self._report(state, moved, data.weights, step, iteration, settled)

    def significance(self, tare: Tare) -> float:
        """Returns by how many standard deviations a force explains the offsets of a tare; see `explain_offsets`."""
        q = np.zeros(self.contact.model.size)
        state = self.contact.linearize(q, np.r_[_LEAST_DEPTH, self._prior])
        modes = self.contact.model.project(self.probe, q, state.modes)[:, [0, 2], DEPTH]
        return explain_offsets(modes, tare, self.settings.offset_stddev)

    def follow(self, contact: Contact) -> None:
        """Takes a contact's height as that of first touch."""
        height = float(np.average(contact.points[:, 2], weights=contact.weights))
        if self._given is None:
            self.reset(height)
        self._given = self._prior[1] = height

    def _predict(self, dt: float) -> tuple[NDArray, NDArray]:
        """Returns depth and its speed dt [s] later, with covariance, under white acceleration."""
        transition = np.array([[1.0, dt], [0.0, 1.0]])
        spread = transition @ self._motion_covariance @ transition.T
        spread += self.settings.acceleration**2 * np.array([[dt**4 / 4, dt**3 / 2], [dt**3 / 2, dt**2]])
        spread[0, 0] += _DEPTH_DRIFT**2
        return transition @ self._motion, spread

    def _residuals(
        self, q: NDArray, state: PressedState, measured: NDArray, tare: Tare, moved: NDArray, spread: float, below: float
    ) -> _Residuals:
        """Returns in-plane residuals about the reference place; the motion along y, known to be none, tells of noise."""
        model = self.contact.model
        positions = model.positions(self.probe, q)
        modes = model.project(self.probe, q, state.modes)[:, [0, 2]]
        full = measured - positions
        known = np.isfinite(full[:, 0])
        full = np.where(known[:, None], full, 0.0)
        noise, gain = condition_on_width(tare.noise)
        r = full[:, [0, 2]] - full[:, 1:2] * gain - modes[:, :, DEPTH] * below + modes @ moved
        way = np.linalg.norm(positions - self._rest, axis=1)
        bias = _MODEL_FLOOR**2 + (self.settings.model_error * way) ** 2 + tare.offset_variance(self.settings.offset_stddev)
        along = modes[:, :, :1] * np.sqrt(spread)
        total = noise + bias[:, None, None] * np.eye(2) + along @ along.transpose(0, 2, 1)
        distance = np.einsum("ka,kab,kb->k", r, np.linalg.inv(total), r)
        distance += full[:, 1] ** 2 / (tare.noise[1, 1] + bias)
        weights = np.where(known, 1.0 / (1.0 + distance / self.settings.gate**2) ** 2, 0.0)
        weights[weights < _LEAST_WEIGHT] = 0.0
        return _Residuals(r=r, modes=modes, weights=weights, noise=noise, bias=bias)

    def _solve(self, data: _Residuals, reference: NDArray, motion: NDArray, spread: NDArray) -> "_Step":
        """Updates depth by this frame, radius and height by the mean residuals."""
        depth_mode = data.modes[:, :, DEPTH]
        precision = np.linalg.inv(data.noise)
        weighted = data.weights[:, None] * (depth_mode @ precision)
        information = np.sum(weighted * depth_mode)
        innovation = np.sum(weighted * (data.r - self._mean)) / information
        gain = spread[:, 0] / (1.0 / information + spread[0, 0])
        motion = motion + gain * innovation
        mean, count = self._average(data, data.r - depth_mode * (motion[0] - reference[0]))
        covariance, shift, kkt = self._place_shift(data, mean, count, reference, information)
        # radius and height leave the depth that this frame's key points ask for
        follow = -np.sum(weighted * (data.modes[:, :, 1:] @ shift)) / information
        place = np.r_[motion[0] + follow, reference[1:] + shift]
        mean = mean - depth_mode * follow - data.modes[:, :, 1:] @ shift
        left = data.weights[:, None] * (data.r - data.modes @ (place - reference)) ** 2
        residual = float(np.sqrt(left.sum() / (2.0 * data.weights.sum())))
        return _Step(
            place=place, motion=np.array([place[0], motion[1]]), gain=gain, mean=mean, count=count,
            covariance=covariance, kkt=kkt, residual=residual,
        )  # fmt: skip

    def _average(self, data: _Residuals, r: NDArray) -> tuple[NDArray, NDArray]:
        """Returns the mean residuals (K, 2) [m] over the memory and how many frames they stand for."""
        memory = self.settings.memory
        gain = data.weights / (np.minimum(self._count, memory) + 1.0)
        count = np.minimum(self._count * (1.0 - 1.0 / memory) + data.weights, memory)
        return self._mean + gain[:, None] * (r - self._mean), count

    def _place_shift(
        self, data: _Residuals, mean: NDArray, count: NDArray, reference: NDArray, information: float
    ) -> tuple[NDArray, NDArray, float]:
        """Returns the place's covariance (3, 3), the shift of log radius and height (2,), and the KKT residual."""
        spread = data.noise / np.maximum(count, 1.0)[:, None, None] + data.bias[:, None, None] * np.eye(2)
        precision = np.linalg.inv(spread) * (count > 0.5)[:, None, None]
        weighted = np.einsum("kai,kab->kib", data.modes, precision)
        hessian = np.einsum("kib,kbj->ij", weighted, data.modes)
        gradient = np.einsum("kib,kb->i", weighted, mean)
        slow = [LOG_RADIUS, HEIGHT]
        hessian[slow, slow] += 1.0 / self._prior_stddev**2
        gradient[slow] -= (reference[1:] - self._prior) / self._prior_stddev**2
        hessian[DEPTH, DEPTH] += 1e-3 * information
        covariance = np.linalg.inv(hessian)
        shift = covariance @ gradient
        kkt = np.abs(hessian @ shift - gradient).max() / max(np.abs(gradient).max(), 1e-30)
        return covariance, np.clip(shift[1:], -_LARGEST_CHANGE[1:], _LARGEST_CHANGE[1:]), float(kkt)

    def _lose(self) -> None:
        """Widens the search for the next frame."""
        self._motion[1] = 0.0
        self._motion_covariance[0, 0] += _LOST_STDDEV**2

    def _keep(self, q: NDArray, place: NDArray, step: "_Step", spread: NDArray, modes: NDArray) -> None:
        """Keeps what the next frame starts from; a released jaw expects any object again."""
        self.q, self._modes, self._reached = q, modes, _reachable(place)
        self._slow = place[1:].copy()
        self._motion = np.array([place[DEPTH], step.motion[1]])
        self._motion_covariance = spread - np.outer(step.gain, spread[0])
        self._mean, self._count = step.mean, step.count
        self._released = self._released + 1 if place[DEPTH] < _TOUCH_DEPTH else 0
        if self._released >= _FRAMES_RELEASED:
            self._forget_place()

    def _report(
        self, state: PressedState, moved: NDArray, weights: NDArray, step: "_Step", iterations: int, settled: bool
    ) -> Track:
        force = state.forces.sum(0) + state.force_correction + state.force_modes @ moved
        if step.place[DEPTH] < _LEAST_DEPTH:
            force = force * max(0.0, step.place[DEPTH] / _LEAST_DEPTH)
        share = np.linalg.norm(state.forces, axis=1)
        share = share / share.sum()
        sound = bool(state.smallest_det > 0 and np.isfinite(force).all() and np.isfinite(step.place).all())
        return Track(
            covariance=step.covariance, force=force, force_modes=state.force_modes,
            pressure_point=share @ state.points, pressure_place=share @ self.contact.surface.points,
            weights=weights, residual=step.residual, kkt=step.kkt, iterations=iterations,
            converged=settled, sound=sound, quiet=bool(step.place[DEPTH] < _TOUCH_DEPTH),
            loaded=bool(step.place[DEPTH] > _LOADED_DEPTH),
        )  # fmt: skip


@dataclass(frozen=True, kw_only=True, eq=False)
class _Step:
    """One solved frame: the new place, motion and Kalman gain, mean residuals and their counts."""

    place: NDArray
    motion: NDArray
    gain: NDArray
    mean: NDArray
    count: NDArray
    covariance: NDArray
    kkt: float
    residual: float


def explain_offsets(modes: NDArray, tare: Tare, offset_stddev: float) -> float:
    """Returns by how many standard deviations one mode (K, 2) explains the offsets of a tare.

    The rest is chance: of every key point [m], and of all together, as a wrong depth scale moves them alike.
    """
    seen = tare.counts > 0
    deviation = np.sqrt(offset_stddev**2 + tare.offset_variance(0.0)[seen, None])
    common = np.broadcast_to(np.eye(2), (int(seen.sum()), 2, 2))
    design = np.concatenate([modes[seen][:, :, None], common], axis=2) / deviation[:, :, None]
    design = np.concatenate([design.reshape(-1, 3), np.diag([0.0, 1.0, 1.0]) / _COMMON_OFFSET])
    target = np.append((tare.offsets[seen][:, [0, 2]] / deviation).ravel(), np.zeros(3))
    covariance = np.linalg.pinv(design.T @ design)
    return float((covariance @ design.T @ target)[0] / np.sqrt(max(covariance[0, 0], 1e-300)))


def _reachable(place: NDArray) -> NDArray:
    """Returns the place (3,) at which the mechanics stands for `place`."""
    return np.r_[max(place[DEPTH], _LEAST_DEPTH), place[1:]]


def condition_on_width(noise: NDArray) -> tuple[NDArray, NDArray]:
    """Returns the in-plane noise (2, 2) [m^2] that is left, and its regression (2,) on y, once y is known."""
    gain = noise[[0, 2], 1] / noise[1, 1]
    return noise[np.ix_([0, 2], [0, 2])] - np.outer(gain, noise[[0, 2], 1]), gain
