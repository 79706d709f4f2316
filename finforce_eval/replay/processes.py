"""The processes of a graph as children of this one: started, watched, and all of them ended."""

from __future__ import annotations

import os
import signal
import subprocess
import tempfile
from collections.abc import Mapping, Sequence
from contextlib import suppress
from time import monotonic
from typing import IO, Any

from finforce.errors import FinforceError
from finforce.systems.processes import SINGLE_THREAD, Process

# how long each signal is given before the next, harder one [s]
PATIENCE = ((signal.SIGINT, 5.0), (signal.SIGTERM, 3.0), (signal.SIGKILL, 3.0))


class ProcessError(FinforceError, RuntimeError):
    """A process of the graph could not be started, or has ended before its time."""


class ProcessGroup:
    """Runs processes as long as the `with` block lasts; none outlives it.

    Args:
        processes: what to run, with this Python.
        environment: variables beside those of this process.
    """

    def __init__(self, processes: Sequence[Process], environment: Mapping[str, str]) -> None:
        self._processes = processes
        self._environment = {**os.environ, **SINGLE_THREAD, **environment}
        self._children: list[subprocess.Popen] = []
        self._logs: list[IO[bytes]] = []

    def __enter__(self) -> ProcessGroup:
        try:
            for process in self._processes:
                self._start(process)
        except BaseException:
            self.__exit__()
            raise
        return self

    def _start(self, process: Process) -> None:
        log = tempfile.TemporaryFile()  # noqa: SIM115 - closed when the group ends
        self._logs.append(log)
        try:
            child = subprocess.Popen(
                process.command(),
                env=self._environment,
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=subprocess.STDOUT,
                start_new_session=True,  # Ctrl-C comes to us alone; we end the children in our order
            )
        except OSError as error:
            raise ProcessError(f"{process.name} cannot be started: {error}") from error
        self._children.append(child)

    def check(self) -> None:
        """Make sure that all processes run.

        Raises:
            ProcessError: one has ended; with its last words.
        """
        for process, child, log in zip(self._processes, self._children, self._logs, strict=True):
            if child.poll() is not None:
                words = last_words(log)
                raise ProcessError(f"{process.name} ended with status {child.returncode}: {words}")

    def __exit__(self, *_: Any) -> None:
        for number, patience in PATIENCE:
            for child in self._children:
                if child.poll() is None:
                    _signal_group(child, number)
            deadline = monotonic() + patience
            for child in self._children:
                try:
                    child.wait(max(0.0, deadline - monotonic()))
                except subprocess.TimeoutExpired:
                    break
            else:
                break
        for log in self._logs:
            log.close()


def _signal_group(child: subprocess.Popen, number: int) -> None:
    """Send a signal to a child and what it has started itself."""
    with suppress(ProcessLookupError):
        os.killpg(child.pid, number)


def last_words(log: IO[bytes]) -> str:
    """Return the last line of a log that says something."""
    log.seek(0)
    lines = [line.strip() for line in log.read().decode(errors="replace").splitlines() if line.strip()]
    return lines[-1] if lines else "it said nothing"
