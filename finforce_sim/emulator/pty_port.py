"""A pseudo-terminal with an emulated adapter behind it, in real time, and the program that opens one."""

from __future__ import annotations

import argparse
import os
import pty
import select
import sys
import termios
import tty
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from threading import Event, RLock, Thread
from time import monotonic
from types import TracebackType

from finforce.errors import FinforceError
from finforce.signals import StopSignals
from finforce_driver.errors import LinkError, TargetError
from finforce_sim.emulator.adapter import ACK_MODES, EmulatedAdapter
from finforce_sim.emulator.control import VARIANTS
from finforce_sim.emulator.faults import FaultyAdapter, draw_plan
from finforce_sim.emulator.firmware import EmulatedGripper

_IDLE_PERIOD = 0.004  # [s] between two steps of the emulation while nothing comes in
_BUSY_PERIOD = 0.0005  # [s] the same while an answer waits for its time
_LARGEST_READ = 4096
_GARBLED = bytes(0x80 | (byte * 5 & 0x7F) for byte in range(256))  # what a receiver at another speed takes for bytes


class PtyPort:
    """A serial port that another program can open; a thread steps the emulation and answers.

    Whoever changes the emulation from another thread holds `lock` meanwhile. Reading a single value needs no lock.

    Attributes:
        adapter: behind the port.
        lock: held by the thread while it steps and answers.
    """

    def __init__(self, adapter: EmulatedAdapter, link: str | Path | None = None, baud_rate: int | None = None) -> None:
        """Prepare a port; `open` makes it.

        Args:
            adapter: behind the port.
            link: path of a symbolic link to the port, whose own name changes each time; None: no link.
            baud_rate: that the other side must set, else both sides get garbage; None: any, as with USB adapters.

        Raises:
            TargetError: there is no such baud rate.
        """
        self.adapter = adapter
        self.lock = RLock()
        self._link = Path(link) if link is not None else None
        self._speed = None if baud_rate is None else getattr(termios, f"B{baud_rate}", None)
        if baud_rate is not None and self._speed is None:
            raise TargetError(f"baud_rate: got {baud_rate!r}, expected one that termios knows, such as 115200")
        self._master = self._slave = -1
        self._name = ""
        self._stop = Event()
        self._thread: Thread | None = None

    @property
    def path(self) -> str:
        """Return what another program opens: the link, or without one the port itself ("" while unplugged)."""
        return str(self._link) if self._link is not None else self._name

    def open(self) -> None:
        """Make the port and start the emulation.

        Raises:
            LinkError: something that is no link lies where the link should be.
        """
        if self._thread is not None:
            return
        self._make_port()
        self._stop.clear()
        self._thread = Thread(target=self._serve, name="emulated gripper", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Stop the emulation and remove the port; may be called again."""
        if self._thread is None:
            return
        self._stop.set()
        self._thread.join()
        self._thread = None
        self._drop_port()

    def unplug(self) -> None:
        """Take the adapter away: the link is gone, who has the port open gets an error; the gripper lives on."""
        with self.lock:
            self.adapter.unplug()
            self._follow_adapter()

    def replug(self) -> None:
        """Plug the adapter in again, closed, under the same link."""
        with self.lock:
            self.adapter.replug()
            self._follow_adapter()

    def __enter__(self) -> PtyPort:
        self.open()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _follow_adapter(self) -> None:
        """Let the port come and go with the adapter, which may unplug itself."""
        if self.adapter.plugged and self._master < 0:
            self._make_port()
        elif not self.adapter.plugged:
            self._drop_port()

    def _make_port(self) -> None:
        if self._link is not None and self._link.exists() and not self._link.is_symlink():
            raise LinkError(f"{self._link}: a file lies there, expected nothing or a link; name another path")
        self._master, self._slave = pty.openpty()  # an open slave keeps the master readable while nobody uses it
        tty.setraw(self._slave)
        os.set_blocking(self._master, False)
        self._name = os.ttyname(self._slave)
        if self._link is not None:
            self._link.parent.mkdir(parents=True, exist_ok=True)
            temporary = self._link.with_name(f".{self._link.name}.{os.getpid()}")
            temporary.unlink(missing_ok=True)
            temporary.symlink_to(self._name)
            temporary.replace(self._link)

    def _drop_port(self) -> None:
        if self._master < 0:
            return
        if self._link is not None and self._link.is_symlink() and os.readlink(self._link) == self._name:
            self._link.unlink()
        os.close(self._master)
        os.close(self._slave)
        self._master = self._slave = -1
        self._name = ""

    def _serve(self) -> None:
        last = monotonic()
        while not self._stop.is_set():
            self._await_input()
            with self.lock:
                now = monotonic()
                self.adapter.step(now - last)
                last = now
                self._follow_adapter()
                self._exchange()

    def _await_input(self) -> None:
        period = _BUSY_PERIOD if self.adapter.has_output else _IDLE_PERIOD
        master = self._master
        try:
            select.select([master] if master >= 0 else [], [], [], period)
        except OSError:  # unplugged just now
            self._stop.wait(period)

    def _exchange(self) -> None:
        if self._master < 0:
            return
        garbles = self._speed is not None and termios.tcgetattr(self._slave)[4] != self._speed
        with suppress(BlockingIOError):  # nothing came
            data = os.read(self._master, _LARGEST_READ)
            self.adapter.write(data.translate(_GARBLED) if garbles else data)
        answer = self.adapter.read()
        if not answer:
            return
        with suppress(BlockingIOError):  # nobody reads, and the buffer is full: an adapter loses it too
            os.write(self._master, answer.translate(_GARBLED) if garbles else answer)


_FAULTS = 10_000  # planned ahead


def build_parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    parser = argparse.ArgumentParser(
        prog="python -m finforce_sim.emulator", description="An emulated SSG-48 behind a pseudo-terminal (SLCAN)."
    )
    parser.add_argument("--link", help="path of a symbolic link to the port")
    parser.add_argument("--variant", choices=tuple(VARIANTS), default="new", help="of the firmware")
    parser.add_argument("--node", type=int, default=0, help="of the gripper on the CAN bus, 0 to 15")
    parser.add_argument("--object-mm", type=float, help="width of what is between the jaws [mm]; without: nothing")
    parser.add_argument("--stiffness", type=float, help="of that object [N per mm of opening]; without: rigid")
    parser.add_argument("--ack", choices=ACK_MODES, default="none", help="answers of the adapter")
    parser.add_argument("--baud", type=int, help="that the other side must set; without: any")
    parser.add_argument("--latency-ms", type=float, default=0.0, help="from the bus to the host [ms]")
    parser.add_argument("--faults", type=float, default=0.0, help="random faults per minute, every kind")
    parser.add_argument("--seed", type=int, default=0, help="of the random faults")
    return parser


def build_load(width: float, stiffness: float) -> Callable[[float], float]:
    """Return the grip force [N] by opening [m] of a spring of a free width [m] and a stiffness [N/m]."""
    return lambda opening: stiffness * max(width - opening, 0.0)


def build_adapter(options: argparse.Namespace) -> EmulatedAdapter:
    """Return the adapter with the gripper that a command line describes.

    Raises:
        TargetError: a value is out of bounds.
    """
    width = None if options.object_mm is None else 1e-3 * options.object_mm
    soft = width is not None and options.stiffness is not None
    gripper = EmulatedGripper(
        options.variant,
        options.node,
        object_opening=None if soft else width,
        load=build_load(width, 1e3 * options.stiffness) if soft else None,
    )
    plan = draw_plan(options.seed, _FAULTS, 60.0 / options.faults) if options.faults > 0.0 else ()
    return FaultyAdapter(gripper, plan, options.seed, ack_mode=options.ack, latency=1e-3 * options.latency_ms)


def main(arguments: Sequence[str] | None = None) -> int:
    """Serve an emulated gripper until Ctrl-C or a request to end; return the exit status."""
    options = build_parser().parse_args(arguments)
    try:
        with StopSignals() as stop, PtyPort(build_adapter(options), options.link, options.baud) as port:
            print(port.path, flush=True)
            while not stop.wait():  # another handled signal wakes it, too
                pass
    except FinforceError as error:
        print(error, file=sys.stderr)
        return 2
    return 0
