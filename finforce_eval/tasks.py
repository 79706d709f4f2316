"""A task per recording: carried out here or on a cluster, each done once even if a run is killed."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass, field
from multiprocessing import current_process
from pathlib import Path
from threading import current_thread, main_thread
from time import perf_counter
from typing import Any
from uuid import uuid4

from finforce.errors import FinforceError, one_line
from finforce_eval.errors import OptionError
from finforce_eval.machine import version, without_nan

OK, FAILED = "ok", "failed"
_LARGEST_MEMORY = 1e6  # [GB]
_OLD_MANIFESTS = "manifest*.jsonl"  # names in earlier versions, also of parts of a run
Line = dict[str, Any]


@dataclass(frozen=True, kw_only=True)
class Task:
    """One recording's work.

    Attributes:
        name: of the recording, of its own among the tasks.
        key: hash of all that the outcome depends on.
        work: a function of a module, which another process can import; returns figures.
        given: arguments of `work`.
        output: file or folder that is there once it is done; "" without one.
        files: that it reads, of which a worker of a cluster must see the first ones as they are here.
    """

    name: str
    key: str
    work: Callable[..., Mapping[str, Any]]
    given: Mapping[str, Any] = field(default_factory=dict)
    output: str = ""
    files: Sequence[Path] = ()

    def is_done(self, line: Mapping[str, Any] | None) -> bool:
        """Say whether a line of the manifest tells that the task is done, and what it made is still there."""
        told = line is not None and line.get("status") == OK and line.get("key") == self.key
        return told and (not self.output or Path(self.output).exists())

    def run(self) -> Line:
        """Return the line of the manifest; whatever the work raises is its own failure."""
        began, figures, error = perf_counter(), {}, ""
        try:
            figures = without_nan(dict(self.work(**self.given)))
        except (FinforceError, OSError, MemoryError) as failure:
            error = one_line(failure)
        except Exception as failure:  # what nobody foresaw costs this recording alone
            error = f"{type(failure).__name__}: {one_line(failure)}"
        return self.line(error, figures, round(perf_counter() - began, 3))

    def line(self, error: str = "", figures: Mapping[str, Any] | None = None, seconds: float = 0.0) -> Line:
        """Return the line of the manifest for the task once it has ended; it has failed where there is an error."""
        return {
            "name": self.name,
            "key": self.key,
            "status": FAILED if error else OK,
            "error": error,
            "figures": dict(figures or {}),
            "version": version(),
            "seconds": seconds,
        }


@dataclass(frozen=True, kw_only=True)
class EngineOptions:
    """The workers that carry out tasks; raises OptionError for settings out of bounds.

    Attributes:
        workers: processes on this machine; 1: this one, 0: one for each processor.
        memory: that each of several processes may have [GB]; 0: any.
        scheduler: address of a Dask scheduler, whose workers do the tasks; "" without one.
    """

    workers: int = 1
    memory: float = 4.0
    scheduler: str = ""

    def __post_init__(self) -> None:
        if self.workers < 0:
            raise OptionError(f"--workers {self.workers}: expected the number of recordings at once, or 0")
        if not 0.0 <= self.memory < _LARGEST_MEMORY:
            raise OptionError(f"--memory {self.memory}: expected gigabytes, or 0")
        if self.scheduler and self.workers != 1:
            raise OptionError(f"--scheduler and --workers {self.workers}: expected one of the two")


def is_manifest(path: Path) -> bool:
    """Say whether a file has the name of a manifest."""
    return (path.name == Manifest.NAME or path.match(_OLD_MANIFESTS)) and path.is_file()


class Manifest:
    """The lines of the tasks that have ended, in a file that grows by one whole line at a time.

    Args:
        folder: of the outputs; made if need be.
    """

    NAME = "_manifest.jsonl"  # readers of a folder of Parquet files pass over an underscore

    def __init__(self, folder: Path) -> None:
        self.path, self.lock, self.run_id = folder / self.NAME, folder / ".lock", uuid4().hex
        folder.mkdir(parents=True, exist_ok=True)

    @contextmanager
    def alone(self) -> Iterator[None]:
        """Keep other runs from the outputs; the file of the lock holds which run has it.

        Raises:
            OptionError: another run is at it.
        """
        import fcntl

        with self.lock.open("a+") as lock:
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError as error:
                folder = self.path.parent
                raise OptionError(f"{folder}: another run writes there; expected a folder of its own") from error
            lock.truncate(0)
            lock.write(self.run_id)
            lock.flush()
            os.fsync(lock.fileno())
            yield

    def read(self) -> dict[str, Line]:
        """Return the last line of every task by its name; a line that was cut off is none."""
        lines: dict[str, Line] = {}
        for path in (*sorted(self.path.parent.glob(_OLD_MANIFESTS)), self.path):
            for text in path.read_text(encoding="utf-8").splitlines() if path.exists() else ():
                try:
                    line = json.loads(text)
                except ValueError:
                    continue
                if isinstance(line, dict) and isinstance(line.get("name"), str):
                    lines[line["name"]] = line
        return lines

    def append(self, line: Line) -> None:
        """Add the line of a task that has ended, and see it to the disk."""
        with self.path.open("ab+") as file:
            if file.tell():
                file.seek(-1, os.SEEK_END)
                if file.read(1) != b"\n":  # cut off when the run before was killed
                    file.write(b"\n")
            file.write(json.dumps(line).encode() + b"\n")
            file.flush()
            os.fsync(file.fileno())


def run_tasks(tasks: Sequence[Task], options: EngineOptions, manifest: Manifest, unit: str = "recording") -> list[Line]:
    """Carry out the tasks that are not done yet, under one progress bar, and return the lines of all in their order.

    Args:
        tasks: with names of their own.
        options: where.
        manifest: where lines are kept; what it holds as done with the same key is not done again.
        unit: noun for a task, for the bar.

    Raises:
        MissingDependencyError: a cluster is asked for, and Dask is not installed.
        ClusterError: the cluster cannot be used, or was lost.
    """
    before = manifest.read()
    lines = {task.name: before[task.name] for task in tasks if task.is_done(before.get(task.name))}
    left = [task for task in tasks if task.name not in lines]
    with progress_bar(len(tasks), unit) as bar, closing(_run_all(left, options, manifest)) as ended:
        bar.update(len(lines))
        for line in ended:
            manifest.append(line)
            lines[line["name"]] = line
            bar.set_postfix_str(f"{sum(each['status'] == FAILED for each in lines.values())} failed")
            bar.update()
    return [lines[task.name] for task in tasks]


def _run_all(tasks: Sequence[Task], options: EngineOptions, manifest: Manifest) -> Iterator[Line]:
    """Yield the lines of tasks as these end."""
    if not tasks or (options.workers == 1 and not options.scheduler):
        yield from map(Task.run, tasks)
        return
    from finforce_eval.cluster import run_in_cluster

    yield from run_in_cluster(tasks, options, manifest)


def progress_bar(total: int, unit: str, name: str = "") -> Any:
    """Return a progress bar on a terminal; none on a worker, whose bars would overwrite those of others."""
    from tqdm import tqdm

    hidden = None if current_process().name == "MainProcess" and current_thread() is main_thread() else True
    return tqdm(total=total, unit=unit, desc=name or None, disable=hidden, leave=False)


def hash_settings(settings: Mapping[str, Any], files: Sequence[Path] = ()) -> str:
    """Return a name (16 hexadecimal digits) for settings, and for files by their paths, sizes and times of change."""
    digest = hashlib.sha256(json.dumps(settings, sort_keys=True, default=str).encode())
    for path in sorted(files):
        state = path.stat()
        digest.update(f"|{path}|{state.st_size}|{state.st_mtime_ns}".encode())
    return digest.hexdigest()[:16]
