"""The standard action GripperCommand as a move of the gripper.

The position is the opening between the jaws [m], `max_effort` the grip force by the maker's curve [N], 0 for that of
the driver's settings; a goal that cannot be is rejected. Both an opening that is reached and something that is grasped
on the way are a success; the result says which.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from finforce_driver.errors import DriverError
from finforce_driver.messages import move_from_gripper_command
from finforce_driver.services import GripperTasks
from finforce_driver.state import GripperState, MoveOutcome, Phase

if TYPE_CHECKING:
    from finforce_driver.gripper import Gripper

SUCCESSES = (MoveOutcome.REACHED, MoveOutcome.GRASPED)


class GripperCommandAction:
    """Executes goals of the action, each in the thread that calls.

    Args:
        kind: the action type, control_msgs/action/GripperCommand.
        gripper: that moves.
        tasks: its commands.
    """

    def __init__(self, kind: Any, gripper: Gripper, tasks: GripperTasks) -> None:
        self._kind, self._gripper, self._tasks = kind, gripper, tasks

    def refusal(self, goal: Any) -> str:
        """Return why a goal cannot be carried out, with what was expected; empty when it can."""
        try:
            request = move_from_gripper_command(goal.command)
            self._gripper.check_move(request.opening, request.speed, request.force)
        except DriverError as error:
            return str(error)
        return ""

    def execute(self, handle: Any) -> Any:
        """Move as a goal says and return the result, when the move is over or the goal is cancelled.

        Args:
            handle: of the goal: `request.command`, `is_cancel_requested`, `publish_feedback`, `succeed`, `abort`,
                `canceled`.
        """
        try:
            state = self._tasks.go(move_from_gripper_command(handle.request.command), leave=self._teller(handle))
            if state.phase is Phase.MOVING:
                self._tasks.stop()
        except DriverError:
            state = replace(self._gripper.state, outcome=MoveOutcome.ABORTED)
        if state.phase is Phase.MOVING:
            handle.canceled()
        elif state.outcome in SUCCESSES:
            handle.succeed()
        else:
            handle.abort()
        return self._describe(self._kind.Result(), state)

    def _teller(self, handle: Any) -> Callable[[GripperState], bool]:
        """Return what tells how far a move has come, and says whether it is to be ended."""

        def tell(state: GripperState) -> bool:
            handle.publish_feedback(self._describe(self._kind.Feedback(), state))
            return handle.is_cancel_requested

        return tell

    def _describe(self, message: Any, state: GripperState) -> Any:
        """Return a result or feedback with a state in it; what is not known is 0."""
        message.position, message.effort = (
            value if math.isfinite(value) else 0.0 for value in (state.opening, state.force)
        )
        message.stalled, message.reached_goal = (
            state.outcome is MoveOutcome.GRASPED,
            state.outcome is MoveOutcome.REACHED,
        )
        return message
