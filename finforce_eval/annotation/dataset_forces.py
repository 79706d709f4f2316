"""A LeRobot dataset with the forces in every frame: a task per episode, then the dataset anew, whole or not at all."""

from __future__ import annotations

import argparse
import json
import os
import shutil
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from finforce.files import FileError, check_inside, check_plain, parse_json, read_json
from finforce_eval.errors import RecordingError
from finforce_eval.evaluation.forces import NOT_FOUND, estimate_forces, no_force_reasons, why_unanswered
from finforce_eval.evaluation.gripper import combine_jaws
from finforce_eval.evaluation.keypoint_source import parse_source, sides_of
from finforce_eval.evaluation.setup import describe_options, read_contacts, share_setup
from finforce_eval.recordings.dataset import (
    EPISODE_STATS_V2,
    EPISODES_V3,
    INFO,
    STATS,
    Dataset,
    Episode,
    open_dataset,
    read_parquet,
    recording_of,
    rows_of,
)
from finforce_eval.recordings.frames import choose_camera
from finforce_eval.recordings.tracks import Recording
from finforce_eval.table import ForceSeries, read_table, write_table
from finforce_eval.tasks import Task, hash_settings

_NO_KEYPOINTS = "no key points in"
_QUANTILES = {"q01": 0.01, "q10": 0.10, "q50": 0.50, "q90": 0.90, "q99": 0.99}
Features = dict[str, NDArray]  # new columns by name: rows (n, k) of numbers, or (n, 1) of truths or texts


def episode_tasks(folder: Path, parts: Path, options: argparse.Namespace) -> list[Task]:
    """Return a task per episode of a dataset, each of which writes its table of forces into a folder of parts.

    Raises:
        FinforceError: the dataset cannot be read, or its camera is not known.
    """
    dataset = open_dataset(folder, options.color or "")
    camera = choose_camera(parse_source(options).choice, dataset.image_size, folder.name)
    _check_files(dataset)
    own = (f"{options.prefix}.force.", f"{options.prefix}.grasp_force")
    same = sorted(name for name in dataset.info["features"] if name.startswith(own))
    if same:
        raise RecordingError(f"{folder.name}: has {', '.join(same)} already; expected another --prefix")
    settings, tasks = describe_options(options), []
    for episode in dataset.episodes:
        recording = recording_of(dataset, episode, camera, sides_of(options))
        if not tasks:
            read_contacts(options).check(recording)
        target = part_of(parts, episode.index)
        files = [path for path in (episode.video, episode.data) if path is not None]
        key = hash_settings(settings | {"episode": episode.index}, files)
        given = {"recording": recording, "target": target, "options": options, "settings": hash_settings(settings)}
        about = {"name": recording.name, "key": key, "output": str(target)}
        files = [*map(Path, settings["files"]), *files]
        tasks.append(Task(work=annotate_episode, given=given | {"key": key}, files=files, **about))
    return tasks


def _check_files(dataset: Dataset) -> None:
    """Refuse a dataset some of whose files are not there, or lead out of it.

    Raises:
        RecordingError: which, and how many.
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
    recording: Recording, target: Path, options: argparse.Namespace, settings: str, key: str
) -> dict[str, Any]:
    """Find the forces of one episode, write them and return figures; what is there already is not done again.

    Args:
        recording: the episode.
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
        found, notes = estimate_forces(seen, setup), list(seen.notes)
    except RecordingError as error:
        if _NO_KEYPOINTS not in str(error):
            raise
        nothing = {"force": np.full((len(images), 3), np.nan), "message": str(error).removeprefix(f"{name}: ")}
        nothing |= {"force_stddev": nothing["force"], "scored": True, "status": NOT_FOUND}
        found = {side: ForceSeries.build(name, side, images.stamps, **nothing) for side in recording.jaws}
    grasp = combine_jaws(found)
    values = grasp.column("grasp_force")
    both, why = int(np.isfinite(values).sum()), why_unanswered(found.values())
    jaws = {"both": {"images": len(values), "answered": both, "largest_N": float(np.nanmax(values)) if both else None}}
    figures = {"jaws": jaws, "without_force": bool(why), "span_s": round(len(values) / images.fps, 3)}
    figures |= {"notes": [*notes, why] if why else notes}
    about = {"key": key, "figures": figures}
    write_table(target, [grasp, *(each.renamed(f"{name}/{side}") for side, each in found.items())], about)
    return figures


def write_dataset(folder: Path, parts: Path, target: Path, options: argparse.Namespace) -> None:
    """Write a dataset with the forces of all of its episodes.

    Everything else stays as it is; videos are hard links where the file system has them, else copies.

    Args:
        folder: of the dataset.
        parts: of the episodes' forces.
        target: to be made; see `new_folder`.
        options: of the command `annotate`.

    Raises:
        RecordingError: its rows are not those of its episodes.
        OSError: the folder cannot be written.
    """
    dataset = open_dataset(folder, options.color or "")
    features = {
        each.index: _features_of(part_of(parts, each.index), options.prefix, sides_of(options))
        for each in dataset.episodes
    }
    described = _describe_features(next(iter(features.values()), {}))
    changed = {each.data for each in dataset.episodes}
    _copy_rest(folder, target, changed)
    for path in sorted(changed):
        own = [each for each in dataset.episodes if each.data == path]
        _add_columns(path, target / path.relative_to(folder), own, features, described)
    info = read_json(folder / INFO)
    info["features"] |= described
    (target / INFO).write_text(json.dumps(info, indent=4) + "\n", encoding="utf-8")
    _write_stats(dataset, target, features)


def _features_of(part: Path, prefix: str, sides: Sequence[str]) -> Features:
    """Return the new columns of an episode by their names, none of which the field has agreed upon."""
    series = {each.side: each for each in read_table(part)[0]}
    features, words = {}, []
    for side in sides:
        forces = series[side]
        features[f"{prefix}.force.{side}"] = forces.force
        features[f"{prefix}.force.{side}.stddev"] = forces.column("force_stddev")
        words.append([f"{side}: {reason}" if reason else "" for reason in no_force_reasons(forces)])
    grasp = series["gripper"].column("grasp_force").astype(float)[:, None]
    features[f"{prefix}.grasp_force"] = grasp
    features[f"{prefix}.force.valid"] = np.isfinite(grasp)
    reasons = ["; ".join(filter(None, row)) for row in zip(*words, strict=True)]
    return features | {f"{prefix}.force.reason": np.array(reasons, dtype=object)[:, None]}


def _describe_features(features: Features) -> dict[str, dict[str, Any]]:
    """Return the entries of `meta/info.json`."""
    kinds = {"f": "float32", "b": "bool", "O": "string"}
    return {
        name: {
            "dtype": kinds[values.dtype.kind],
            "shape": [values.shape[1]],
            "names": ["x", "y", "z"] if values.shape[1] == 3 else None,
        }
        for name, values in features.items()
    }


def _copy_rest(folder: Path, target: Path, changed: set[Path]) -> None:
    """Copy all files of a dataset but those that are written anew; videos as links, where that is possible."""
    for path in sorted(folder.rglob("*")):
        if not path.is_file() or path in changed:
            continue
        copy = target / path.relative_to(folder)
        copy.parent.mkdir(parents=True, exist_ok=True)
        if path.suffix == ".mp4":
            with suppress(OSError):
                os.link(path.resolve(), copy)
                continue
        shutil.copy2(path, copy)


def _add_columns(
    source: Path,
    target: Path,
    episodes: Sequence[Episode],
    features: Mapping[int, Features],
    described: Mapping[str, Mapping[str, Any]],
) -> None:
    """Write a Parquet file with the new columns behind its own, which stay as they are.

    Raises:
        RecordingError: its rows are not those of its episodes, in their order.
    """
    table = read_parquet(source)
    for episode in episodes:
        rows_of(table, episode, source.name)
    order = expected = sorted(episode.index for episode in episodes)
    if "episode_index" in table.column_names:
        indices = table["episode_index"].to_numpy()
        order = indices[np.r_[True, np.diff(indices) != 0][: len(indices)]].tolist()
    if sorted(order) != expected:
        raise RecordingError(
            f"{source.name}: its rows are of the episodes {order}; expected {expected}, each in one piece"
        )
    for name, entry in described.items():
        values = np.concatenate([features[index][name] for index in order])
        column = pa.array(values.ravel().tolist(), pa.type_for_alias(entry["dtype"]))
        if values.shape[1] > 1:
            column = pa.FixedSizeListArray.from_arrays(column, values.shape[1])
        table = table.append_column(name, column)
    table = table.replace_schema_metadata(_with_features(table.schema.metadata, described))
    target.parent.mkdir(parents=True, exist_ok=True)
    metadata = pq.ParquetFile(source).metadata
    group = max((metadata.row_group(number).num_rows for number in range(metadata.num_row_groups)), default=1)
    pq.write_table(table, target, row_group_size=max(group, 1))


def _with_features(
    metadata: Mapping[bytes, bytes] | None, described: Mapping[str, Mapping[str, Any]]
) -> dict[bytes, bytes]:
    """Return a schema's metadata with the new features in what the `datasets` library keeps there, if it does."""
    metadata = dict(metadata or {})
    try:
        content = json.loads(metadata[b"huggingface"])
        known = content["info"]["features"]
    except (KeyError, ValueError, TypeError):
        return metadata
    kinds = {each.get("_type") for each in known.values() if isinstance(each, dict)}
    kind = "List" if "List" in kinds else "Sequence"  # which of them depends on that library's version
    for feature, entry in described.items():
        value, (length,) = {"dtype": entry["dtype"], "_type": "Value"}, entry["shape"]
        known[feature] = value if length == 1 else {"feature": value, "length": length, "_type": kind}
    return metadata | {b"huggingface": json.dumps(content).encode()}


def _write_stats(dataset: Dataset, target: Path, features: Mapping[int, Features]) -> None:
    """Add the statistics of the new features, of the frames that have a force, where the dataset keeps such."""
    if (target / STATS).is_file() and features:
        stats = read_json(target / STATS)
        whole = {
            name: np.concatenate([each[name] for each in features.values()]) for name in next(iter(features.values()))
        }
        stats |= _describe_columns(whole, _kinds_of(stats))
        (target / STATS).write_text(json.dumps(stats, indent=4) + "\n", encoding="utf-8")
    if (target / EPISODE_STATS_V2).is_file():
        lines = [parse_json(text) for text in (target / EPISODE_STATS_V2).read_text(encoding="utf-8").splitlines()]
        for line in lines:
            line["stats"] |= _describe_columns(features[line["episode_index"]], _kinds_of(line["stats"]))
        (target / EPISODE_STATS_V2).write_text("".join(json.dumps(line) + "\n" for line in lines), encoding="utf-8")
    for path in (
        sorted((target / EPISODES_V3).glob("*/*.parquet")) if dataset.info["codebase_version"] == "v3.0" else ()
    ):
        table = read_parquet(path)
        known = {name.rpartition("/")[2]: None for name in table.column_names if name.startswith("stats/")}
        rows = [_describe_columns(features[index], list(known)) for index in table["episode_index"].to_pylist()]
        for name, kinds in rows[0].items() if rows else ():
            for kind in kinds:
                table = table.append_column(f"stats/{name}/{kind}", pa.array([row[name][kind] for row in rows]))
        pq.write_table(table, path)


def _kinds_of(stats: Mapping[str, Any]) -> list[str]:
    """Return the statistics that the features of a dataset have."""
    return list(next((each for each in stats.values() if isinstance(each, dict)), {}))


def _describe_columns(features: Features, kinds: Sequence[str]) -> dict[str, dict[str, list[float]]]:
    """Return the statistics of the numbers by feature, those of the kinds that a dataset has.

    A column without one known row has NaN; `count` is the number of known rows.
    """
    found: dict[str, dict[str, Any]] = {}
    for name, values in features.items():
        if values.dtype.kind != "f":
            continue
        known = values[np.isfinite(values).all(axis=1)]
        stats: dict[str, Any] = {"count": [len(known)]}
        if len(known):
            stats |= {kind: getattr(known, kind)(axis=0).tolist() for kind in ("min", "max", "mean", "std")}
            stats |= {kind: np.quantile(known, share, axis=0).tolist() for kind, share in _QUANTILES.items()}
        found[name] = {kind: stats.get(kind, [float("nan")] * values.shape[1]) for kind in kinds}
    return found
