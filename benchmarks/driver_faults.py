"""Ten thousand random faults between the gripper driver and an emulated gripper: wrong states, hangs, crashes, motion.

    python benchmarks/driver_faults.py [--json report/driver_faults.json] [--faults 10000] [--seed 1]

Driver and gripper live in stepped time, in runs of 100 faults of every kind that the emulator can inject, on both
firmware variants and with adapters of different latencies, while a user moves, holds, stops, clears and calibrates at
random and objects come and go. Every state that the driver reports is compared with the truth (`driver_oracle.py`),
every order that leaves with what was asked for. At the end of a run the faults cease, and the gripper has to get back
to work.
"""

from __future__ import annotations

import argparse
import logging
import time
from collections.abc import Sequence
from dataclasses import replace
from random import Random

from driver_oracle import Guard, Oracle, Tape
from driver_tally import FaultTally, print_tally, tally_json
from tqdm import tqdm

from finforce_driver.can.bus import CanMessage
from finforce_driver.can.protocol import Command, decode_move, split_identifier
from finforce_driver.emulator.adapter import EmulatedAdapter
from finforce_driver.emulator.faults import LINE_FAULTS, FaultKind, FaultyAdapter, draw_plan
from finforce_driver.emulator.firmware import EmulatedGripper
from finforce_driver.emulator.protection import Fault
from finforce_driver.emulator.virtual import VirtualBus, VirtualClock
from finforce_driver.errors import DriverError
from finforce_driver.gripper import Gripper
from finforce_driver.settings import GripperSettings
from finforce_driver.state import GripperState, MoveOutcome, Phase
from finforce_eval.evaluation.machine import describe_machine, write_figures

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
        tracing: print what happens.
    """

    def __init__(self, seed: int, count: int, kinds: Sequence[FaultKind], tracing: bool = False) -> None:
        self.tally = FaultTally()
        self._random = Random(seed)
        self._tracing = tracing
        self._until = START + count * PERIOD
        self.clock, self.emulated = VirtualClock(), EmulatedGripper(("new", "old")[seed % 2])
        sound = EmulatedAdapter(
            self.emulated, self._random.choice(("none", "lawicel")), latency=self._random.choice(LATENCIES)
        )
        plan = [replace(fault, time=fault.time + START) for fault in draw_plan(seed, count, PERIOD, kinds)]
        self.adapter = FaultyAdapter(sound, plan, seed)
        self.bus = VirtualBus(self.adapter, self.clock)
        self._send, self.bus.send = self.bus.send, self._watch_message
        self.tape = Tape(self.emulated)
        self.clock.attach(self.tape)
        settings = GripperSettings(poll_rate=self._random.choice((50.0, 100.0, 200.0)), telemetry_period=0.3)
        self.gripper = Gripper(self.bus, settings, self.clock)
        self.oracle, self.guard = Oracle(self.tape, self.gripper.scale), Guard(self.tape)
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
            if self._tracing:
                raise
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
            elif state.phase is Phase.UNCALIBRATED:
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
        complaints = self.oracle.check(state, self._goal, self._stopped, self._clearing)
        self._clearing &= state.estopped or self._stopped
        self.tally.wrong.update(complaints)
        if self._tracing and complaints:
            print(
                f"{self.clock.now():.3f} {complaints} {state}\n   {self.tape.truths[-1]} {self.adapter.injected[-3:]}"
            )

    def _watch_message(self, message: CanMessage) -> None:
        """Check a message that leaves."""
        if split_identifier(message.id).command == Command.MOVE and message.data:
            self.tally.orders += 1
            goal = self.gripper.scale.counts_of(self._goal) if self._allowed else None
            complaints = self.guard.check(decode_move(message), goal, self._stopped, self._allowed)
            self.tally.motion.update(complaints)
            if self._tracing and complaints:
                print(f"{self.clock.now():.3f} {complaints} {decode_move(message)} {self.gripper.state}")
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
                elif phase is Phase.UNCALIBRATED:
                    self._allowed = False
                    self.gripper.calibrate()
                elif phase in (Phase.READY, Phase.MOVING) and self._works():
                    return
                self.gripper.wait(lambda state, phase=phase: state.phase is not phase, 1.0)
            except DriverError:
                continue
        self.tally.unrecovered += 1
        if self._tracing:
            print("unrecovered", self.gripper.state)

    def _works(self) -> bool:
        """Return whether a move reaches its goal."""
        self.gripper.activate(True)
        self._goal, self._allowed = 0.030 if self.emulated.true_opening < 0.02 else 0.010, True
        self.gripper.move(self._goal, 0.1)
        state = self.gripper.wait(lambda state: state.phase is not Phase.MOVING, 5.0)
        way = self.tape.truths[-1].place - self.gripper.scale.counts_of(self._goal)
        return state.outcome is MoveOutcome.REACHED and abs(way) < 3.0


def choose_kinds(seed: int) -> tuple[FaultKind, ...]:
    """Return every kind of fault, or in every third run those on the line, between which the gripper gets about."""
    return tuple(LINE_FAULTS) if seed % 3 == 0 else tuple(FaultKind)


def run_all(faults: int, seed: int) -> FaultTally:
    """Return the tally of enough runs for a number of faults."""
    tally = FaultTally()
    with tqdm(total=faults, disable=None, leave=False) as bar:
        for index in range(-(-faults // PER_RUN)):
            run = FaultRun(seed + index, min(PER_RUN, faults - index * PER_RUN), choose_kinds(seed + index))
            tally.add(run.run())
            bar.update(PER_RUN)
    return tally


def main() -> None:
    """Run, print, write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--faults", type=int, default=10_000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--trace", action="store_true", help="one run with all that is wrong in it")
    parser.add_argument("--json")
    options = parser.parse_args()
    if options.trace:
        print_tally(FaultRun(options.seed, PER_RUN, choose_kinds(options.seed), tracing=True).run())
        return
    began = time.perf_counter()
    tally = run_all(options.faults, options.seed)
    print_tally(tally)
    machine = describe_machine()
    print(f"{time.perf_counter() - began:.0f} s on {machine['processor']}, {machine['commit']}")
    if options.json:
        figures = {name: tally_json(value) for name, value in vars(tally).items()}
        write_figures(options.json, {"seed": options.seed, **figures})


if __name__ == "__main__":
    main()
