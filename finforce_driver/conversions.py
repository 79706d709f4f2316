"""Messages into what a gripper is asked for, its state into a message and into words."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from finforce.health import Health, Level, Outcome, StampError, StampGate
from finforce.messages import NANOSECONDS
from finforce_driver.errors import TargetError
from finforce_driver.gripper import Clock
from finforce_driver.settings import GraspGoal
from finforce_driver.state import GraspPhase, GraspStatus, GripperState, MoveOutcome, MoveRequest, Phase, describe

JOINTS_DIFFER = 1e-4  # [m] by which the joints of one command may differ


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


def move_from_gripper_command(goal: Any) -> MoveRequest:
    """Return the move of a goal of control_msgs/GripperCommand: opening and grip force, 0 for the driver's own."""
    return MoveRequest(opening=goal.command.position, force=goal.command.max_effort or None)


def move_from_parallel_command(goal: Any, joints: Sequence[str]) -> MoveRequest:
    """Return the move of a goal of control_msgs/ParallelGripperCommand, a JointState; 0 for the driver's own.

    Raises:
        TargetError: as `move_from_joint_state`.
    """
    request = move_from_joint_state(goal.command, joints)
    return replace(request, force=request.force or None, speed=request.speed or None)


def fill_outcome(message: Any, state: GripperState) -> None:
    """Write what became of a move into a result of either action."""
    message.stalled = state.outcome is MoveOutcome.GRASPED
    message.reached_goal = state.outcome is MoveOutcome.REACHED


def fill_gripper_command(message: Any, state: GripperState) -> None:
    """Write a state into a result or feedback of control_msgs/GripperCommand; what is not known is 0."""
    message.position = state.opening if math.isfinite(state.opening) else 0.0
    message.effort = state.force if math.isfinite(state.force) else 0.0
    fill_outcome(message, state)


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
        message: new values; others stay as they were.
        last: values before.

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


class MessageTimes:
    """Translates between a node's clock and the gripper's by what both show at the same moment.

    Args:
        clock: the gripper's.
        sources: names of what sends messages, each in the order of its stamps.
        max_age: greatest age of a message, and greatest time that its stamp may lie ahead [s].
    """

    def __init__(self, clock: Clock, sources: tuple[str, ...], max_age: float) -> None:
        self._clock = clock
        self._gates = {name: StampGate(max_age) for name in sources}

    def enter(self, source: str, stamp: int, now: int) -> float:
        """Return the stamp [ns] of a fresh message of a source on the gripper's clock [s].

        Args:
            source: its name.
            stamp: of the message [ns].
            now: the node's clock [ns].

        Raises:
            StaleError: the message is too old.
            StampError: the stamp repeats, goes back or lies ahead of the clock.
        """
        self._gates[source].enter(stamp, now)
        return self._clock.now() - (now - stamp) / NANOSECONDS

    def to_stamp(self, time: float, now: int) -> int:
        """Return a time of the gripper's clock [s] as a stamp [ns], with `now` of the node's clock [ns].

        Raises:
            StampError: the node's clock does not go yet.
        """
        stamp = now - round((self._clock.now() - time) * NANOSECONDS)
        if stamp < 0:
            raise StampError(f"the node's clock stands at {now / NANOSECONDS:g} s: use_sim_time without /clock?")
        return stamp


LEVELS = {Phase.READY: Level.OK, Phase.MOVING: Level.OK} | dict.fromkeys(
    (Phase.FAULT, Phase.LOST, Phase.DISCONNECTED), Level.ERROR
)
FAILURES = (MoveOutcome.BLOCKED, MoveOutcome.TIMED_OUT, MoveOutcome.ABORTED)


class GripperHealth(Health):
    """Keeps what became of the gripper's replies, and of commands and forces that were rejected.

    Args:
        options: of `finforce.health.Health`.
    """

    times = ("request to reply", "reply to published")

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        self._reported: dict[str, str] = {}

    def is_news(self, topic: str, text: str) -> bool:
        """Keep a text and return whether the last one on this topic was another one."""
        last, self._reported[topic] = self._reported.get(topic), text
        return text != last

    def take(self, state: GripperState, now: float) -> None:
        """Count a reply that was published, or was not because it tells no opening.

        Args:
            state: with the reply.
            now: the driver's clock [s].
        """
        self.arrive()
        outcome = outcome_of_state(state)
        if math.isfinite(state.opening):
            latency = 0.0 if math.isnan(state.latency) else state.latency
            self.publish(outcome, latency=latency, age=now - state.stamp)
        else:
            self.refuse(outcome)


def outcome_of_state(state: GripperState) -> Outcome:
    """Return the level of a gripper's phase, a word for it and its sentence."""
    level = Level.ERROR if state.estopped or state.faults else LEVELS.get(state.phase, Level.WARN)
    # what no phase says by itself deserves attention: another program's commands, or a speed that was limited
    extraordinary = state.message not in ("", describe(state.phase, state.outcome, state.faults))
    if level == Level.OK and (state.outcome in FAILURES or extraordinary):
        level = Level.WARN
    word = "estopped" if state.estopped else state.phase.value
    return Outcome(level=level, reason=word, text=(state.message or word) + name_limp(state))


def name_limp(state: GripperState) -> str:
    """Return that a gripper is limp although it is ready, as after a fault; else nothing."""
    is_limp = state.phase is Phase.READY and not state.activated and not state.estopped
    return ", limp until the next move" if is_limp else ""


def news_of_state(state: GripperState) -> str:
    """Return the text to log of a gripper when it changes; moves do not change it."""
    outcome = outcome_of_state(state)
    return f"the gripper is ready{name_limp(state)}" if outcome.level == Level.OK else outcome.text


def outcome_of_grasp(status: GraspStatus) -> Outcome:
    """Return the level of a grasp, its phase and its sentence; one that was ended deserves attention."""
    level = Level.WARN if status.phase is GraspPhase.STOPPED else Level.OK
    level = Level.ERROR if status.unseen else level
    return Outcome(level=level, reason=status.phase.value, text=status.reason)


def find_alarms(state: GripperState, status: GraspStatus | None) -> list[Outcome]:
    """Return the alarms of a gripper that cannot do what it is asked, and of a grasp that failed."""
    found = [outcome_of_state(state)]
    if status is not None and status.failed:
        found.append(outcome_of_grasp(status))
    return [outcome for outcome in found if outcome.level != Level.OK]
