"""Processes that nothing outlives, and the memory that one takes."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from contextlib import suppress
from time import monotonic
from typing import IO, Any

import psutil

from finforce.errors import FinforceError
from finforce.optional import check_middleware
from finforce.ros.transport import describe_domain
from finforce.systems.processes import RESPAWN_DELAY, SINGLE_THREAD, UNUSABLE, Process

# how long each signal is given before the next, harder one [s]
PATIENCE = ((signal.SIGINT, 5.0), (signal.SIGTERM, 3.0), (signal.SIGKILL, 3.0))


class ProcessError(FinforceError, RuntimeError):
    """A process of the graph could not be started, or has ended before its time."""


class ProcessGroup:
    """Runs processes as long as the `with` block lasts; none outlives it.

    Args:
        processes: commands to run, with this Python.
        environment: variables in addition to those of this process.
        quiet: keep what they print, of which a complaint has the last line; else they print to the terminal.
    """

    def __init__(self, processes: Sequence[Process], environment: Mapping[str, str], *, quiet: bool = True) -> None:
        check_middleware()
        self._processes, self._quiet = processes, quiet
        self._environment = {**os.environ, **SINGLE_THREAD, **environment}
        self._children: list[subprocess.Popen] = []
        self._logs: list[IO[bytes]] = []
        self._dead: dict[int, float] = {}  # places of processes, and when [s] they were seen to have ended

    def __enter__(self) -> ProcessGroup:
        if wrong := describe_domain(self._environment.get("ROS_DOMAIN_ID", "")):
            raise ProcessError(wrong)
        try:
            for process in self._processes:
                self._children.append(self._start(process))
        except BaseException:
            self.__exit__()
            raise
        return self

    def _start(self, process: Process) -> subprocess.Popen:
        log = tempfile.TemporaryFile()  # noqa: SIM115 - closed when the group ends
        self._logs.append(log)
        try:
            return subprocess.Popen(
                process.command(),
                env=self._environment,
                stdin=subprocess.DEVNULL,
                stdout=log if self._quiet else None,
                stderr=subprocess.STDOUT if self._quiet else None,
                start_new_session=True,  # Ctrl-C comes to us alone; we end the children in our order
            )
        except OSError as error:
            raise ProcessError(f"{process.label} cannot be started: {error}") from error

    @property
    def pids(self) -> dict[str, int]:
        """The process ids by what the processes are called."""
        return {process.label: child.pid for process, child in zip(self._processes, self._children, strict=True)}

    def check(self) -> None:
        """Make sure that all processes run.

        Raises:
            ProcessError: one has ended; with its last words.
        """
        for process, child, log in zip(self._processes, self._children, self._logs, strict=True):
            if child.poll() is not None:
                words = f": {last_words(log)}" if self._quiet else ""
                raise ProcessError(f"{process.label} ended with status {child.returncode}{words}")

    def has_finished(self) -> bool:
        """Start again what has died and may be; return whether the process that ends all has ended well, or all have.

        Raises:
            ProcessError: the settings of one cannot be used, or the process that ends all has failed.
        """
        for index, (process, child) in enumerate(zip(self._processes, self._children, strict=True)):
            status = child.poll()
            if status is None:
                continue
            if status == UNUSABLE or (status and process.ends_all):
                raise ProcessError(f"{process.label} ended with status {status}")
            if process.ends_all:
                return True
            if index not in self._dead:
                self._dead[index] = monotonic()
                then = "it is started again" if process.respawns else "the others go on"
                print(f"{process.label} ended with status {status}: {then}", file=sys.stderr)
            elif process.respawns and monotonic() > self._dead[index] + RESPAWN_DELAY:
                del self._dead[index]
                self._children[index] = self._start(process)
        return len(self._dead) == len(self._children) and not any(process.respawns for process in self._processes)

    def __exit__(self, *_: Any) -> None:
        for number, patience in PATIENCE:
            for child in self._children:
                if child.poll() is None:
                    with suppress(ProcessLookupError):
                        os.killpg(child.pid, number)  # and what it has started itself
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


def last_words(log: IO[bytes]) -> str:
    """Return the last line of a log that says something."""
    log.seek(0)
    lines = [line.strip() for line in log.read().decode(errors="replace").splitlines() if line.strip()]
    return lines[-1] if lines else "it said nothing"


def begin_shares(pids: Mapping[str, int]) -> dict[str, psutil.Process]:
    """Begin to measure the CPU use of processes; see `end_shares`."""
    processes = {name: psutil.Process(pid) for name, pid in pids.items()}
    for process in processes.values():
        process.cpu_percent()
    return processes


def end_shares(processes: Mapping[str, psutil.Process]) -> dict[str, float]:
    """Return the CPU use of processes since they began to be measured, all threads [% of one core]; NaN of one gone."""
    shares = dict.fromkeys(processes, float("nan"))
    for name, process in processes.items():
        with suppress(psutil.Error):
            shares[name] = process.cpu_percent()
    return shares


def resident_bytes(pid: int | None = None) -> int:
    """Return the resident memory of a process [bytes], this one without an id; 0 when it has gone."""
    with suppress(psutil.Error):
        return psutil.Process(pid).memory_info().rss
    return 0
