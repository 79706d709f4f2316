"""The topics that a gripper driver writes, and how gripper and grasp are doing, in words for the diagnostics."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from finforce.health import Health, Level, Outcome, Report
from finforce.ros import node as ros
from finforce_driver.grasp.settings import GraspPhase, GraspStatus
from finforce_driver.messages import fill_joint_state
from finforce_driver.parameters import DriverParameters
from finforce_driver.state import GripperState, MoveOutcome, Phase, describe


class DriverOutputs:
    """The publishers of a gripper driver node.

    Args:
        qos: makes publishers and watches them.
        parameters: names of the joints.
        own_joints: nobody else tells the state of the joints.
    """

    def __init__(self, qos: ros.QosWatch, parameters: DriverParameters, *, own_joints: bool = True) -> None:
        self._names, self._source = parameters.joint_names, qos.node.get_name()
        self._told: tuple[str, str] | None = None
        self.joints = qos.publisher(ros.JointState, "joint_states", ros.RESULT) if own_joints else None
        self.grasp = qos.publisher(ros.DiagnosticStatus, "~/grasp_state", ros.LATCHED)

    def send_joints(self, stamp: int, state: GripperState, effort: float | None) -> None:
        """Send the joints as a reply at `stamp` [ns] shows them; what is not known stays empty.

        Args:
            stamp: of the reply [ns].
            state: with it.
            effort: force that is trusted [N]; None: none is.
        """
        if self.joints is None:
            return
        message = ros.JointState(header=ros.Header(stamp=ros.stamp_message(stamp)))
        fill_joint_state(message, self._names, state, effort)
        self.joints.publish(message)

    def send_grasp(self, status: GraspStatus | None) -> None:
        """Send how the grasp is, when its phase or its reason has changed."""
        if status is None:
            return
        outcome = outcome_of_grasp(status)
        if self._told != (told := (outcome.reason, outcome.text)):
            self._told = told
            report = Report(level=outcome.level, message=outcome.text, values=describe_grasp(status))
            self.grasp.publish(ros.status_message("finforce: grasp", self._source, report))


LEVELS = {Phase.READY: Level.OK, Phase.MOVING: Level.OK, Phase.FAULT: Level.ERROR, Phase.DISCONNECTED: Level.ERROR}
FAILURES = (MoveOutcome.BLOCKED, MoveOutcome.TIMED_OUT, MoveOutcome.ABORTED)
MEASURED = {"callback to published": "request to reply", "image to published": "reply to published"}


class GripperHealth(Health):
    """Keeps what became of the gripper's replies, and of commands and forces that were refused.

    Args:
        options: of `finforce.health.Health`.
    """

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        self._told: dict[str, str] = {}

    def is_news(self, topic: str, text: str) -> bool:
        """Say whether something else was said of a topic the last time."""
        last, self._told[topic] = self._told.get(topic), text
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

    def report(self, alarms: Sequence[Outcome] = (), values: Mapping[str, str] | None = None) -> Report:
        """Return the state now, with the times of a driver by their own names."""
        report = super().report(alarms, values)
        named = {_rename(name): value for name, value in report.values.items()}
        return Report(level=report.level, message=report.message, values=named)


def _rename(figure: str) -> str:
    """Return the name that a figure of images has for a driver."""
    for name, own in MEASURED.items():
        figure = figure.replace(name, own)
    return figure


def outcome_of_state(state: GripperState) -> Outcome:
    """Return the level of a gripper's phase, a word for it and its sentence."""
    level = Level.ERROR if state.estopped or state.faults else LEVELS.get(state.phase, Level.WARN)
    # what no phase says by itself is worth a look: another program's commands, or a speed that was cut
    extraordinary = state.message not in ("", describe(state.phase, state.outcome, state.faults))
    if level == Level.OK and (state.outcome in FAILURES or extraordinary):
        level = Level.WARN
    word = "estopped" if state.estopped else state.phase.value
    return Outcome(level=level, reason=word, text=state.message or word)


def news_of_state(state: GripperState) -> str:
    """Return what a log should say of a gripper once; its moves are no news."""
    outcome = outcome_of_state(state)
    return "the gripper is ready" if outcome.level == Level.OK else outcome.text


def gripper_alarms(state: GripperState) -> list[Outcome]:
    """Return the alarm of a gripper that cannot do what it is asked."""
    outcome = outcome_of_state(state)
    return [] if outcome.level == Level.OK else [outcome]


def describe_state(state: GripperState) -> dict[str, str]:
    """Return what is known of a gripper as text."""
    return {
        "phase": state.phase.value,
        "opening [mm]": _number(1e3 * state.opening, 2),
        "target [mm]": _number(1e3 * state.target, 2),
        "current [A]": _number(state.current, 3),
        "force by the maker's curve [N]": _number(state.force, 1),
        "contact": state.contact or "none",
        "outcome of the last move": state.outcome.value,
        "temperature [deg C]": _number(state.temperature, 0),
        "voltage [V]": _number(state.voltage, 1),
        "faults": ", ".join(state.faults) or "none",
        "emergency stop": "latched" if state.estopped else "no",
        "calibrated": "yes" if state.calibrated else "no",
        "activated": "yes" if state.activated else "no",
        "events": ", ".join(f"{count} {name}" for name, count in state.counts.items() if count) or "none",
    }


def outcome_of_grasp(status: GraspStatus) -> Outcome:
    """Return the level of a grasp, its phase and its sentence; one that was ended wants to be looked at."""
    level = Level.WARN if status.phase is GraspPhase.STOPPED else Level.OK
    level = Level.ERROR if status.unseen else level
    return Outcome(level=level, reason=status.phase.value, text=status.reason)


def grasp_alarms(status: GraspStatus | None) -> list[Outcome]:
    """Return the alarm of a grasp that failed, until something else is commanded."""
    return [outcome_of_grasp(status)] if status is not None and status.failed else []


def describe_grasp(status: GraspStatus | None) -> dict[str, str]:
    """Return the figures of a grasp as text, nothing before the first."""
    if status is None:
        return {}
    refused = ", ".join(f"{count} {reason}" for reason, count in status.refused.items() if count)
    return {
        "grasp": status.phase.value,
        "grasp reason": status.reason,
        "set force [N]": _number(status.goal, 2),
        "force [N]": _number(status.force, 3),
        "stated deviation of the force [N]": _number(status.stddev, 3),
        "predicted force [N]": _number(status.predicted, 3),
        "peak force [N]": _number(status.peak, 3),
        "overshoot bound [N]": _number(status.overshoot_bound, 3),
        "stiffness [N/mm]": _number(1e-3 * status.stiffness, 3),
        "force of one step [N]": _number(status.resolution, 3),
        "image to force [ms]": _number(1e3 * status.latency, 0),
        "image period [ms]": _number(1e3 * status.period, 0),
        "forces refused": refused or "none",
    }


def _number(value: float, digits: int) -> str:
    """Return a number as text, a dash for one that is not known."""
    return f"{value + 0.0:.{digits}f}" if math.isfinite(value) else "-"
