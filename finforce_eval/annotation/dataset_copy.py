"""A copy of a LeRobot dataset with other columns: rows, descriptions and statistics change together."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from finforce.files import parse_json, read_json
from finforce_eval.errors import RecordingError
from finforce_eval.recordings.dataset import (
    EPISODE_STATS_V2,
    EPISODES_V3,
    INFO,
    STATS,
    Dataset,
    Episode,
    read_parquet,
    rows_of,
)

_QUANTILES = {"q01": 0.01, "q10": 0.10, "q50": 0.50, "q90": 0.90, "q99": 0.99}
_RANGES = (("min", "max"), ("q01", "q99"), ("q10", "q90"))  # by whose widths LeRobot divides
_KINDS = {"f": "float32", "b": "bool", "O": "string"}
Stats = dict[str, dict[str, Any]]  # statistics by feature and kind


@dataclass(frozen=True, kw_only=True)
class Column:
    """A feature that the copy has and the dataset has not, or not in this way.

    Attributes:
        entry: of `meta/info.json`; None leaves the feature out.
        rows: by episode, (n, k) new numbers, truths or texts.
        kept: number of values of a row that stay, before the new ones.
        has_stats: True if the new numbers, all finite, have statistics.
    """

    entry: Mapping[str, Any] | None
    rows: Mapping[int, NDArray]
    kept: int = 0
    has_stats: bool = False

    def concatenate(self, episodes: Sequence[int]) -> NDArray:
        """Return the new numbers of some episodes (n, k)."""
        return np.concatenate([self.rows[index] for index in episodes])


def describe(rows: NDArray, names: Sequence[str] | None, info: Mapping[str, Any]) -> dict[str, Any]:
    """Return the entry in `meta/info.json` of a feature with such rows (n, k)."""
    names = None if names is None else list(names)
    return {"dtype": _KINDS[rows.dtype.kind], "shape": [rows.shape[1]], "names": names, "info": dict(info)}


def write_copy(dataset: Dataset, target: Path, columns: Mapping[str, Column]) -> None:
    """Write a dataset with other columns; all else stays as it is.

    Videos are hard links where the file system has them, else copies.

    Args:
        dataset: the original.
        target: folder of the copy, which is there and empty.
        columns: by feature.

    Raises:
        RecordingError: the dataset's rows are not those of its episodes.
        OSError: the folder cannot be written.
    """
    folder, changed = dataset.folder, {each.data for each in dataset.episodes}
    copy_files(folder, target, changed, lambda path: path.suffix == ".mp4")
    for path in sorted(changed):
        own = [each for each in dataset.episodes if each.data == path]
        _write_rows(path, target / path.relative_to(folder), own, columns)
    info = read_json(folder / INFO)
    _change_entries(info["features"], {name: column.entry for name, column in columns.items()})
    (target / INFO).write_text(json.dumps(info, indent=4) + "\n", encoding="utf-8")
    _StatsWriter(dataset, columns).write(target)


def _change_entries(entries: dict[str, Any], changed: Mapping[str, Any]) -> None:
    """Put changed entries in their places, new ones behind all others; None takes one out."""
    entries |= changed
    for name in [name for name, entry in changed.items() if entry is None]:
        del entries[name]


def copy_files(folder: Path, target: Path, changed: Collection[Path], is_linked: Callable[[Path], bool]) -> None:
    """Copy all files of a folder but those that are written anew; some as hard links, where that is possible."""
    for path in sorted(folder.rglob("*")):
        if not path.is_file() or path in changed:
            continue
        copy = target / path.relative_to(folder)
        copy.parent.mkdir(parents=True, exist_ok=True)
        if is_linked(path):
            with suppress(OSError):
                os.link(path.resolve(), copy)
                continue
        shutil.copy2(path, copy)


def _write_rows(source: Path, target: Path, episodes: Sequence[Episode], columns: Mapping[str, Column]) -> None:
    """Write a Parquet file with other columns.

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
    metadata = _change_metadata(table.schema.metadata, {name: column.entry for name, column in columns.items()})
    for name, column in columns.items():
        before = table[name].combine_chunks() if name in table.column_names else None
        if before is not None and not column.kept:
            table = table.drop_columns([name])
        if column.entry is None:
            continue
        content = _join(before if column.kept else None, column, column.concatenate(order))
        place = table.column_names.index(name) if name in table.column_names else None
        table = table.append_column(name, content) if place is None else table.set_column(place, name, content)
    target.parent.mkdir(parents=True, exist_ok=True)
    file = pq.ParquetFile(source).metadata
    group = max((file.row_group(number).num_rows for number in range(file.num_row_groups)), default=1)
    pq.write_table(table.replace_schema_metadata(metadata), target, row_group_size=max(group, 1))


def _join(before: pa.Array | None, column: Column, rows: NDArray) -> pa.Array:
    """Return a column of the new rows (n, k), behind those numbers of the old ones that are kept."""
    kind = pa.type_for_alias(column.entry["dtype"])
    if before is not None:
        old = np.array(before.to_pylist(), dtype=float).reshape(len(rows), -1)
        rows = np.concatenate([old[:, : column.kept], rows], axis=1)
    content, width = pa.array(rows.ravel().tolist(), kind), rows.shape[1]
    if width == 1:
        return content
    if before is not None and pa.types.is_list(before.type):
        return pa.ListArray.from_arrays(pa.array(np.arange(0, rows.size + 1, width, dtype=np.int32)), content)
    return pa.FixedSizeListArray.from_arrays(content, width)


def _change_metadata(
    metadata: Mapping[bytes, bytes] | None, entries: Mapping[str, Mapping[str, Any] | None]
) -> dict[bytes, bytes]:
    """Return a schema's metadata with changed features in what the `datasets` library keeps there, if it does."""
    metadata = dict(metadata or {})
    try:
        content = json.loads(metadata[b"huggingface"])
        known = content["info"]["features"]
    except (KeyError, ValueError, TypeError):
        return metadata
    kinds = {each.get("_type") for each in known.values() if isinstance(each, dict)}
    kind = "List" if "List" in kinds else "Sequence"  # which of them depends on that library's version
    changed: dict[str, Any] = {}
    for feature, entry in entries.items():
        changed[feature] = None
        if entry is not None:
            value, (length,) = {"dtype": entry["dtype"], "_type": "Value"}, entry["shape"]
            changed[feature] = value if length == 1 else {"feature": value, "length": length, "_type": kind}
    _change_entries(known, {name: entry for name, entry in changed.items() if entry is not None or name in known})
    return metadata | {b"huggingface": json.dumps(content).encode()}


class _StatsWriter:
    """Writes the statistics of a copy, wherever its layout keeps some.

    Args:
        dataset: the original.
        columns: by feature.
    """

    def __init__(self, dataset: Dataset, columns: Mapping[str, Column]) -> None:
        self._version, self._columns = dataset.info["codebase_version"], columns
        self._all = [each.index for each in dataset.episodes]
        self._constant = {
            name: np.ptp(column.concatenate(self._all), axis=0) == 0.0
            for name, column in columns.items()
            if column.has_stats and self._all
        }

    def write(self, target: Path) -> None:
        """Change the files that were copied."""
        if (target / STATS).is_file():
            stats = self._change(read_json(target / STATS), self._all)
            (target / STATS).write_text(json.dumps(stats, indent=4) + "\n", encoding="utf-8")
        if (target / EPISODE_STATS_V2).is_file():
            lines = [parse_json(text) for text in (target / EPISODE_STATS_V2).read_text(encoding="utf-8").splitlines()]
            for line in lines:
                line["stats"] = self._change(line["stats"], [line["episode_index"]])
            text = "".join(json.dumps(line) + "\n" for line in lines)
            (target / EPISODE_STATS_V2).write_text(text, encoding="utf-8")
        for path in sorted((target / EPISODES_V3).glob("*/*.parquet")) if self._version == "v3.0" else ():
            pq.write_table(self._change_table(read_parquet(path)), path)

    def _change_table(self, table: pa.Table) -> pa.Table:
        """Return a table of episodes of layout v3 with changed statistics."""
        parts = {name: name.split("/")[1:] for name in table.column_names if name.startswith("stats/")}
        parts = {name: part for name, part in parts.items() if len(part) == 2}
        known = {name: table[name] for name, (feature, _) in parts.items() if feature in self._columns}
        kinds, rows = dict.fromkeys(kind for _, kind in parts.values()), []
        for row, index in enumerate(table["episode_index"].to_pylist()):
            before: Stats = {"": kinds}
            for name, values in known.items():
                before.setdefault(parts[name][0], {})[parts[name][1]] = values[row].as_py()
            rows.append(self._change(before, [index]))
        table = table.drop_columns(list(known))
        for feature in self._columns if rows else ():
            for kind in rows[0].get(feature, ()):
                name = f"stats/{feature}/{kind}"
                content = pa.array([row[feature][kind] for row in rows], known[name].type if name in known else None)
                table = table.append_column(name, content)
        return table

    def _change(self, stats: Stats, episodes: Sequence[int]) -> Stats:
        """Return the statistics of some episodes with those of the columns."""
        kinds = list(next((each for each in stats.values() if isinstance(each, dict)), {}))
        stats = dict(stats)
        for name, column in self._columns.items():
            before = stats.pop(name, None)
            if column.entry is None or (column.kept and before is None):
                continue
            new: dict[str, Any] = {}
            if column.has_stats:
                new = describe_numbers(column.concatenate(episodes), self._constant[name])
            if column.kept:
                stats[name] = {
                    kind: values if kind == "count" else [*values[: column.kept], *new.get(kind, ())]
                    for kind, values in before.items()
                    if kind == "count" or kind in new or not column.has_stats
                }
            elif column.has_stats:
                stats[name] = {kind: new[kind] for kind in kinds if kind in new}
        return stats


def describe_numbers(rows: NDArray, constant: NDArray[np.bool_]) -> dict[str, list[float]]:
    """Return the statistics of finite rows (n, k), by kind.

    LeRobot divides by widths and deviations plus 1e-8, so that a number that never changed would become huge once it
    does. Where a width, or the deviation of a number that is `constant` (k,) in the whole dataset, is zero, it is 1.
    """
    found = {"count": np.array([len(rows)])}
    found |= {kind: getattr(rows, kind)(axis=0, dtype=float) for kind in ("mean", "std")}
    found |= {kind: getattr(rows, kind)(axis=0).astype(float) for kind in ("min", "max")}
    found |= {kind: np.quantile(rows.astype(float), share, axis=0) for kind, share in _QUANTILES.items()}
    found["std"][constant] = 1.0
    for low, high in _RANGES:
        flat = constant if (low, high) == ("min", "max") else found[low] == found[high]
        found[high] = np.where(flat, found[low] + 1.0, found[high])
    return {kind: values.tolist() for kind, values in found.items()}
