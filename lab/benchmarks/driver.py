"""The gripper driver in real time on a pseudo-terminal, the emulated gripper in a process of its own; table and JSON.

    python -m lab.benchmarks.driver [--json report/driver.json] [--seconds 600] [--commands 300] [--stops 40]

- **rate**: believed replies per second and lost replies, at 50 Hz at rest and at 200 Hz with slow moves; what a reply
  that is doubted is asked for again comes on top.
- **command to first byte**: from the call of `move` to the write of its first byte to the port, at 50 Hz.
- **E-stop to last motion order**: from the call of `estop` to the last order that would move, while another thread
  commands moves without pause; 0 where none left after the call.
- **E-stop to its first byte**: from the call to the write.

The times are of this machine under its present load.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from threading import Event, Thread
from typing import Any

import numpy as np
from tqdm import tqdm

from finforce_driver.can.bus import CanMessage
from finforce_driver.can.protocol import Command, decode_move, split_identifier
from finforce_driver.can.serial_bus import SerialBus
from finforce_driver.errors import DriverError
from finforce_driver.gripper import Gripper
from finforce_driver.settings import GripperSettings
from finforce_driver.state import Phase
from finforce_eval.machine import describe_machine, write_figures
from lab.bench.bench import row_from_times

STARTED = 10.0  # [s] that the emulator may take


@dataclass(frozen=True, kw_only=True)
class Rate:
    """What a time of polling gave."""

    name: str
    seconds: float
    asked_Hz: float
    replies_per_s: float
    lost: int
    longest_gap_ms: float
    processor_pct: float


class WatchedBus(SerialBus):
    """A bus that keeps when orders went out.

    Attributes:
        orders: order and time [s] at which the write of its first byte began.
    """

    def __init__(self, port: str) -> None:
        super().__init__(port)
        self.orders: list[tuple[Any, float]] = []

    def send(self, message: CanMessage) -> None:
        """Send, and keep orders."""
        began = time.monotonic()
        super().send(message)
        if split_identifier(message.id).command == Command.MOVE and message.data:
            self.orders.append((decode_move(message), began))


@contextmanager
def emulated_port() -> Iterator[str]:
    """Give the port of an emulated gripper that runs in a process of its own."""
    with tempfile.TemporaryDirectory() as folder:
        link = Path(folder) / "gripper"
        command = [sys.executable, "-m", "finforce_sim.emulator", "--link", str(link)]
        process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        try:
            process.stdout.readline()
            yield str(link)
        finally:
            process.terminate()
            process.wait(STARTED)


@contextmanager
def ready_gripper(port: str, poll_rate: float) -> Iterator[tuple[Gripper, WatchedBus]]:
    """Give a gripper that is calibrated, with its bus."""
    bus = WatchedBus(port)
    with Gripper(bus, GripperSettings(poll_rate=poll_rate)) as gripper:
        state = gripper.wait(lambda state: state.phase in (Phase.UNCALIBRATED, Phase.READY, Phase.FAULT), STARTED)
        if state.phase is Phase.FAULT:
            gripper.clear_errors()
            gripper.wait(lambda state: state.phase is not Phase.FAULT, 2.0)
        if not gripper.state.calibrated:
            gripper.calibrate()
        gripper.wait(lambda state: state.phase is Phase.READY, 40.0)
        yield gripper, bus


def measure_rate(port: str, poll_rate: float, seconds: float, moving: bool) -> Rate:
    """Return how often the gripper was heard."""
    with ready_gripper(port, poll_rate) as (gripper, _):
        stamps: list[float] = []
        lost = gripper.state.counts.get("lost replies", 0)
        gripper.listen(lambda state: stamps.append(state.stamp))
        began, used, name = time.monotonic(), time.process_time(), f"{poll_rate:g} Hz" + (", moving" if moving else "")
        for _ in tqdm(range(max(1, round(seconds))), desc=name, disable=None, leave=False):
            if moving:
                gripper.move(0.040 if gripper.state.opening < 0.02 else 0.005, 0.004)
            time.sleep(1.0)
        spent = time.monotonic() - began
        times = np.unique(stamps)
        return Rate(
            name=name,
            seconds=spent,
            asked_Hz=poll_rate,
            replies_per_s=len(times) / spent,
            lost=gripper.state.counts.get("lost replies", 0) - lost,
            longest_gap_ms=1e3 * float(np.max(np.diff(times))),
            processor_pct=100.0 * (time.process_time() - used) / spent,
        )


def measure_commands(port: str, count: int) -> list[float]:
    """Return times from the call of a move to its first byte [s]."""
    random = np.random.default_rng(1)
    times = []
    with ready_gripper(port, 50.0) as (gripper, bus):
        for index in tqdm(range(count), desc="commands", disable=None, leave=False):
            time.sleep(random.uniform(0.02, 0.06))
            before, called = len(bus.orders), time.monotonic()
            gripper.move(0.010 + 0.0004 * (index % 50), 0.1)
            gripper.wait(lambda _, before=before: len(bus.orders) > before, 1.0)
            times.append(bus.orders[before][1] - called)
    return times


def measure_stops(port: str, count: int) -> dict[str, list[float]]:
    """Return times from the call of an emergency stop to the last motion order and to its own first byte [s]."""
    last, first = [], []
    with ready_gripper(port, 50.0) as (gripper, bus):
        for _ in tqdm(range(count), desc="emergency stops", disable=None, leave=False):
            done, thread = Event(), None
            thread = Thread(target=_command_without_pause, args=(gripper, done), daemon=True)
            thread.start()
            time.sleep(0.2)
            called = time.monotonic()
            gripper.estop()
            time.sleep(0.3)
            done.set()
            thread.join()
            orders = [(order, sent) for order, sent in list(bus.orders) if sent >= called]
            last.append(max((sent - called for order, sent in orders if order.drives), default=0.0))
            first.append(next(sent - called for order, sent in orders if not order.drives))
            gripper.clear_errors()
            gripper.wait(lambda state: state.phase is Phase.READY, 3.0)
    return {"E-stop to last motion order": last, "E-stop to its first byte": first}


def _command_without_pause(gripper: Gripper, done: Event) -> None:
    """Command one move after the other."""
    index = 0
    while not done.is_set():
        index += 1
        with suppress(DriverError):
            gripper.move(0.010 + 0.0004 * (index % 50), 0.1)
        time.sleep(0.001)


def main() -> None:
    """Measure, print, write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=600.0, help="of polling, for each of the rates")
    parser.add_argument("--commands", type=int, default=300)
    parser.add_argument("--stops", type=int, default=40)
    parser.add_argument("--json")
    options = parser.parse_args()
    with emulated_port() as port:
        times = {"command to first byte": measure_commands(port, options.commands)}
        times |= measure_stops(port, options.stops)
        rows = [row_from_times(name, values) for name, values in times.items()]
        rates = [
            measure_rate(port, poll_rate, options.seconds, moving)
            for poll_rate, moving in ((50.0, False), (200.0, True))
        ]
    for row in rows:
        figures = f"p50 {row.p50:6.2f}  p95 {row.p95:6.2f}  p99 {row.p99:6.2f}  max {row.max:6.2f} ms"
        print(f"{row.name:<30} {figures}  n {row.n}")
    for rate in rates:
        figures = f"{rate.replies_per_s:6.1f} believed replies/s over {rate.seconds:.0f} s, {rate.lost} lost"
        print(
            f"{rate.name:<30} {figures}, longest gap {rate.longest_gap_ms:.1f} ms, {rate.processor_pct:.1f} % of a core"
        )
    machine = describe_machine()
    print(f"{machine['processor']}, {machine['cores']} cores, {machine['commit']}")
    if options.json:
        write_figures(
            options.json, {"times_ms": [asdict(row) for row in rows], "rates": [asdict(rate) for rate in rates]}
        )


if __name__ == "__main__":
    main()
