"""Depth, shape and height of the pressing object from key points, image after image, on the deformed jaw.

The shape of an unknown object is its radius, that of a known outline its tilt.
"""

from __future__ import annotations

from math import hypot, inf, log, nan, sqrt
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from finforce_ifea.contact_mechanics.friction import FRICTIONLESS, constant_traction
from finforce_ifea.contact_mechanics.indenter import DEPTH, HEIGHT, SHAPE, OutlineIndenter, RoundIndenter, expect_object
from finforce_ifea.contact_mechanics.pressed_jaw import Mechanics, RigidContact, limit_step
from finforce_ifea.jaw.jaw import KEYPOINT_DISTANCE
from finforce_ifea.observation import Contact, Observation
from finforce_ifea.settings import EstimatorSettings
from finforce_ifea.tare import PointNoise, Tare
from finforce_ifea.tracking.common_motion import CommonMotion
from finforce_ifea.tracking.contact_filter import link_neighbours
from finforce_ifea.tracking.contact_search import LOADED_DEPTH, TOUCH_DEPTH, ContactSearch, find_x_model
from finforce_ifea.tracking.contact_state import (
    MIDDLE_STDDEV,
    UNSEEN_TRACTION,
    ContactState,
)
from finforce_ifea.tracking.friction import SMOOTH, Coefficient, FrictionEstimate, SlipHistory, leave_play
from finforce_ifea.tracking.held_weight import LARGEST_RATIO, HeldWeight, project_response
from finforce_ifea.tracking.hold import HoldHypotheses, measure_traction
from finforce_ifea.tracking.influence import explain_offsets, measure_influence, press_lightly
from finforce_ifea.tracking.lateral_load import LateralLoad, Torsion

IMAGES_RELEASED = 15
LOST_STDDEV = 1e-3
# The height may leave what was given by this many of its standard deviations; beyond, the contact is another one.
_FARTHEST_HEIGHT = 8.0
# Shapes so many times as far from the stored ones as these are good for are left to the full mechanics, until the
# object has gone back to this share of its depth.
_BEYOND_STORED, _BACK = 1.0, 0.8
# Iterations of the full mechanics in one image, each as long as a hundred others: a shape that asks for more is wrong,
# or settles over the next images.
FULL_ITERATIONS = 3
# Those that find the equilibrium of the full mechanics in the state at which they take over, and their last correction.
_SETTLING, _SETTLED = 8, 2e-3
# An object is apart from the jaw where its pose says so by this many standard deviations.
_APART_SIGMAS = 3.0
# So far from the pressure centre is elsewhere along the finger [m], of whose heights every third is asked.
_ELSEWHERE, _EVERY = 5e-3, 3
# Heights next to the clamp, as shares of the lowest at which key points show a force; objects farther off than this,
# or deeper in, are surely so [m].
_NEXT_TO_CLAMP, _WELL_CLEAR = np.array([0.2, 0.4, 0.6, 0.8, 1.0]), 3e-3
_LEAST_VARIANCE = 1e-12
# Of the traction ratio: what friction does beyond its history, and errors in the direction of the force; of what only
# the jaws hold, a ratio that is never excluded [-].
_UNFOLLOWED, _MISDIRECTED, _TRACTION = 0.35, 0.04, 0.08
# What is kept of the averaged residuals where an object slides.
_KEPT = 0.5
# Of an unknown weight, as a share of the normal force, and the least normal force that counts [N].
_WEIGHT, _LEAST_NORMAL = 0.15, 0.1


class _Fidelity(NamedTuple):
    """One of the mechanics of a jaw: its contact, the probe of the key points, and these at rest (K, 3) [m]."""

    contact: RigidContact
    probe: Any
    rest: NDArray


class ContactTracker:
    """Tracks the contact with the pressing object; holds the jaw in equilibrium with it.

    Where a reduced jaw bends as none of its stored shapes does, as around large flat things, the full one takes over.

    Attributes:
        roughness: what is known of the object's friction.
        slips: how far the object makes use of it.
        response: of the unloaded jaw, see `InfluenceCoefficients`.
    """

    search_type = ContactSearch

    def __init__(
        self,
        mechanics: Mechanics,
        keypoints: NDArray,
        settings: EstimatorSettings,
        torsion: Torsion | None = None,
        smooth: Coefficient = SMOOTH,
        *,
        contact_range: tuple[float, float],
    ) -> None:
        """Attach the key points to the model.

        Args:
            mechanics: of the jaw.
            keypoints: (K, 3) [m, undeformed].
            settings: of the estimator.
            torsion: response to what acts laterally; None where unknown.
            smooth: friction of the objects of the calibration.
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
        self._search = self.search_type(len(keypoints), settings)
        link_neighbours(self._search.points, keypoints)
        self._search.expectation["farthest"] = _FARTHEST_HEIGHT * settings.height_stddev
        self.response = measure_influence(self._contact, self._probe, len(keypoints))
        self._outline: OutlineIndenter | None = None
        self._is_apart = False
        self.slips = SlipHistory(self._contact)
        self.roughness = FrictionEstimate(settings, smooth)
        # height [m], stiffness [N/m], and standard deviation of what key points tell of a force there [N]
        self._base = [(height, self._measure_stiffness(height), inf) for height in contact_range[0] * _NEXT_TO_CLAMP]
        _, vague = self.response.fit_forces(np.ones(len(keypoints), bool))
        self._along = list(zip(self.response.heights, self.response.stiffness, vague, strict=True))[::_EVERY]
        self._lateral = LateralLoad(torsion, len(keypoints), UNSEEN_TRACTION * settings.friction)
        self._held = HeldWeight(self._lateral.half_width)
        self._hold = HoldHypotheses()
        self._camera = CommonMotion()
        self.reset()

    def reset(self, height: float | None = None) -> None:
        """Start anew, unloaded, with an unknown object that will first touch at `height` [m], the middle if None."""
        settings = self.settings
        self._given = height
        self._use(0)
        height = float(np.median(self._contact.surface.heights)) if height is None else height
        self._press(RoundIndenter())
        self._traction = FRICTIONLESS
        self._expect(
            np.array([np.log(settings.radius), height]),
            np.array([settings.radius_log_stddev, settings.height_stddev]) ** 2,
        )
        self._begin()

    def _use(self, fidelity: int) -> None:
        """Take one of the mechanics for the next images, with the object that was pressed into the one before."""
        indenter = self._fidelities[self._fidelity].contact.indenter
        self._fidelity = fidelity
        self._contact, self._probe, self._rest = self._fidelities[fidelity]
        self._contact.set_indenter(indenter)

    def _press(self, indenter: RoundIndenter | OutlineIndenter) -> None:
        """Take another object, and what the search is allowed with it."""
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
        """Go on with the full mechanics where the shape is too far from those stored, and back where it bends less."""
        pressed = float(state["x"][DEPTH])
        is_beyond = state["extrapolation"] > _BEYOND_STORED and state["depth"] > TOUCH_DEPTH
        if self._fidelity == 0 and is_beyond and len(self._fidelities) > 1:
            self._left = (self.q.copy(), pressed)
            q = self._contact.model.expand(self.q)
            self._use(1)
            q = self._settle(q, state["x_model"])
        elif self._fidelity == 1 and pressed < _BACK * self._left[1]:
            self._use(0)
            # of the shape that was left and the unloaded jaw, the nearer one
            is_near = pressed > 0.5 * self._left[1]
            q = self._left[0] if is_near else self._contact.begin(float(state["x"][HEIGHT]))
        else:
            return
        self._search.resume(q)

    def _settle(self, q: NDArray, x: NDArray) -> NDArray:
        """Return the shape (size,) of the jaw that is pressed in a state (3,), from one nearby."""
        for _ in range(_SETTLING):
            pressed = self._contact.linearize(q, x, self._traction)
            if not pressed.touches or pressed.size < _SETTLED:
                break
            q = q + limit_step(self._contact.model, pressed.correction)
        return q

    def vertices(self) -> NDArray:
        """Return the deformed mesh vertices (n, 3) [m], in mesh order."""
        return self._contact.model.vertices(self.q)

    @property
    def q(self) -> NDArray:
        """The jaw's unknowns (size,)."""
        return self._search.q

    @property
    def used(self) -> NDArray:
        """Which key points of the last image count (K,)."""
        return self._search.points["weight"] > 0

    def give_shape(self) -> NDArray:
        """Return the shape (size,) for another tracker to begin with."""
        return self.q if self._fidelity == 0 else self._left[0]

    def _begin(self) -> None:
        """Start with the undeformed jaw and an object that just touches."""
        self._use(0)
        self._search.begin(self._contact, self._mean)
        self._led = self._mean.copy()
        self.slips.reset()
        self._held.reset()
        self._hold.reset()
        self._lateral.reset()
        self._released, self._jumped, self._slides = 0, False, False

    def _forget_contact(self) -> None:
        """Expect any object again, as the next one may be."""
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
        noise = tare.point_noise(observation.stddev)
        self._search.expectation["shared"] = observation.shared
        measured = points - tare.offsets
        held = self._lateral.by_force * self._held.lateral if self._is_known else None
        if held is not None:
            measured -= self._lateral.motions + held
        self._fill(measured, tare, noise)
        is_sudden = bool(self._released or self._jumped)
        most = FULL_ITERATIONS if self._fidelity else self.settings.iterations
        if not self._search.find(self._contact, self._traction, self._probe, dt, iterations=most, is_sudden=is_sudden):
            self._search.lose(LOST_STDDEV)
            return None
        state = self._search.state
        state["traction_ratio"] = self._traction.ratio
        self._jumped = bool(state["jumped"])
        self._released = self._released + 1 if state["depth"] < TOUCH_DEPTH else 0
        if self._released >= IMAGES_RELEASED:  # the next object may be any again, and nothing hangs on the jaw yet
            self._forget_contact()
            if self.settings.may_be_held:
                self._held.reset()
                self._hold.reset()
                self._traction = FRICTIONLESS
        prior = self._search.expectation["variance"]
        asked, spread, absorbed = measure_traction(self._search.points, self._search.average, prior)
        if held is not None and state["converged"] and state["depth"] >= LOADED_DEPTH and not self._jumped:
            self._follow_traction((asked, spread), noise.gain, dt, observation.gravity)
        self._complete(state)
        expected = self._search.expectation["mean"], prior
        if observation.shared:  # common motion is expected
            state["bumped"] = state["motion"] = 0.0
        else:
            self._camera.update(self._search.points, self._search.positions, state, expected, tare)
        state["traction_leak"] = state["by_traction"] - state["force_modes"] @ absorbed
        if held is not None:
            motions = (points - tare.offsets - held - self._search.positions)[:, 1]
            bend = self._search.positions[:, 0] - self._rest[:, 0]
            self._lateral.update(motions, bend, self._search.points, state)
        self._change_fidelity(state)
        return state

    def _fill(self, measured: NDArray, tare: Tare, noise: PointNoise) -> None:
        """Fill in the key points of an image, measured (K, 3) [m]."""
        points = self._search.points
        points["measured"], points["rest"] = measured, self._rest
        points["tare_noise"], points["gain"] = noise.plane, noise.gain
        points["width_variance"], points["trust"] = noise.width_variance, noise.trust
        points["offset_variance"], points["sight"] = tare.offset_variance() + noise.bias, noise.bias

    def significance(self, tare: Tare, stddev: float) -> float:
        """Return by how many standard deviations a force explains the offsets of a tare; see `explain_offsets`."""
        return explain_offsets(self.rest_modes(), tare, stddev)

    def rest_modes(self) -> NDArray:
        """Return how the key points of the undeformed jaw move in x and z by the depth (K, 2) [m/m]."""
        q = np.zeros(self._contact.model.size)
        pressed = self._contact.linearize(q, find_x_model(self._contact, np.r_[-1.0, self._mean])[0])
        return self._contact.model.project(self._probe, q, pressed.modes)[:, [0, 2], DEPTH]

    def forget(self) -> None:
        """Forget what was learnt of the object."""
        self.roughness.reset()
        self.reset()

    def expect_friction(self, friction: Coefficient | None) -> None:
        """Expect an object of a stated coefficient of friction; None for one of which the settings say all."""
        self.roughness.expect(friction)

    @property
    def friction(self) -> Coefficient:
        """What is known of the object's coefficient of friction."""
        return self.roughness.coefficient

    @property
    def _is_known(self) -> bool:
        """Whether the object is known by its outline."""
        return self._outline is self._contact.indenter

    def _follow_traction(
        self, evidence: tuple[float, float], gain: NDArray, dt: float, gravity: NDArray | None
    ) -> None:
        """Follow the traction of an object that only the jaws hold, or may; friction is left to `learn`."""
        search, prior = self._search, self._search.expectation["variance"]
        self._slides = self.settings.held != "yes"
        if not self.settings.may_be_held:
            return
        response = tuple(project_response(each, gain) for each in (self._lateral.by_force, self._lateral.by_moment))
        wanted = self._held.update(search.points, search.state, response, prior, dt, gravity)
        if self.settings.held == "either":
            normal = max(hypot(search.state["pressing"][0], search.state["pressing"][2]), _LEAST_NORMAL)
            expected = Coefficient(wanted, self._find_held_stddev(normal)), self._find_friction()
            wanted = self._hold.update(evidence, search.state, expected, dt)
            search.explain(self._hold.learnt)
        self._traction = constant_traction(min(max(wanted, -LARGEST_RATIO), LARGEST_RATIO))

    def learn(self) -> None:
        """Learn what the last image tells of friction, which its force did not wait for."""
        if not self._slides:
            return
        self._slides = False
        state, mean = self._search.state, self._mean
        before, known = self.slips.mobilised, self.roughness.coefficient.mean
        self._fidelities[0].contact.set_indenter(self._contact.indenter)
        expected = np.r_[state["x_model"][DEPTH], mean]
        self.slips.follow(self.give_shape(), expected, sqrt(state["depth_variance"]), known)
        self.roughness.update(self._search.points, state, mean, self._search.expectation["variance"], before)
        if not self.settings.may_be_held:
            self._traction = constant_traction(self._find_friction().mean)

    def resume(self, q: NDArray) -> None:
        """Start anew from the shape (size,) that another tracker has found."""
        self.reset()
        self._search.resume(q.copy())

    def follow(self, contact: Contact) -> None:
        """Take over where a contact's object is: its outline, or its height as that of first touch."""
        if contact.outline is not None:
            self._follow_outline(contact)
            return
        height = float(expect_object(contact, self.settings).mean[1])
        if self._given is None:
            self.reset(height)
        if abs(height - self._given) > _FARTHEST_HEIGHT * self.settings.height_stddev:
            self._mean[1] = height
            self._forget_contact()  # another object
        self._search.expectation["stiffness"] = self.response.stiffness_at(height)
        self._given = self._mean[1] = height

    def _follow_outline(self, contact: Contact) -> None:
        """Take the outline's tilt and height as what is to be expected; an outline cut anew keeps the contact."""
        before = self._contact.indenter
        if contact.outline.across is not None:
            self._lateral.expect(*contact.outline.across)
        expected = expect_object(contact, self.settings, self._outline)
        self._expect(expected.mean, expected.variance)
        self._lead(contact.outline.stddev[[2, 1]])
        self._outline = after = expected.indenter
        self._press(after)
        pressed_by_pose = self._contact.face_x + after.pressed.front - contact.outline.origin[0]
        self._is_apart = bool(pressed_by_pose < -_APART_SIGMAS * contact.outline.stddev[0])
        height = float(expected.mean[1])
        self._given, self._search.expectation["stiffness"] = None, self.response.stiffness_at(height)
        is_off = abs(self._search.state["x"][HEIGHT] - height) > _FARTHEST_HEIGHT * self.settings.height_stddev
        is_same = isinstance(before, OutlineIndenter) and after.resembles(before)
        if isinstance(before, OutlineIndenter) and not is_same:
            self.roughness.reset()
        if is_off or not is_same:
            self._begin()
        elif after is not before:
            change = after.pressed.front - before.pressed.front
            self._search.shift(change)
            self.slips.shift(change)

    def _lead(self, chance: NDArray) -> None:
        """Take the contact along where the object slides or tilts, beyond what its pose may be off by chance.

        The averaged residuals are those of an object that stays where it is, and would hold the contact back.
        """
        moved = self._mean - self._led
        change = np.array([leave_play(moved[0], chance[0]), leave_play(moved[1], chance[1])])
        if change.any():
            self._led += change
            self._search.lead(change, _KEPT)
            self._held.lead(change)

    def _complete(self, state: ContactState) -> None:
        """Fill in what is known of the traction of a contact, and what the jaw bears."""
        normal = hypot(state["force"][0], state["force"][2])
        if not self._is_known:
            traction = UNSEEN_TRACTION * self.settings.friction
            load = 0.0, MIDDLE_STDDEV, nan, traction
        else:
            load, traction = self._find_lateral(normal), self._find_traction(normal)
        state["y"], state["y_stddev"], state["lateral_force"], state["lateral_stddev"] = load
        state["traction_stddev"] = traction
        state["hidden"] = self._find_hidden(state, normal)
        state["bearable"] = self._fidelities[0].contact.bearable

    def _find_hidden(self, state: ContactState, normal: float) -> float:
        """Return the standard deviation of a force [N] elsewhere than the key points have it, which they hardly show.

        Within the uncertainty of its state, as by rocking, an object that is clear of the base may press there, and one
        that seems to press there may be clear of it; so may a flat one anywhere along a stiff finger. A force whose
        centre is next to the clamp is not known at all.
        """
        if self._is_apart:
            return 0.0
        centre = state["pressure_location"][2]
        if centre < self._base[-1][0]:
            return normal
        places = self._base + [place for place in self._along if abs(place[0] - centre) > _ELSEWHERE]
        x, indenter, surface = state["x"], self._contact.indenter, self._contact.surface
        near = [(place, c) for place in places if abs(c := indenter.find_clearance(x, 0.0, place[0])) < _WELL_CLEAR]
        if not near:
            return 0.0
        moved, hidden = self._contact.place_points(self.q)[:, 0] - surface.points[:, 0], 0.0
        for (height, stiffness, vague), clearance in near:
            row = max(0, int(np.searchsorted(surface.heights, height)) - 1) * surface.across
            beyond = self._find_clearance_stddev(state, height) - abs(clearance - moved[row]) / _APART_SIGMAS
            hidden = max(hidden, min(stiffness * beyond, vague))
        return hidden

    def _find_clearance_stddev(self, state: ContactState, height: float) -> float:
        """Return the standard deviation of the object's clearance at a height by its state [m]."""
        x, indenter = state["x"], self._contact.indenter
        slope, covariance = np.array([-1.0, 0.0, 0.0]), state["covariance"]
        for i in (SHAPE, HEIGHT):
            step = np.zeros(3)
            step[i] = sqrt(max(covariance[i, i], _LEAST_VARIANCE))
            change = [indenter.find_clearance(x + sign * step, 0.0, height) for sign in (-1.0, 1.0)]
            slope[i] = 0.5 * (change[1] - change[0]) / step[i] if np.isfinite(change).all() else 0.0
        return sqrt(max(float(slope @ covariance @ slope), 0.0))

    def _measure_stiffness(self, height: float) -> float:
        """Return the stiffness of the unloaded jaw at a height [m] against a round object [N/m]."""
        _, pressed = press_lightly(self._contact, log(self.settings.radius), height)
        return abs(float(pressed.force_modes[0, DEPTH]))

    def _find_lateral(self, normal: float) -> NDArray:
        """Return what acts laterally, see `LateralLoad`; what a lifted object may do there is uncertainty."""
        load, held = self._lateral.load.copy(), self._held
        if self.settings.may_be_held and held.lateral_stddev < np.inf:
            load[2] += held.lateral
            load[3] = hypot(load[3], held.lateral_stddev / max(normal, _LEAST_NORMAL))
        return load

    def _find_traction(self, normal: float) -> float:
        """Return the standard deviation of the traction ratio of a force [N] along the finger [-]."""
        if not self.settings.may_be_held:
            return self._find_friction().stddev
        if self.settings.held == "either" and self._hold.ratio.stddev < np.inf:
            return self._hold.ratio.stddev
        return self._find_held_stddev(max(normal, _LEAST_NORMAL))

    def _find_held_stddev(self, normal: float) -> float:
        """Return the standard deviation of the traction ratio of what only the jaws hold, by a force [N]."""
        return sqrt(min(self._held.stddev / normal, _WEIGHT) ** 2 + _TRACTION**2)

    def _find_friction(self) -> Coefficient:
        """Return the traction ratio of what something else holds, too."""
        found, mobilised = self.roughness.coefficient, self.slips.mobilised
        variance = (found.stddev * mobilised) ** 2 + (_UNFOLLOWED * found.mean) ** 2 + _MISDIRECTED**2
        return Coefficient(found.mean * mobilised, sqrt(variance))


def _attach(contact: RigidContact, keypoints: NDArray) -> _Fidelity:
    """Return the mechanics of a contact with key points (K, 3) [m]; raises MeshError when one is off the jaw."""
    probe = contact.model.attach(keypoints, KEYPOINT_DISTANCE)
    return _Fidelity(contact, probe, contact.model.positions(probe, np.zeros(contact.model.size)))
