"""Recordings through their estimators as tasks, each on its own, and their scores together."""

from __future__ import annotations

import argparse
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike

from finforce.errors import FinforceError
from finforce.gripper_frames import read_extrinsics
from finforce.messages import SECOND
from finforce.rig import read_rig
from finforce.transforms import pose_numbers
from finforce_eval.errors import RecordingError
from finforce_eval.evaluation.contact_source import choose_contact
from finforce_eval.evaluation.forces import (
    describe_contradictions,
    estimate_shown,
    evaluate_jaws,
    truth_sides,
)
from finforce_eval.evaluation.keypoint_source import KeypointSource, parse_source, pose_of
from finforce_eval.evaluation.scoring import Evaluation, score_results, score_series, true_range
from finforce_eval.evaluation.setup import (
    EvaluationSetup,
    announce_compilation,
    describe_options,
    print_notes,
    share_setup,
)
from finforce_eval.recordings.bags import list_files, name_recordings
from finforce_eval.recordings.images import ImageChoice
from finforce_eval.recordings.recording import find_recordings, stated_jaw
from finforce_eval.recordings.tracks import Recording
from finforce_eval.table import ForceSeries, read_table, unit_of, write_table
from finforce_eval.tasks import OK, EngineOptions, Manifest, Task, hash_settings, run_tasks
from finforce_ifea.jaw.calibration import Calibration, load_calibration
from finforce_ifea.jaw.jaw import load_jaw
from finforce_ifea.settings import EstimatorSettings


def evaluate(
    recordings: str | Path | Sequence[str | Path],
    *,
    jaw: str | Path | None = None,
    rig: str | Path | None = None,
    camera: str | Path | ArrayLike | None = None,
    extrinsics: str | ArrayLike | None = None,
    contact_height: float | None = None,
    object_mesh: str | Path | None = None,
    calibration: str | Path | Calibration | None = None,
    source: str = "",
    sides: Sequence[str] = (),
    stills: bool = False,
    episode: int = 0,
    gravity_frame: str = "",
    detector: Mapping[str, Any] | None = None,
    settings: EstimatorSettings | Mapping[str, Any] | None = None,
) -> pd.DataFrame:
    """Estimate the forces in recordings and return them as a table with a row for each image and jaw.

    The estimators and columns are those of `finforce evaluate` and its Parquet files, in SI units, which
    `attrs["units"]` of the table lists. In an image without a force, the force is NaN and `message` states the reason.

    Args:
        recordings: rosbag2 folders, .mcap or .db3 files, LeRobot datasets, UMI's .zarr, videos, folders of pictures, or
            folders that hold some of these; one or several.
        jaw: jaw file, or name of an included jaw; None for that of the rig or of the `case.json`, else "bench".
        rig: file written by `finforce camera`, instead of jaw, camera and extrinsics.
        camera: intrinsics for images without camera_info, as for `ForceSensor`.
        extrinsics: camera pose in `gripper_base`, as for `ForceSensor`; None for that of the `case.json`, else "robot".
        contact_height: height of first touch above the clamped base [m].
        object_mesh: file of the object's mesh [m], which gives the contact together with the recorded poses. Without
            height and mesh, those of the `case.json` are used.
        calibration: calibration of the finger, its file or an included name; None for the material of the jaw file.
        source: source of the key points: "images", "keypoints" as recorded, "truth" of a simulation, or "" for recorded
            ones if there are any, else images.
        sides: jaws in the images, if no topic names them.
        stills: True if every image is a separate photograph, without a tare.
        episode: number of the episode of a dataset.
        gravity_frame: upright frame on the /tf of bags, from which gravity and the elevation of the gripper are taken;
            "" for the topic /gravity.
        detector: parameters of the detector that differ from their defaults.
        settings: settings of the estimator, or only those that differ from the defaults, by name.

    Raises:
        FinforceError: a recording cannot be read or evaluated, or an argument cannot be used.
    """
    found = None if rig is None else read_rig(rig)
    paths = [recordings] if isinstance(recordings, str | Path) else recordings
    named = name_recordings([each for path in paths for each in find_recordings(Path(path))], "/")
    jaw = str(jaw or (found.jaw if found else stated_jaw([path for _, path in named], "bench")))
    parameters = {**(found.detector_parameters() if found else {}), **(detector or {})}
    if extrinsics is not None:
        parameters["T_gripper_camera"] = list(pose_numbers(read_extrinsics(extrinsics)))
    choice = ImageChoice(
        intrinsics=_words_of(camera),
        camera=found.intrinsics if found else None,
        T_gripper_camera=pose_of(parameters),
        episode=episode,
    )
    keypoints = KeypointSource(
        source=source,
        jaw_file=jaw,
        parameters=parameters,
        stills=stills,
        choice=choice,
        sides=tuple(sides),
        gravity_frame=gravity_frame,
    )
    announce_compilation()
    settings = settings if isinstance(settings, EstimatorSettings) else EstimatorSettings(**(settings or {}))
    setup = EvaluationSetup(
        jaw=load_jaw(jaw),
        settings=replace(settings, automatic_tare=False) if stills else settings,
        calibration=None if calibration is None else load_calibration(calibration),
        contacts=choose_contact(contact_height, object_mesh),
        about={},
        stills=stills,
    )
    table = pd.concat([_tabulate(name, path, keypoints, setup) for name, path in named], ignore_index=True)
    table["stamp"] = SECOND * table["stamp"]
    table.attrs = {"units": {column: unit_of(column) for column in table} | {"stamp": "s"}}
    return table


def _words_of(camera: str | Path | ArrayLike | None) -> tuple[str, ...]:
    """Return intrinsics, a file or numbers, as words of `--intrinsics`."""
    given = [camera] if isinstance(camera, str | Path) else np.ravel(() if camera is None else camera)
    return tuple(map(str, given))


def _tabulate(name: str, path: Path, keypoints: KeypointSource, setup: EvaluationSetup) -> pd.DataFrame:
    """Return the forces on all jaws of a recording, under a progress bar."""
    read = replace(keypoints.read(path), name=name)
    setup.contacts.check(read)
    recording = keypoints.apply(read)
    print_notes(name, recording.notes)
    return pd.concat([each.table for each in estimate_shown(recording, setup).values()])


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


SCORED = "true_range_N"  # of what a table says of its run: it is that of an evaluation


def read_evaluations(paths: Iterable[Path]) -> tuple[Evaluation, dict[str, Any]]:
    """Return the scores of the tables of some recordings together, and what the first of them says was run.

    Raises:
        FinforceError: a file is damaged or another program's, or two have the same name.
    """
    tables = [read_table(path) for path in paths]
    try:
        found = [about[SCORED] for _, about in tables]
        ranges = [(float(low), float(high)) for low, high in filter(None, found)]
        first = dict(tables[0][1]["about"])
    except (KeyError, TypeError, ValueError) as error:
        raise RecordingError(f"a table says nothing of its run: {error!r}; expected those of evaluate --out") from error
    return score_series([each for series, _ in tables for each in series], ranges), first


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
    noted: Sequence[str] = ()
    try:
        read = replace(source.read(path), name=name)
        truth_sides(read)
        setup.contacts.check(read)
        recording = source.apply(read)
        noted = recording.notes
        results = evaluate_jaws(recording, setup)
    except FinforceError as error:
        text = "; ".join((str(error), *noted))
        raise RecordingError(text if name in text or path in text else f"{name}: {text}") from error
    names = list(setup.jaw.keypoint_names)
    cases = {case: asdict(score) for case, score in score_results(results, [recording]).scores.items()}
    about = {"about": dict(setup.about), "path": path, SCORED: true_range(recording), "keypoint_names": names}
    write_table(Path(target), results, about | {"cases": cases})
    notes = [*recording.notes, *setup.contacts.describe_comparison(recording), *describe_contradictions(results)]
    notes += [note_left_out(recording, result) for result in results if setup.as_live]
    return {"cases": cases, "notes": notes, "version": setup.about["version"]}


def note_left_out(recording: Recording, result: ForceSeries) -> str:
    """Return how many images of a jaw the live chain would have left out."""
    track = recording.jaw(result.side)
    images = len(track.keypoints.stamps_ns if track.detection is None else recording.images)
    return f"{result.side} jaw: {images - len(result)} of {images} images left out, as the live chain leaves them out"
