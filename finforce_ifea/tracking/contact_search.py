"""The state of a contact in one image: forecast, then Newton's method on jaw and contact together."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from finforce_ifea.contact_mechanics.friction import Traction
from finforce_ifea.contact_mechanics.indenter import DEPTH, HEIGHT, SHAPE
from finforce_ifea.contact_mechanics.pressed_jaw import PressedState, RigidContact, limit_step
from finforce_ifea.settings import EstimatorSettings
from finforce_ifea.tracking.contact_filter import (
    EXPECTATION,
    FORECAST,
    LARGEST_SHIFT,
    forecast_state,
    update_state,
    weigh_keypoints,
)
from finforce_ifea.tracking.contact_state import (
    AVERAGE,
    KEYPOINT,
    blank_contact_state,
    measure_along,
)

_OPTIONS = {"cache": True, "error_model": "numpy"}
# The mechanics is evaluated at this depth [m] at least; below it shapes and forces are continued linearly.
_LEAST_DEPTH = 3e-5
TOUCH_DEPTH, LOADED_DEPTH = 0.15e-3, 0.5e-3
_LARGEST_MOVE = 0.7e-3
# A leap only has to come near. One that leaves the points as far as they were by all but this is in vain [m].
_LARGEST_LEAP, _LEAST_APPROACH = 2e-3, 0.1e-3
_SETTLED_MOVE = 1e-4
# Of the model's reach, 0.1 mm.
_SETTLED_CORRECTION = 0.05
# Steps shortened to less than this share are taken as they are: the key points cannot decide.
_UNDECIDED = 0.2
# Fewer points in agreement with the forecast than this share call for a leap.
_LEAST_AGREEMENT = 0.6
# Standard deviations of depth and speed with which an object begins [m, m/s].
_FIRST_SPREAD = np.diag([0.1e-3, 1e-3]) ** 2


class ContactSearch:
    """The contact of one jaw with one object, image after image.

    Attributes:
        points: key points of the last image (K,), see `KEYPOINT`.
        average: of their residuals (K,), see `AVERAGE`.
        state: of the contact in the last image in which it was found, see `CONTACT_STATE`.
        expectation: of the object, see `EXPECTATION`.
        q: unknowns of the jaw (size,).
        positions: of the key points in the model (K, 3) [m].
    """

    def __init__(self, count: int, settings: EstimatorSettings) -> None:
        """Prepare the search by `count` key points."""
        self.settings = settings
        self.points = np.zeros(count, KEYPOINT)
        self.state, self._found = blank_contact_state(), blank_contact_state()
        self._forecast = np.zeros((), FORECAST)
        self.average, self._extended = np.zeros(count, AVERAGE), np.zeros(count, AVERAGE)
        self.expectation = np.zeros((), EXPECTATION)
        self.expectation["gate"] = settings.gate
        self.positions = np.zeros((count, 3))

    def begin(self, contact: RigidContact, mean: NDArray) -> None:
        """Begin with the undeformed jaw and an object of expected shape and height (2,) that just touches."""
        self.state = blank_contact_state()
        self.state["x"][1:] = mean
        self.state["x"][DEPTH] = contact.find_touch(self.state["x"])
        self.state["spread"] = _FIRST_SPREAD
        self.resume(contact.begin(mean[1]))
        self.average[:] = np.zeros((), AVERAGE)

    def resume(self, q: NDArray) -> None:
        """Continue from another shape of the jaw (size,), whose motions are not known yet."""
        self.q, self._modes = q, np.zeros((len(q), 3))

    def forget(self, mean: NDArray) -> None:
        """Expect an object of any shape and height about the mean (2,) again."""
        self.state["x"][1:] = mean
        self.average[:] = np.zeros((), AVERAGE)

    def lead(self, change: NDArray, kept: float) -> None:
        """Take shape and height along by a change (2,), and keep a share of the averaged residuals."""
        self.state["x"][1:] += change
        self.average["count"] *= kept

    def explain(self, change: float) -> None:
        """Take what a traction ratio [-] that was learnt from the averaged residuals explains of them out of them."""
        self.average["residual"] -= change * self.average["modes"][:, :, 3]

    def find(
        self, contact: RigidContact, traction: Traction, probe: Any, dt: float, *, iterations: int, is_sudden: bool
    ) -> bool:
        """Find the contact in the image of `points`; False, all as it was, where too few key points agree.

        Args:
            contact: of the jaw with the object.
            traction: what acts along the surface.
            probe: of its key points.
            dt: time since the last image [s].
            iterations: at most; the next image goes on from there.
            is_sudden: whether that did not show the speed.
        """
        expectation, forecast, found, model = self.expectation, self._forecast, self._found, contact.model
        forecast_state(self.state, dt, is_sudden, expectation, forecast)
        x = forecast["x"].copy()
        x_model, _ = find_x_model(contact, x)
        q = self.q + self._modes @ (x_model - self.state["x_model"])
        updated, settled, iteration, share = False, False, 0, 1.0
        last, moved, depth, far, in_vain = np.zeros(3), np.zeros(3), 0.0, np.inf, 0
        while not settled and iteration < iterations and in_vain < 2:
            iteration += 1
            pressed = contact.linearize(q, x_model, traction)
            if not pressed.touches:
                q = q + contact.approach(q, pressed.correction, x_model)
                continue
            q = q + pressed.correction
            self.positions = positions = model.positions(probe, q)
            motions = model.project(probe, q, pressed.modes)
            weigh_keypoints(self.points, positions, motions, x, x_model, forecast, expectation, found)
            if found["used"] < max(self.settings.minimum_keypoints, _LEAST_AGREEMENT * found["known"]):
                q, x_model = self._leap(contact, pressed, q, x, x_model)
                in_vain = in_vain + 1 if abs(found["jump"]) > far - _LEAST_APPROACH else 0
                far = float(abs(found["jump"]))
                continue
            update_state(self.points, self.average, self._extended, forecast, expectation, found)
            updated = True
            aim = _bound_step(found, x, share, expectation)
            # between two corners of an object the linearisation changes its mind: meet in the middle
            if expectation["has_corners"] and (aim - x)[1:] @ last[1:] < 0.0:
                share *= 0.5
            last, before, x = aim - x, x_model, aim
            x_model, depth = find_x_model(contact, x)
            moved = x_model - before
            q = q + limit_step(model, pressed.modes[:, :3] @ moved)
            settled = _is_settled(found, pressed.size, x, moved, share, expectation)
        if not updated or not pressed.touches:
            return False
        self.q, self._modes = q, pressed.modes[:, :3]
        self.average, self._extended = self._extended, self.average
        self.state, self._found = found, self.state
        found["x"], found["x_model"], found["depth"] = x, x_model, depth
        self._conclude(pressed, moved)
        found["iterations"], found["converged"] = iteration, settled
        if settled:
            found["ambiguity"] = 0.0
        return True

    def _leap(
        self, contact: RigidContact, pressed: PressedState, q: NDArray, x: NDArray, x_model: NDArray
    ) -> tuple[NDArray, NDArray]:
        """Take x towards the median depth that points ask for which disagree with the forecast; return q, x_model."""
        x[DEPTH] += min(max(float(self._found["jump"]), -_LARGEST_LEAP), _LARGEST_LEAP)
        after, _ = find_x_model(contact, x)
        return q + limit_step(contact.model, pressed.modes[:, DEPTH] * (after[DEPTH] - x_model[DEPTH])), after

    def _conclude(self, pressed: PressedState, moved: NDArray) -> None:
        """Complete the state after a search whose last step moved the model from the pressed state by (3,)."""
        state = self.state
        state["by_traction"] = pressed.force_modes[:, 3]
        state["pressing"], state["force_modes"] = pressed.force, pressed.force_modes[:, :3]
        state["pressure_point"], state["pressure_location"] = pressed.pressure_point, pressed.pressure_location
        state["extrapolation"], state["sound"] = pressed.extrapolation, pressed.smallest_det > 0.0
        _complete_state(state, moved, self.q, self.expectation)

    def lose(self, stddev: float) -> None:
        """Widen the search for the next image by a standard deviation of the depth [m]."""
        self.state["speed"] = 0.0
        self.state["spread"][0, 0] += stddev**2

    def shift(self, change: float) -> None:
        """Count the depth `change` [m] more, as of an object that was cut anew."""
        self.state["x"][DEPTH] += change
        self.state["x_model"][DEPTH] += change


def find_x_model(contact: RigidContact, x: NDArray) -> tuple[NDArray, float]:
    """Return the state (3,) at which the mechanics stands for x, never above the surface, and the depth below [m]."""
    x_model, touch = x.copy(), contact.find_touch(x)
    x_model[DEPTH] = max(x[DEPTH], touch + _LEAST_DEPTH)
    return x_model, x[DEPTH] - touch


@njit(**_OPTIONS)
def _bound_step(state, x, share, expectation):
    """Return the state asked for (3,), within a share of where the linearisation about the present one holds."""
    state, expectation, aim = state[()], expectation[()], np.empty(3)
    change = (_LARGEST_MOVE, share * expectation.largest_change, share * LARGEST_SHIFT)
    for i in range(3):
        aim[i] = min(max(state.x_asked[i], x[i] - change[i]), x[i] + change[i])
    aim[SHAPE] = min(max(aim[SHAPE], expectation.lowest), expectation.highest)
    middle = expectation.mean[1]
    aim[HEIGHT] = min(max(aim[HEIGHT], middle - expectation.farthest), middle + expectation.farthest)
    return aim


@njit(**_OPTIONS)
def _is_settled(state, correction, x, moved, share, expectation):
    """Whether an iteration that moved the model by (3,), to x, changed nothing that matters."""
    state, expectation = state[()], expectation[()]
    change = (_SETTLED_MOVE, expectation.settled_change, _SETTLED_MOVE)
    for i in range(3):
        missing = state.x_asked[i] - x[i] if share > _UNDECIDED else 0.0
        if max(abs(moved[i]), abs(missing)) >= change[i]:
            return False
    return correction < _SETTLED_CORRECTION


@njit(**_OPTIONS)
def _complete_state(state, moved, q, expectation):
    """Fill in the force after the last step, its uncertainty, and whether all numbers are finite."""
    state, expectation = state[()], expectation[()]
    scale, depth = max(1.0, state.scatter**2), state.depth
    continued = max(0.0, depth / _LEAST_DEPTH) if depth < _LEAST_DEPTH else 1.0
    changed, total = 0.0, q.sum()
    for a in range(3):
        change = 0.0
        for i in range(3):
            change += state.force_modes[a, i] * moved[i]
            total += state.covariance[a, i]
        state.force[a] = (state.pressing[a] + change) * continued
        changed, total = changed + change * change, total + state.force[a]
    state.height_stddev = np.sqrt(max(state.covariance[HEIGHT, HEIGHT], 0.0))
    for a in range(3):
        for i in range(3):
            state.covariance[a, i] *= scale
    state.covariance[DEPTH, DEPTH] += state.depth_variance * scale
    state.magnitude = np.sqrt((state.force * state.force).sum())
    state.stddev = measure_along(state.force, state.force_modes, state.covariance)
    state.stiffening = 1.0
    if expectation.stiffness > 0.0 and depth >= LOADED_DEPTH:
        state.stiffening = state.magnitude / (expectation.stiffness * depth)
    state.ambiguity = np.sqrt(changed)
    state.sound = state.sound and np.isfinite(total)
    state.quiet, state.loaded = depth < TOUCH_DEPTH, depth > LOADED_DEPTH
