"""A pseudo-terminal with an emulated adapter behind it, in real time."""

from __future__ import annotations

import os
import pty
import select
import tty
from contextlib import suppress
from pathlib import Path
from threading import Event, Lock, Thread
from time import monotonic

from finforce_driver.errors import LinkError
from finforce_sim.emulator.adapter import EmulatedAdapter

_IDLE_PERIOD = 0.004  # [s] between two steps of the emulation while nothing comes in
_BUSY_PERIOD = 0.0005  # [s] the same while an answer waits for its time
_LARGEST_READ = 4096


class PtyPort:
    """A serial port that another program can open; a thread steps the emulation and answers.

    Whoever changes the emulation from another thread holds `lock` meanwhile. Reading a single value needs no lock.

    Attributes:
        adapter: behind the port.
        lock: held by the thread while it steps and answers.
    """

    def __init__(self, adapter: EmulatedAdapter, link: str | Path | None = None) -> None:
        """Prepare a port; `open` makes it.

        Args:
            adapter: behind the port.
            link: path of a symbolic link to the port, whose own name changes each time; None: no link.
        """
        self.adapter = adapter
        self.lock = Lock()
        self._link = Path(link) if link is not None else None
        self._master = self._slave = -1
        self._name = ""
        self._stop = Event()
        self._thread: Thread | None = None

    @property
    def path(self) -> str:
        """Return what another program opens: the link, or without one the port itself ("" while closed)."""
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
        if self._link is not None and self._link.is_symlink() and os.readlink(self._link) == self._name:
            self._link.unlink()
        os.close(self._master)
        os.close(self._slave)
        self._name = ""

    def __enter__(self) -> PtyPort:
        self.open()
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

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

    def _serve(self) -> None:
        last = monotonic()
        while not self._stop.is_set():
            period = _BUSY_PERIOD if self.adapter.has_output else _IDLE_PERIOD
            select.select([self._master], [], [], period)
            with self.lock:
                now = monotonic()
                self.adapter.step(now - last)
                last = now
                self._exchange()

    def _exchange(self) -> None:
        with suppress(BlockingIOError):  # nothing came
            self.adapter.write(os.read(self._master, _LARGEST_READ))
        answer = self.adapter.read()
        if not answer:
            return
        with suppress(BlockingIOError):  # nobody reads, and the buffer is full: an adapter loses it too
            os.write(self._master, answer)
