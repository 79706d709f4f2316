"""Closing until a camera's force reaches a set one, and holding it: forces and openings in, moves out."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from dataclasses import replace
from statistics import median

from finforce_driver.errors import BackOffError, GraspError, UnseenForceError
from finforce_driver.grasp.force_monitor import NOISE, ForceFilter, ForceMonitor, ForceSample, JawPosition, TouchSample
from finforce_driver.grasp.plan import DEVIATIONS, FRICTION, MOTOR_MARGIN, GraspPlan
from finforce_driver.grasp.probe import FrictionProbe
from finforce_driver.settings import GraspGoal, GraspSettings, GripperSettings
from finforce_driver.state import USABLE, GraspPhase, GraspStatus, GripperState, MoveRequest

_ONSET_FORCE = 0.25  # [N] above what was seen without load, that says that something presses
_MOTOR_ONSET = 0.8  # [N] of the motor's force above that of free motion, at which jaws wait for the next image
_RELAXATION = 0.4  # share of the set force that holding may make up for by closing
_SETTLED = 3  # images at rest without a reason to move after which the force is held
_SATURATED_AFTER = 1.0  # [s] at the least opening
_RESERVE_STEPS = 3  # that holding may close in any case
# Shortfall from the set force that still holds it.
_WITHIN = 0.2  # [-], of the set force, or that of one step of the jaws if it is more
_FARTHEST = 1.0  # [N], at most
_FIRST_GRASPS = 9  # that teach how the motor's force goes with the camera's
_FACTOR = 1.5  # times the camera's force, that the motor's may be at rest
_FRICTION_DOUBT = "does the gear have more friction than motor_friction"
_LIKELY_ERROR = 0.1  # of a force, of camera and motor alike
_DOUBTED = 15  # images at rest in which the camera says more than the motor gives, after which a hold has ended
_WITNESSED = 0.05  # [s] that the motor's force has to be too large; the current of a motor that starts is, too


class ForceGrasp:
    """One grasp by force, from approach to the end; deterministic, and without input or output of its own.

    Args:
        goal: force, speed, least opening, time limit.
        settings: limits and expectations.
        jaws: closed opening, stroke, range of forces.
        resolution: opening per step of the gripper [m]; None: that of its position byte.
        ratios: of the camera's force to the motor's in the first grasps of this gripper, which adds its own.

    Raises:
        TargetError: the set force is above the limit of the settings.
    """

    def __init__(
        self,
        goal: GraspGoal,
        settings: GraspSettings | None = None,
        *,
        jaws: GripperSettings | None = None,
        resolution: float | None = None,
        ratios: list[float] | None = None,
    ) -> None:
        self._jaws, self._ratios = jaws or GripperSettings(), [] if ratios is None else ratios
        self._short, self._low_images, self._high_images = False, 0, 0
        self._excess = 0.0  # of the camera's force above the motor's [N], more than friction explains
        self.goal, self.settings = goal, settings or GraspSettings()
        self.set_force = self.settings.check_force(goal.force)
        self._feed = ForceFilter(self.settings.stale_after)
        self._load = ForceMonitor(self.settings, min(_ONSET_FORCE, 0.5 * goal.force))
        self._position = JawPosition(opening=math.nan, resting=False)
        self._plan = GraspPlan(goal, self.settings, self._load, self._feed, self._jaws, resolution)
        self._probe = FrictionProbe(self.settings.probe)
        self._pending: deque[ForceSample | TouchSample] = deque()
        self.phase, self._reason = GraspPhase.APPROACH, "waits for the first force"
        self._began = self._held_at = self._reserve = self._saturated = math.nan
        self._settled = 0
        self._excess_since = self._start = self._waits_since = math.nan
        self._free = 0.0  # largest force of the motor [N] while nothing pressed
        self._motor: deque[tuple[float, float]] = deque()  # times [s] and forces [N] that no image is newer than
        self._failure: type[GraspError] | None = None

    def take_force(self, sample: ForceSample) -> None:
        """Take the force of an image; it counts with the next `update`."""
        self._pending.append(sample)

    def take_touch(self, touching: bool, stamp: float) -> None:
        """Take whether the jaws touch the object in the image at `stamp` [s]; it counts with the next `update`."""
        self._pending.append(TouchSample(stamp=stamp, touching=touching))

    def change_force(self, force: float) -> None:
        """Set another force [N], up or down, without letting go; the time limit begins anew. The same changes nothing.

        Raises:
            TargetError: the force is no number, not above zero, or above the limit.
        """
        force = self.settings.check_force(force)
        if force == self.set_force:
            return
        self.set_force = force
        self._began = self._held_at = math.nan
        self._settled = 0
        if self.phase is GraspPhase.HOLDING:
            self.phase, self._reason = GraspPhase.LOADING, "goes to another force"

    def reject(self, reason: str) -> None:
        """Take note of a force that was rejected before it came here, and why."""
        self._feed.reject("rejected", reason)

    def update(self, state: GripperState, now: float, opening_at: Callable[[float], float]) -> MoveRequest | None:
        """Take what came since the last call and return the move to be made, None to leave the gripper as it is.

        A grasp that has ended is in phase STOPPED; without a move the gripper is then to hold where it is.

        Args:
            state: of the gripper, the newest.
            now: time [s].
            opening_at: the opening [m] at a past time [s], NaN where it is not known.
        """
        if self.phase is GraspPhase.STOPPED:
            return None
        if math.isnan(self._began):
            self._began = now
        if math.isnan(self._start):
            self._start = state.opening
        try:
            check_gripper(state, now)
            self._plan.check_power(state)
            fresh = self._drain(state, now, opening_at)
            self._check_witness(state, now)
            if fresh:
                self._compare_motor(state)
            self._check_limits(state, now)
            move = self._wait_for_image(state, now)
            if move is None and fresh and math.isnan(self._waits_since):
                move = self._choose_move(state, now)
            return move
        except GraspError as error:
            self.phase, self._reason, self._failure = GraspPhase.STOPPED, str(error), type(error)
            if not isinstance(error, BackOffError):
                return None
            # back to where the grasp began: how soft what the motor presses on is, nobody knows
            target = self._plan.nearest(min(max(self._start, state.opening), self._plan.widest))
            return self._move(target, self.goal.speed, state, now)

    def _drain(self, state: GripperState, now: float, opening_at: Callable[[float], float]) -> bool:
        """Take what is pending and return whether the jaws may be planned for anew.

        Raises:
            GraspError: a force is none, jumped, is above the limit, or has gone.
        """
        fresh = False
        while self._pending:
            sample = self._pending.popleft()
            if isinstance(sample, TouchSample):
                # before the first force, an image that shows the jaws apart shows that nothing presses
                counts = self._feed.admit_touch(sample, now) and not self._feed.heard and not sample.touching
                sample = ForceSample(stamp=sample.stamp, arrived=now, force=0.0)
            else:
                sample = replace(sample, force=check_force_value(sample.force, sample.stddev))
                counts = self._feed.admit(sample)
            if counts:
                here = self._plan.locate(sample.stamp, state, opening_at)
                fresh |= not math.isnan(here.opening)
                if not math.isnan(here.opening):
                    self._take(sample, here)
        return fresh

    def _take(self, sample: ForceSample, here: JawPosition) -> None:
        """Take a force and where the jaws were at its image."""
        passing = self._plan.stepping and not here.resting and self._load.loaded
        self._load.take(
            sample,
            here,
            travel_stddev=self._plan.travel_stddev(self._position, here),
            passing=passing,
            touching=bool(self._feed.touching(sample.stamp)),
        )
        if not (self._load.suspect or passing):
            self._position = here
        if self.phase is GraspPhase.APPROACH:
            self._reason = "closes to the set force" if self._load.loaded else "closes until something presses"
            self.phase = GraspPhase.LOADING if self._load.loaded else GraspPhase.APPROACH

    def _wait_for_image(self, state: GripperState, now: float) -> MoveRequest | None:
        """Return a move that stops the jaws where the motor meets something that no image shows yet.

        That is more than the force that is expected there and what free motion takes, which is learnt from the motor's
        forces up to each image.
        """
        if self.phase not in (GraspPhase.APPROACH, GraspPhase.LOADING) or not math.isfinite(state.force):
            self._waits_since = math.nan
            return None
        loaded = self._load.loaded
        excess = state.force - (self._load.model.predict(state.opening) if loaded else 0.0)
        if not self._motor or state.stamp > self._motor[-1][0]:
            self._motor.append((state.stamp, excess))
        while self._motor and self._motor[0][0] <= self._feed.stamp:
            older = self._motor.popleft()[1]
            self._free = max(0.0, min(self._free, older)) if loaded else max(self._free, older)
        if self._feed.stamp > self._waits_since:
            self._waits_since = math.nan
        meets = (self._free > 0.0 or loaded) and excess > self._free + _MOTOR_ONSET
        if not meets or not math.isnan(self._waits_since):
            return None
        self._waits_since = now
        return self._pause(state, now)

    def _check_witness(self, state: GripperState, now: float) -> None:
        """Refuse to press harder, by the motor's current, than the camera says by more than friction explains.

        Raises:
            UnseenForceError: that has been so for a while.
        """
        seen = 0.0 if math.isnan(self._load.force) else max(0.0, self._load.pressing)
        moved = not math.isnan(self._plan.target)  # else it was not this grasp that presses
        if not (moved and state.force - seen > MOTOR_MARGIN):
            self._excess_since = math.nan
            return
        if math.isnan(self._excess_since):
            self._excess_since = now
        if now - self._excess_since >= _WITNESSED:
            raise UnseenForceError(
                f"the motor presses with {state.force:.1f} N by its current, the camera says {seen:.2f} N: "
                "is the estimator blind, frozen or looking at something else? The jaws back off"
            )

    def _check_limits(self, state: GripperState, now: float) -> None:
        """Refuse to go on beyond a limit.

        Raises:
            GraspError: forces are late, time is up, or the jaws do not follow, slip, or may not close further.
        """
        self._feed.check_silence(now, self._began, self.settings.force_timeout)
        plan, pressing = self._plan, 0.0 if math.isnan(self._load.force) else self._load.pressing
        got = f"{pressing:.2f} N of {self.set_force:g} N"
        if self.phase is not GraspPhase.HOLDING and now - self._began > self.goal.time_limit:
            cause = f": {self._reason}" if self._short else ""
            raise GraspError(f"{got} within the time limit of {self.goal.time_limit:g} s{cause}")
        if now - self._saturated > _SATURATED_AFTER:
            raise GraspError(f"{got} with the jaws at their least opening, {1e3 * plan.target:.1f} mm")
        if plan.is_late(now, state.opening):
            raise GraspError(
                f"{got}: the jaws stay at {1e3 * state.opening:.1f} mm on their way to {1e3 * plan.target:.1f} mm; "
                f"is something in the way, or the motor's limit of {self._motor_force:g} N too low?"
            )
        if self._held_at - plan.target > self._reserve:
            way = 1e3 * (self._held_at - plan.target)
            raise GraspError(
                f"{got} although the jaws closed by {way:.1f} mm while holding: the object slips or yields"
            )

    def _choose_move(self, state: GripperState, now: float) -> MoveRequest | None:
        """Return the next move, None where the jaws are to go on as they do."""
        if self._load.suspect:
            return self._pause(state, now)
        self._plan.note_rest()
        if self._probe.is_due:
            return self._probe_friction(state, now)
        ideal = self._plan.ideal_target(self.set_force)
        target = self._plan.limit(ideal)
        self._watch(ideal, target, state, now)
        speed = self._plan.choose_speed(target)
        return self._move(target, speed, state, now) if self._plan.is_worth(target, speed, state.opening) else None

    def _probe_friction(self, state: GripperState, now: float) -> MoveRequest | None:
        """Return the next move until the object was probed, None where the jaws are to go on as they do."""
        plan = self._plan
        target = self._probe.find_target(plan, self._load, self.set_force)
        if abs(target - plan.target) > 0.5 * plan.step and self._probe.goes_back:
            self._reason = "goes back a little, to see how rough the object is"
            return self._move(target, self.goal.speed, state, now)
        speed = plan.choose_speed(target)
        return self._move(target, speed, state, now) if plan.is_worth(target, speed, state.opening) else None

    def _watch(self, ideal: float, target: float, state: GripperState, now: float) -> None:
        """See whether the force is held, and whether the least opening keeps it from being reached."""
        near = 0.5 * self._plan.step  # openings are multiples of it, but for rounding
        settled = self._load.resting and abs(target - self._plan.target) < near
        if not (settled and ideal < target - near):
            self._saturated = math.nan
        elif math.isnan(self._saturated):
            self._saturated = now
        held = settled and abs(ideal - target) < near and self._load.loaded
        if held:
            held = self._is_near_set_force()
        self._settled = self._settled + 1 if held else 0
        if self._settled >= _SETTLED and self.phase is not GraspPhase.HOLDING:
            self.phase, self._held_at = GraspPhase.HOLDING, target
            if self._load.pressing > 0.0 and state.force > 0.0 and len(self._ratios) < _FIRST_GRASPS:
                self._ratios.append(self._load.pressing / state.force)
            # as it is now: a force that drifts while the jaws close looks like something that gets softer
            yielded = _RELAXATION * self.set_force / self._load.model.stiffness
            self._reserve = yielded + _RESERVE_STEPS * self._plan.step

    def _is_near_set_force(self) -> bool:
        """Return whether the force that is held is near to the set one, and say it, or why it is held below."""
        plan, load, short = self._plan, self._load, self.set_force - self._load.pressing
        if self._excess:
            self._short, self._reason = True, f"not known to be held: {self._describe_excess()}"
            return False
        self._short = short > min(_FARTHEST, max(_WITHIN * self.set_force, plan.force_per_step))
        cause = f"one step of the gripper is {plan.force_per_step:.2f} N"
        if load.stddev > plan.force_per_step:
            cause = f"its stated deviation is {load.stddev:.2f} N"
        self._reason = f"held below the set force by {short:.2f} N: {cause}" if self._short else "holds the set force"
        return not self._short

    def _compare_motor(self, state: GripperState) -> None:
        """Doubt a camera whose force at rest is not that of the motor, by what that was in the first grasps.

        A camera that says more ends nothing before the force was held, but is no success.

        Raises:
            UnseenForceError: it says much less in several images.
            GraspError: it says more for a while, of a force that was held.
        """
        load, plan = self._load, self._plan
        if not (
            load.loaded and load.resting and plan.rests_at(state.stamp, state.opening) and load.opening == plan.target
        ):
            return
        known = state.force * (median(self._ratios) if len(self._ratios) >= _SETTLED else 1.0)
        friction, excess = self.settings.motor_friction, load.pressing - known
        largest = max(friction, _LIKELY_ERROR * load.pressing, DEVIATIONS * load.stddev)
        self._low_images = self._low_images + 1 if known > _FACTOR * load.pressing + friction else 0
        self._high_images = self._high_images + 1 if excess > largest else 0
        self._excess = excess if self._high_images >= _SETTLED else 0.0
        if self._low_images >= _SETTLED:
            raise UnseenForceError(
                f"the motor holds {known:.1f} N by its current, the camera says {load.pressing:.2f} N: is the "
                f"camera's calibration off by a factor, or {_FRICTION_DOUBT}? The jaws back off"
            )
        if self._high_images >= _DOUBTED and self.phase is GraspPhase.HOLDING:
            raise GraspError(self._describe_excess())

    def _describe_excess(self) -> str:
        """Say that the camera's force is above the motor's."""
        pressing = self._load.pressing
        return (
            f"the camera says {pressing:.2f} N, the motor holds {pressing - self._excess:.1f} N by its current: does "
            f"the camera read too much, or {_FRICTION_DOUBT}?"
        )

    def _pause(self, state: GripperState, now: float) -> MoveRequest | None:
        """Return a move that keeps the jaws where they are until the next image says what to think of this one."""
        here = self._plan.nearest(state.opening)
        is_closing = here - self._plan.target > 0.5 * self._plan.step
        return self._move(here, self._plan.speed, state, now) if is_closing else None

    def _move(self, target: float, speed: float, state: GripperState, now: float) -> MoveRequest:
        target = min(target, self._plan.widest)
        self._plan.command(target, speed, now, self._plan.locate(now, state, lambda _: state.opening))
        return MoveRequest(opening=target, speed=speed, force=self._motor_force)

    @property
    def _motor_force(self) -> float:
        """The motor's limit [N]: no hindrance to the set force, which both jaws give, and friction takes from."""
        least, largest = self._jaws.forces
        return min(max(self.settings.motor_force, _FACTOR * self.set_force, least), largest)

    def status(self, state: GripperState, now: float) -> GraspStatus:
        """Return the grasp as it is, after an `update` with the same state and time."""
        load, model, feed = self._load, self._load.model, self._feed
        here = self._plan.locate(now, state, lambda _: state.opening).opening
        return GraspStatus(
            phase=self.phase,
            reason=self._reason,
            goal=self.set_force,
            force=load.force,
            predicted=model.predict(here) if load.loaded else math.nan,
            stiffness=model.stiffness,
            latency=feed.latency,
            period=feed.period,
            overshoot_bound=self._plan.overshoot_bound(self.set_force),
            hard_bound=self._motor_force + FRICTION - self.set_force,
            peak=load.peak,
            resolution=self._plan.force_per_step,
            target=self._plan.target,
            stddev=max(load.stddev, self._excess),
            failure=self._failure,
            rejected=dict(feed.rejected),
        )


_SILENT = 0.3  # [s] after which a gripper without a reply is not the one that is known


def check_force_value(force: float, stddev: float = 0.0) -> float:
    """Return a grasp force [N]; one that is negative by no more than noise is none.

    Args:
        force: that came [N].
        stddev: as its source states it [N].

    Raises:
        GraspError: the force is no finite number, or negative, or its deviation is.
    """
    if not 0.0 <= stddev < math.inf:
        raise GraspError(f"a stated deviation of {stddev} N came, expected a number from 0: holds in place")
    if not math.isfinite(force) or force < -3.0 * max(NOISE, stddev):
        raise GraspError(f"a grasp force of {force} N came, expected a number from 0: holds in place")
    return max(0.0, force)


def check_gripper(state: GripperState, now: float) -> None:
    """Refuse a gripper that cannot be told to move.

    Raises:
        GraspError: it is stopped, faulty, not calibrated, or out of reach.
    """
    if state.estopped:
        raise GraspError("emergency stop of the gripper")
    if state.phase not in USABLE or not math.isfinite(state.opening):
        raise GraspError(f"the gripper is {state.phase.value}{': ' if state.message else ''}{state.message}")
    if not now - state.stamp <= _SILENT:
        raise GraspError(f"no reply of the gripper for {now - state.stamp:.2f} s")
