"""A LeRobot dataset with the forces in every frame: a task per episode, then the dataset anew, whole or not at all."""

from __future__ import annotations

import argparse
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from finforce.files import FileError, check_inside, check_plain
from finforce.typed_yaml import FileModel, parse_model
from finforce_eval.annotation.dataset_copy import Column, describe, write_copy
from finforce_eval.errors import OptionError, RecordingError
from finforce_eval.evaluation.forces import NOT_FOUND, estimate_forces, no_force_reasons, why_unanswered
from finforce_eval.evaluation.gripper import combine_jaws
from finforce_eval.evaluation.keypoint_source import parse_source, sides_of
from finforce_eval.evaluation.setup import describe_options, read_contacts, share_setup
from finforce_eval.evaluation.tare_source import borrow_tares, parse_tare_source
from finforce_eval.policy import (
    FORCE,
    GRASP,
    NONE,
    STATE,
    STATE_FEATURE,
    STDDEV,
    PolicyForces,
    check_prefix,
    grasp_columns,
)
from finforce_eval.recordings.dataset import Dataset, open_dataset, recording_of
from finforce_eval.recordings.frames import choose_camera
from finforce_eval.recordings.tracks import Recording
from finforce_eval.table import AXES, ForceSeries, read_table, write_table
from finforce_eval.tasks import Task, hash_settings

_NO_KEYPOINTS = "no key points in"
_MARK = "finforce"  # in `info` of a feature's entry: annotate wrote it, or a part of it
Features = dict[str, NDArray]  # new columns by name: rows (n, k) of numbers, or (n, 1) of truths or texts


def episode_tasks(folder: Path, parts: Path, options: argparse.Namespace) -> list[Task]:
    """Return a task per episode of a dataset, each of which writes its table of forces into a folder of parts.

    Raises:
        FinforceError: the dataset cannot be read, or its camera is not known.
    """
    dataset = open_dataset(folder, options.color or "")
    camera = choose_camera(parse_source(options).choice, dataset.image_size, folder.name)
    _check_files(dataset)
    _check_names(dataset, options)
    settings, tasks = describe_options(options), []
    tare = parse_tare_source(options.tare_from)
    unloaded = [each for each in dataset.episodes if tare is not None and each.index == tare.episode]
    if tare is not None and tare.episode is not None and not unloaded:
        raise OptionError(f"--tare-from {tare.episode}: {folder.name} has no such episode")
    other = recording_of(dataset, unloaded[0], camera, sides_of(options)) if unloaded else None
    for episode in dataset.episodes:
        recording = recording_of(dataset, episode, camera, sides_of(options))
        if not tasks:
            read_contacts(options).check(recording)
        target = part_of(parts, episode.index)
        files = [path for each in (episode, *unloaded) for path in (each.video, each.data) if path is not None]
        key = hash_settings(settings | {"episode": episode.index}, files)
        given = {"recording": recording, "other": other, "target": target, "options": options, "key": key}
        given |= {"settings": hash_settings(settings)}
        about = {"name": recording.name, "key": key, "output": str(target)}
        files = [*map(Path, settings["files"]), *files]
        tasks.append(Task(work=annotate_episode, given=given, files=files, **about))
    return tasks


def _check_files(dataset: Dataset) -> None:
    """Refuse a dataset some of whose files are not there, or lead out of it.

    Raises:
        RecordingError: Episodes are missing; names them.
    """
    files, missing = {path for each in dataset.episodes for path in (each.video, each.data) if path is not None}, {}
    for path in sorted(files):
        try:
            check_plain(path)
        except FileError as error:
            missing[path.relative_to(dataset.folder)] = error
    if missing:
        (path, error), *_ = missing.items()
        what = f"{len(missing)} of {len(files)} files cannot be read"
        raise RecordingError(f"{dataset.folder.name}: {what}; {path} {error}")
    try:
        for path in dataset.folder.rglob("*"):
            check_inside(path, dataset.folder)
    except FileError as error:
        raise RecordingError(f"{dataset.folder.name}: {error}") from error


def part_of(parts: Path, index: int) -> Path:
    """Return the file of one episode's forces."""
    return parts / f"episode_{index:06d}.parquet"


def annotate_episode(
    recording: Recording, other: Recording | None, target: Path, options: argparse.Namespace, settings: str, key: str
) -> dict[str, Any]:
    """Find the forces of one episode, write them and return figures; what is there already is not done again.

    Args:
        recording: the episode.
        other: the episode of `--tare-from`, if it names one.
        target: file of the forces.
        options: of the command `annotate`.
        settings: hash of them and of the files that they name.
        key: of the task, which is kept with the forces.

    Raises:
        FinforceError: its pictures cannot be read, or the jaw not be used.
    """
    with suppress(RecordingError):
        about = read_table(target)[1]
        if about.get("key") == key:
            return about["figures"]
    setup, keypoints, name = share_setup(settings, options), parse_source(options), recording.name
    images, notes = recording.images, []
    try:
        seen = keypoints.apply(recording)
        tares, notes = borrow_tares(parse_tare_source(options.tare_from), seen, other, keypoints, setup)
        found, notes = estimate_forces(seen, setup, tares=tares), [*seen.notes, *notes]
    except RecordingError as error:
        if _NO_KEYPOINTS not in str(error):
            raise
        nothing = {"force": np.full((len(images), 3), np.nan), "message": str(error).removeprefix(f"{name}: ")}
        nothing |= {"force_stddev": nothing["force"], "scored": True, "status": NOT_FOUND}
        found = {side: ForceSeries.build(name, side, images.stamps_ns, **nothing) for side in recording.jaws}
    grasp = combine_jaws(found)
    values = grasp.column("grasp_force")
    both, why = int(np.isfinite(values).sum()), why_unanswered(found.values())
    jaws = {"both": {"images": len(values), "answered": both, "largest_N": float(np.nanmax(values)) if both else None}}
    figures = {"jaws": jaws, "without_force": bool(why), "span_s": round(len(values) / images.fps, 3)}
    figures |= {"notes": [*notes, why] if why else notes}
    about = {"key": key, "figures": figures}
    write_table(target, [grasp, *(each.renamed(f"{name}/{side}") for side, each in found.items())], about)
    return figures


class _Mark(FileModel):
    """Former entries of a feature that it has extended."""

    kept: Annotated[int, Field(strict=True, ge=0)] | None = Field(None, description="Numbers of its own")
    names: Any = Field(None, description="Of these")


def write_dataset(folder: Path, parts: Path, target: Path, options: argparse.Namespace) -> None:
    """Write a dataset with the forces of all of its episodes, in place of those that it may have already.

    Args:
        folder: of the dataset.
        parts: of the episodes' forces.
        target: to be made; see `new_folder`.
        options: of the command `annotate`.

    Raises:
        FinforceError: its rows are not those of its episodes, or its state cannot be extended.
        OSError: the folder cannot be written.
    """
    dataset = open_dataset(folder, options.color or "")
    sides, prefix = sides_of(options), options.prefix
    forces = PolicyForces(sides, options.columns, prefix)
    told: dict[int, Features] = {}
    taken: dict[int, NDArray] = {}
    for each in dataset.episodes:
        series = {one.side: one for one in read_table(part_of(parts, each.index))[0]}
        told[each.index] = _features_of(series, prefix, sides)
        taken[each.index] = forces.rows_of({side: series[side] for side in sides}, grasp_columns(series["gripper"]))
    columns = plain_columns(dataset)
    for name, rows in next(iter(told.values()), {}).items():
        names = {2: (FORCE, STDDEV), 3: AXES}.get(rows.shape[1])
        each_rows = {index: features[name] for index, features in told.items()}
        columns[name] = Column(entry=describe(rows, names, {_MARK: {}}), rows=each_rows)
    if options.into == STATE:
        columns[STATE_FEATURE] = _extend_state(dataset, taken, forces.names)
    elif options.into != NONE:
        entry = describe(next(iter(taken.values())), forces.names, {_MARK: {}})
        columns[f"observation.{prefix}"] = Column(entry=entry, rows=taken, has_stats=True)
    write_copy(dataset, target, columns)


def plain_columns(dataset: Dataset) -> dict[str, Column]:
    """Return what a copy has to change so that nothing is left of what annotate has added to a dataset."""
    columns = {}
    for name, entry in dataset.info["features"].items():
        if _MARK not in (entry.get("info") or {}):
            continue
        mark = parse_model(entry["info"][_MARK], _Mark, RecordingError)
        columns[name] = Column(entry=None, rows={})
        if mark.kept is not None:
            info = {key: value for key, value in entry["info"].items() if key != _MARK}
            plain = {**entry, "shape": [mark.kept], "names": mark.names, "info": info or None}
            plain = {key: value for key, value in plain.items() if key != "info" or value}
            nothing = {each.index: np.zeros((each.length, 0)) for each in dataset.episodes}
            columns[name] = Column(entry=plain, rows=nothing, kept=mark.kept)
    return columns


def _extend_state(dataset: Dataset, rows: Mapping[int, NDArray], names: Sequence[str]) -> Column:
    """Return `observation.state` with forces (n, k) behind its own numbers.

    Raises:
        RecordingError: there is no such feature, or not one of numbers.
    """
    plain = plain_columns(dataset).get(STATE_FEATURE)
    entry = plain.entry if plain is not None else dataset.info["features"].get(STATE_FEATURE)
    if entry is None or len(entry["shape"]) != 1 or not entry["dtype"].startswith("float"):
        found = "none" if entry is None else f"{entry['dtype']} of shape {entry['shape']}"
        raise RecordingError(
            f"{dataset.folder.name}: {STATE_FEATURE}: {found}; expected a row of floats, or --into feature"
        )
    (kept,), own = entry["shape"], entry.get("names")
    info = {**(entry.get("info") or {}), _MARK: {"kept": kept, "names": own}}
    changed = {"shape": [kept + len(names)], "names": _extend_names(own, kept, names), "info": info}
    return Column(entry={**entry, **changed}, rows=rows, kept=kept, has_stats=True)


def _extend_names(own: Any, count: int, names: Iterable[str]) -> Any:
    """Return the names of a state, a list or one list under a word such as motors, with more; a number for none."""
    if isinstance(own, dict) and len(own) == 1:
        ((word, listed),) = own.items()
        return {word: _extend_names(listed, count, names)}
    is_list = isinstance(own, list) and len(own) == count
    return [*(own if is_list else map(str, range(count))), *names]


def _check_names(dataset: Dataset, options: argparse.Namespace) -> None:
    """Refuse names that the dataset has for something else, and a state that cannot be extended.

    Raises:
        FinforceError: Its images or options cannot be used.
    """
    check_prefix(options.prefix)
    own = (f"{options.prefix}.", f"observation.{options.prefix}")
    entries, marked = dataset.info["features"], plain_columns(dataset)
    same = sorted(name for name in entries if f"{name}.".startswith(own) and name not in marked)
    if same:
        raise RecordingError(f"{dataset.folder.name}: has {', '.join(same)} already; expected another --prefix")
    if options.into == STATE:
        _extend_state(dataset, {}, ())


def _features_of(series: Mapping[str, ForceSeries], prefix: str, sides: Sequence[str]) -> Features:
    """Return what is known of the forces of an episode, by names that LeRobot hands to no policy.

    Numbers without an answer are 0, not NaN: pandas, by which LeRobot merges and converts datasets, makes missing
    values of NaN, and LeRobot cannot read these.
    """
    features, words = {}, []
    for side in sides:
        solved = series[side].solved[:, None]
        features[f"{prefix}.{side}"] = np.where(solved, series[side].force, 0.0)
        features[f"{prefix}.{side}.stddev"] = np.where(solved, series[side].column("force_stddev"), 0.0)
        features[f"{prefix}.{side}.valid"] = solved
        words.append([f"{side}: {reason}" if reason else "" for reason in no_force_reasons(series[side])])
    grasp = grasp_columns(series["gripper"])
    features[f"{prefix}.{GRASP}"] = np.nan_to_num(grasp)
    features[f"{prefix}.valid"] = np.isfinite(grasp[:, :1])
    reasons = ["; ".join(filter(None, row)) for row in zip(*words, strict=True)]
    return features | {f"{prefix}.reason": np.array(reasons, dtype=object)[:, None]}
