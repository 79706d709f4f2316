"""What is known of a gripper at one instant, in SI units; knows no bytes."""

from __future__ import annotations

import math
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


class Outcome(Enum):
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
    outcome: Outcome = Outcome.NONE
    message: str = ""
    temperature: float = math.nan
    voltage: float = math.nan
    latency: float = math.nan
    counts: dict[str, int] = field(default_factory=dict)
