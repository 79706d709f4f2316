"""Closing until a camera's force reaches a set one, and holding it: forces and openings in, moves out."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable

from finforce_driver.errors import BackOffError, GraspError, UnseenForceError
from finforce_driver.grasp.load_watch import NOISE, ForceFeed, ForceSample, LoadWatch, LocatedForce, TouchSample
from finforce_driver.grasp.plan import GraspPlan, JawHistory, JawPlace
from finforce_driver.grasp.settings import (
    MOTOR_MARGIN,
    GraspGoal,
    GraspPhase,
    GraspSettings,
    GraspStatus,
    GraspStep,
    GripperMove,
)
from finforce_driver.state import GripperState, Phase

OpeningAt = Callable[[float], float]

_ONSET_FORCE = 0.25  # [N] above what was seen without load, that says that something presses
_MOTOR_ONSET = 0.8  # [N] of the motor's force above that of free motion, at which jaws wait for the next image
_RELAXATION = 0.4  # share of the set force that holding may make up for by closing
_CONTENT = 3  # images at rest without a wish to move after which the force is held
_SATURATED_AFTER = 1.0  # [s] at the least opening
_SPARE_STEPS = 3  # that holding may close in any case
_WITNESSED = 0.05  # [s] that the motor's force has to be too large; the current of a motor that starts is, too


class ForceGrasp:
    """One grasp by force, from approach to the end; deterministic, and without input or output of its own.

    Args:
        goal: force, speed, least opening, time limit.
        settings: limits and expectations.
        resolution: opening per step of the gripper [m].
        closed_opening: opening of the closed gripper [m].
        stroke: of the gripper [m].

    Raises:
        TargetError: the set force is above the limit of the settings.
    """

    def __init__(
        self,
        goal: GraspGoal,
        settings: GraspSettings | None = None,
        *,
        resolution: float,
        closed_opening: float = 0.0,
        stroke: float = 0.048,
    ) -> None:
        self.goal, self.settings = goal, settings or GraspSettings()
        self._set_force = self.settings.check_force(goal.force)
        self._feed = ForceFeed(self.settings.stale_after)
        self._load = LoadWatch(self.settings, min(_ONSET_FORCE, 0.5 * goal.force))
        self._jaws = JawHistory(
            resolution=resolution, closed_opening=closed_opening, stroke=stroke, reaction=self.settings.reaction
        )
        self._place = JawPlace(opening=math.nan, resting=False)
        self._plan = GraspPlan(goal, self.settings, self._load, self._jaws, self._feed)
        self._pending: deque[ForceSample | TouchSample] = deque()
        self._phase, self._reason = GraspPhase.APPROACH, "waits for the first force"
        self._began = self._held_at = self._spare = self._saturated = math.nan
        self._content = 0
        self._excess_since = self._start = self._waits_since = math.nan
        self._free = 0.0  # largest force of the motor [N] while nothing pressed
        self._motor: deque[tuple[float, float]] = deque()  # times [s] and forces [N] that no image is newer than
        self._asked_to_stop = ""
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
        if force == self._set_force:
            return
        self._set_force = force
        self._began = self._held_at = math.nan
        self._content = 0
        if self._phase is GraspPhase.HOLDING:
            self._phase, self._reason = GraspPhase.LOADING, "goes to another force"

    @property
    def set_force(self) -> float:
        """The force that is to be held [N]."""
        return self._set_force

    @property
    def phase(self) -> GraspPhase:
        """Where the grasp is."""
        return self._phase

    def refuse(self, words: str) -> None:
        """Take note of a force that was refused before it came here, and why."""
        self._feed.refuse("refused", words)

    def stop(self, reason: str) -> None:
        """End the grasp with the next `update`; the jaws hold where they are."""
        self._asked_to_stop = reason

    def update(self, state: GripperState, now: float, opening_at: OpeningAt) -> GraspStep:
        """Take what came since the last call and return what is to be done.

        Args:
            state: of the gripper, the newest.
            now: time [s].
            opening_at: the opening [m] at a past time [s], NaN where it is not known.
        """
        if self._phase is GraspPhase.STOPPED:
            self._pending.clear()
            return self._step(None, state, now)
        if math.isnan(self._began):
            self._began = now
        if math.isnan(self._start):
            self._start = state.opening
        try:
            if self._asked_to_stop:
                raise GraspError(self._asked_to_stop)
            check_gripper(state, now)
            self._jaws.check_power(state)
            fresh = self._drain(state, now, opening_at)
            self._check_witness(state, now)
            self._check_limits(state, now)
            move = self._wait_for_image(state, now)
            if move is None and fresh and math.isnan(self._waits_since):
                move = self._choose_move(state, now)
        except GraspError as error:
            self._phase, self._reason = GraspPhase.STOPPED, str(error)
            self._failure = None if self._asked_to_stop else type(error)
            if isinstance(error, BackOffError):
                return self._step(self._back_off(state, now), state, now)
            return GraspStep(move=None, stop=is_working(state), status=self._status(state, now))
        return self._step(move, state, now)

    def _drain(self, state: GripperState, now: float, opening_at: OpeningAt) -> bool:
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
                force = 0.0
            else:
                force = check_force_value(sample.force, sample.stddev)
                counts = self._feed.admit(sample)
            if counts:
                stddev = 0.0 if isinstance(sample, TouchSample) else sample.stddev
                fresh |= self._locate(force, sample.stamp, stddev, state, opening_at)
        return fresh

    def _locate(self, force: float, stamp: float, stddev: float, state: GripperState, opening_at: OpeningAt) -> bool:
        """Take a force [N] with its deviation [N] and the opening at its image; False where that is not known."""
        place = self._jaws.locate(stamp, state, opening_at)
        if math.isnan(place.opening):
            return False
        way = self._jaws.way_stddev(self._place, place)
        passing = self._jaws.stepping and not place.resting and self._load.loaded
        located = LocatedForce(
            force=force,
            stamp=stamp,
            opening=place.opening,
            way_stddev=way,
            resting=place.resting,
            passing=passing,
            stddev=stddev,
        )
        self._load.take(located, self._feed.is_touching(stamp))
        if not (self._load.doubtful or passing):
            self._place = place
        if self._phase is GraspPhase.APPROACH:
            words = "closes to the set force" if self._load.loaded else "closes until something presses"
            self._phase = GraspPhase.LOADING if self._load.loaded else GraspPhase.APPROACH
            self._reason = words
        return True

    def _wait_for_image(self, state: GripperState, now: float) -> GripperMove | None:
        """Return a move that stops the approach where the motor meets something that no image shows yet.

        What free motion takes is learnt from the motor's forces up to each image in which nothing presses.
        """
        if self._phase is not GraspPhase.APPROACH or not math.isfinite(state.force):
            self._waits_since = math.nan
            return None
        if not self._motor or state.stamp > self._motor[-1][0]:
            self._motor.append((state.stamp, state.force))
        while self._motor and self._motor[0][0] <= self._feed.stamp:
            self._free = max(self._free, self._motor.popleft()[1])
        if self._feed.stamp > self._waits_since:
            self._waits_since = math.nan
        meets = self._free > 0.0 and state.force > self._free + _MOTOR_ONSET
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
        moved = not math.isnan(self._jaws.target)  # else it was not this grasp that presses
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

    def _back_off(self, state: GripperState, now: float) -> GripperMove:
        """Return the move to where the grasp began: how soft what the motor presses on is, nobody knows."""
        target = self._jaws.nearest(min(max(self._start, state.opening), self._jaws.widest))
        return self._move(target, self.goal.speed, state, now)

    def _check_limits(self, state: GripperState, now: float) -> None:
        """Refuse to go on beyond a limit.

        Raises:
            GraspError: forces are late, time is up, or the jaws do not follow, slip, or may not close further.
        """
        check_silence(self._feed, now, self._began, self.settings)
        jaws, pressing = self._jaws, 0.0 if math.isnan(self._load.force) else self._load.pressing
        got = f"{pressing:.2f} N of {self._set_force:g} N"
        if self._phase is not GraspPhase.HOLDING and now - self._began > self.goal.time_limit:
            raise GraspError(f"{got} within the time limit of {self.goal.time_limit:g} s")
        if now - self._saturated > _SATURATED_AFTER:
            raise GraspError(f"{got} with the jaws at their least opening, {1e3 * jaws.target:.1f} mm")
        if jaws.is_late(now, state.opening):
            raise GraspError(
                f"{got}: the jaws stay at {1e3 * state.opening:.1f} mm on their way to {1e3 * jaws.target:.1f} mm; "
                f"is something in the way, or the motor's limit of {self._motor_force:g} N too low?"
            )
        if self._held_at - jaws.target > self._spare:
            way = 1e3 * (self._held_at - jaws.target)
            raise GraspError(
                f"{got} although the jaws closed by {way:.1f} mm while holding: the object slips or yields"
            )

    def _choose_move(self, state: GripperState, now: float) -> GripperMove | None:
        """Return the next move, None where the jaws are to go on as they do."""
        if self._load.doubtful:
            return self._pause(state, now)
        self._plan.note_rest()
        wish = self._plan.wish(self._set_force)
        target = self._plan.limit(wish)
        self._watch(wish, target, now)
        speed = self._plan.choose_speed(target)
        return self._move(target, speed, state, now) if self._plan.is_worth(target, speed, state.opening) else None

    def _watch(self, wish: float, target: float, now: float) -> None:
        """See whether the force is held, and whether the least opening keeps it from being reached."""
        near = 0.5 * self._jaws.resolution  # openings are multiples of it, but for rounding
        is_content = self._load.resting and abs(target - self._jaws.target) < near
        if not (is_content and wish < target - near):
            self._saturated = math.nan
        elif math.isnan(self._saturated):
            self._saturated = now
        held = is_content and abs(wish - target) < near and self._load.loaded
        self._content = self._content + 1 if held else 0
        if self._content >= _CONTENT and self._phase is not GraspPhase.HOLDING:
            self._phase, self._reason, self._held_at = GraspPhase.HOLDING, "holds the set force", target
            # as it is now: a force that drifts while the jaws close looks like something that gets softer
            yielded = _RELAXATION * self._set_force / self._load.model.stiffness
            self._spare = yielded + _SPARE_STEPS * self._jaws.resolution

    def _pause(self, state: GripperState, now: float) -> GripperMove | None:
        """Return a move that keeps the jaws where they are until the next image says what to think of this one."""
        here = self._jaws.nearest(state.opening)
        is_closing = here - self._jaws.target > 0.5 * self._jaws.resolution
        return self._move(here, self._jaws.speed, state, now) if is_closing else None

    def _move(self, target: float, speed: float, state: GripperState, now: float) -> GripperMove:
        target = min(target, self._jaws.widest)
        self._jaws.command(target, speed, now, self._jaws.locate(now, state, lambda _: state.opening))
        return GripperMove(opening=target, speed=speed, force=self._motor_force)

    @property
    def _motor_force(self) -> float:
        """The motor's limit [N]: no hindrance to the set force, which both jaws give, and friction takes from."""
        return max(self.settings.motor_force, 2.5 * self._set_force)

    def _step(self, move: GripperMove | None, state: GripperState, now: float) -> GraspStep:
        return GraspStep(move=move, stop=False, status=self._status(state, now))

    def _status(self, state: GripperState, now: float) -> GraspStatus:
        """Return the grasp as it is."""
        load, model, feed = self._load, self._load.model, self._feed
        here = self._jaws.locate(now, state, lambda _: state.opening).opening
        return GraspStatus(
            phase=self._phase,
            reason=self._reason,
            goal=self._set_force,
            force=load.force,
            predicted=model.predict(here) if load.loaded else math.nan,
            stiffness=model.stiffness,
            stiffness_stddev=model.stiffness_stddev,
            latency=feed.latency,
            period=feed.period,
            overshoot_bound=self._plan.overshoot_bound(self._set_force),
            peak=load.peak,
            resolution=self._plan.resolution,
            target=self._jaws.target,
            stddev=load.stddev,
            failure=self._failure,
            refused=dict(feed.refused),
        )


_WORKING = (Phase.READY, Phase.MOVING)
_SILENT = 0.3  # [s] after which a gripper without a reply is not the one that is known


def check_force_value(force: float, stddev: float = 0.0) -> float:
    """Return a grasp force [N]; one that is negative by no more than noise is none.

    Args:
        force: that came [N].
        stddev: as its source states it [N].

    Raises:
        GraspError: the force is no finite number, or negative.
    """
    if not math.isfinite(force) or force < -3.0 * max(NOISE, stddev):
        raise GraspError(f"a grasp force of {force} N came, expected a number from 0: holds in place")
    return max(0.0, force)


def is_working(state: GripperState) -> bool:
    """Whether the gripper takes commands to move."""
    return state.phase in _WORKING and not state.estopped


def check_gripper(state: GripperState, now: float) -> None:
    """Refuse a gripper that cannot be told to move.

    Raises:
        GraspError: it is stopped, faulty, not calibrated, or out of reach.
    """
    if state.estopped:
        raise GraspError("emergency stop of the gripper")
    if state.phase not in _WORKING or not math.isfinite(state.opening):
        raise GraspError(f"the gripper is {state.phase.value}{': ' if state.message else ''}{state.message}")
    if not now - state.stamp <= _SILENT:
        raise GraspError(f"no reply of the gripper for {now - state.stamp:.2f} s")


def check_silence(feed: ForceFeed, now: float, started: float, settings: GraspSettings) -> None:
    """Refuse to go on without fresh news of the camera.

    Before the first force a word on touching will do: an estimator that waits for its first contact has no force yet.

    Args:
        feed: what came.
        now: time [s].
        started: when the grasp began [s].
        settings: with the time limits.

    Raises:
        GraspError: forces have become stale, or did not come when they were due.
    """
    if feed.heard:
        if feed.age(now) > settings.stale_after:
            raise GraspError(
                f"the newest force is {feed.age(now):.2f} s old, at most {settings.stale_after:g} s are allowed: "
                + (_refused(feed) or "is the camera there, and the solver sure of itself?")
            )
        return
    touched = feed.touched_since
    if now - touched > settings.force_timeout:
        words = f"the jaws are said to touch, but no force came for {now - touched:.2f} s"
        raise GraspError(f"{words}: {_refused(feed)}" if feed.last_refusal else words)
    heard = max(started, feed.touch.stamp if feed.touch else started)
    if now - heard > 2.0 * settings.force_timeout:
        raise GraspError(
            f"no force came for {now - heard:.2f} s: "
            + (_refused(feed) or "is the camera there, are the solvers tared (30 unloaded images)?")
        )


def _refused(feed: ForceFeed) -> str:
    """Return what was wrong with the forces that came last; empty where nothing was."""
    return f"those that came were refused, the last one as {feed.last_refusal}" if feed.last_refusal else ""
