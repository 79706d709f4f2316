"""Processes that nothing outlives, and the share of a core that each takes."""

from __future__ import annotations

import os
import signal
import subprocess
import tempfile
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
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
            raise ProcessError(f"{process.label} cannot be started: {error}") from error
        self._children.append(child)

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
                words = last_words(log)
                raise ProcessError(f"{process.label} ended with status {child.returncode}: {words}")

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


TICKS = os.sysconf("SC_CLK_TCK")  # of /proc/<pid>/stat, per second
UTIME, STIME = 11, 12  # fields 14 and 15 of proc(5), counted from the state, which follows the name in parentheses


@dataclass(frozen=True, kw_only=True)
class _Reading:
    """What processes had used at a time: CPU time [s] by name, None for one that had gone, and the time [s]."""

    seconds: Mapping[str, float | None]
    time: float


def cpu_seconds(process: str | int = "self", proc: Path | str = "/proc") -> float | None:
    """Return the CPU time that a process has used in user and system mode, all its threads [s]; None when it is gone.

    Args:
        process: its id, or "self".
        proc: where the kernel tells of processes.
    """
    try:
        text = (Path(proc) / str(process) / "stat").read_text(encoding="utf-8", errors="replace")
    except (FileNotFoundError, ProcessLookupError):
        return None
    fields = text.rsplit(")", 1)[1].split()
    # a process that ended and was not waited for yet has a stat, but stands still
    return None if fields[0] in "ZX" else (int(fields[UTIME]) + int(fields[STIME])) / TICKS


def busy_seconds(proc: Path | str = "/proc") -> float:
    """Return the CPU time that everything on the machine has used since it started, over all cores [s]."""
    line = (Path(proc) / "stat").read_text(encoding="ascii").splitlines()[0]
    user, nice, system, _, _, interrupts, soft, stolen = (int(word) for word in line.split()[1:9])
    return (user + nice + system + interrupts + soft + stolen) / TICKS


class CpuMeter:
    """CPU shares of processes between the first and the last sample; all threads of a process count.

        share = 100 % (utime + stime at the last sample - at the first) / (time of the last - of the first)

    Resolution: a tick of 10 ms, thus 0.1 % of a core over 10 s.

    Args:
        pids: ids by name.
        clock: time [s], monotonic.
        read: CPU time [s] of a process id, None when it has gone.
    """

    def __init__(
        self,
        pids: Mapping[str, int],
        *,
        clock: Callable[[], float] = monotonic,
        read: Callable[[int], float | None] = cpu_seconds,
    ) -> None:
        """Take no sample yet."""
        self._pids = dict(pids)
        self._clock, self._read = clock, read
        self._first: _Reading | None = None
        self._last: _Reading | None = None

    def sample(self) -> None:
        """Take a sample: the first begins the stretch that is measured, every later one is its end so far."""
        seconds = {name: self._read(pid) for name, pid in self._pids.items()}
        self._last = _Reading(seconds=seconds, time=self._clock())
        self._first = self._first or self._last

    def restart(self) -> None:
        """Begin a new stretch at the present time."""
        self._first = None
        self.sample()

    @property
    def elapsed(self) -> float:
        """Time between the first and the last sample [s]; 0 without two."""
        return self._last.time - self._first.time if self._last else 0.0

    def used(self) -> dict[str, float]:
        """Return the CPU time [s] by name that was used over the stretch; NaN for a process that has gone."""
        if self._first is None:
            return dict.fromkeys(self._pids, float("nan"))
        return {name: _less(self._last.seconds[name], self._first.seconds[name]) for name in self._pids}

    def shares(self) -> dict[str, float]:
        """Return the CPU use by name [% of one core]; NaN without two samples, or for a process that has gone."""
        elapsed = self.elapsed
        return {name: 100.0 * used / elapsed if elapsed > 0.0 else float("nan") for name, used in self.used().items()}


def _less(after: float | None, before: float | None) -> float:
    """Return a difference, NaN where one of both is not known."""
    return float("nan") if after is None or before is None else after - before


def resident_bytes(process: str | int = "self") -> int:
    """Return the resident memory of a process [bytes]; 0 when it has gone."""
    try:
        pages = int(Path(f"/proc/{process}/statm").read_text(encoding="ascii").split()[1])
    except (FileNotFoundError, ProcessLookupError):
        return 0
    return pages * os.sysconf("SC_PAGE_SIZE")


def child_processes(parent: int) -> list[int]:
    """Return the processes that a process has started itself."""
    found: set[int] = set()
    for path in Path(f"/proc/{parent}/task").glob("*/children"):
        found.update(int(word) for word in path.read_text(encoding="ascii").split())
    return sorted(found)
