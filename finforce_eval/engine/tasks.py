"""A task per recording, and a manifest that tells which are done: a run that was killed goes on where it was."""

from __future__ import annotations

import gc
import hashlib
import json
import os
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from time import perf_counter
from typing import Any, TypeVar

from finforce.errors import FinforceError, one_line
from finforce_eval.errors import OptionError
from finforce_eval.machine import version, without_nan

OK, FAILED = "ok", "failed"
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


def run_task(task: Task) -> dict[str, Any]:
    """Return the line of the manifest for a task that is carried out here; whatever it raises is its own failure."""
    began = perf_counter()
    # what was made before stays, and of what a task makes little is garbage: it is looked for a hundred times less
    seldom = gc.get_threshold()
    gc.freeze()
    gc.set_threshold(100 * seldom[0], *seldom[1:])
    try:
        line = make_line(task, figures=without_nan(dict(task.work(**task.given))))
    except (FinforceError, OSError, MemoryError) as error:
        line = make_line(task, error=one_line(error))
    except Exception as error:  # what nobody foresaw costs this recording alone
        line = make_line(task, error=f"{type(error).__name__}: {one_line(error)}")
    finally:
        gc.set_threshold(*seldom)
        gc.unfreeze()
    return line | {"seconds": round(perf_counter() - began, 3)}


def make_line(task: Task, *, figures: Mapping[str, Any] | None = None, error: str = "") -> dict[str, Any]:
    """Return the line of the manifest for a task that has ended; it has failed where there is an error."""
    status = FAILED if error else OK
    return {
        "name": task.name,
        "key": task.key,
        "status": status,
        "error": error,
        "figures": dict(figures or {}),
        "version": version(),
        "seconds": 0.0,
    }


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

    def read(self) -> dict[str, dict[str, Any]]:
        """Return the last line of every task, of any part, by its name; a line that was cut off is none."""
        lines: dict[str, dict[str, Any]] = {}
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

    def append(self, line: Mapping[str, Any]) -> None:
        """Add the line of a task that has ended, and see it to the disk."""
        with self.path.open("ab+") as file:
            if file.tell():
                file.seek(-1, os.SEEK_END)
                if file.read(1) != b"\n":  # cut off when the run before was killed
                    file.write(b"\n")
            file.write(json.dumps(line).encode() + b"\n")
            file.flush()
            os.fsync(file.fileno())
