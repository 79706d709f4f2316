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

from finforce_ifea.contact_mechanics.indenter import DEPTH, HEIGHT, SHAPE, OutlineIndenter, RoundIndenter, expect_object
from finforce_ifea.contact_mechanics.pressed_jaw import Mechanics, PressedState, RollingContact, limit_step
from finforce_ifea.contact_mechanics.torsion import Torsion
from finforce_ifea.jaw.jaw import KEYPOINT_DISTANCE
from finforce_ifea.observation import Contact
from finforce_ifea.settings import EstimatorSettings
from finforce_ifea.tare import PointNoise, Tare
from finforce_ifea.tracking.friction_estimate import SMOOTH, Coefficient, FrictionEstimate, FrictionFrame
from finforce_ifea.tracking.held_weight import HeldFrame, HeldWeight
from finforce_ifea.tracking.influence import measure_influence
from finforce_ifea.tracking.place_update import (
    Average,
    Forecast,
    PlaceUpdate,
    Residuals,
    Uncertainty,
    forecast_place,
    update_place,
    weigh_residuals,
)
from finforce_ifea.tracking.slip_history import SlipHistory, leave_play
from finforce_ifea.tracking.track import UNSEEN_LEAN, AcrossFinger, Track, explain_offsets
from finforce_ifea.tracking.width_tracker import WidthTracker

# The mechanics is evaluated at this depth [m] at least; below it shapes and forces are continued linearly.
_LEAST_DEPTH = 3e-5
_TOUCH_DEPTH = 0.15e-3
_LOADED_DEPTH = 0.5e-3
_DEPTH_DRIFT = 0.01e-3
_LARGEST_MOVE = 0.7e-3
# A leap only has to come near. One that leaves the points as far as they were by all but this is in vain [m].
_LARGEST_LEAP, _LEAST_APPROACH = 2e-3, 0.1e-3
_LARGEST_SHIFT = 0.3e-3
_SETTLED_MOVE = 1e-4
# Of the model's reach, 0.1 mm.
_SETTLED_CORRECTION = 0.05
_UNDECIDED = 0.2
_FRAMES_RELEASED = 15
_LOST_STDDEV = 1e-3
# The height may leave what was given by this many of its standard deviations; beyond, the contact is another one.
_FARTHEST_HEIGHT = 8.0
# Fewer points in agreement with the forecast than this share call for a leap; a forecast is never wider than this [m].
_LEAST_AGREEMENT = 0.6
_WIDEST_FORECAST = 1e-3
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
        self._stiffness: float | None = None
        contact = self.contact
        self.response = measure_influence(contact, self.probe, len(keypoints))
        self._outline: OutlineIndenter | None = None
        self.slips = SlipHistory(contact.with_friction())
        self.roughness = FrictionEstimate(settings, smooth)
        self._held = HeldWeight()
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
        before, pressed = self.contact, float(self._motion[0])
        if self._level == 0 and extrapolation > _STRANGE and len(self._levels) > 1:
            self._left = (self.q, _BACK * pressed)
            q = before.model.expand(self.q)
            self._stand_on(1)
        elif self._level == 1 and pressed < self._left[1]:
            q = self._left[0]
            self._stand_on(0)
        else:
            return
        self.contact.set_indenter(before.indenter)
        self.contact.rubbing.lean = before.rubbing.lean
        self.q, self._modes = q, np.zeros((self.contact.model.size, 3))

    def vertices(self) -> NDArray:
        """Returns the deformed mesh vertices (n, 3) [m], in mesh order."""
        return self.contact.model.vertices(self.q)

    def positions(self) -> NDArray:
        """Returns the key points (K, 3) [m] of the deformed jaw."""
        return self.contact.model.positions(self.probe, self.q)

    def give_shape(self) -> NDArray:
        """Returns the shape (size,) for another tracker to begin with."""
        return self.q if self._level == 0 else self._left[0]

    def _begin(self) -> None:
        """Starts with the undeformed jaw and an object that just touches."""
        self._stand_on(0)
        self.q = self.contact.begin(self._prior[1])
        self._motion = np.array([self._find_touch(np.r_[0.0, self._prior]), 0.0])
        self._motion_covariance = np.diag([0.1e-3, 1e-3]) ** 2
        self._modes, self._reached = np.zeros((self.contact.model.size, 3)), np.zeros(3)
        self.slips.reset()
        self._held.reset()
        self._width.reset()
        self._released, self._jumped = 0, False
        self._unlearnt: Callable[[], None] | None = None
        self._forget_place()

    def _forget_place(self) -> None:
        self._slow, self._led = self._prior.copy(), self._prior.copy()
        count = len(self._rest)
        self._average = Average(np.zeros((count, 2)), np.zeros((count, 2, 3)), np.zeros(count))

    def update(self, points: NDArray, tare: Tare, dt: float, stddev: NDArray | None = None) -> Track | None:
        """Takes the key points (K, 3) [m], NaN where unused, dt [s] after the last; None when too few agree.

        `stddev` (K, 3) [m] are their stated standard deviations.
        """
        forecast, noise = self._predict(dt), tare.point_noise(stddev)
        place = forecast.place
        q = self.q + self._modes @ (self._reachable(place) - self._reached)
        measured, unseen = points - tare.offsets - self._move_across(), self.settings.offset_stddev
        chance = self._expect_errors(noise, tare.offset_variance(unseen) + noise.standing, forecast)
        update, settled, iteration, share, last = None, False, 0, 1.0, np.zeros(3)
        far, in_vain = np.inf, 0
        while not settled and iteration < self.settings.iterations and in_vain < 2:
            iteration += 1
            mechanical = self._reachable(place)
            state = self.contact.linearize(q, mechanical)
            if not state.touches:
                q = q + self.contact.approach(q, state.correction, mechanical)
                continue
            q = q + state.correction
            data = self._weigh(q, state, measured, place - forecast.place, place, chance)
            if data.used < max(self.settings.minimum_keypoints, _LEAST_AGREEMENT * data.known):
                place, q = self._leap(q, state, mechanical, place, data)
                in_vain = in_vain + 1 if abs(data.jump) > far - _LEAST_APPROACH else 0
                far = abs(data.jump)
                continue
            update = self._update_place(data, forecast)
            aim = self._bound(update.place, place, share)
            # between two corners of an object the linearisation changes its mind: meet in the middle
            rocks = self.contact.indenter.has_corners and last[1:] @ (aim - place)[1:] < 0
            share *= 0.5 if rocks else 1.0
            missing = update.place - aim if share > _UNDECIDED else np.zeros(3)
            last, moved, place = aim - place, self._reachable(aim) - mechanical, aim
            q = q + limit_step(self.contact.model, state.modes[:, :3] @ moved)
            settled = self._is_settled(state, moved, missing)
        if update is None or not state.touches:
            return self._lose()
        self._keep(q, place, update, state.modes[:, :3])
        if settled and self._is_known:
            self._learn_friction(state, data, update, forecast, chance.gain, dt)
        track = self._report(state, place, moved, data, update, iteration, settled)
        if self._is_known:
            variances, aside = (chance.width_variance, chance.offset_variance), points[:, 1] - tare.offsets[:, 1]
            aside = aside - self._width.sideways[:, 1] * self._held.across
            self._width.update(aside - self._rest[:, 1], data, variances, track.force, track.pressure_place[2])
        self._change_level(state.extrapolation)
        return track

    def _move_across(self) -> NDArray:
        """Returns what acts across the finger moves the key points by (K, 3) [m]."""
        return self._width.motions + self._width.sideways * self._held.across

    def _bound(self, asked: NDArray, place: NDArray, share: float) -> NDArray:
        """Returns the place asked for, within a share of where the linearisation about the present one holds."""
        bounds, reach = self.contact.indenter.shape_range, _FARTHEST_HEIGHT * self.settings.height_stddev
        change = np.array([_LARGEST_MOVE, share * bounds.largest_change, share * _LARGEST_SHIFT])
        aim = np.minimum(np.maximum(asked, place - change), place + change)
        aim[SHAPE] = min(max(aim[SHAPE], bounds.low), bounds.high)
        aim[HEIGHT] = min(max(aim[HEIGHT], self._prior[1] - reach), self._prior[1] + reach)
        return aim

    def _is_settled(self, state: PressedState, moved: NDArray, missing: NDArray) -> bool:
        """Whether the last iteration changed nothing that matters."""
        change = (_SETTLED_MOVE, self.contact.indenter.shape_range.settled_change, _SETTLED_MOVE)
        small = all(max(abs(m), abs(k)) < c for m, k, c in zip(moved, missing, change, strict=True))
        return small and state.size < _SETTLED_CORRECTION

    def _find_touch(self, place: NDArray) -> float:
        """Returns the depth [m] at which the object of a place (3,) first touches the undeformed jaw."""
        return self.contact.find_touch(place)

    def _reachable(self, place: NDArray) -> NDArray:
        """Returns the place (3,) at which the mechanics stands for `place`."""
        return np.array([max(place[DEPTH], self._find_touch(place) + _LEAST_DEPTH), place[SHAPE], place[HEIGHT]])

    def significance(self, tare: Tare, stddev: float) -> float:
        """Returns by how many standard deviations a force explains the offsets of a tare; see `explain_offsets`."""
        return explain_offsets(self.rest_modes(), tare, stddev)

    def rest_modes(self) -> NDArray:
        """Returns how the key points of the undeformed jaw move in x and z by the depth (K, 2) [m/m]."""
        q = np.zeros(self.contact.model.size)
        state = self.contact.linearize(q, self._reachable(np.r_[-1.0, self._prior]))
        return self.contact.model.project(self.probe, q, state.modes)[:, [0, 2], DEPTH]

    def forget(self) -> None:
        """Forgets what was learnt of the object."""
        self.roughness.reset()
        self.reset()

    @property
    def _is_known(self) -> bool:
        """Whether the object is known by its outline."""
        return self._outline is self.contact.indenter

    def _learn_friction(
        self, state: PressedState, data: Residuals, update: PlaceUpdate, forecast: Forecast, gain: NDArray, dt: float
    ) -> None:
        """Learns how the object leans where it is held; what slides is followed by `learn`.

        `gain` (K, 2) is the regression of the noise along x and z on that along y, `dt` the time since the last [s].
        """
        if self._reached[DEPTH] - self._find_touch(self._reached) < _LOADED_DEPTH or self._jumped:
            return
        normal, moved = float(np.hypot(*state.force[::2])), update.place - forecast.place
        if self.settings.held == "yes":
            rubbing = self.contact.rubbing
            upright = find_upright_lean(state.force, rubbing.lean)
            width = self._width
            frame = HeldFrame(
                data=data,
                modes=self._motions[:, ::2],
                normal=normal,
                lean=rubbing.lean - upright,
                moved=moved,
                place=update.place,
                aside=see_aside(width.sideways, gain),
                across=self._held.across,
                twist=see_aside(width.twisting, gain),
                arm=_ARM * width.half_width,
            )
            wanted = upright + self._held.update(frame, self._prior_variance, dt) / normal
            rubbing.lean += _HELD_GAIN * (min(max(wanted, -_LARGEST_LEAN), _LARGEST_LEAN) - rubbing.lean)
            return
        self._unlearnt = partial(self._follow_slide, normal, moved, data, update)

    def learn(self) -> None:
        """Learns what the last frame says of friction, which its force did not wait for."""
        unlearnt, self._unlearnt = self._unlearnt, None
        if unlearnt is not None:
            unlearnt()

    def _follow_slide(self, normal: float, moved: NDArray, data: Residuals, update: PlaceUpdate) -> None:
        """Follows how an object slides that presses with a normal force [N] and has moved (3,)."""
        expected = np.array([self._reached[DEPTH], self._prior[0], self._prior[1]])
        before, known = self.slips.mobilised, self.roughness.coefficient.mean
        self.slips.set_indenter(self.contact.indenter)
        mobilised = self.slips.follow(self.give_shape(), expected, float(np.sqrt(update.depth_variance)), known)
        away = update.place[1:] - self._prior
        frame = FrictionFrame(data, self._motions[:, ::2], normal, before, self.contact.rubbing.lean, moved, away)
        found = self.roughness.update(frame, self._prior_variance)
        self.contact.rubbing.lean = found.mean * mobilised

    def resume(self, q: NDArray) -> None:
        """Starts anew from the shape (size,) that another tracker has found."""
        self.reset()
        self.q = q.copy()

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
        away = abs(self._slow[1] - expected.mean[1]) > _FARTHEST_HEIGHT * self.settings.height_stddev
        if isinstance(before, OutlineIndenter) and not after.resembles(before):
            self.roughness.reset()
        if away or not isinstance(before, OutlineIndenter) or not after.resembles(before):
            self._begin()
        elif after is not before:
            change = after.field.front - before.field.front
            self._motion[0] += change
            self._reached[DEPTH] += change
            self.slips.shift(change)

    def _lead_place(self) -> None:
        """Takes the place along where the object slides or tilts, beyond what its pose may be off by chance.

        The averaged residuals are those of an object that stays where it is, and would hold the place back.
        """
        chance, moved = np.sqrt(self._prior_variance), self._prior - self._led
        way = np.array([leave_play(moved[0], chance[0]), leave_play(moved[1], chance[1])])
        if way.any():
            self._slow += way
            self._led += way
            self._average = self._average._replace(count=_KEPT * self._average.count)
            self._held.lead(way)

    def _predict(self, dt: float) -> Forecast:
        """Returns the place dt [s] later: constant speed of the depth under white acceleration."""
        sudden = bool(self._released or self._jumped)
        return forecast_place(
            self._motion, self._motion_covariance, self._slow, dt, self.settings.acceleration, _DEPTH_DRIFT, sudden
        )

    def _expect_errors(self, noise: PointNoise, offset_variance: NDArray, forecast: Forecast) -> Uncertainty:
        """Returns what is known of the errors of this frame's key points."""
        return Uncertainty(
            noise=noise.plane,
            gain=noise.gain,
            width_variance=noise.width_variance,
            trust=noise.trust,
            offset_variance=offset_variance,
            depth_variance=float(min(forecast.spread[0, 0], _WIDEST_FORECAST**2)),
            model_error=self.settings.model_error,
            gate=self.settings.gate,
        )

    def _weigh(
        self, q: NDArray, state: PressedState, measured: NDArray, moved: NDArray, place: NDArray, chance: Uncertainty
    ) -> Residuals:
        """Returns the residuals of a state at a place (3,) that has moved by `moved` (3,) since the forecast."""
        model = self.contact.model
        self._motions = model.project(self.probe, q, state.modes)
        below = float(place[DEPTH] - self._reachable(place)[DEPTH])
        positions = model.positions(self.probe, q)
        return weigh_residuals(measured, positions, self._rest, self._motions[:, :, :3], moved, below, chance)

    def _update_place(self, data: Residuals, forecast: Forecast) -> PlaceUpdate:
        """Returns the place that the residuals ask for."""
        return update_place(
            data,
            self._average,
            forecast,
            self._prior,
            self._prior_variance,
            float(self.settings.memory),
            np.array([self.contact.indenter.shape_range.largest_change, _LARGEST_SHIFT]),
        )

    def _leap(
        self, q: NDArray, state: PressedState, mechanical: NDArray, place: NDArray, data: Residuals
    ) -> tuple[NDArray, NDArray]:
        """Returns place and unknowns moved towards the median depth when the points disagree with the forecast."""
        jump = float(np.clip(data.jump, -_LARGEST_LEAP, _LARGEST_LEAP))
        place = place + np.array([jump, 0.0, 0.0])
        step = state.modes[:, DEPTH] * (self._reachable(place)[DEPTH] - mechanical[DEPTH])
        return place, q + limit_step(self.contact.model, step)

    def _lose(self) -> None:
        """Widens the search for the next frame."""
        self._motion[1] = 0.0
        self._motion_covariance[0, 0] += _LOST_STDDEV**2

    def _keep(self, q: NDArray, place: NDArray, update: PlaceUpdate, modes: NDArray) -> None:
        """Keeps what the next frame starts from; a released jaw expects any object again."""
        self.q, self._modes, self._reached = q, modes, self._reachable(place)
        self._slow = place[1:].copy()
        self._motion = np.array([place[DEPTH], update.speed])
        self._motion_covariance, self._jumped = update.spread, update.jumped
        self._average = update.average
        pressed = place[DEPTH] - self._find_touch(place)
        self._released = self._released + 1 if pressed < _TOUCH_DEPTH else 0
        if self._released >= _FRAMES_RELEASED:
            self._forget_place()

    def _report(
        self,
        state: PressedState,
        place: NDArray,
        moved: NDArray,
        data: Residuals,
        update: PlaceUpdate,
        iterations: int,
        settled: bool,
    ) -> Track:
        force = state.force + state.force_modes[:, :3] @ moved
        pressed = place[DEPTH] - self._find_touch(place)
        if pressed < _LEAST_DEPTH:
            force = force * max(0.0, pressed / _LEAST_DEPTH)
        normal = float(np.hypot(*force[::2]))
        covariance = update.covariance * max(1.0, update.misfit**2)
        covariance[DEPTH, DEPTH] += update.depth_variance * max(1.0, update.misfit**2)
        finite = np.isfinite(force.sum() + update.covariance.sum() + self.q.sum())
        return Track(
            covariance=covariance,
            force=force,
            force_modes=state.force_modes[:, :3],
            pressure_point=state.pressure_point,
            pressure_place=state.pressure_place,
            weights=data.weights,
            stiffening=self._stiffening(force, place),
            residual=update.residual,
            misfit=update.misfit,
            kkt=update.kkt,
            iterations=iterations,
            converged=settled,
            bearable=self._levels[0].contact.bearable,
            across=self._describe_across(normal) if self._is_known else None,
            lean_stddev=self._describe_lean(normal) if self._is_known else None,
            lean_leak=self._find_leak(state, normal) if self._is_known else 0.0,
            ambiguity=0.0 if settled else float(np.linalg.norm(state.force_modes[:, :3] @ moved)),
            sound=bool(finite and state.smallest_det > 0),
            quiet=bool(pressed < _TOUCH_DEPTH),
            loaded=bool(pressed > _LOADED_DEPTH),
            away=update.away,
            extrapolation=state.extrapolation,
            mistaken=update.mistaken,
            agreement=data.agreed / data.known,
            condition=update.condition,
            place_stddev=float(np.sqrt(max(update.covariance[HEIGHT, HEIGHT], 0.0))),
        )

    def _describe_across(self, normal: float) -> AcrossFinger:
        """Returns what acts across the finger; what a lifted object may do there besides is doubt."""
        seen, held = self._width.across, self._held
        if self.settings.held != "yes" or not held.across_stddev < np.inf:
            return seen
        doubt = held.across_stddev / max(normal, _LEAST_NORMAL)
        return AcrossFinger(seen.place, seen.place_stddev, seen.force + held.across, hypot(seen.lean_stddev, doubt))

    def _find_leak(self, state: PressedState, normal: float) -> float:
        """Returns by how much a held object's force [N] along the finger changes that along x [-]."""
        if self.settings.held != "yes" or normal < _LEAST_NORMAL:
            return 0.0
        return float(state.force_modes[0, 3] / normal - state.force_modes[0, DEPTH] * self._held.leverage)

    def _describe_lean(self, normal: float) -> float:
        """Returns the standard deviation of the lean of a force [N] along the finger that friction leaves [-]."""
        if self.settings.held == "yes":
            return sqrt(min(self._held.stddev / max(normal, _LEAST_NORMAL), _WEIGHT) ** 2 + _LEAN**2)
        found = self.roughness.coefficient
        return sqrt((found.stddev * self.slips.mobilised) ** 2 + (_UNFOLLOWED * found.mean) ** 2 + _LEAN**2)

    def _stiffening(self, force: NDArray, place: NDArray) -> float:
        """Returns how much stiffer the pressed jaw is than at first touch; 1 until it is surely pressed."""
        pressed = place[DEPTH] - self._find_touch(place)
        if self._stiffness is None or pressed < _LOADED_DEPTH:
            return 1.0
        return float(np.linalg.norm(force) / (self._stiffness * pressed))


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
