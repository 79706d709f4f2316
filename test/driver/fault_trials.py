"""Random faults between the gripper driver and an emulated gripper: wrong states, hangs, crashes, motion.

Driver and gripper live in stepped time, in runs of 100 faults of every kind that the emulator can inject, on both
firmware variants and with adapters of different latencies, while a user moves, holds, stops, clears and calibrates at
random and objects come and go. Every state that the driver reports is compared with the truth (`Oracle`), every order
that leaves with what was asked for (`Guard`). At the end of a run the faults cease, and the gripper has to get back to
work.
"""

from __future__ import annotations

import logging
import math
from collections import Counter, deque
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from random import Random
from typing import Any

from emulator_faults import LINE_FAULTS, FaultKind, FaultyAdapter, FaultyBus, PlannedFault, draw_plan

from finforce_driver.can.protocol import CanMessage, Command, Move, decode_move
from finforce_driver.errors import DriverError
from finforce_driver.gripper import Gripper
from finforce_driver.machine.machine import INHERITED
from finforce_driver.settings import GripperSettings
from finforce_driver.state import GripperState, MoveOutcome, Phase
from finforce_sim.emulator.control import Mode
from finforce_sim.emulator.firmware import EmulatedGripper, Fault
from finforce_sim.emulator.mechanism import Jaws
from finforce_sim.emulator.virtual import VirtualClock

PER_RUN = 100
PERIOD = 0.4  # [s] in which one fault is injected
START = 4.0  # [s] before the first fault: the gripper is calibrated meanwhile
STANDSTILL = 200  # turns without time passing: a hang
RECOVERY_TIME = 120.0  # [s] in which the gripper has to work again: a calibration may fail after 35 s and be repeated
SPEEDS = (0.002, 0.004, 0.02, 0.1, 0.3)  # [m/s]
LATENCIES = (0.0003, 0.001, 0.003, 0.012)  # [s]


class _Complaints(logging.Handler):
    """Counts the errors that the loop survived."""

    def __init__(self, tally: FaultTally) -> None:
        super().__init__(logging.ERROR)
        self._tally = tally

    def emit(self, record: logging.LogRecord) -> None:
        """Count one."""
        self._tally.crashes[repr(record.exc_info[1]) if record.exc_info else record.getMessage()] += 1


class FaultRun:
    """One gripper, its driver, its user and its faults.

    Args:
        seed: of everything random.
        count: number of faults.
        kinds: of faults.
    """

    def __init__(self, seed: int, count: int, kinds: Sequence[FaultKind]) -> None:
        self.tally = FaultTally()
        self._random = Random(seed)
        self._until = START + count * PERIOD
        self.clock, self.emulated = VirtualClock(), EmulatedGripper(("new", "old")[seed % 2])
        ack_mode, latency = self._random.choice(("none", "lawicel")), self._random.choice(LATENCIES)
        plan = [replace(fault, time=fault.time + START) for fault in draw_plan(seed, count, PERIOD, kinds)]
        self.adapter = FaultyAdapter(self.emulated, plan, seed, ack_mode=ack_mode, latency=latency)
        self.bus = FaultyBus(self.adapter, self.clock)
        self._send, self.bus.send = self.bus.send, self._watch_message
        self.tape = Tape(self.adapter)
        self.clock.attach(self.tape)
        settings = GripperSettings(poll_rate=self._random.choice((50.0, 100.0, 200.0)), telemetry_period=0.3)
        self.gripper = Gripper(self.bus, settings, self.clock)
        self.oracle, self.guard = Oracle(self.tape, settings, self.adapter.injected), Guard(self.tape)
        self._goal, self._stopped, self._clearing, self._allowed = 0.0, False, False, False
        self._next_act = 0.0
        self.gripper.listen(self._take)

    def run(self) -> FaultTally:
        """Live until the plan is over and the gripper works again."""
        complaints = _Complaints(self.tally)
        logging.getLogger("finforce_driver").addHandler(complaints)
        logging.getLogger("finforce_driver").propagate = False
        try:
            while self.clock.now() < self._until and not self.tally.hangs:
                self._live()
            self.adapter.heal()
            self.adapter.replug()
            self._recover()
        except Exception as error:
            self.tally.crashes[f"{type(error).__name__}: {error}"] += 1
        finally:
            logging.getLogger("finforce_driver").removeHandler(complaints)
        self.tally.faults.update(fault.kind.value for fault in self.adapter.injected)
        self.tally.worst.update(self.oracle.worst)
        self.tally.violations.update(self.emulated.violations)
        return self.tally

    def _live(self) -> None:
        """One turn of the driver, and what its user does meanwhile."""
        for _ in range(STANDSTILL):
            before = self.clock.now()
            self.gripper.turn()
            if self.clock.now() > before:
                break
        else:
            self.tally.hangs += 1
        if self.clock.now() >= self._next_act:
            self._next_act = self.clock.now() + self._random.uniform(0.02, 1.0)
            self._act()

    def _act(self) -> None:
        """Do what a user could do now."""
        state, draw = self.gripper.state, self._random.random()
        try:
            if state.phase in (Phase.READY, Phase.MOVING):
                self._use(draw)
            elif state.phase is Phase.FAULT and draw < 0.9:
                self.gripper.clear_errors()
                self._stopped = False
            elif state.phase in (Phase.UNCALIBRATED, Phase.LOST):
                self._allowed = False
                self.gripper.calibrate()
            elif draw < 0.05:
                self._stop()
            elif draw < 0.1 and state.phase is Phase.CALIBRATING:
                self.gripper.hold()
            elif draw < 0.2:
                self.gripper.move(0.02)
                self.tally.wrong["a move was accepted in " + state.phase.value] += 1
        except DriverError:
            pass

    def _use(self, draw: float) -> None:
        """Use a gripper that works."""
        gripper, random = self.gripper, self._random
        if draw < 0.65:
            goal = random.uniform(0.0, 0.048)
            gripper.move(goal, random.choice(SPEEDS), random.choice((None, 10.0, 30.0)))
            self._goal, self._allowed = goal, True
        elif draw < 0.75:
            gripper.hold()
        elif draw < 0.79:
            self._stop()
        elif draw < 0.82:
            self._allowed = False
            gripper.release_power()
        elif draw < 0.85:
            self._allowed = False
            gripper.activate(False)
        elif draw < 0.9:
            gripper.activate(True)
            self._allowed = True
        elif draw < 0.92:
            self._allowed = False
            gripper.calibrate()
        elif draw < 0.94:
            gripper.clear_errors()
        else:
            jaws = self.emulated.jaws
            jaws.object_opening = max(0.0, jaws.opening - random.uniform(0.001, 0.02)) if draw < 0.97 else None

    def _stop(self) -> None:
        self._stopped, self._clearing, self._allowed = True, True, False
        self.gripper.estop()

    def _take(self, state: GripperState) -> None:
        """Check a state."""
        self.tally.states += 1
        self.tally.phases[state.phase.value] += 1
        if state.outcome is not self.oracle.outcome:
            self.tally.outcomes[state.outcome.value] += 1
        self.tally.wrong.update(self.oracle.check(state, self._goal, self._stopped, self._clearing))
        self._clearing &= state.estopped or self._stopped

    def _watch_message(self, message: CanMessage) -> None:
        """Check a message that leaves."""
        if message.command == Command.MOVE and message.data:
            self.tally.orders += 1
            goal = self.gripper.settings.counts_of(self._goal) if self._allowed else None
            # jaws that move by somebody's order are held where they are, as documented
            state = self.gripper.state
            allowed = self._allowed or state.message == INHERITED or state.phase is Phase.LOST
            self.tally.motion.update(self.guard.check(decode_move(message), goal, self._stopped, allowed))
        self._send(message)

    def _recover(self) -> None:
        """Bring the gripper back to work, as a user would."""
        self.emulated.faults.discard(Fault.WATCHDOG)
        self.emulated.jaws.object_opening = None
        deadline = self.clock.now() + RECOVERY_TIME
        while self.clock.now() < deadline:
            phase = self.gripper.state.phase
            try:
                if phase is Phase.FAULT:
                    self._stopped = False
                    self.gripper.clear_errors()
                elif phase in (Phase.UNCALIBRATED, Phase.LOST):
                    self._allowed = False
                    self.gripper.calibrate()
                elif phase in (Phase.READY, Phase.MOVING) and self._works():
                    return
                self.gripper.wait(lambda state, phase=phase: state.phase is not phase, 1.0)
            except DriverError:
                continue
        self.tally.unrecovered += 1

    def _works(self) -> bool:
        """Return whether a move reaches its goal."""
        self.gripper.activate(True)
        self._goal, self._allowed = 0.030 if self.emulated.jaws.opening < 0.02 else 0.010, True
        self.gripper.move(self._goal, 0.1)
        state = self.gripper.wait(lambda state: state.phase is not Phase.MOVING, 5.0)
        distance = self.tape.truths[-1].position - self.gripper.settings.counts_of(self._goal)
        return state.outcome is MoveOutcome.REACHED and abs(distance) < 3.0


def choose_kinds(seed: int) -> tuple[FaultKind, ...]:
    """Return every kind of fault, or in every third run those on the line, between which the gripper gets about."""
    return tuple(LINE_FAULTS) if seed % 3 == 0 else tuple(FaultKind)


def run_all(faults: int, seed: int = 1) -> FaultTally:
    """Return the tally of enough runs for a number of faults."""
    tally = FaultTally()
    for index in range(-(-faults // PER_RUN)):
        run = FaultRun(seed + index, min(PER_RUN, faults - index * PER_RUN), choose_kinds(seed + index))
        tally.add(run.run())
    return tally


WINDOW = 0.06  # [s] a reply may be as old as its time-out, and is stamped when it comes
LONG_WINDOW = 0.4  # [s] in which a contact or an outcome is to have been true: they are debounced
POSITION_TOLERANCE = 3.0  # [counts] truncation, and what one flipped digit can pretend unnoticed in motion
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
    """One millisecond of a gripper: position [counts] between its own end stops, latched faults and motion."""

    time: float
    position: float
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

    def __init__(self, adapter: FaultyAdapter, length: int = 6000) -> None:
        self.adapter, self.gripper = adapter, adapter.gripper
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
                position=(jaws.encoder - ends.open) * 255.0 / span if span else math.nan,
                current=1e-3 * self.adapter.reported_current,
                calibrated=gripper.calibrated,
                configured=gripper.configured,
                faults=frozenset(gripper.faults),
                echo=(gripper.order.activated, gripper.order.action),
                mode=gripper.mode,
                blocked=_blocked(jaws),
                temperature=float(round(gripper.protection.temperature)),
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

    def __init__(self, tape: Tape, settings: GripperSettings, injected: Sequence[PlannedFault]) -> None:
        self.tape, self.injected = tape, injected
        self.worst: Counter[str] = Counter()
        self._settings = settings
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
        if state.faults == () and all(truth.faults for truth in near):
            wrong.append("no fault")
        for name in state.faults:
            if name == "unknown" or (name == "E-stop" and clearing):
                continue
            if not any(truth.faults & FAULT_NAMES.get(name, set()) for truth in self.tape.last(state.stamp, 4.0)):
                wrong.append(f"fault {name}")
        usable = state.phase in (Phase.READY, Phase.MOVING)
        if usable and (stopped or all(truth.faults for truth in near)):
            wrong.append("usable")
        if state.activated and not any(truth.echo[0] for truth in near):
            wrong.append("activated")
        return wrong + self._check_power(state, near)

    def _check_power(self, state: GripperState, near: list[TrueGripper]) -> list[str]:
        awake = all(truth.echo[0] and truth.mode is Mode.GRIPPER for truth in near)
        lost = state.phase is Phase.LOST and all(fault.kind is not FaultKind.OTHER_MASTER for fault in self.injected)
        return ["not activated"] * (state.phase is Phase.READY and awake and not state.activated) + ["lost"] * lost

    def _check_values(self, state: GripperState, near: list[TrueGripper]) -> list[str]:
        wrong = []
        # a controller that ceases to be a gripper freezes its position byte, which only a calibration finds out
        if not math.isnan(state.opening) and all(truth.configured for truth in near):
            position = self._settings.counts_of(state.opening)
            # the reply tells a position between the stops
            error = min(abs(position - min(max(truth.position, 0.0), 255.0)) for truth in near)
            self.worst["place [counts]"] = max(self.worst["place [counts]"], error)
            wrong += ["opening"] * (error > POSITION_TOLERANCE)
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
            position = self._settings.counts_of(goal)
            right = any(abs(truth.position - position) <= GOAL_TOLERANCE for truth in recent)
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
        positions = [truth.position for truth in self._tape.last(self._tape.now, 0.2)] + (
            [] if goal is None else [goal]
        )
        low, high = min(positions) - 4.0, max(positions) + 4.0
        return [] if low <= order.position <= high else ["motion beyond what was asked for"]


@dataclass(kw_only=True)
class Tally:
    """What came out of some runs: counters, counts and lists that add up, and largest values by name."""

    def add(self, other: Tally) -> None:
        """Add another tally of the same kind."""
        for name, value in vars(other).items():
            own = getattr(self, name)
            if isinstance(value, Counter):
                own.update(value)
            elif isinstance(value, dict):
                own |= {key: max(own.get(key, 0.0), largest) for key, largest in value.items()}
            else:
                setattr(self, name, own + value)

    def plain(self) -> dict[str, Any]:
        """Return counts, or counts by what they count, by name."""
        return {name: dict(value) if isinstance(value, Counter) else value for name, value in vars(self).items()}


@dataclass(kw_only=True)
class FaultTally(Tally):
    """What came out of runs with faults."""

    faults: Counter[str] = field(default_factory=Counter)
    wrong: Counter[str] = field(default_factory=Counter)
    motion: Counter[str] = field(default_factory=Counter)
    crashes: Counter[str] = field(default_factory=Counter)
    hangs: int = 0
    unrecovered: int = 0
    states: int = 0
    orders: int = 0
    phases: Counter[str] = field(default_factory=Counter)
    outcomes: Counter[str] = field(default_factory=Counter)
    worst: dict[str, float] = field(default_factory=dict)
    violations: Counter[str] = field(default_factory=Counter)
