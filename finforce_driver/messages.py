"""Messages into what a gripper is asked for, and its state into a message."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

from finforce_driver.errors import TargetError
from finforce_driver.grasp.settings import GraspGoal
from finforce_driver.state import GripperState

JOINTS_DIFFER = 1e-4  # [m] by which the joints of one command may differ


@dataclass(frozen=True, kw_only=True)
class MoveRequest:
    """What a command asks for, as it came.

    Attributes:
        opening: to go to [m].
        speed: of the opening [m/s]; None: the driver's own.
        force: grip force by the motor's current [N]; None: the driver's own.
    """

    opening: float
    speed: float | None = None
    force: float | None = None


def move_from_joint_state(message: Any, joints: Sequence[str] = ()) -> MoveRequest:
    """Return the move of a sensor_msgs/JointState: position = opening, velocity = speed, effort = grip force.

    With the names of joints, position and velocity are theirs: the value of each is half the opening, and they move
    alike.

    Args:
        message: the command.
        joints: names of the two jaws' joints.

    Raises:
        TargetError: there is no opening, a field has several values, or a joint is not one of the gripper.
    """
    if message.name:
        return _move_of_joints(message, joints)
    opening = _single(message.position, "position, the opening [m]")
    if opening is None:
        raise TargetError("a command without position; expected one value, the opening between the jaws [m]")
    speed = _single(message.velocity, "velocity, the speed of the opening [m/s]")
    return MoveRequest(opening=opening, speed=speed, force=_single(message.effort, "effort, the grip force [N]"))


def _move_of_joints(message: Any, joints: Sequence[str]) -> MoveRequest:
    """Return the move of a command that names its joints, one or both; one value for both is that of each.

    Raises:
        TargetError: a joint is not one of the gripper, or both are told to differ.
    """
    if not set(message.name) <= set(joints) or len(set(message.name)) != len(message.name):
        raise TargetError(f"joints {list(message.name)}; expected {' or '.join(joints)}, or both, or no name")
    if len(message.position) not in (1, len(message.name)):
        raise TargetError(f"{len(message.position)} positions of {len(message.name)} joints; expected one for each")
    speeds = [abs(speed) for speed in message.velocity]
    if max(message.position) - min(message.position) > JOINTS_DIFFER or len(set(speeds)) > 1:
        raise TargetError(f"positions {list(message.position)}; expected the same for both joints, which move alike")
    efforts = {float(effort) for effort in message.effort}
    return MoveRequest(
        opening=2.0 * sum(message.position) / len(message.position),
        speed=2.0 * speeds[0] if speeds else None,
        force=_single(sorted(efforts), "effort, the grip force [N]"),
    )


def move_from_gripper_command(command: Any) -> MoveRequest:
    """Return the move of a control_msgs/GripperCommand: position = opening, max_effort = grip force, 0 for none."""
    return MoveRequest(opening=command.position, force=command.max_effort or None)


def fill_joint_state(message: Any, joints: Sequence[str], state: GripperState, effort: float | None) -> None:
    """Write a gripper's state into a sensor_msgs/JointState: what is not known stays empty.

    Args:
        message: to be filled.
        joints: names of the two jaws' joints, whose value is half the opening.
        state: of the gripper.
        effort: force [N]; None: there is none that is trusted.
    """
    known = math.isfinite(state.opening) and math.isfinite(state.velocity)
    message.name = list(joints)
    message.position = [0.5 * state.opening] * 2 if known else []
    message.velocity = [0.5 * state.velocity] * 2 if known else []
    message.effort = [effort] * 2 if known and effort is not None else []


def goal_from_joint_state(message: Any, last: GraspGoal) -> GraspGoal:
    """Return the goal of a sensor_msgs/JointState: effort = force, velocity = speed, position = least opening.

    Args:
        message: what it does not say stays as it was.
        last: how it was.

    Raises:
        TargetError: there is nothing in it, a field has several values, or a value cannot be.
    """
    given = {
        "force": _single(message.effort, "effort, the force to hold [N]"),
        "speed": _single(message.velocity, "velocity, the speed of the opening [m/s]"),
        "least_opening": _single(message.position, "position, the least opening [m]"),
    }
    changes = {name: value for name, value in given.items() if value is not None}
    if not changes:
        raise TargetError("an empty grasp goal; expected effort, the force to hold [N]")
    return replace(last, **changes)


def _single(values: Sequence[float], what: str) -> float | None:
    """Return the only value of a field, None of an empty one."""
    if len(values) > 1:
        raise TargetError(f"{len(values)} values of {what}; expected one for both jaws together, or none")
    return float(values[0]) if len(values) else None
