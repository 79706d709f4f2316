"""Commands to a gripper, and its state and that of its grasp at one instant, in SI units and in a sentence."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import MISSING, dataclass, field, fields
from enum import Enum
from typing import Any

from finforce_driver.errors import GraspError, UnseenForceError


def shown(label: str, default: Any = MISSING, digits: int = 0, scale: float = 1.0, **options: Any) -> Any:
    """Return a dataclass field that `describe_record` shows by a label, a number times a scale with so many digits."""
    return field(default=default, metadata={"label": label, "digits": digits, "scale": scale}, **options)


def describe_record(record: Any) -> dict[str, str]:
    """Return the shown fields of a record as text, by their labels."""
    entries = [entry for entry in fields(record) if entry.metadata]
    return {entry.metadata["label"]: _describe(getattr(record, entry.name), entry.metadata) for entry in entries}


def _describe(value: Any, how: Mapping[str, Any]) -> str:
    """Return a value as text: a dash for a number that is not known, none for what is empty."""
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{how['scale'] * value + 0.0:.{how['digits']}f}" if math.isfinite(value) else "-"
    if isinstance(value, Mapping):
        value = [f"{count} {name}" for name, count in value.items() if count]
    text = value.value if isinstance(value, Enum) else value if isinstance(value, str) else ", ".join(value)
    return text or "none"


class Phase(Enum):
    """The phase of the driver."""

    DISCONNECTED = "disconnected"  # no port, or nothing answers for long
    PROBING = "probing"  # the port is open, no reply yet
    UNCALIBRATED = "uncalibrated"
    LOST = "lost"  # moved by an order that was not ours: where the jaws are is not known until a calibration
    CALIBRATING = "calibrating"
    READY = "ready"  # holds, or rests
    MOVING = "moving"
    FAULT = "fault"  # the gripper's power stage is asleep until its errors are cleared


USABLE = (Phase.READY, Phase.MOVING)  # a move may begin
ABSENT = (Phase.DISCONNECTED, Phase.PROBING)  # nothing has answered


class MoveOutcome(Enum):
    """The outcome of the last move."""

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
        at_target: True if the gripper says so.
        calibrated: the gripper knows its end stops.
        activated: its power stage may move it, and does not sleep since a fault or a calibration.
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

    phase: Phase = shown("phase", Phase.DISCONNECTED)
    stamp: float = math.nan
    opening: float = shown("opening [mm]", math.nan, 2, 1e3)
    velocity: float = math.nan
    current: float = shown("current [A]", math.nan, 3)
    force: float = shown("force by the maker's curve [N]", math.nan, 1)
    target: float = shown("target [mm]", math.nan, 2, 1e3)
    contact: str = shown("contact", "")
    at_target: bool = False
    calibrated: bool = shown("calibrated", False)
    activated: bool = shown("activated", False)
    faults: tuple[str, ...] = shown("faults", ())
    estopped: bool = shown("emergency stop", False)
    stop_pending: bool = False
    outcome: MoveOutcome = shown("outcome of the last move", MoveOutcome.NONE)
    message: str = ""
    temperature: float = shown("temperature [deg C]", math.nan)
    voltage: float = shown("voltage [V]", math.nan, 1)
    latency: float = math.nan
    counts: dict[str, int] = shown("events", default_factory=dict)


@dataclass(frozen=True, kw_only=True)
class MoveRequest:
    """A move that is asked for.

    Attributes:
        opening: to go to [m].
        speed: of the opening [m/s]; None: the driver's own.
        force: grip force by the motor's current [N]; None: the driver's own.
    """

    opening: float
    speed: float | None = None
    force: float | None = None


class GraspPhase(Enum):
    """The phase of a grasp."""

    APPROACH = "approach"  # nothing presses yet
    LOADING = "loading"  # on the way to the set force
    HOLDING = "holding"  # as near to the set force as the gripper's steps allow, and following it
    STOPPED = "stopped"  # ended; the jaws stay where they are, and a new grasp is needed


@dataclass(frozen=True, kw_only=True)
class GraspStatus:
    """A grasp at one instant.

    Attributes:
        phase: where it is.
        reason: one sentence: what it does, or why it ended.
        goal: set force [N].
        force: last one measured [N]; NaN before the first.
        predicted: force now, over the latency [N]; NaN without load.
        stiffness: change of the force per metre of closing [N/m]; as expected until it is learnt.
        latency: from image to arrival of a force, median [s].
        period: between two images with a force, median [s].
        overshoot_bound: by which the set force is passed at most if the stiffness at most doubles on the way that no
            image has shown yet, and the force is off by two of its stated deviations [N].
        hard_bound: by which it is passed at most if the object turns as hard as it may be: the motor stalls [N].
        peak: largest force measured while loaded [N]; 0 before.
        resolution: change of the force with one step of the gripper [N].
        target: opening that the jaws were told to go to [m]; NaN before the first move.
        stddev: of the newest force, as its source states it [N].
        failure: kind of failure; None: it did not fail, was ended by a command, or something has been commanded since.
        rejected: forces and touches that were not used, by reason.
    """

    phase: GraspPhase = shown("grasp")
    reason: str = shown("grasp reason")
    goal: float = shown("set force [N]", digits=2)
    force: float = shown("force [N]", math.nan, 3)
    predicted: float = shown("predicted force [N]", math.nan, 3)
    stiffness: float = shown("stiffness [N/mm]", math.nan, 3, 1e-3)
    latency: float = shown("image to force [ms]", math.nan, 0, 1e3)
    period: float = shown("image period [ms]", math.nan, 0, 1e3)
    overshoot_bound: float = shown("overshoot bound [N]", math.nan, 3)
    hard_bound: float = shown("overshoot bound on a hard object [N]", math.nan, 1)
    peak: float = shown("peak force [N]", 0.0, 3)
    resolution: float = shown("force of one step [N]", math.nan, 3)
    target: float = math.nan
    stddev: float = shown("stated deviation of the force [N]", 0.0, 3)
    failure: type[GraspError] | None = None
    rejected: Mapping[str, int] = shown("forces rejected", default_factory=dict)

    @property
    def failed(self) -> bool:
        """True if it failed."""
        return self.failure is not None

    @property
    def unseen(self) -> bool:
        """True if it failed because the motor pressed much harder than the camera said."""
        return self.failed and issubclass(self.failure, UnseenForceError)


SILENT = (
    "the gripper at node {node} does not answer: check its 24 V, CANH and CANL, the termination, 1 Mbit/s, node_id and "
    "the adapter's baud_rate"
)
OTHER_NODE = "no gripper answers at node {node}, but one does at node {other}: set node_id to {other}"
LOST = "{what}; the jaws were stopped at an unknown opening: stop other programs, clear the jaws, calibrate"
OTHER_MASTER = "another program commands this gripper ({what}): stop it, then command again"
REBOOTED = "the gripper lost its calibration, it was probably restarted: calibrate it"
UNCALIBRATED = "the gripper is not calibrated: keep the jaws clear, then calibrate"
HALF_CALIBRATED = "a calibration was cut short: calibrate again, which restarts the gripper and takes 3 s longer"
STOP_PENDING = "emergency stop pending: the gripper has not confirmed it, its jaws may still move; the stop is repeated"
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


def describe(phase: Phase, outcome: MoveOutcome, faults: Sequence[str]) -> str:
    """Return the sentence for a phase in which nothing more special is to be said."""
    if phase is Phase.FAULT:
        return "; ".join(FAULTS.get(name, UNKNOWN_FAULT) for name in faults) or UNKNOWN_FAULT
    return {
        Phase.DISCONNECTED: "no gripper is connected",
        Phase.PROBING: "waiting for the gripper's first reply",
        Phase.UNCALIBRATED: UNCALIBRATED,
        Phase.LOST: "where the jaws are is not known: calibrate",
        Phase.CALIBRATING: "calibrating: the jaws open, then close",
        Phase.READY: OUTCOMES.get(outcome, "ready"),
        Phase.MOVING: "moving",
    }[phase]
