"""Depth, shape and height of the pressing object from key points, image after image, on the deformed jaw.

The shape of an unknown object is its radius, that of a known outline its tilt.
"""

from __future__ import annotations

from math import hypot, nan, sqrt
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from finforce_ifea.contact_mechanics.friction import Coefficient, constant_traction
from finforce_ifea.contact_mechanics.indenter import DEPTH, HEIGHT, OutlineIndenter, RoundIndenter, expect_object
from finforce_ifea.contact_mechanics.pressed_jaw import Mechanics, RigidContact, limit_step
from finforce_ifea.filter.image_update import find_place
from finforce_ifea.filter.lateral_load import LateralLoad, Torsion
from finforce_ifea.filter.search import ContactSearch
from finforce_ifea.filter.unobserved_force import APART_SIGMAS, UnobservedForce, list_clamped_heights
from finforce_ifea.jaw.jaw import KEYPOINT_DISTANCE
from finforce_ifea.observation import Contact, Observation
from finforce_ifea.posture import PostureTrack, WristMove, WristPosture
from finforce_ifea.settings import EstimatorSettings
from finforce_ifea.tare import PointNoise, Tare
from finforce_ifea.tracking.contact_state import MIDDLE_STDDEV, TOUCH_DEPTH, UNSEEN_TRACTION, ContactState
from finforce_ifea.tracking.influence import explain_offsets, measure_influence, press_lightly

# Images without touch after which another object is expected.
_IMAGES_RELEASED = 15
# Images in a row without a contact that fits after which the search begins anew from the unloaded jaw.
_IMAGES_LOST = 5
# Standard deviation that an image without information adds to the depth [m].
_LOST_STDDEV = 1e-3
# Distance from the given height beyond which the contact is another one [sigma].
_FARTHEST_HEIGHT = 8.0
# Extrapolation from the stored shapes beyond which the full mechanics takes over [-].
_BEYOND_STORED = 1.0
# Fraction of the depth at that moment below which the stored shapes take over again [-].
_BACK = 0.8
# Iterations of the full mechanics per image, each as long as a hundred others.
_FULL_ITERATIONS = 3
# Largest number of iterations in which the full mechanics settles.
_SETTLING = 8
# Tolerance of these, relative to the model's reach [-].
_SETTLED = 2e-3
# Steps of the depth in which the full mechanics is pressed anew [m].
_PRESSING = 0.5e-3
# Root mean square of the part of a weight along the finger where the direction of gravity is not known [-].
_ANY_DIRECTION = 1.0 / sqrt(3.0)
# Standard deviation of a learnt coefficient of friction, relative to that of the prior [-].
_LEARNT = 0.75


class _Fidelity(NamedTuple):
    """One model of a jaw: contact, probe of the key points, and these at rest (K, 3) [m]."""

    contact: RigidContact
    probe: Any
    rest: NDArray


class ContactTracker:
    """Tracks the contact with the pressing object; holds the jaw in equilibrium with it.

    Where a reduced jaw bends as none of its stored shapes does, as around large flat things, the full one takes over.

    Attributes:
        response: of the unloaded jaw, see `InfluenceCoefficients`.
    """

    def __init__(
        self,
        mechanics: Mechanics,
        keypoints: NDArray,
        settings: EstimatorSettings,
        torsion: Torsion | None = None,
        *,
        contact_range: tuple[float, float],
    ) -> None:
        """Attach the key points to the model.

        Args:
            mechanics: of the jaw.
            keypoints: (K, 3) [m, undeformed].
            settings: of the estimator.
            torsion: response to what acts laterally; None where unknown.
            contact_range: heights at which the jaw can be touched, see `Jaw.contact_range` [m].

        Raises:
            MeshError: A key point is off the jaw.
        """
        self.settings = settings
        self._fidelities = [
            _attach(each.contact, keypoints) for each in (mechanics, mechanics.full) if each is not None
        ]
        self._fidelity = 0
        self._use(0)
        self._search = ContactSearch(len(keypoints), settings)
        self.response = measure_influence(self._contact, self._probe, len(keypoints))
        self._outline: OutlineIndenter | None = None
        self._is_apart, self._led_stddev, self._lost = False, np.zeros(2), 0
        self._unobserved = self._build_unobserved(contact_range[0])
        self._lateral = LateralLoad(
            torsion, len(keypoints), UNSEEN_TRACTION * settings.friction, may_be_held=settings.may_be_held
        )
        self._tare: Tare | None = None
        self._postures = PostureTrack()
        self.expect_friction(None)
        self.reset()

    def reset(self, height: float | None = None) -> None:
        """Restart unloaded, with an unknown object that first touches at `height` [m], the middle if None."""
        settings = self.settings
        self._given = height
        self._use(0)
        height = float(np.median(self._contact.surface.heights)) if height is None else height
        self._press(RoundIndenter())
        self._expect(
            np.array([settings.radius, height]),
            np.array([settings.radius_stddev, settings.height_stddev]) ** 2,
        )
        self._begin()

    def _use(self, fidelity: int) -> None:
        """Use another model for the next images, with the object of the one before."""
        indenter = self._fidelities[self._fidelity].contact.indenter
        self._fidelity = fidelity
        self._contact, self._probe, self._rest = self._fidelities[fidelity]
        self._contact.set_indenter(indenter)

    def _press(self, indenter: RoundIndenter | OutlineIndenter) -> None:
        """Set the object and the limits of the search."""
        self._contact.set_indenter(indenter)
        for name in ("lowest", "highest", "largest_change", "settled_change", "has_corners"):
            self._search.expectation[name] = getattr(indenter, name)

    def _expect(self, mean: NDArray, variance: NDArray) -> None:
        """Expect an object of some shape and height (2,), each with its variance (2,)."""
        self._search.expectation["mean"], self._search.expectation["variance"] = mean, variance

    @property
    def _mean(self) -> NDArray:
        """Expected shape and height (2,)."""
        return self._search.expectation["mean"]

    def _change_fidelity(self, state: ContactState) -> None:
        """Switch to the full mechanics beyond the stored shapes, and back."""
        pressed = float(state["x"][DEPTH])
        is_beyond = state["extrapolation"] > _BEYOND_STORED and state["depth"] > TOUCH_DEPTH
        if self._fidelity == 0 and is_beyond and len(self._fidelities) > 1:
            self._left = (self.q.copy(), pressed)
            q = self._contact.model.expand(self.q)
            self._use(1)
            self._search.resume(self._settle(q, state["x_model"])[0])
        elif self._fidelity == 1 and pressed < _BACK * self._left[1]:
            self._use(0)
            # of the shape that was left and the unloaded jaw, the nearer one
            is_near = pressed > 0.5 * self._left[1]
            self._search.resume(self._left[0] if is_near else self._contact.begin(float(state["x"][HEIGHT])))

    def _settle(self, q: NDArray, x: NDArray) -> tuple[NDArray, bool]:
        """Return the shape (size,) of the jaw pressed in a state (3,), from one nearby, and whether it was found."""
        traction = constant_traction(self._search.ratio)
        for _ in range(_SETTLING):
            pressed = self._contact.linearize(q, x, traction)
            if not pressed.touches or pressed.size < _SETTLED:
                return q, pressed.touches
            q = q + limit_step(self._contact.model, pressed.correction)
        return q, False

    def _restore_shape(self) -> None:
        """Restore the equilibrium of the full mechanics from the unloaded jaw, after a failed image."""
        x = self._search.state["x_model"]
        if self._settle(self.q, x)[1]:
            return
        q = np.zeros(self._contact.model.size)
        for depth in np.append(np.arange(self._contact.find_touch(x), x[DEPTH], _PRESSING)[1:], x[DEPTH]):
            q, _ = self._settle(q, np.r_[depth, x[1:]])
        self._search.resume(q)

    def vertices(self) -> NDArray:
        """Return the deformed mesh vertices (n, 3) [m], in mesh order."""
        return self._contact.model.vertices(self.q)

    @property
    def q(self) -> NDArray:
        """The jaw's unknowns (size,)."""
        return self._search.q

    @property
    def used(self) -> NDArray:
        """Used key points of the last image (K,), bool."""
        return self._search.points["weight"] > 0

    def give_shape(self) -> NDArray:
        """Return the shape (size,) with which another tracker starts."""
        return self.q if self._fidelity == 0 else self._left[0]

    def _begin(self) -> None:
        """Start with the undeformed jaw and an object that just touches."""
        self._use(0)
        self._search.begin(self._contact, self._mean)
        self._led = self._mean.copy()
        self._lateral.reset()
        self._released, self._has_moved = 0, False
        self._postures.reset()

    def _forget_contact(self) -> None:
        """Forget the contact: the next object may be any."""
        self._led = self._mean.copy()
        self._search.forget(self._mean)

    def update(self, points: NDArray, tare: Tare, dt: float, observation: Observation) -> ContactState | None:
        """Take the key points of an image; return None when too few agree.

        Args:
            points: (K, 3) [m], NaN where unused.
            tare: offsets and noise.
            dt: time since the last image [s].
            observation: that the points are of.
        """
        search, measured, move = self._search, points - tare.offsets, self._follow_posture(observation.posture)
        if tare is not self._tare:
            self._tare, search.correlation = tare, tare.correlation
            search.restart()
        search.expectation["shared"] = observation.shared.shift
        search.expectation["closing"] = observation.shared.closing
        search.expectation["mount"] = observation.shared.height if self._is_known else 0.0
        planar = measured - self._lateral.motions if self._is_known else measured
        self._fill(planar, tare, tare.point_noise(observation.stddev))
        most = _FULL_ITERATIONS if self._fidelity else self.settings.iterations
        if not search.find(self._contact, self._probe, dt, iterations=most):
            self._lose()
            return None
        state, self._lost = search.state, 0
        self._released = self._released + 1 if state["depth"] < TOUCH_DEPTH else 0
        if self._released == _IMAGES_RELEASED:
            self._forget_contact()
            if self.settings.may_be_held:
                search.let_go()
        self._complete(state)
        if self._is_known:
            bend = search.positions[:, 0] - self._rest[:, 0]
            self._lateral.update((measured - search.positions)[:, 1], bend, search.points, state, dt, move)
        if self._fidelity and not state["converged"]:
            self._restore_shape()
        self._change_fidelity(state)
        self._has_moved = True
        return state

    def _lose(self) -> None:
        """Widen the search after an image without a contact that fits; now and then begin anew, knowing nothing."""
        self._lost += 1
        if self._lost % _IMAGES_LOST == 0:
            self._search.expect_friction(self._friction)
            self._begin()
            return
        self._search.lose(_LOST_STDDEV)
        if self._fidelity:
            self._restore_shape()

    def _follow_posture(self, posture: WristPosture | None) -> WristMove | None:
        """Return the motion of the jaw since the last image."""
        move, search = self._postures.update(posture if self.settings.may_be_held else None), self._search
        weight, stddev = self._lateral.weigh(float(search.state["magnitude"]))
        search.pull = 0.0, _ANY_DIRECTION * stddev
        if move is not None:
            search.pull = weight * float(move.now[2]), stddev * abs(float(move.now[2]))
            search.hypotheses.part(move.parting if search.state["loaded"] else 0.0, shows_lifts=move.shows_lifts)
        return move

    def _fill(self, measured: NDArray, tare: Tare, noise: PointNoise) -> None:
        """Fill in the key points of an image, measured (K, 3) [m]."""
        points = self._search.points
        points["measured"], points["rest"] = measured, self._rest
        points["tare_noise"], points["gain"] = noise.plane, noise.gain
        points["width_variance"], points["noise_ratio"] = noise.width_variance, noise.noise_ratio
        points["offset_variance"], points["detector_variance"] = tare.offset_variance() + noise.bias, noise.bias

    def significance(self, tare: Tare, stddev: float) -> float:
        """Return by how many standard deviations a force explains the offsets of a tare; see `explain_offsets`."""
        return explain_offsets(self.rest_modes(), tare, stddev)

    def rest_modes(self) -> NDArray:
        """Return the derivative of the undeformed jaw's key point positions in x and z by the depth (K, 2) [m/m]."""
        q = np.zeros(self._contact.model.size)
        pressed = self._contact.linearize(q, find_place(self._contact.packed_object, np.r_[-1.0, self._mean])[0])
        return self._contact.model.project(self._probe, q, pressed.modes)[:, [0, 2], DEPTH]

    def forget(self) -> None:
        """Forget the object and its coefficient of friction."""
        self._search.expect_friction(self._friction)
        self.reset()

    def expect_friction(self, friction: Coefficient | None) -> None:
        """Set the object's stated coefficient of friction; None for that of the settings."""
        settings, self._is_unstated = self.settings, friction is None
        self._friction = Coefficient(settings.friction, settings.friction_stddev) if friction is None else friction
        self._search.expect_friction(self._friction)

    @property
    def friction(self) -> Coefficient:
        """The estimate of the object's coefficient of friction."""
        return self._search.friction

    @property
    def friction_source(self) -> str:
        """Source of the coefficient of friction: "stated", "expected" by the settings, or "learned"."""
        if self.friction.stddev < _LEARNT * self._friction.stddev:
            return "learned"
        return "expected" if self._is_unstated else "stated"

    @property
    def _is_known(self) -> bool:
        """True if the object is known by its outline."""
        return self._outline is self._contact.indenter

    def learn(self) -> None:
        """Extend the friction path after the force of the last image has been reported."""
        if self._has_moved:
            self._has_moved = False
            self._search.follow_path(self._contact)

    def resume(self, q: NDArray) -> None:
        """Restart from the shape (size,) of another tracker."""
        self.reset()
        self._search.resume(q.copy())

    def follow(self, contact: Contact) -> None:
        """Set the contact's object: its outline, or its height of first touch."""
        if contact.outline is not None:
            self._follow_outline(contact)
            return
        height = float(expect_object(contact, self.settings).mean[1])
        if self._given is None:
            self.reset(height)
        if abs(height - self._given) > _FARTHEST_HEIGHT * self.settings.height_stddev:
            self._mean[1] = height
            self._forget_contact()  # another object
        self._given = self._mean[1] = height

    def _follow_outline(self, contact: Contact) -> None:
        """Set the prior to the outline's tilt and height; a new section of the same object keeps the contact."""
        before, search = self._contact.indenter, self._search
        is_free = self._is_apart and bool(search.state["depth"] < TOUCH_DEPTH)
        touch = self._contact.find_touch(search.state["x"]) if is_free else 0.0
        if contact.outline.across is not None:
            self._lateral.expect(*contact.outline.across)
        expected = expect_object(contact, self.settings, self._outline)
        self._expect(expected.mean, expected.variance)
        self._lead(contact.outline.stddev[2:0:-1], is_free=is_free)
        self._outline = after = expected.indenter
        if after is not before:
            self._press(after)
        pressed_by_pose = self._contact.face_x + after.pressed.front - contact.outline.origin[0]
        self._is_apart = bool(pressed_by_pose < -APART_SIGMAS * contact.outline.stddev[0])
        height = float(expected.mean[1])
        self._given = None
        search.hypotheses.carried.see(height, float(contact.outline.stddev[1]))
        is_off = abs(search.state["x"][HEIGHT] - height) > _FARTHEST_HEIGHT * self.settings.height_stddev
        is_same = isinstance(before, OutlineIndenter) and after.resembles(before)
        if isinstance(before, OutlineIndenter) and not is_same:
            search.expect_friction(self._friction)
        if is_off or not is_same:
            self._begin()
        elif is_free:  # of what does not touch, the distance from first touch stays
            search.shift(self._contact.find_touch(search.state["x"]) - touch)
        elif after is not before:
            search.shift(after.pressed.front - before.pressed.front)

    def _lead(self, stddev: NDArray, *, is_free: bool) -> None:
        """Move the contact with an object that slides or tilts: beyond the noise of its pose, now and before.

        What a better pose corrects has not moved, unless nothing holds it.
        """
        moved, before = self._mean - self._led, self._led_stddev
        unsure = stddev if is_free else np.maximum(stddev, before)
        change = moved - np.clip(moved, -unsure, unsure)
        if change.any():
            self._search.lead(change)
        self._led, self._led_stddev = self._mean - np.clip(moved - change, -stddev, stddev), stddev

    def _complete(self, state: ContactState) -> None:
        """Fill in lateral force, unobserved force and largest force."""
        traction = UNSEEN_TRACTION * self.settings.friction
        load = self._lateral.load if self._is_known else (0.0, MIDDLE_STDDEV, nan, traction)
        state["y"], state["y_stddev"], state["lateral_force"], state["lateral_stddev"] = load
        state["unobserved_stddev"] = self._find_unobserved_stddev(state)
        state["max_force"] = self._fidelities[0].contact.max_force

    def _find_unobserved_stddev(self, state: ContactState) -> float:
        """Return the standard deviation of the unobserved force [N], see `UnobservedForce`."""
        force, centre = state["force"], float(state["pressure_location"][2])
        if self._is_apart:
            return 0.0
        if self._unobserved.is_next_to_clamp(centre):
            return hypot(force[0], force[2])
        pressed, covariance = self._contact.indenter.pressed, self._search.contact_covariance()
        return self._unobserved.bound(pressed, state["x"], covariance, centre, self._move_surface)

    def _move_surface(self) -> NDArray:
        """Return the motion along x of the inner face at its heights (h,) [m]."""
        surface = self._contact.surface
        return (self._contact.place_points(self.q)[:, 0] - surface.points[:, 0])[:: surface.across]

    def _build_unobserved(self, lowest: float) -> UnobservedForce:
        """Return where key points hardly show a force, on a finger that shows one from a height [m] on."""
        _, vague = self.response.fit_forces(np.ones(len(self._rest), bool))
        contact, along = self._contact, zip(self.response.heights, self.response.stiffness, vague, strict=True)
        clamped = [
            (height, abs(float(press_lightly(contact, self.settings.radius, height)[1].force_modes[0, DEPTH])))
            for height in list_clamped_heights(lowest)
        ]
        return UnobservedForce(clamped, list(along), contact.surface)


def _attach(contact: RigidContact, keypoints: NDArray) -> _Fidelity:
    """Return the mechanics of a contact with key points (K, 3) [m]; raises MeshError when one is off the jaw."""
    probe = contact.model.attach(keypoints, KEYPOINT_DISTANCE)
    return _Fidelity(contact, probe, contact.model.positions(probe, np.zeros(contact.model.size)))
