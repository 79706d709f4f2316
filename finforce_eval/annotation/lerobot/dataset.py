"""A LeRobot dataset with the forces in every frame: a task per episode, then the dataset anew, whole or not at all."""

from __future__ import annotations

import argparse
import json
import os
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from finforce.files import parse_json, read_json
from finforce_eval.annotation.forces import estimate_forces, reasons
from finforce_eval.annotation.lerobot.features import (
    FeatureNames,
    add_columns,
    add_features,
    describe_column,
    stack_episodes,
)
from finforce_eval.annotation.lerobot.images import EpisodeImages
from finforce_eval.annotation.lerobot.layout import (
    EPISODE_STATS_V2,
    EPISODES_V3,
    INFO,
    STATS,
    Dataset,
    Episode,
    import_arrow,
    open_dataset,
    read_table,
)
from finforce_eval.engine.settings import describe_options, sides_of
from finforce_eval.engine.tasks import Task, hash_settings, make_line
from finforce_eval.errors import RecordingError
from finforce_eval.evaluation.keypoint_source import parse_source
from finforce_eval.evaluation.manipulation import combine_jaws
from finforce_eval.evaluation.warm import open_warm
from finforce_eval.recordings.image_files import read_intrinsics
from finforce_eval.recordings.tracks import JawTrack, KeypointTrack, Recording
from finforce_eval.table import ForceSeries

_NO_KEYPOINTS = "no key points in"
Columns = dict[str, NDArray]


def episode_tasks(folder: Path, parts: Path, options: argparse.Namespace) -> list[Task]:
    """Return a task per episode of a dataset, each of which writes its forces into a folder of parts.

    Raises:
        FinforceError: the dataset cannot be read, or its camera is not known.
    """
    dataset = open_dataset(folder, options.images)
    image_size(dataset)
    settings = describe_options(options)
    shared = {"options": vars(options) | {"run": None}, "settings": hash_settings(settings)}
    given = {"dataset": replace(dataset, episodes=()), **shared}
    tasks = []
    for episode in dataset.episodes:
        files = [path for path in (episode.video, episode.data) if path is not None and path.is_file()]
        target = part_of(parts, episode.index)
        key = hash_settings(settings | {"episode": episode.index}, files)
        work = {**given, "episode": episode, "target": str(target), "key": key}
        tasks.append(
            Task(name=f"{dataset.name}/{target.stem}", key=key, work=annotate_episode, given=work, output=str(target))
        )
    return tasks


def part_of(parts: Path, index: int) -> Path:
    """Return the file of one episode's forces."""
    return parts / f"episode_{index:06d}.npz"


def image_size(dataset: Dataset) -> tuple[int, int]:
    """Return height and width of the pictures.

    Raises:
        RecordingError: the dataset does not say.
    """
    shape = list(dataset.info["features"][dataset.camera].get("shape") or ())
    if len(shape) != 3 or 3 not in shape or not all(isinstance(side, int) and side > 0 for side in shape):
        raise RecordingError(f"{dataset.name}: {dataset.camera} has the shape {shape}; expected height, width, 3")
    return (shape[1], shape[2]) if shape[0] == 3 else (shape[0], shape[1])


def annotate_episode(
    dataset: Dataset, episode: Episode, target: str, options: Mapping[str, Any], settings: str, key: str
) -> dict[str, Any]:
    """Find the forces of one episode, write them and return figures.

    Args:
        dataset: as described; its other episodes are not needed.
        episode: of it.
        target: file of the forces.
        options: of the command `annotate`.
        settings: hash of them and of the files that they name.
        key: of the task, which is kept beside the forces.

    Raises:
        FinforceError: its pictures cannot be read, or the jaw not be used.
    """
    columns = _find_forces(dataset, episode, argparse.Namespace(**options), settings)
    path = Path(target)
    part = path.with_suffix(f".{os.getpid()}.part")
    try:
        with part.open("wb") as file:
            np.savez(file, key=np.array(key), **columns)
        os.replace(part, path)
    finally:
        part.unlink(missing_ok=True)
    return _figures(columns, dataset)


def ended_before(task: Task) -> dict[str, Any] | None:
    """Return the line of an episode whose forces are there already, None of another."""
    if not Path(task.given["target"]).is_file():
        return None
    try:
        columns = read_part(Path(task.given["target"]))
    except RecordingError:
        return None
    if str(columns.pop("key", "")) != task.key:
        return None
    return make_line(task)


def read_part(path: Path) -> Columns:
    """Return the forces of an episode by column, and its key.

    Raises:
        RecordingError: they are not there, or damaged.
    """
    try:
        with np.load(path, allow_pickle=False) as stored:
            return dict(stored)
    except Exception as error:  # numpy, zip and their decompressors each have their own classes
        raise RecordingError(f"{path.name}: {error}") from error


def _figures(columns: Columns, dataset: Dataset) -> dict[str, Any]:
    """Return what is said of an episode in the manifest."""
    answered = columns["valid"][:, 0]
    largest = float(np.nanmax(columns["grasp"])) if answered.any() else float("nan")
    jaws = {"images": len(answered), "answered": int(answered.sum()), "largest_N": largest}
    return {"jaws": {"both": jaws}, "span_s": round(len(answered) / dataset.fps, 3), "notes": []}


def _find_forces(dataset: Dataset, episode: Episode, options: argparse.Namespace, settings: str) -> Columns:
    """Return the columns of one episode."""
    warm, keypoints = open_warm(settings, options), parse_source(options)
    name = f"{dataset.name}/episode_{episode.index:06d}"
    images = EpisodeImages(
        episode=episode,
        name=name,
        feature=dataset.camera,
        fps=dataset.fps,
        camera=read_intrinsics(options.intrinsics, image_size(dataset)),
    )
    sides = sides_of(options)
    jaws = {side: JawTrack(keypoints=KeypointTrack.empty(), truth=None, pose=None) for side in sides}
    recording = Recording(name=name, path=dataset.folder, jaws=jaws, images=images)
    try:
        seen = keypoints.apply(recording)
        found = estimate_forces(seen, warm.setup, build=warm.estimator)
        grasp = combine_jaws(found).column("grasp_force")[:, None]
    except RecordingError as error:
        if _NO_KEYPOINTS not in str(error):
            raise
        return _unanswered(sides, episode.length, str(error).removeprefix(f"{name}: "))
    return _columns(found, grasp)


def _columns(found: Mapping[str, ForceSeries], grasp: NDArray) -> Columns:
    """Return the columns of an episode's forces."""
    columns: Columns = {"grasp": grasp, "valid": np.isfinite(grasp)}
    words = []
    for side, forces in found.items():
        columns[side], columns[f"{side}.stddev"] = forces.force, forces.column("force_stddev")
        words.append([f"{side}: {reason}" if reason else "" for reason in reasons(forces)])
    columns["reason"] = np.array(["; ".join(filter(None, row)) for row in zip(*words, strict=True)])[:, None]
    return columns


def _unanswered(sides: Sequence[str], count: int, reason: str) -> Columns:
    """Return the columns of an episode without a force."""
    columns: Columns = {"grasp": np.full((count, 1), np.nan), "valid": np.zeros((count, 1), bool)}
    for side in sides:
        columns[side] = columns[f"{side}.stddev"] = np.full((count, 3), np.nan)
    return columns | {"reason": np.full((count, 1), reason)}


def write_dataset(folder: Path, parts: Path, target: Path, options: argparse.Namespace) -> None:
    """Write a dataset with the forces of all of its episodes.

    Everything else stays as it is; videos are hard links where the file system has them, else copies.

    Args:
        folder: of the dataset.
        parts: of the episodes' forces.
        target: to be made; see `new_folder`.
        options: of the command `annotate`.

    Raises:
        RecordingError: the dataset has such features already, or its rows are not those of its episodes.
        OSError: the folder cannot be written.
    """
    dataset, names = open_dataset(folder, options.images), FeatureNames(options.prefix, sides_of(options))
    same = sorted(names.all & dataset.info["features"].keys())
    if same:
        raise RecordingError(f"{dataset.name}: has {', '.join(same)} already; expected another --prefix")
    columns = {each.index: read_part(part_of(parts, each.index)) for each in dataset.episodes}
    changed = {each.data for each in dataset.episodes}
    _copy_rest(dataset, target, changed)
    for path in sorted(changed):
        own = [each for each in dataset.episodes if each.data == path]
        add_columns(path, target / path.relative_to(folder), own, columns, names)
    info = read_json(folder / INFO)
    add_features(info, names)
    (target / INFO).write_text(json.dumps(info, indent=4) + "\n", encoding="utf-8")
    _write_stats(dataset, target, columns, names)


def _copy_rest(dataset: Dataset, target: Path, changed: set[Path]) -> None:
    """Copy all files of a dataset but those that are written anew; videos as links, where that is possible."""
    for path in sorted(dataset.folder.rglob("*")):
        if not path.is_file() or path in changed:
            continue
        copy = target / path.relative_to(dataset.folder)
        copy.parent.mkdir(parents=True, exist_ok=True)
        if path.suffix == ".mp4":
            try:
                os.link(path, copy)
                continue
            except OSError:
                pass
        shutil.copy2(path, copy)


def _write_stats(dataset: Dataset, target: Path, columns: Mapping[int, Columns], names: FeatureNames) -> None:
    """Add the statistics of the new features, of the frames that have a force, where the dataset keeps such."""
    if (target / STATS).is_file():
        stats = read_json(target / STATS)
        known = _kinds_of(stats)
        whole = stack_episodes(columns)
        stats |= {feature: describe_column(whole[column], known) for feature, column in names.numeric.items()}
        (target / STATS).write_text(json.dumps(stats, indent=4) + "\n", encoding="utf-8")
    if (target / EPISODE_STATS_V2).is_file():
        lines = []
        for text in (target / EPISODE_STATS_V2).read_text(encoding="utf-8").splitlines():
            line = parse_json(text)
            own, known = columns[line["episode_index"]], _kinds_of(line["stats"])
            line["stats"] |= {name: describe_column(own[column], known) for name, column in names.numeric.items()}
            lines.append(json.dumps(line))
        (target / EPISODE_STATS_V2).write_text("\n".join(lines) + "\n", encoding="utf-8")
    for path in sorted((target / EPISODES_V3).glob("*/*.parquet")) if dataset.is_v3 else ():
        _add_episode_stats(path, columns, names)


def _kinds_of(stats: Mapping[str, Any]) -> list[str]:
    """Return the statistics that the features of a dataset have."""
    return list(next((each for each in stats.values() if isinstance(each, dict)), {}))


def _add_episode_stats(path: Path, columns: Mapping[int, Columns], names: FeatureNames) -> None:
    """Add the statistics of the new features to a table of episodes."""
    pyarrow, parquet = import_arrow(), import_arrow("pyarrow.parquet")
    table = read_table(path)
    heads = [name.split("/") for name in table.column_names if name.startswith("stats/")]
    known = list(dict.fromkeys(head[-1] for head in heads))
    indices = table["episode_index"].to_pylist()
    for feature, column in names.numeric.items():
        rows = [describe_column(columns[index][column], known) for index in indices]
        for kind in known:
            values = pyarrow.array([row[kind] for row in rows])
            table = table.append_column(f"stats/{feature}/{kind}", values)
    parquet.write_table(table, path)
