"""Recordings through their estimators as tasks, each on its own, and their scores together."""

from __future__ import annotations

import argparse
from collections.abc import Iterable, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from finforce.errors import FinforceError
from finforce_eval.errors import RecordingError
from finforce_eval.evaluation.forces import describe_contradictions, evaluate_jaws, truth_sides
from finforce_eval.evaluation.keypoint_source import parse_source
from finforce_eval.evaluation.scoring import Evaluation, score_results, score_series, true_range
from finforce_eval.evaluation.setup import EvaluationSetup, describe_options, print_notes, share_setup
from finforce_eval.recordings.bags import list_files, name_recordings
from finforce_eval.recordings.tracks import Recording
from finforce_eval.table import ForceSeries, read_table, write_table
from finforce_eval.tasks import OK, EngineOptions, Manifest, Task, hash_settings, run_tasks


def evaluate_all(recordings: Sequence[Recording], setup: EvaluationSetup) -> Evaluation:
    """Evaluate every jaw with ground truth of every recording.

    Raises:
        FinforceError: one of them cannot be evaluated.
    """
    results = [result for recording in recordings for result in evaluate_jaws(recording, setup)]
    return score_results(results, recordings)


def evaluate_many(
    options: argparse.Namespace, engine: EngineOptions, folder: Path
) -> tuple[Evaluation, dict[str, str]]:
    """Evaluate the recordings that the options name; what is kept in the folder already is not done again.

    Args:
        options: of the command `evaluate`.
        engine: where they are evaluated.
        folder: of a manifest and a table for each recording; made if need be.

    Returns:
        Scores and time series of the recordings that could be evaluated, and why each of the others could not.

    Raises:
        FinforceError: not one could be evaluated.
    """
    settings = describe_options(options)
    manifest, tasks = Manifest(folder), []
    for name, path in name_recordings(options.bags, "/"):
        target = str(folder / f"{name.replace('/', '_')}.parquet")
        given = {"name": name, "path": str(path), "target": target, "options": options}
        given["settings"] = hash_settings(settings)
        files = list_files(path)
        key = hash_settings(settings, files)
        files = [*map(Path, settings["files"]), *files]
        tasks.append(Task(name=name, key=key, work=evaluate_task, given=given, output=target, files=files))
    with manifest.alone():
        lines = run_tasks(tasks, engine, manifest)
    failed = {line["name"]: line["error"] for line in lines if line["status"] != OK}
    for line in lines:
        print_notes(line["name"], line["figures"].get("notes", ()))
    if len(failed) == len(lines):
        raise RecordingError(next(iter(failed.values())))
    evaluation, _ = read_evaluations(Path(task.output) for task in tasks if task.name not in failed)
    return evaluation, failed


def read_evaluations(paths: Iterable[Path]) -> tuple[Evaluation, dict[str, Any]]:
    """Return the scores of the tables of some recordings together, and what the first of them says was run.

    Raises:
        FinforceError: a file is damaged or another program's, or two have the same name.
    """
    tables = [read_table(path) for path in paths]
    ranges = [about["true_range_N"] for _, about in tables if about["true_range_N"]]
    return score_series([each for series, _ in tables for each in series], ranges), tables[0][1]["about"]


def evaluate_task(name: str, path: str, target: str, options: argparse.Namespace, settings: str) -> dict[str, Any]:
    """Evaluate one recording, keep its series and return figures.

    Args:
        name: of the recording.
        path: rosbag2 folder, .mcap or .db3 file.
        target: file of what is kept.
        options: of the command `evaluate`.
        settings: hash of them and of the files that they name.

    Raises:
        FinforceError: the recording cannot be read or evaluated.
    """
    setup, source = share_setup(settings, options), parse_source(options)
    try:
        read = replace(source.read(path), name=name)
        truth_sides(read)
        setup.contacts.check(read)
        recording = source.apply(read)
        results = evaluate_jaws(recording, setup)
    except FinforceError as error:
        text = str(error)
        raise RecordingError(text if name in text or path in text else f"{name}: {text}") from error
    names = list(setup.jaw.keypoint_names)
    cases = {case: asdict(score) for case, score in score_results(results, [recording]).scores.items()}
    about = {"about": dict(setup.about), "path": path, "true_range_N": true_range(recording), "keypoint_names": names}
    write_table(Path(target), results, about | {"cases": cases})
    notes = [*recording.notes, *describe_contradictions(results)]
    notes += [note_left_out(recording, result) for result in results if setup.as_live]
    return {"cases": cases, "notes": notes, "version": setup.about["version"]}


def note_left_out(recording: Recording, result: ForceSeries) -> str:
    """Return how many images of a jaw the live chain would have left out."""
    track = recording.jaw(result.side)
    images = len(track.keypoints.stamps_ns if track.detection is None else recording.images)
    return f"{result.side} jaw: {images - len(result)} of {images} images left out, as the live chain leaves them out"
