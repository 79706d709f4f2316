"""Waiting in the main thread until the process is told to end.

A handler of Python runs in the main thread between any two instructions, so also while that thread holds the lock of
an `Event` that it waits for: a handler that sets the event then waits for a lock that it holds itself, for ever. Here
the interpreter's own C handler writes the signal's number to a socket, and whoever waits reads it. No lock is taken.
"""

from __future__ import annotations

import select
import signal
import socket
from contextlib import suppress
from typing import Any

STOPS = (signal.SIGINT, signal.SIGTERM)


class StopSignals:
    """A `with` block in which SIGINT and SIGTERM end the waiting of the main thread instead of the process."""

    def __init__(self) -> None:
        self._stopped = False
        self._reader, self._writer = socket.socketpair()
        self._reader.setblocking(False)
        self._writer.setblocking(False)
        self._handlers: dict[int, Any] = {}
        self._wakeup = -1

    def __enter__(self) -> StopSignals:
        self._wakeup = signal.set_wakeup_fd(self._writer.fileno(), warn_on_full_buffer=False)
        # that there is a handler keeps the signal from ending the process
        self._handlers = {number: signal.signal(number, lambda *_: None) for number in STOPS}
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._handlers.items():
            signal.signal(number, handler)
        signal.set_wakeup_fd(self._wakeup)
        self._reader.close()
        self._writer.close()

    def wait(self, seconds: float | None = None) -> bool:
        """Return whether the process has been told to end, within some time [s] or, without one, as soon as it is."""
        if not self._stopped:
            select.select([self._reader], [], [], seconds)
            with suppress(BlockingIOError):
                self._stopped = any(number in STOPS for number in self._reader.recv(4096))
        return self._stopped
