"""What is known of a gripper at one instant, in SI units, and in one sentence."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from enum import Enum


class Phase(Enum):
    """Where the driver is with its gripper."""

    DISCONNECTED = "disconnected"  # no port, or nothing answers for long
    PROBING = "probing"  # the port is open, no reply yet
    UNCALIBRATED = "uncalibrated"
    CALIBRATING = "calibrating"
    READY = "ready"  # holds, or rests
    MOVING = "moving"
    FAULT = "fault"  # the gripper's power stage is asleep until its errors are cleared


class MoveOutcome(Enum):
    """What became of the last move."""

    NONE = "none"  # none yet, or still under way
    REACHED = "reached"
    GRASPED = "grasped"  # stalled on something while closing
    CLOSED_EMPTY = "closed on nothing"
    BLOCKED = "blocked while opening"
    TIMED_OUT = "timed out"
    REPLACED = "replaced by another command"
    ABORTED = "aborted"  # fault, E-stop, reboot, lost link


@dataclass(frozen=True, kw_only=True)
class GripperState:
    """One instant of a gripper.

    Attributes:
        phase: where the driver is with it.
        stamp: of the last reply that was believed [s], on the driver's clock; NaN before the first.
        opening: between the undeformed inner faces of the jaws [m]; NaN while not calibrated.
        velocity: of the opening [m/s], negative while closing; NaN while not calibrated.
        current: of the motor [A], negative when it drives closed.
        force: grip force by the maker's curve [N], positive when it drives closed.
        target: opening that the gripper was told to go to [m]; NaN without one.
        contact: "", "closing" or "opening": what the motor pushes against.
        at_target: whether the gripper says so.
        calibrated: the gripper knows its end stops.
        activated: its power stage may move it.
        faults: names of what is latched, in the gripper's order.
        estopped: an emergency stop is latched, by us or by it.
        stop_pending: an emergency stop was asked for, and the gripper has not said yet that it stands.
        outcome: of the last move.
        message: one sentence: how it is, and what would help.
        temperature: of the motor [deg C]; NaN unknown.
        voltage: of the supply [V]; NaN unknown.
        latency: from a request to its reply [s], of the last one; NaN unknown.
        counts: of events since the start, by name.
    """

    phase: Phase = Phase.DISCONNECTED
    stamp: float = math.nan
    opening: float = math.nan
    velocity: float = math.nan
    current: float = math.nan
    force: float = math.nan
    target: float = math.nan
    contact: str = ""
    at_target: bool = False
    calibrated: bool = False
    activated: bool = False
    faults: tuple[str, ...] = ()
    estopped: bool = False
    stop_pending: bool = False
    outcome: MoveOutcome = MoveOutcome.NONE
    message: str = ""
    temperature: float = math.nan
    voltage: float = math.nan
    latency: float = math.nan
    counts: dict[str, int] = field(default_factory=dict)


SILENT = (
    "the gripper at node {node} does not answer: check its 24 V, CANH and CANL, the termination, 1 Mbit/s, node_id and "
    "the adapter's baud_rate"
)
OTHER_NODE = "no gripper answers at node {node}, but one does at node {other}: set node_id to {other}"
OTHER_MASTER = "another program commands this gripper ({what}): stop it, then command again"
REBOOTED = "the gripper lost its calibration, it was probably restarted: calibrate it"
UNCALIBRATED = "the gripper is not calibrated: keep the jaws clear, then calibrate"
HALF_CALIBRATED = "a calibration was cut short: calibrate again, which restarts the gripper and takes 3 s longer"
STOP_PENDING = "emergency stop pending: the gripper has not confirmed it, its jaws may go on moving; it is sent again"
STOPPED = "emergency stop: make the place safe, then clear the errors"
FAULTS = {
    "temperature": "the motor is too hot: let it cool, use less force, then clear the errors",
    "encoder": "the encoder lost its magnet: check the motor, then clear the errors",
    "supply": "the supply is or was outside 9 to 29 V: check it, then clear the errors",
    "driver": "the power stage reports a fault: switch the gripper off and on",
    "velocity": "the motor was measured faster than it can be: check the encoder, then clear the errors",
    "current": "the current was too great: clear the errors",
    "E-stop": STOPPED,
    "watchdog": "the gripper was not asked in time (its watchdog is on): clear the errors",
    "motor not calibrated": "the motor itself was never calibrated: do that with the maker's program over UART",
}
UNKNOWN_FAULT = "the gripper reports a fault: clear the errors"
OUTCOMES = {
    MoveOutcome.REACHED: "the opening is reached",
    MoveOutcome.GRASPED: "something is grasped",
    MoveOutcome.CLOSED_EMPTY: "closed on nothing",
    MoveOutcome.BLOCKED: "something blocks the opening jaws",
    MoveOutcome.TIMED_OUT: "the opening was not reached in time, nothing resists: is it configured as a gripper?",
    MoveOutcome.REPLACED: "the move was replaced",
    MoveOutcome.ABORTED: "the move was aborted",
}


def describe_faults(faults: Sequence[str]) -> str:
    """Return what is latched and what would help."""
    return "; ".join(FAULTS.get(name, UNKNOWN_FAULT) for name in faults) or UNKNOWN_FAULT


def describe(phase: Phase, outcome: MoveOutcome, faults: Sequence[str]) -> str:
    """Return the sentence for a phase in which nothing more special is to be said."""
    if phase is Phase.FAULT:
        return describe_faults(faults)
    return {
        Phase.DISCONNECTED: "no gripper is connected",
        Phase.PROBING: "waiting for the gripper's first reply",
        Phase.UNCALIBRATED: UNCALIBRATED,
        Phase.CALIBRATING: "calibrating: the jaws open, then close",
        Phase.READY: OUTCOMES.get(outcome, "ready"),
        Phase.MOVING: "moving",
    }[phase]
