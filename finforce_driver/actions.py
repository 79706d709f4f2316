"""The standard actions of grippers, GripperCommand and ParallelGripperCommand, as moves.

Both an opening that is reached and something that is grasped on the way are a success; the result says which. A goal
that cannot be is rejected.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from finforce_driver.errors import DriverError
from finforce_driver.messages import MoveRequest, fill_joint_state, move_from_gripper_command, move_from_joint_state
from finforce_driver.services import GripperTasks
from finforce_driver.settings import FORCE_PER_CURRENT
from finforce_driver.state import GripperState, MoveOutcome, Phase

if TYPE_CHECKING:
    from finforce_driver.gripper import Gripper

SUCCESSES = (MoveOutcome.REACHED, MoveOutcome.GRASPED)


class MoveAction(ABC):
    """Executes goals of an action, each in the thread that calls.

    Args:
        kind: the action's type.
        gripper: that moves.
        tasks: its commands.
    """

    def __init__(self, kind: Any, gripper: Gripper, tasks: GripperTasks) -> None:
        self.kind, self._gripper, self._tasks = kind, gripper, tasks

    @abstractmethod
    def read(self, goal: Any) -> MoveRequest:
        """Return the move of a goal.

        Raises:
            TargetError: it is none.
        """

    @abstractmethod
    def tell(self, message: Any, state: GripperState) -> None:
        """Fill a result or feedback with a state."""

    def refusal(self, goal: Any) -> str:
        """Return why a goal cannot be carried out, with what was expected; empty when it can."""
        try:
            request = self.read(goal)
            self._gripper.check_move(request.opening, request.speed, request.force)
        except DriverError as error:
            return str(error)
        return ""

    def remark(self, goal: Any) -> str:
        """Return what a goal leaves to the settings; empty where it leaves nothing."""
        if self.read(goal).force is not None:
            return ""
        settings = self._gripper.settings
        force = settings.default_current * FORCE_PER_CURRENT
        return f"no effort, or 0: {force:.0f} N of grip force by the motor's current, gripper.default_current"

    def execute(self, handle: Any) -> Any:
        """Move as a goal says and return the result, when the move is over or the goal is cancelled.

        Args:
            handle: of the goal: `request`, `is_cancel_requested`, `publish_feedback`, `succeed`, `abort`, `canceled`.
        """
        try:
            state = self._tasks.go(self.read(handle.request), leave=self._teller(handle))
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
        result = self.kind.Result()
        self.tell(result, state)
        _judge(result, state)
        return result

    def _teller(self, handle: Any) -> Callable[[GripperState], bool]:
        """Return what tells how far a move has come, and says whether it is to be ended."""

        def tell(state: GripperState) -> bool:
            feedback = self.kind.Feedback()
            self.tell(feedback, state)
            handle.publish_feedback(feedback)
            return handle.is_cancel_requested

        return tell


def _judge(message: Any, state: GripperState) -> None:
    message.stalled = state.outcome is MoveOutcome.GRASPED
    message.reached_goal = state.outcome is MoveOutcome.REACHED


class GripperCommandAction(MoveAction):
    """control_msgs/action/GripperCommand: position = opening [m], effort = grip force by the motor's current [N].

    An effort of 0 is that of the settings; what is not known of the state is 0.
    """

    def read(self, goal: Any) -> MoveRequest:
        """Return the move of a goal."""
        return move_from_gripper_command(goal.command)

    def tell(self, message: Any, state: GripperState) -> None:
        """Fill a result or feedback with a state."""
        message.position, message.effort = (
            value if math.isfinite(value) else 0.0 for value in (state.opening, state.force)
        )
        _judge(message, state)


class ParallelGripperCommandAction(MoveAction):
    """control_msgs/action/ParallelGripperCommand: a JointState, as that of `~/command`, and one back.

    Args:
        joints: names of the two jaws' joints, whose value is half the opening.
        effort: returns the trusted force [N]; None: there is none, and the field stays empty.
        options: of `MoveAction`.
    """

    def __init__(self, joints: Sequence[str], effort: Callable[[], float | None], *options: Any) -> None:
        super().__init__(*options)
        self._joints, self._effort = joints, effort

    def read(self, goal: Any) -> MoveRequest:
        """Return the move of a goal."""
        request = move_from_joint_state(goal.command, self._joints)
        return replace(request, force=request.force or None, speed=request.speed or None)

    def tell(self, message: Any, state: GripperState) -> None:
        """Fill a result or feedback with a state."""
        fill_joint_state(message.state, self._joints, state, self._effort())
