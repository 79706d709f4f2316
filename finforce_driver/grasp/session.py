"""The force-controlled grasps of one gripper: begun, changed and ended from outside, or as one blocking call."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import replace
from threading import Condition

from finforce_driver.errors import BackOffError, DriverError, GraspError, GripperTimeoutError
from finforce_driver.grasp.controller import ForceGrasp
from finforce_driver.grasp.force_monitor import ForceSample, TouchSample
from finforce_driver.gripper import Gripper
from finforce_driver.settings import GraspGoal, GraspSettings
from finforce_driver.state import USABLE, GraspPhase, GraspStatus, GripperState

CYCLE = 0.05  # [s] in which the silence of a gripper is noticed
MARGIN = 2.0  # [s] beyond the time limit of a goal, after which nobody waits for its grasp any longer
SETTLED = (GraspPhase.HOLDING, GraspPhase.STOPPED)


class GraspSession:
    """Hands forces and states to a grasp, and its moves to the gripper, one at a time from whatever thread.

    The gripper's own thread must not wait for it: it is the gripper's moves that are made here.

    Attributes:
        goal: of the grasp that runs, or of the next.
        status: of the grasp that runs, or of the last; None before the first.

    Args:
        gripper: that grasps.
        goal: the first.
        settings: of all grasps.
        ended: called when a grasp has ended.

    Raises:
        TargetError: the force of the goal is above the limit of the settings, or its opening beyond the stroke.
    """

    def __init__(
        self, gripper: Gripper, goal: GraspGoal, settings: GraspSettings, ended: Callable[[], None] = lambda: None
    ) -> None:
        settings.check_force(goal.force)
        _check_opening(goal, gripper)
        self.goal = goal
        self.status: GraspStatus | None = None
        self._gripper, self._settings, self._ended = gripper, settings, ended
        self._grasp: ForceGrasp | None = None
        self._touches: dict[str, TouchSample] = {}
        self._touch_told = -math.inf
        self._stddevs: dict[str, tuple[float, float]] = {}
        self._ratios: list[float] = []
        self._goals = 0  # that were set
        self._changed = Condition()

    @property
    def runs(self) -> bool:
        """True if a grasp is under way, or holds."""
        return self._grasp is not None

    def set_goal(self, goal: GraspGoal) -> None:
        """Take a goal for the next grasp; its force at once, too, for one that runs.

        Raises:
            TargetError: the force is above the limit, or the least opening beyond the stroke.
        """
        self._settings.check_force(goal.force)
        _check_opening(goal, self._gripper)
        with self._changed:
            self._goals += goal != self.goal
            self.goal = goal
            if self._grasp is not None:
                self._grasp.change_force(goal.force)

    def begin(self) -> None:
        """Begin a grasp, which looks at the gripper at once and may end by that."""
        gripper = self._gripper
        with self._changed:
            self._grasp = ForceGrasp(
                self.goal,
                self._settings,
                jaws=gripper.settings,
                resolution=gripper.resolution,
                ratios=self._ratios,
            )
            self.status = None
            self.update(gripper.state)

    def advance(self, samples: Sequence[ForceSample | TouchSample]) -> GraspStatus:
        """Hand on what has come, act once on all of it, and return how the grasp is.

        Raises:
            GraspError: it has ended; of the class that its status names.
        """
        with self._changed:
            for sample in samples:
                if isinstance(sample, TouchSample):
                    self.take_touch("", sample.touching, sample.stamp)
                elif self._grasp is not None:
                    self._grasp.take_force(sample)
            self.update(self._gripper.state)
            if self.status.phase is GraspPhase.STOPPED:
                raise (self.status.failure or GraspError)(self.status.reason)
            return self.status

    def run(self, begun: Callable[[], None] = lambda: None) -> GraspStatus:
        """Begin a grasp, if none runs, and wait; return how it is once the force is held, and go on holding it.

        Args:
            begun: called when a grasp has begun that the gripper does not refuse.

        Raises:
            GraspError: it was ended before; the gripper holds where it is.
        """
        with self._changed:
            if self._grasp is None:
                self.begin()
                if self.runs:
                    begun()
            before = self._goals
            if not self._changed.wait_for(self._is_settled, longest := self.goal.time_limit + MARGIN):
                changes = self._goals - before
                cause = f"its goal was changed {changes} times meanwhile" if changes else "the gripper was silent"
                self.stop(f"the force was not held within {longest:g} s: {cause}")
            if self.status.phase is GraspPhase.STOPPED:
                raise GraspError(f"the grasp was ended: {self.status.reason}")
            return self.status

    def take_force(self, sample: ForceSample) -> None:
        """Hand the force of an image to the grasp that runs, and let it act on it.

        Where it states no deviation, the largest of what was told of the jaws in the last images is taken.
        """
        with self._changed:
            if self._grasp is not None:
                oldest = sample.stamp - self._settings.stale_after
                told = [stddev for stamp, stddev in self._stddevs.values() if stamp > oldest]
                self._grasp.take_force(replace(sample, stddev=sample.stddev or max(told, default=0.0)))
                self.update(self._gripper.state)

    def take_touch(self, jaw: str, touching: bool, stamp: float) -> None:
        """Hand on whether a jaw touches the object in the image at `stamp` [s]: if any does, or none of both."""
        with self._changed:
            self._touches[jaw] = TouchSample(stamp=stamp, touching=touching)
            fresh = [touch for touch in self._touches.values() if touch.stamp > stamp - self._settings.stale_after]
            complete = all(touch.stamp >= stamp for touch in fresh)
            if self._grasp is not None and stamp > self._touch_told and (touching or complete):
                self._touch_told = stamp
                self._grasp.take_touch(any(touch.touching for touch in fresh), stamp)

    def take_stddev(self, jaw: str, stddev: float, stamp: float) -> None:
        """Keep the standard deviation of a jaw's force [N] in the image at `stamp` [s], for the forces to come."""
        with self._changed:
            self._stddevs[jaw] = (stamp, stddev)

    def reject(self, reason: str) -> None:
        """Keep why a force was rejected before it came here, for what the grasp says when none come."""
        with self._changed:
            if self._grasp is not None:
                self._grasp.reject(reason)

    def update(self, state: GripperState) -> None:
        """Let the grasp that runs do what is due; what the gripper refuses ends it."""
        with self._changed:
            if self._grasp is None:
                return
            now = self._gripper.clock.now()
            move = self._grasp.update(state, now, self._gripper.opening_at)
            status = self._grasp.status(state, now)
            try:
                if move is not None:
                    self._gripper.move(move.opening, move.speed, move.force)
                elif status.phase is GraspPhase.STOPPED and state.phase in USABLE and not state.estopped:
                    self._gripper.hold()
            except DriverError as error:
                with suppress(DriverError):
                    self._gripper.hold()
                if move is not None:
                    status = replace(status, phase=GraspPhase.STOPPED, reason=str(error), failure=GraspError)
            self._tell(status)
            if status.phase is GraspPhase.STOPPED:
                self._grasp = None
                self._ended()

    def replace(self, command: Callable[[], None], reason: str) -> None:
        """Give the gripper another command; the grasp ends, unless the command is refused.

        Raises:
            DriverError: it is refused.
        """
        with self._changed:
            command()
            self._end(reason)
            self._acknowledge()

    def stop(self, reason: str) -> None:
        """End the grasp that runs; the gripper holds in place.

        Raises:
            GripperStateError: the gripper cannot hold: its jaws are limp.
        """
        with self._changed:
            self._end(reason)
            self._acknowledge()
            self._gripper.hold()

    def _acknowledge(self) -> None:
        """Take a command for a sign that somebody knows of a grasp that failed."""
        if self.status is not None and self.status.failed:
            self.status = replace(self.status, failure=None)

    def _end(self, reason: str) -> None:
        """Forget the grasp that runs and say why."""
        if self._grasp is not None:
            self._grasp = None
            last = self.status or GraspStatus(phase=GraspPhase.STOPPED, reason=reason, goal=self.goal.force)
            self._tell(replace(last, phase=GraspPhase.STOPPED, reason=reason, failure=None))
            self._ended()

    def _tell(self, status: GraspStatus) -> None:
        self.status = status
        self._changed.notify_all()

    def _is_settled(self) -> bool:
        return self.status is not None and self.status.phase in SETTLED


def _check_opening(goal: GraspGoal, gripper: Gripper) -> None:
    """Refuse a least opening [m] that the jaws are never above; below the closed one it limits nothing."""
    settings = gripper.settings
    settings.check_opening("least opening", max(goal.least_opening, settings.closed_opening))


def hold_force(
    gripper: Gripper,
    forces: Callable[[], Sequence[ForceSample | TouchSample]],
    goal: GraspGoal,
    settings: GraspSettings | None = None,
    *,
    until: Callable[[GraspStatus], bool] | None = None,
) -> GraspStatus:
    """Close until the force is reached, and return how the grasp is; the jaws then stay where they are.

    Args:
        gripper: calibrated and ready.
        forces: returns what the camera has said since the last call, oldest first, without waiting; times are on the
            gripper's clock.
        goal: force, speed, limits.
        settings: of the grasp.
        until: asked with every status; the force is held, with feedback, until it returns true. None: returns as soon
            as the force is held.

    Raises:
        TargetError: the set force is above the limit of the settings, or the least opening beyond the stroke.
        GraspError: the grasp was ended for safety. Here, and whatever else is raised, the gripper holds in place, if
            it can.
    """
    session = GraspSession(gripper, goal, settings or GraspSettings())
    is_done = until or (lambda status: status.phase is GraspPhase.HOLDING)
    try:
        session.begin()
        while not is_done(status := session.advance(forces())):
            last = gripper.state.stamp
            with suppress(GripperTimeoutError):  # the next reply, or a silence that has to be noticed
                gripper.wait(lambda state, last=last: state.stamp != last, CYCLE)
    except BackOffError:
        raise  # the jaws back off
    except BaseException:
        with suppress(DriverError):
            gripper.hold()
        raise
    return status
