"""One sentence on how the gripper is, with what would help; knows no link and no time."""

from __future__ import annotations

from collections.abc import Sequence

from finforce_driver.state import Outcome, Phase

SILENT = (
    "the gripper at node {node} does not answer: check its 24 V, CANH and CANL, the termination, 1 Mbit/s, node_id and "
    "the adapter's baud_rate"
)
OTHER_NODE = "no gripper answers at node {node}, but one does at node {other}: set node_id to {other}"
OTHER_MASTER = "another program commands this gripper ({what}): stop it, then command again"
REBOOTED = "the gripper lost its calibration, it was probably restarted: calibrate it"
UNCALIBRATED = "the gripper is not calibrated: keep the jaws clear, then calibrate"
HALF_CALIBRATED = "a calibration was cut short: calibrate again, which restarts the gripper and takes 3 s longer"
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
    Outcome.REACHED: "the opening is reached",
    Outcome.GRASPED: "something is grasped",
    Outcome.CLOSED_EMPTY: "closed on nothing",
    Outcome.BLOCKED: "something blocks the opening jaws",
    Outcome.TIMED_OUT: "the opening was not reached in time, nothing resists: is the gripper configured as a gripper?",
    Outcome.REPLACED: "the move was replaced",
    Outcome.ABORTED: "the move was aborted",
}


def describe_faults(faults: Sequence[str]) -> str:
    """Return what is latched and what would help."""
    return "; ".join(FAULTS.get(name, UNKNOWN_FAULT) for name in faults) or UNKNOWN_FAULT


def describe(phase: Phase, outcome: Outcome, faults: Sequence[str]) -> str:
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
