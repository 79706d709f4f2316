"""A task per recording: carried out here or in processes, each done once even if a run is killed."""

from __future__ import annotations

import hashlib
import json
import os
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from multiprocessing import current_process
from pathlib import Path
from time import perf_counter
from typing import Any, TypeVar

from finforce.errors import FinforceError, one_line
from finforce_eval.errors import OptionError
from finforce_eval.machine import version, without_nan

OK, FAILED = "ok", "failed"
DIED = "the process that was at it died: out of memory, or killed"
_GIGABYTE, _LARGEST_MEMORY = 1 << 30, 1e6
Line = dict[str, Any]
T = TypeVar("T")


@dataclass(frozen=True, kw_only=True)
class Task:
    """One recording's work.

    Attributes:
        name: of the recording, of its own among the tasks.
        key: hash of all that the outcome depends on.
        work: a function of a module, which another process can import; returns figures.
        given: what `work` is called with.
        output: file or folder that is there once it is done; "" without one.
    """

    name: str
    key: str
    work: Callable[..., Mapping[str, Any]]
    given: Mapping[str, Any] = field(default_factory=dict)
    output: str = ""

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
    """How many tasks are carried out at once; raises OptionError where that cannot be.

    Attributes:
        workers: processes; 1: this one, 0: one for each processor.
        memory: that a task may have in a process of its own [GB]; 0: any.
    """

    workers: int = 1
    memory: float = 4.0

    def __post_init__(self) -> None:
        if self.workers < 0:
            raise OptionError(f"--workers {self.workers}: expected the number of recordings at once, or 0")
        if not 0.0 <= self.memory < _LARGEST_MEMORY:
            raise OptionError(f"--memory {self.memory}: expected gigabytes, or 0")


def is_manifest(path: Path) -> bool:
    """Say whether a file has the name of a manifest."""
    return path.match("manifest*.jsonl") and path.is_file()


class Manifest:
    """The lines of the tasks that have ended, in a file that grows by one whole line at a time.

    Args:
        folder: of the outputs; made if need be.
        shard: "i/n" of a run that does a part only; each part has a file of its own.
    """

    def __init__(self, folder: Path, shard: str = "") -> None:
        ending = f".{shard.replace('/', '-of-')}" if shard else ""
        self.path, self._lock = folder / f"manifest{ending}.jsonl", folder / f".lock{ending}"
        folder.mkdir(parents=True, exist_ok=True)

    @contextmanager
    def alone(self) -> Iterator[None]:
        """Keep other runs from this part of the outputs.

        Raises:
            OptionError: another run is at it.
        """
        import fcntl

        with self._lock.open("w") as lock:
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError as error:
                folder = self.path.parent
                raise OptionError(f"{folder}: another run writes there; expected a folder of its own") from error
            yield

    def read(self) -> dict[str, Line]:
        """Return the last line of every task, of any part, by its name; a line that was cut off is none."""
        lines: dict[str, Line] = {}
        others = set(self.path.parent.glob("manifest*.jsonl")) - {self.path}
        for path in (*sorted(others), self.path):
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
        options: how many at once.
        manifest: where lines are kept; what it holds as done with the same key is not done again.
        unit: what a task is, for the bar.
    """
    before = manifest.read()
    lines = {task.name: before[task.name] for task in tasks if task.is_done(before.get(task.name))}
    left = [task for task in tasks if task.name not in lines]
    with progress_bar(len(tasks), unit) as bar:
        bar.update(len(lines))
        for line in map(Task.run, left) if options.workers == 1 else _run_in_processes(left, options):
            manifest.append(line)
            lines[line["name"]] = line
            bar.set_postfix_str(f"{sum(each['status'] == FAILED for each in lines.values())} failed")
            bar.update()
    return [lines[task.name] for task in tasks]


def progress_bar(total: int, unit: str, name: str = "") -> Any:
    """Return a progress bar on a terminal; none in the process of a task, whose bars would overwrite each other."""
    from tqdm import tqdm

    hidden = None if current_process().name == "MainProcess" else True
    return tqdm(total=total, unit=unit, desc=name or None, disable=hidden, leave=False)


def hash_settings(settings: Mapping[str, Any], files: Sequence[Path] = ()) -> str:
    """Return a name (16 hexadecimal digits) for settings, and for files by their paths, sizes and times of change."""
    digest = hashlib.sha256(json.dumps(settings, sort_keys=True, default=str).encode())
    for path in sorted(files):
        state = path.stat()
        digest.update(f"|{path}|{state.st_size}|{state.st_mtime_ns}".encode())
    return digest.hexdigest()[:16]


def choose_shard(items: Sequence[T], shard: str) -> list[T]:
    """Return the part of a list that a shard "i/n" is to do; all of it for "".

    Raises:
        OptionError: another text, or no such part.
    """
    if not shard:
        return list(items)
    found = re.fullmatch(r"(\d{1,6})/(\d{1,6})", shard)
    number, count = (int(part) for part in found.groups()) if found else (0, 0)
    if not 1 <= number <= count:
        raise OptionError(f"--shard {shard}: expected i/n with 1 <= i <= n, as 3/16")
    return list(items[number - 1 :: count])


def _run_limited(task: Task, gigabytes: float) -> Line:
    """Return the line of a task that may have so much memory, from now on in this process."""
    if gigabytes > 0.0:
        import resource

        hard = resource.getrlimit(resource.RLIMIT_DATA)[1]
        resource.setrlimit(resource.RLIMIT_DATA, (int(gigabytes * _GIGABYTE), hard))
    return task.run()


def _run_in_processes(tasks: Sequence[Task], options: EngineOptions) -> Iterator[Line]:
    """Yield lines as joblib's processes end their tasks; one that dies costs the task that it was at."""
    from joblib import Parallel, delayed
    from joblib.externals.loky.process_executor import TerminatedWorkerError

    left, alone = {task.name: task for task in tasks}, False
    while left:
        pool = Parallel(n_jobs=options.workers or -1, return_as="generator_unordered", batch_size=1)
        batch = list(left.values())[: 1 if alone else None]
        try:
            for line in pool(delayed(_run_limited)(task, options.memory) for task in batch):
                del left[line["name"]]
                yield line
            alone = False
        except TerminatedWorkerError:
            # which task it was is not known: the first one is tried again by itself, then all others as before
            if alone:
                yield left.pop(batch[0].name).line(DIED)
            alone = not alone
