"""Forces as features of a LeRobot dataset: names, columns, descriptions, statistics."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from finforce_eval.annotation.lerobot.images import rows_of
from finforce_eval.annotation.lerobot.layout import Episode, import_arrow, read_table
from finforce_eval.errors import RecordingError

_AXES = ["x", "y", "z"]
_QUANTILES = {"q01": 0.01, "q10": 0.10, "q50": 0.50, "q90": 0.90, "q99": 0.99}


class FeatureNames:
    """The names of the new features, none of which the field has agreed upon.

    Args:
        prefix: of all but the last words, as "observation".
        sides: of the jaws.

    Attributes:
        numeric: feature -> column of the forces.
        reason: feature that says why a frame has no force.
        valid: feature that says whether all jaws have one.
        all: every new feature.
    """

    def __init__(self, prefix: str, sides: Sequence[str]) -> None:
        self.numeric = {}
        for side in sides:
            self.numeric[f"{prefix}.force.{side}"] = side
            self.numeric[f"{prefix}.force.{side}.stddev"] = f"{side}.stddev"
        self.numeric[f"{prefix}.grasp_force"] = "grasp"
        self.valid, self.reason = f"{prefix}.force.valid", f"{prefix}.force.reason"
        self.all = {*self.numeric, self.valid, self.reason}

    def describe(self) -> dict[str, dict[str, Any]]:
        """Return the entries of `meta/info.json`."""
        entries: dict[str, dict[str, Any]] = {}
        for feature, column in self.numeric.items():
            is_vector = column != "grasp"
            shape, axes = ([3], _AXES) if is_vector else ([1], None)
            entries[feature] = {"dtype": "float32", "shape": shape, "names": axes}
        entries[self.valid] = {"dtype": "bool", "shape": [1], "names": None}
        entries[self.reason] = {"dtype": "string", "shape": [1], "names": None}
        return entries


def add_features(info: dict[str, Any], names: FeatureNames) -> None:
    """Add the new features to the content of `meta/info.json`."""
    info["features"] |= names.describe()


def stack_episodes(columns: Mapping[int, Mapping[str, NDArray]]) -> dict[str, NDArray]:
    """Return the columns of all episodes together, in their order."""
    return _join(columns, sorted(columns))


def _join(columns: Mapping[int, Mapping[str, NDArray]], order: Sequence[int]) -> dict[str, NDArray]:
    """Return the columns of some episodes one after the other."""
    names = [name for name in next(iter(columns.values()), {}) if name != "key"]
    return {name: np.concatenate([columns[index][name] for index in order]) for name in names}


def describe_column(values: NDArray, kinds: Sequence[str]) -> dict[str, list[float]]:
    """Return the statistics of the rows (n, k) that are known, those of the kinds that a dataset has.

    A column without one known row has NaN; `count` is the number of known rows.
    """
    known = values[np.isfinite(values).all(axis=1)]
    found: dict[str, Any] = {"count": [len(known)]}
    if not len(known):
        return {kind: found.get(kind, [float("nan")] * values.shape[1]) for kind in kinds}
    found |= {name: getattr(known, name)(axis=0).tolist() for name in ("min", "max", "mean", "std")}
    found |= {name: np.quantile(known, share, axis=0).tolist() for name, share in _QUANTILES.items()}
    return {kind: found.get(kind, [float("nan")] * values.shape[1]) for kind in kinds}


def add_columns(
    source: Path,
    target: Path,
    episodes: Sequence[Episode],
    columns: Mapping[int, Mapping[str, NDArray]],
    names: FeatureNames,
) -> None:
    """Write a Parquet file with the new columns behind its own, which stay as they are.

    Raises:
        RecordingError: its rows are not those of its episodes, in their order.
    """
    parquet = import_arrow("pyarrow.parquet")
    table = read_table(source)
    for episode in episodes:
        rows_of(table, episode, source.name)
    whole = _join(columns, _order_of(table, episodes, source.name))
    for feature, values in _arrow_columns(whole, names).items():
        table = table.append_column(feature, values)
    table = table.replace_schema_metadata(_with_features(table.schema.metadata, names))
    target.parent.mkdir(parents=True, exist_ok=True)
    file = parquet.ParquetFile(source)
    group = max((file.metadata.row_group(number).num_rows for number in range(file.num_row_groups)), default=1)
    parquet.write_table(table, target, row_group_size=max(group, 1))


def _order_of(table: Any, episodes: Sequence[Episode], name: str) -> list[int]:
    """Return the episodes as they come in a file's rows."""
    expected = sorted(episode.index for episode in episodes)
    if "episode_index" not in table.column_names:
        return expected
    indices = np.asarray(table["episode_index"].to_pylist(), dtype=np.int64)
    order = indices[np.r_[True, np.diff(indices) != 0][: len(indices)]].tolist()
    if sorted(order) != expected:
        raise RecordingError(f"{name}: the rows are of the episodes {order}; expected {expected}, each in one piece")
    return order


def _arrow_columns(columns: Mapping[str, NDArray], names: FeatureNames) -> dict[str, Any]:
    """Return the new columns of a Parquet file."""
    pyarrow = import_arrow()
    found: dict[str, Any] = {}
    for feature, column in names.numeric.items():
        values = np.asarray(columns[column], np.float32)
        flat = pyarrow.array(values.ravel())
        found[feature] = flat if values.shape[1] == 1 else pyarrow.FixedSizeListArray.from_arrays(flat, values.shape[1])
    found[names.valid] = pyarrow.array(columns["valid"].ravel())
    found[names.reason] = pyarrow.array(columns["reason"].ravel().tolist(), pyarrow.string())
    return found


def _with_features(metadata: Mapping[bytes, bytes] | None, names: FeatureNames) -> dict[bytes, bytes]:
    """Return a schema's metadata with the new features in what the `datasets` library keeps there, if it does."""
    metadata = dict(metadata or {})
    try:
        described = json.loads(metadata[b"huggingface"])
        known = described["info"]["features"]
    except (KeyError, ValueError, TypeError):
        return metadata
    kinds = {each.get("_type") for each in known.values() if isinstance(each, dict)}
    kind = "List" if "List" in kinds else "Sequence"  # which of them depends on that library's version
    for feature, entry in names.describe().items():
        value = {"dtype": entry["dtype"], "_type": "Value"}
        length = entry["shape"][0]
        known[feature] = value if length == 1 else {"feature": value, "length": length, "_type": kind}
    return metadata | {b"huggingface": json.dumps(described).encode()}
