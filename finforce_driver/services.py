"""Services and actions of a gripper, each as one call that answers with a sentence or a result.

Of an action both an opening that is reached and something that is grasped on the way are a success; the result says
which. A goal that cannot be is rejected.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any

from finforce_driver.conversions import fill_outcome, name_limp
from finforce_driver.errors import DriverError, GripperStateError, GripperTimeoutError
from finforce_driver.grasp.session import GraspSession
from finforce_driver.gripper import Gripper
from finforce_driver.settings import DriverParameters
from finforce_driver.state import ABSENT, GripperState, MoveOutcome, MoveRequest, Phase

CALIBRATION_TIMEOUT = 50.0  # s; the driver gives up after 35 s, and a reset may go before
STOP_TIMEOUT = 0.2  # s in which a gripper says that it stands; usually 0.02 s
CLEARING_TIMEOUT = 2.0  # s; it takes 0.2 s
WATCH_PERIOD = 0.1  # s
MOVE_MARGIN = 5.0  # s beyond the time that the way takes
LIMP = (*ABSENT, Phase.FAULT, Phase.UNCALIBRATED, Phase.LOST)


class GripperTasks:
    """Commands that end whatever the gripper was doing, and wait for their outcome.

    A rejected command leaves the gripper as it was, a grasp by force included.

    Args:
        gripper: that is commanded.
        session: its grasps by force.
        parameters: opening, speed, and current of a grasp without vision.
    """

    def __init__(self, gripper: Gripper, session: GraspSession, parameters: DriverParameters) -> None:
        self._gripper, self._session, self._parameters = gripper, session, parameters
        self._commands = 0
        self._streamed: tuple[MoveRequest, int] | None = None  # the last command of a stream, and its number

    def close(self) -> None:
        """End what is under way, and have nobody wait any longer."""
        self._command(lambda: None, "the driver ends")

    def stream(self, request: MoveRequest) -> None:
        """Go to an opening as one of many commands says; one that repeats what is done changes nothing.

        Raises:
            DriverError: the move was refused.
        """
        state = self._gripper.state
        works = state.phase is Phase.MOVING or (
            state.phase is Phase.READY and state.outcome in (MoveOutcome.REACHED, MoveOutcome.GRASPED)
        )
        if not (works and (request, self._commands) == self._streamed):
            self.move(request)
            self._streamed = (request, self._commands)

    def move(self, request: MoveRequest, reason: str = "another move was commanded") -> None:
        """Go to an opening; return at once.

        Raises:
            DriverError: the move was refused.
        """
        self._command(lambda: self._gripper.move(request.opening, request.speed, request.force), reason)

    def stop(self) -> str:
        """Hold in place."""
        self._session.stop("stopped by command")
        self._count()
        return "the gripper holds in place"

    def estop(self) -> str:
        """Stop at once, limp, before anything else is looked at; return when the gripper says that it stands.

        Raises:
            GripperStateError: it does not say so, or no gripper answers; the stop is pending.
        """
        self._gripper.estop()
        self._command(lambda: None, "emergency stop")
        with suppress(GripperTimeoutError):
            self._gripper.wait(lambda state: not state.stop_pending, STOP_TIMEOUT)
        if self._gripper.state.phase in ABSENT or self._gripper.state.stop_pending:
            raise GripperStateError(
                "emergency stop pending: no link to the gripper, whose jaws may still move; the stop is sent once "
                "it answers, until clear_errors ends it"
            )
        return "emergency stop: the jaws are limp; clear_errors ends it"

    def activate(self, on: bool) -> str:
        """Switch the power stage on or off."""
        self._command(lambda: self._gripper.activate(on), "the gripper was switched")
        return "the gripper is active" if on else "the gripper is off, its jaws are limp"

    def calibrate(self) -> str:
        """Find the end stops, and wait for it; refused during a grasp by force."""
        self._refuse_in_grasp("calibrate")
        self._command(self._gripper.calibrate, "a calibration was commanded")
        state = self._await(lambda state: state.phase is not Phase.CALIBRATING, CALIBRATION_TIMEOUT, self._commands)
        _check(state, "the calibration failed")
        return "calibrated: the jaws are closed, and limp until the first move"

    def clear_errors(self) -> str:
        """Clear what is latched, and wait for it; without a fault nothing changes, for a grasp neither."""
        self._gripper.clear_errors()
        state = self._await(
            lambda state: state.phase is not Phase.FAULT and not state.estopped, CLEARING_TIMEOUT, self._commands
        )
        return f"no error is latched; the gripper is {state.phase.value}{name_limp(state)}"

    def grasp(self) -> str:
        """Close until the set force is reached by vision; return while it is held."""
        status = self._session.run(self._count)
        return f"holds {status.force:.2f} N, set {status.goal:.2f} N: {status.reason}"

    def grasp_without_vision(self) -> str:
        """Close until something resists, by the motor's current alone; return while it is held."""
        self._refuse_in_grasp("grasp_without_vision")
        given = self._parameters
        least, force = self._gripper.settings.closed_opening, given.motor_force
        state = self.go(MoveRequest(opening=least, speed=given.grasp_speed, force=force), "a grasp without vision")
        if state.outcome is not MoveOutcome.GRASPED:
            self._gripper.hold()
            raise GripperStateError(f"nothing was grasped: {state.outcome.value} at {1e3 * state.opening:.1f} mm")
        return f"holds with {force:.0f} N by the motor's current, without vision, at {1e3 * state.opening:.1f} mm"

    def release(self) -> str:
        """Open, and wait for it."""
        opening = self._parameters.release_opening
        opening = self._gripper.settings.largest_opening if math.isnan(opening) else opening
        state = self.go(MoveRequest(opening=opening), "release was commanded")
        if state.outcome is not MoveOutcome.REACHED:
            raise GripperStateError(f"the gripper did not open: {state.outcome.value} at {1e3 * state.opening:.1f} mm")
        return f"open: {1e3 * state.opening:.1f} mm"

    def go(
        self,
        request: MoveRequest,
        reason: str = "another move was commanded",
        leave: Callable[[GripperState], bool] = lambda state: False,
    ) -> GripperState:
        """Go to an opening; return the state when the move is over, whatever ended it.

        Args:
            request: the move.
            reason: for the grasp by force that it ends.
            leave: asked ten times a second on the way; true ends the waiting, not the move.

        Raises:
            DriverError: the move was refused, another command came, or the gripper was lost.
        """
        self.move(request, reason)
        own, settings = self._commands, self._gripper.settings
        longest = settings.stroke / (request.speed or settings.default_speed) + MOVE_MARGIN
        for _ in range(math.ceil(longest / WATCH_PERIOD)):
            with suppress(GripperTimeoutError):
                return _check(
                    self._await(lambda state: state.phase is not Phase.MOVING, WATCH_PERIOD, own), "the move was lost"
                )
            if leave(state := self._gripper.state):
                return state
        raise GripperTimeoutError(f"the move has no end after {longest:.1f} s")

    def _refuse_in_grasp(self, what: str) -> None:
        """Raise GripperStateError during a grasp by force: what is held is not to be let go or crushed unasked."""
        if self._session.runs:
            raise GripperStateError(f"{what}: a grasp by force is under way; stop or release it first")

    def _command(self, command: Callable[[], None], reason: str) -> None:
        """Give a command that ends whatever the gripper was doing."""
        self._session.replace(command, reason)
        self._count()

    def _count(self) -> None:
        """Note that there was another command, for those who wait for the end of an earlier one."""
        self._commands += 1

    def _await(self, condition: Callable[[GripperState], bool], timeout: float, own: int) -> GripperState:
        """Return the first state with a condition.

        Args:
            condition: of the state.
            timeout: longest wait [s].
            own: number of the command whose end is waited for.

        Raises:
            GripperTimeoutError: there was none in time.
            GripperStateError: another command came.
        """
        state = self._gripper.wait(lambda state: self._commands != own or condition(state), timeout)
        if self._commands != own:
            raise GripperStateError("another command came in between")
        return state


def _check(state: GripperState, what: str) -> GripperState:
    """Return a state, unless it is one in which the jaws are limp."""
    if state.phase in LIMP:
        raise GripperStateError(f"{what}: {state.message}")
    return state


SUCCESSES = (MoveOutcome.REACHED, MoveOutcome.GRASPED)


@dataclass(frozen=True)
class MoveAction:
    """Executes goals of an action of control_msgs, each in the thread that calls.

    Attributes:
        kind: the action's type.
        read: returns the move of a goal, or raises TargetError.
        fill: writes a state into a result or feedback.
        gripper: that moves.
        tasks: its commands.
    """

    kind: Any
    read: Callable[[Any], MoveRequest]
    fill: Callable[[Any, GripperState], None]
    gripper: Gripper
    tasks: GripperTasks

    def rejection(self, goal: Any) -> str:
        """Return why a goal cannot be carried out, with what was expected; empty when it can."""
        try:
            request = self.read(goal)
            self.gripper.check_move(request.opening, request.speed, request.force)
        except DriverError as error:
            return str(error)
        return ""

    def remark(self, goal: Any) -> str:
        """Return what a goal leaves to the settings; empty where it leaves nothing."""
        if self.read(goal).force is not None:
            return ""
        settings = self.gripper.settings
        force = settings.force_of(settings.default_current)
        return f"no effort, or 0: {force:.0f} N of grip force by the motor's current, gripper.default_current"

    def execute(self, handle: Any) -> Any:
        """Move as a goal says and return the result, when the move is over or the goal is cancelled.

        Args:
            handle: of the goal: `request`, `is_cancel_requested`, `publish_feedback`, `succeed`, `abort`, `canceled`.
        """

        def tell(state: GripperState) -> bool:
            feedback = self.kind.Feedback()
            self.fill(feedback, state)
            handle.publish_feedback(feedback)
            return handle.is_cancel_requested

        try:
            state = self.tasks.go(self.read(handle.request), leave=tell)
            if state.phase is Phase.MOVING:
                self.tasks.stop()
        except DriverError:
            state = replace(self.gripper.state, outcome=MoveOutcome.ABORTED)
        if state.phase is Phase.MOVING:
            handle.canceled()
        elif state.outcome in SUCCESSES:
            handle.succeed()
        else:
            handle.abort()
        result = self.kind.Result()
        self.fill(result, state)
        fill_outcome(result, state)
        return result
