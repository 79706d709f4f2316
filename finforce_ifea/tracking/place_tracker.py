"""Depth, shape and height of the pressing object from key points, frame after frame, on the deformed jaw.

The shape of an unknown object is its radius, that of a known outline its tilt. Depth changes fast and is tracked by a
Kalman filter with constant velocity. Shape and height change slowly: the maximum a posteriori for the residuals
averaged over the last frames, so that their priors count once and errors of the mechanics are no information.
"""

from collections.abc import Callable
from functools import partial
from math import hypot, sqrt
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from finforce_ifea.contact_mechanics.indenter import DEPTH, OutlineIndenter, RoundIndenter, expect_object
from finforce_ifea.contact_mechanics.pressed_jaw import Mechanics, RollingContact
from finforce_ifea.contact_mechanics.torsion import Torsion
from finforce_ifea.jaw.jaw import KEYPOINT_DISTANCE
from finforce_ifea.observation import Contact
from finforce_ifea.settings import EstimatorSettings
from finforce_ifea.tare import Tare
from finforce_ifea.tracking.friction_estimate import SMOOTH, Coefficient, FrictionEstimate, FrictionFrame
from finforce_ifea.tracking.held_weight import HeldFrame, HeldWeight
from finforce_ifea.tracking.influence import measure_influence
from finforce_ifea.tracking.place_search import (
    LOADED_DEPTH,
    TOUCH_DEPTH,
    FoundPlace,
    PlaceFrame,
    PlaceRoom,
    PlaceRules,
    PlaceState,
    find_place,
    reach_place,
)
from finforce_ifea.tracking.place_update import blank_average
from finforce_ifea.tracking.slip_history import SlipHistory, leave_play
from finforce_ifea.tracking.track import UNSEEN_LEAN, AcrossFinger, Track, explain_offsets
from finforce_ifea.tracking.width_tracker import WidthTracker

_FRAMES_RELEASED = 15
_LOST_STDDEV = 1e-3
# The height may leave what was given by this many of its standard deviations; beyond, the contact is another one.
_FARTHEST_HEIGHT = 8.0
# Shapes so many times as far from the stored ones as these are good for are left to the full mechanics, until the
# object has gone back to this share of its depth.
_STRANGE, _BACK = 1.0, 0.8
# What is held by the jaws alone does not slide out: of the force along the finger its weight is left, as far as
# friction can. From image to image the lean goes this share of its way there.
_LARGEST_LEAN, _HELD_GAIN = 0.9, 1.0
# What of the friction the mechanics does not follow, and a lean of the force that is never excluded [-].
_UNFOLLOWED, _LEAN = 0.25, 0.08
# What is kept of the averaged residuals where an object slides.
_KEPT = 0.5
# Of a weight that nobody knows, as a share of the normal force, and the least normal force that counts [N].
_WEIGHT, _LEAST_NORMAL = 0.15, 0.1
# Where along y a lifted object comes to press, as a share of half the finger's width.
_ARM = 0.5


class _Level(NamedTuple):
    """One of the mechanics of a jaw: its contact, the probe of the key points, and these at rest (K, 3) [m]."""

    contact: RollingContact
    probe: Any
    rest: NDArray


class PlaceTracker:
    """Tracks the place of the pressing object; holds the jaw in equilibrium with it.

    Where a reduced jaw bends as none of its stored shapes does, as around large flat things, the full one takes over.

    Attributes:
        roughness: what is known of the object's friction.
        slips: how far the object makes use of it.
        gravity: its direction (3,) in the jaw's frame; None where nobody knows.
    """

    def __init__(
        self,
        mechanics: Mechanics,
        keypoints: NDArray,
        settings: EstimatorSettings,
        torsion: Torsion | None = None,
        smooth: Coefficient = SMOOTH,
    ) -> None:
        """Attaches the key points to the model.

        Args:
            mechanics: of the jaw.
            keypoints: (K, 3) [m, undeformed].
            settings: of the estimator.
            torsion: what acts across the finger does; None where nobody knows.
            smooth: friction of the objects of the calibration.

        Raises:
            MeshError: A key point is off the jaw.
        """
        self.settings = settings
        self._levels = [_attach(level.contact, keypoints) for level in (mechanics, mechanics.full) if level is not None]
        self._stand_on(0)
        self._room = PlaceRoom(len(keypoints))
        self._stiffness: float | None = None
        contact = self.contact
        self.response = measure_influence(contact, self.probe, len(keypoints))
        self._outline: OutlineIndenter | None = None
        self.slips = SlipHistory(contact.with_friction())
        self.roughness = FrictionEstimate(settings, smooth)
        self._held = HeldWeight()
        self.gravity: NDArray | None = None
        self._width = WidthTracker(torsion, len(keypoints), UNSEEN_LEAN * settings.friction)
        self._face = contact.surface.heights[[0, -1]]
        self.reset()

    def reset(self, height: float | None = None) -> None:
        """Starts anew, unloaded, with an unknown object that will first touch at `height` [m], the middle if None."""
        settings = self.settings
        self._given = height
        self._stand_on(0)
        height = float(np.median(self.contact.surface.heights)) if height is None else height
        self.contact.set_indenter(RoundIndenter())
        self.contact.rubbing.lean = 0.0
        self._prior = np.array([np.log(settings.radius), height])
        self._prior_variance = np.array([settings.radius_log_stddev, settings.height_stddev]) ** 2
        self._begin()

    def _stand_on(self, level: int) -> None:
        """Takes one of the mechanics for the next frames."""
        self._level = level
        self.contact, self.probe, self._rest = self._levels[level]

    def _change_level(self, extrapolation: float) -> None:
        """Goes on with the full mechanics where the shape is too far from those stored, and back where it bends less.

        Args:
            extrapolation: of the shape that was found; see `PressedState`.
        """
        before, pressed = self.contact, float(self._state.motion[0])
        if self._level == 0 and extrapolation > _STRANGE and len(self._levels) > 1:
            self._left = (self.q.copy(), _BACK * pressed)
            q = before.model.expand(self.q)
            self._stand_on(1)
        elif self._level == 1 and pressed < self._left[1]:
            q = self._left[0]
            self._stand_on(0)
        else:
            return
        self.contact.set_indenter(before.indenter)
        self.contact.rubbing.lean = before.rubbing.lean
        self._state = self._state._replace(q=q, modes=np.zeros((self.contact.model.size, 3)))

    def vertices(self) -> NDArray:
        """Returns the deformed mesh vertices (n, 3) [m], in mesh order."""
        return self.contact.model.vertices(self.q)

    def positions(self) -> NDArray:
        """Returns the key points (K, 3) [m] of the deformed jaw."""
        return self.contact.model.positions(self.probe, self.q)

    @property
    def q(self) -> NDArray:
        """The jaw's unknowns (size,)."""
        return self._state.q

    def give_shape(self) -> NDArray:
        """Returns the shape (size,) for another tracker to begin with."""
        return self.q if self._level == 0 else self._left[0]

    def _begin(self) -> None:
        """Starts with the undeformed jaw and an object that just touches."""
        self._stand_on(0)
        touch = self.contact.find_touch(np.r_[0.0, self._prior])
        self._state = PlaceState(
            self.contact.begin(self._prior[1]),
            np.zeros((self.contact.model.size, 3)),
            np.zeros(3),
            np.array([touch, 0.0]),
            np.diag([0.1e-3, 1e-3]) ** 2,
            self._prior.copy(),
            *blank_average(len(self._rest)),
        )
        self._led = self._prior.copy()
        self.slips.reset()
        self._held.reset()
        self._width.reset()
        self._released, self._jumped = 0, False
        self._unlearnt: Callable[[], None] | None = None

    def _forget_place(self) -> None:
        """Expects any object again, as the next one may be."""
        self._led, state = self._prior.copy(), self._state
        state.slow[:] = self._prior
        for average in (state.residuals, state.by_place, state.count):
            average[:] = 0.0

    def _put_down(self) -> None:
        """Takes the next object as one of which nothing hangs on the jaw yet: weights are those of one hold."""
        if self.settings.held == "yes":
            self._held.reset()
            self.contact.rubbing.lean = 0.0

    def update(self, points: NDArray, tare: Tare, dt: float, stddev: NDArray | None = None) -> Track | None:
        """Takes the key points (K, 3) [m], NaN where unused, dt [s] after the last; None when too few agree.

        `stddev` (K, 3) [m] are their stated standard deviations.
        """
        noise, unseen = tare.point_noise(stddev), self.settings.offset_stddev
        measured = points - tare.offsets
        if self._is_known:
            measured -= self._width.motions + self._width.sideways * self._held.across
        frame = PlaceFrame(
            measured=measured,
            rest=self._rest,
            noise=noise.plane,
            gain=noise.gain,
            width_variance=noise.width_variance,
            trust=noise.trust,
            offset_variance=tare.offset_variance(unseen) + noise.standing,
            dt=dt,
            sudden=bool(self._released or self._jumped),
        )
        found = find_place(self.contact, self.probe, self._state, frame, self._rules(), self._room)
        if found is None:
            return self._lose()
        self._jumped = found.jumped
        self._released = self._released + 1 if found.pressed < TOUCH_DEPTH else 0
        if self._released >= _FRAMES_RELEASED:  # the next object may be any again
            self._forget_place()
            self._put_down()
        if found.settled and self._is_known:
            self._learn_friction(found, noise.gain, dt)
        track = self._report(found)
        if self._is_known:
            variances, aside = (frame.width_variance, frame.offset_variance), points[:, 1] - tare.offsets[:, 1]
            aside = aside - self._width.sideways[:, 1] * self._held.across
            self._width.update(aside - self._rest[:, 1], found.data, variances, track.force, track.pressure_place[2])
        self._change_level(found.extrapolation)
        return track

    def _rules(self) -> PlaceRules:
        """Returns what is expected of the object and allowed to the search."""
        settings, indenter = self.settings, self.contact.indenter
        shapes = indenter.shape_range
        return PlaceRules(
            self._prior,
            self._prior_variance,
            shapes.low,
            shapes.high,
            shapes.largest_change,
            shapes.settled_change,
            indenter.has_corners,
            _FARTHEST_HEIGHT * settings.height_stddev,
            settings.acceleration,
            float(settings.memory),
            settings.model_error,
            settings.gate,
            settings.iterations,
            settings.minimum_keypoints,
            self._stiffness or 0.0,
        )

    def significance(self, tare: Tare, stddev: float) -> float:
        """Returns by how many standard deviations a force explains the offsets of a tare; see `explain_offsets`."""
        return explain_offsets(self.rest_modes(), tare, stddev)

    def rest_modes(self) -> NDArray:
        """Returns how the key points of the undeformed jaw move in x and z by the depth (K, 2) [m/m]."""
        q = np.zeros(self.contact.model.size)
        state = self.contact.linearize(q, reach_place(self.contact, np.r_[-1.0, self._prior]))
        return self.contact.model.project(self.probe, q, state.modes)[:, [0, 2], DEPTH]

    def forget(self) -> None:
        """Forgets what was learnt of the object."""
        self.roughness.reset()
        self.reset()

    @property
    def _is_known(self) -> bool:
        """Whether the object is known by its outline."""
        return self._outline is self.contact.indenter

    def _learn_friction(self, found: FoundPlace, gain: NDArray, dt: float) -> None:
        """Learns how the object leans where it is held; what slides is followed by `learn`.

        `gain` (K, 2) is the regression of the noise along x and z on that along y, `dt` the time since the last [s].
        """
        if found.pressed < LOADED_DEPTH or found.jumped:
            return
        normal = hypot(found.pressing[0], found.pressing[2])
        if self.settings.held == "yes":
            rubbing = self.contact.rubbing
            upright = find_upright_lean(found.pressing, rubbing.lean)
            width = self._width
            frame = HeldFrame(
                data=found.data,
                modes=found.motions[:, ::2],
                normal=normal,
                lean=rubbing.lean - upright,
                moved=found.moved,
                place=found.place,
                aside=see_aside(width.sideways, gain),
                across=self._held.across,
                twist=see_aside(width.twisting, gain),
                arm=_ARM * width.half_width,
            )
            wanted = upright + self._held.update(frame, self._prior_variance, dt, self.gravity) / normal
            rubbing.lean += _HELD_GAIN * (min(max(wanted, -_LARGEST_LEAN), _LARGEST_LEAN) - rubbing.lean)
            return
        self._unlearnt = partial(self._follow_slide, normal, found)

    def learn(self) -> None:
        """Learns what the last frame says of friction, which its force did not wait for."""
        unlearnt, self._unlearnt = self._unlearnt, None
        if unlearnt is not None:
            unlearnt()

    def _follow_slide(self, normal: float, found: FoundPlace) -> None:
        """Follows how an object slides that presses with a normal force [N]."""
        expected = np.array([self._state.reached[DEPTH], self._prior[0], self._prior[1]])
        before, known = self.slips.mobilised, self.roughness.coefficient.mean
        self.slips.set_indenter(self.contact.indenter)
        mobilised = self.slips.follow(self.give_shape(), expected, sqrt(found.depth_variance), known)
        away = found.place[1:] - self._prior
        frame = FrictionFrame(
            found.data, found.motions[:, ::2], normal, before, self.contact.rubbing.lean, found.moved, away
        )
        found = self.roughness.update(frame, self._prior_variance)
        self.contact.rubbing.lean = found.mean * mobilised

    def resume(self, q: NDArray) -> None:
        """Starts anew from the shape (size,) that another tracker has found."""
        self.reset()
        self._state = self._state._replace(q=q.copy())

    def follow(self, contact: Contact) -> None:
        """Takes over where a contact's object is: its outline, or its height as that of first touch."""
        if contact.outline is not None:
            self._follow_outline(contact)
            return
        height = float(expect_object(contact, self.settings).mean[1])
        if self._given is None:
            self.reset(height)
        if abs(height - self._given) > _FARTHEST_HEIGHT * self.settings.height_stddev:
            self._prior[1] = height
            self._forget_place()  # another object
        self._stiffness = self.response.stiffness_at(height)
        self._given = self._prior[1] = height

    def _follow_outline(self, contact: Contact) -> None:
        """Takes the outline's tilt and height as what is to be expected; an outline cut anew keeps the place."""
        before = self.contact.indenter
        if contact.outline.across is not None:
            self._width.expect(*contact.outline.across)
        expected = expect_object(contact, self.settings, self._outline)
        self._prior, self._prior_variance = expected.mean, expected.variance
        self._lead_place()
        self._outline = after = expected.indenter
        self.contact.set_indenter(after)
        self._given, self._stiffness = None, self.response.stiffness_at(float(expected.mean[1]))
        away = abs(self._state.slow[1] - expected.mean[1]) > _FARTHEST_HEIGHT * self.settings.height_stddev
        if isinstance(before, OutlineIndenter) and not after.resembles(before):
            self.roughness.reset()
        if away or not isinstance(before, OutlineIndenter) or not after.resembles(before):
            self._begin()
        elif after is not before:
            change = after.field.front - before.field.front
            self._state.motion[0] += change
            self._state.reached[DEPTH] += change
            self.slips.shift(change)

    def _lead_place(self) -> None:
        """Takes the place along where the object slides or tilts, beyond what its pose may be off by chance.

        The averaged residuals are those of an object that stays where it is, and would hold the place back.
        """
        chance, moved = np.sqrt(self._prior_variance), self._prior - self._led
        way = np.array([leave_play(moved[0], chance[0]), leave_play(moved[1], chance[1])])
        if way.any():
            self._led += way
            self._state.slow[:] += way
            self._state.count[:] *= _KEPT
            self._held.lead(way)

    def _lose(self) -> None:
        """Widens the search for the next frame."""
        self._state.motion[1] = 0.0
        self._state.spread[0, 0] += _LOST_STDDEV**2

    def _report(self, found: FoundPlace) -> Track:
        data, normal, known = found.data, hypot(found.force[0], found.force[2]), self._is_known
        return Track(
            covariance=found.covariance,
            force=found.force,
            magnitude=found.magnitude,
            stddev=found.stddev,
            force_modes=found.force_modes,
            pressure_point=found.pressure_point,
            pressure_place=found.pressure_place,
            weights=data.weights,
            stiffening=found.stiffening,
            residual=found.residual,
            misfit=found.misfit,
            kkt=found.kkt,
            iterations=found.iterations,
            converged=found.settled,
            bearable=self._levels[0].contact.bearable,
            across=self._describe_across(normal) if known else None,
            lean_stddev=self._describe_lean(normal) if known else None,
            lean_leak=self._find_leak(found, normal) if known else 0.0,
            ambiguity=found.ambiguity,
            sound=found.sound,
            quiet=found.pressed < TOUCH_DEPTH,
            loaded=found.pressed > LOADED_DEPTH,
            away=found.away,
            extrapolation=found.extrapolation,
            mistaken=found.mistaken,
            agreement=data.agreed / data.known,
            condition=found.condition,
            place_stddev=sqrt(max(found.height_variance, 0.0)),
        )

    def _describe_across(self, normal: float) -> AcrossFinger:
        """Returns what acts across the finger; what a lifted object may do there besides is doubt."""
        seen, held = self._width.across, self._held
        if self.settings.held != "yes" or not held.across_stddev < np.inf:
            return seen
        doubt = held.across_stddev / max(normal, _LEAST_NORMAL)
        return AcrossFinger(seen.place, seen.place_stddev, seen.force + held.across, hypot(seen.lean_stddev, doubt))

    def _find_leak(self, found: FoundPlace, normal: float) -> float:
        """Returns by how much a held object's force [N] along the finger changes that along x [-]."""
        if self.settings.held != "yes" or normal < _LEAST_NORMAL:
            return 0.0
        return float(found.leaning[0] / normal - found.force_modes[0, DEPTH] * self._held.leverage)

    def _describe_lean(self, normal: float) -> float:
        """Returns the standard deviation of the lean of a force [N] along the finger that friction leaves [-]."""
        if self.settings.held == "yes":
            return sqrt(min(self._held.stddev / max(normal, _LEAST_NORMAL), _WEIGHT) ** 2 + _LEAN**2)
        found = self.roughness.coefficient
        return sqrt((found.stddev * self.slips.mobilised) ** 2 + (_UNFOLLOWED * found.mean) ** 2 + _LEAN**2)


def _attach(contact: RollingContact, keypoints: NDArray) -> _Level:
    """Returns the mechanics of a contact with key points (K, 3) [m]; raises MeshError when one is off the jaw."""
    probe = contact.model.attach(keypoints, KEYPOINT_DISTANCE)
    return _Level(contact, probe, contact.model.positions(probe, np.zeros(contact.model.size)))


def see_aside(sideways: NDArray, gain: NDArray) -> NDArray:
    """Returns what residuals show of motions across the finger (K, 3): those in x and z are taken as if y were known.

    A residual in the plane is what is left once the residual along y has told of noise that they share, which is most
    of what is seen along a line of sight that is aslant.

    Args:
        sideways: motions (K, 3).
        gain: regression of the noise along x and z on that along y (K, 2).
    """
    seen = sideways.copy()
    seen[:, ::2] -= gain * sideways[:, 1:2]
    return seen


def find_upright_lean(force: NDArray, lean: float) -> float:
    """Returns the lean with which a force has nothing along the finger, that has a lean now.

    Args:
        force: of the object on the jaw (3,) [N].
        lean: of it now [-].
    """
    ahead, along = force[0] - lean * force[2], force[2] + lean * force[0]
    return min(max(along / ahead, -_LARGEST_LEAN), _LARGEST_LEAN) if ahead != 0.0 else 0.0
