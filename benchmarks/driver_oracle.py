"""Compares what a driver says of an emulated gripper with the truth, state by state."""

from __future__ import annotations

import math
from collections import Counter, deque
from dataclasses import dataclass

from finforce_driver.can.protocol import Move
from finforce_driver.emulator.control import Mode
from finforce_driver.emulator.firmware import EmulatedGripper
from finforce_driver.emulator.mechanism import Jaws
from finforce_driver.emulator.protection import Fault
from finforce_driver.state import GripperState, MoveOutcome, Phase
from finforce_driver.units import GripperScale

WINDOW = 0.06  # [s] a reply may be as old as its time-out, and is stamped when it comes
LONG_WINDOW = 0.4  # [s] in which a contact or an outcome is to have been true: they are debounced
PLACE_TOLERANCE = 3.0  # [counts] truncation, and what one flipped digit can pretend unnoticed in motion
GOAL_TOLERANCE = 3.0  # [counts]
CURRENT_TOLERANCE = 0.15  # [A]
FAULT_NAMES = {
    "temperature": {Fault.TEMPERATURE},
    "encoder": {Fault.ENCODER},
    "supply": {Fault.SUPPLY},
    "E-stop": {Fault.ESTOP_COMMAND, Fault.ESTOP_FLAG},
    "watchdog": {Fault.WATCHDOG},
    "motor not calibrated": {Fault.MOTOR_UNCALIBRATED},
}


@dataclass(frozen=True, kw_only=True)
class TrueGripper:
    """One millisecond of a gripper: place [counts] between its own end stops, what it latched and does."""

    time: float
    place: float
    current: float
    calibrated: bool
    configured: bool
    faults: frozenset[Fault]
    echo: tuple[bool, bool]
    mode: Mode
    blocked: int
    temperature: float
    voltage: float


class Tape:
    """Keeps the last truths of a gripper; to be attached to its clock after it."""

    def __init__(self, gripper: EmulatedGripper, length: int = 6000) -> None:
        self.gripper = gripper
        self.truths: deque[TrueGripper] = deque(maxlen=length)
        self.now = 0.0

    def step(self, dt: float) -> None:
        """Keep the present."""
        self.now += dt
        gripper = self.gripper
        ends, jaws = gripper.endpoints, gripper.jaws
        span = ends.closed - ends.open
        self.truths.append(
            TrueGripper(
                time=self.now,
                place=(jaws.encoder - ends.open) * 255.0 / span if span else math.nan,
                current=1e-3 * gripper.reported_current,
                calibrated=gripper.calibrated,
                configured=gripper.configured,
                faults=frozenset(gripper.faults),
                echo=(gripper.order.activated, gripper.order.action),
                mode=gripper.mode,
                blocked=_blocked(jaws),
                temperature=float(gripper.protection.reported_temperature),
                voltage=gripper.protection.voltage,
            )
        )

    def last(self, stamp: float, window: float) -> list[TrueGripper]:
        """Return the truths of a window [s] that ends at a stamp."""
        found = []
        for truth in reversed(self.truths):
            if truth.time < stamp - window - 0.002:
                break
            if truth.time <= stamp + 0.0015:
                found.append(truth)
        return found


def _blocked(jaws: Jaws) -> int:
    """Return 1 for jaws at what stops them closing, -1 for what stops them opening, 2 for both."""
    low, high = jaws._bounds()
    closing, opening = jaws.ticks <= low + 3.0, jaws.ticks >= high - 3.0
    return 2 if closing and opening else int(closing) - int(opening)


class Oracle:
    """Says what is wrong with a state.

    Attributes:
        worst: largest differences seen, by name.
        outcome: of the last move, in the last state that was checked.
    """

    def __init__(self, tape: Tape, scale: GripperScale) -> None:
        self.tape = tape
        self.worst: Counter[str] = Counter()
        self._scale = scale
        self.outcome = MoveOutcome.NONE
        self._telemetry: dict[str, float] = {}
        self._cut = False

    def check(self, state: GripperState, goal: float, stopped: bool, clearing: bool) -> list[str]:
        """Return the complaints about a new state.

        Args:
            state: as reported.
            goal: opening that was last asked for [m].
            stopped: an emergency stop was asked for and not cleared.
            clearing: it was, or its clearing was asked for and may fail.
        """
        outcome, self.outcome = self.outcome, state.outcome
        # a calibration that was cut short leaves a flag that the driver does not trust
        self._cut = state.phase is Phase.CALIBRATING or (self._cut and state.phase not in (Phase.READY, Phase.MOVING))
        if math.isnan(state.stamp):
            return self._check_ignorance(state)
        near = self.tape.last(state.stamp, WINDOW)
        if not near:  # an old reply, whose state was checked when it came
            return []
        complaints = [*self._check_flags(state, near, stopped, clearing), *self._check_values(state, near)]
        if state.outcome is not outcome:
            complaints += self._check_outcome(state, goal)
        return complaints

    def _check_ignorance(self, state: GripperState) -> list[str]:
        known = [name for name in ("opening", "current") if not math.isnan(getattr(state, name))]
        known += ["calibrated"] * state.calibrated + ["phase"] * (state.phase in (Phase.READY, Phase.MOVING))
        return [f"{name} without a reply" for name in known]

    def _check_flags(self, state: GripperState, near: list[TrueGripper], stopped: bool, clearing: bool) -> list[str]:
        wrong = []
        if state.calibrated and not any(truth.calibrated for truth in near):
            wrong.append("calibrated")
        cut = self._cut or "cut short" in state.message
        if state.phase is Phase.UNCALIBRATED and not cut and all(truth.calibrated for truth in near):
            wrong.append("uncalibrated")
        if not any(truth.echo[0] == state.activated for truth in near):
            wrong.append("activated")
        if state.faults == () and all(truth.faults for truth in near):
            wrong.append("no fault")
        for name in state.faults:
            if name == "unknown" or (name == "E-stop" and clearing):
                continue
            if not any(truth.faults & FAULT_NAMES.get(name, set()) for truth in self.tape.last(state.stamp, 4.0)):
                wrong.append(f"fault {name}")
        if state.phase in (Phase.READY, Phase.MOVING) and (stopped or all(truth.faults for truth in near)):
            wrong.append("usable")
        return wrong

    def _check_values(self, state: GripperState, near: list[TrueGripper]) -> list[str]:
        wrong = []
        # a controller that ceases to be a gripper freezes its position byte, which only a calibration finds out
        if not math.isnan(state.opening) and all(truth.configured for truth in near):
            place = self._scale.counts_of(state.opening)
            # the reply tells a place between the stops
            error = min(abs(place - min(max(truth.place, 0.0), 255.0)) for truth in near)
            self.worst["place [counts]"] = max(self.worst["place [counts]"], error)
            wrong += ["opening"] * (error > PLACE_TOLERANCE)
        error = min(abs(state.current - truth.current) for truth in near)
        self.worst["current [A]"] = max(self.worst["current [A]"], error)
        wrong += ["current"] * (error > CURRENT_TOLERANCE)
        side = {"closing": 1, "opening": -1, "": 0}[state.contact]
        if side and not any(truth.blocked in (side, 2) for truth in self.tape.last(state.stamp, LONG_WINDOW)):
            wrong.append(f"contact {state.contact}")
        return wrong + self._check_telemetry(state)

    def _check_telemetry(self, state: GripperState) -> list[str]:
        wrong = []
        for name, tolerance in (("temperature", 3.5), ("voltage", 0.6)):
            value, before = getattr(state, name), self._telemetry.get(name)
            self._telemetry[name] = value
            if math.isnan(value) or value == before:
                continue
            if all(abs(value - getattr(truth, name)) > tolerance for truth in self.tape.last(state.stamp, 1.0)):
                wrong.append(name)
        return wrong

    def _check_outcome(self, state: GripperState, goal: float) -> list[str]:
        recent = self.tape.last(state.stamp, LONG_WINDOW)
        right = True
        if state.outcome is MoveOutcome.REACHED:
            place = self._scale.counts_of(goal)
            right = any(abs(truth.place - place) <= GOAL_TOLERANCE for truth in recent)
        elif state.outcome in (MoveOutcome.GRASPED, MoveOutcome.CLOSED_EMPTY):
            right = any(truth.blocked in (1, 2) for truth in recent)
        elif state.outcome is MoveOutcome.BLOCKED:
            right = any(truth.blocked in (-1, 2) for truth in recent)
        return [] if right else [f"outcome {state.outcome.value}"]


class Guard:
    """Says which orders were not asked for.

    Args:
        tape: truth of the gripper that gets them.
    """

    def __init__(self, tape: Tape) -> None:
        self._tape = tape

    def check(self, order: Move, goal: float | None, stopped: bool, allowed: bool) -> list[str]:
        """Return the complaints about an order.

        Args:
            order: that left.
            goal: position that was asked for [counts]; None: to hold.
            stopped: an emergency stop was asked for and not cleared.
            allowed: moves are allowed at all.
        """
        if not order.drives:
            return []
        if stopped:
            return ["motion after the emergency stop"]
        if not allowed:
            return ["motion without a command"]
        places = [truth.place for truth in self._tape.last(self._tape.now, 0.2)] + ([] if goal is None else [goal])
        low, high = min(places) - 4.0, max(places) + 4.0
        return [] if low <= order.position <= high else ["motion beyond what was asked for"]
