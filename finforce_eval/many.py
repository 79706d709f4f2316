"""Recordings through their estimators as tasks, each on its own, and their scores together."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from finforce.errors import FinforceError
from finforce_eval.engine.engines import SEQUENTIAL, EngineOptions, run_tasks
from finforce_eval.engine.settings import describe_options
from finforce_eval.engine.tasks import OK, Manifest, Task, choose_shard, hash_settings
from finforce_eval.errors import RecordingError
from finforce_eval.evaluation.evaluate import Evaluation, score_results, score_series, true_range
from finforce_eval.evaluation.keypoint_source import parse_source
from finforce_eval.evaluation.setup import evaluate_jaws
from finforce_eval.evaluation.warm import open_warm
from finforce_eval.recordings.bags import list_files, name_recordings
from finforce_eval.recordings.recording import read_recording
from finforce_eval.table import read_table, write_table


@dataclass(frozen=True, kw_only=True)
class ManyEvaluated:
    """What became of the recordings of one call.

    Attributes:
        evaluation: scores and time series of those that could be evaluated.
        failed: why each of the others could not, by its name.
    """

    evaluation: Evaluation
    failed: Mapping[str, str]


def evaluate_many(options: argparse.Namespace, engine: EngineOptions, folder: Path) -> ManyEvaluated:
    """Evaluate the recordings that the options name; what is kept in the folder already is not done again.

    Args:
        options: of the command `evaluate`.
        engine: where they are evaluated.
        folder: of a manifest and a table for each recording; made if need be.

    Raises:
        FinforceError: not one could be evaluated.
    """
    # pictures are drawn with each recording: where they are missing, it is not done
    settings = describe_options(options) | {"report": options.report}
    manifest = Manifest(folder, options.shard)
    named = choose_shard(name_recordings(options.bags, "/"), options.shard)
    shown = engine.engine == SEQUENTIAL
    tasks = [_make_task(name, path, folder, options, settings, shown=shown) for name, path in named]
    with manifest.alone():
        lines = run_tasks(tasks, engine, manifest)
    failed = {line["name"]: line["error"] for line in lines if line["status"] != OK}
    for line in lines:
        for note in line["figures"].get("notes", ()):
            print(f"note: {line['name']}: {note}", file=sys.stderr)
    if len(failed) == len(lines):
        raise RecordingError(next(iter(failed.values()), f"--shard {options.shard}: no recording is left for it"))
    evaluation, _ = read_evaluations(Path(task.output) for task in tasks if task.name not in failed)
    return ManyEvaluated(evaluation=evaluation, failed=failed)


def read_evaluations(paths: Iterable[Path]) -> tuple[Evaluation, dict[str, Any]]:
    """Return the scores of the tables of some recordings together, and what the first of them says was run.

    Raises:
        FinforceError: a file is damaged or another program's, or two have the same name.
    """
    tables = [read_table(path) for path in paths]
    ranges = [about["true_range_N"] for _, about in tables if about["true_range_N"]]
    return score_series([each for series, _ in tables for each in series], ranges), tables[0][1]["about"]


def _make_task(
    name: str, path: Path, folder: Path, options: argparse.Namespace, settings: Mapping[str, Any], *, shown: bool
) -> Task:
    """Return the task of evaluating a recording; `shown`: with a bar of its images."""
    key = hash_settings(settings, list_files(path))
    target = folder / f"{name.replace('/', '_')}.parquet"
    given = {
        "name": name,
        "path": str(path),
        "target": str(target),
        "options": vars(options) | {"run": None},
        "settings": hash_settings(settings),
        "shown": shown,
    }
    return Task(name=name, key=key, work=evaluate_task, given=given, output=str(target))


def evaluate_task(
    name: str, path: str, target: str, options: Mapping[str, Any], settings: str, *, shown: bool
) -> dict[str, Any]:
    """Evaluate one recording, keep its series and return figures.

    Args:
        name: of the recording.
        path: rosbag2 folder, .mcap or .db3 file.
        target: file of what is kept.
        options: of the command `evaluate`.
        settings: hash of them and of the files that they name.
        shown: with a bar of its images.

    Raises:
        FinforceError: the recording cannot be read or evaluated.
    """
    chosen = argparse.Namespace(**options)
    warm, source = open_warm(settings, chosen), parse_source(chosen)
    try:
        read = replace(read_recording(path, source.pairing, strict=source.strict), name=name)
        recording = source.apply(read)
        results = evaluate_jaws(recording, warm.setup, warm.estimator, shown=shown)
    except FinforceError as error:
        text = str(error)
        raise RecordingError(text if name in text or path in text else f"{name}: {text}") from error
    setup = warm.setup
    if chosen.report:
        from finforce_eval.figures.report import draw_results

        names = setup.jaw.keypoint_names
        draw_results(results, Path(chosen.report), keypoint_names=names, recordings=[recording])
    about = {"about": dict(setup.about), "path": path, "true_range_N": true_range(recording)}
    write_table(Path(target), results, about | {"keypoint_names": list(setup.jaw.keypoint_names)})
    scores = score_results(results, [recording])
    return {
        "cases": {case: asdict(score) for case, score in scores.scores.items()},
        "notes": list(recording.notes),
        "version": setup.about["version"],
    }
