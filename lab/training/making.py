"""Files of a data set, each made by a task of its own."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from finforce_eval.engine.engines import EngineOptions, run_tasks
from finforce_eval.engine.tasks import OK, Manifest, Task
from lab.training.errors import DatasetError


def make_all(tasks: Sequence[Task], engine: EngineOptions, folder: Path, shard: str, unit: str) -> list[dict[str, Any]]:
    """Make what is not made yet, and return the lines of all tasks.

    Args:
        tasks: each makes a file.
        engine: where they are carried out.
        folder: of the files, and of a manifest that lets several runs share the work, or go on where one was killed.
        shard: "i/n" of a run that does a part only.
        unit: what a task is, for the bar.

    Raises:
        DatasetError: one of them failed; which, and how many.
    """
    lines = run_tasks(tasks, engine, Manifest(folder, shard), unit=unit)
    failed = [line for line in lines if line["status"] != OK]
    if failed:
        raise DatasetError(f"{len(failed)} of {len(lines)} failed, {failed[0]['name']} with: {failed[0]['error']}")
    return lines
