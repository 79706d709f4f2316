"""A copy of UMI's replay buffer with arrays of forces beside its pictures, for UMI's and diffusion policies."""

from __future__ import annotations

import json
import shutil
import warnings
import zipfile
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from finforce.gripper_frames import SIDES
from finforce_eval.annotation.bag import TABLE
from finforce_eval.annotation.dataset_copy import copy_files
from finforce_eval.errors import RecordingError
from finforce_eval.evaluation.gripper import combine_jaws
from finforce_eval.policy import PolicyForces, grasp_columns
from finforce_eval.recordings.umi import CAMERA, find_episodes
from finforce_eval.recordings.zarr_store import ZarrStore
from finforce_eval.table import ForceSeries, read_table

_METADATA = ".zmetadata"  # of all arrays at once, where somebody has consolidated it


def write_buffer(path: Path, target: Path, parts: Sequence[Path], columns: Sequence[str], prefix: str) -> int:
    """Write a replay buffer with the forces of its episodes; all else stays as it is, hard links in a folder.

    For every group of numbers there is an array of float32 (n, k) and one of its flag `valid`, 0 or 1 (n,); for the
    rows see `PolicyForces`. Rows of an episode without a table of forces have no answer.

    Args:
        path: .zarr folder or .zarr.zip file.
        target: of the same kind, to be made; see `new_folder`.
        parts: folder of each episode's forces, which need not be there.
        columns: numbers to include.
        prefix: of the names, behind `robot0_`.

    Returns:
        Number of the episodes that have forces.

    Raises:
        RecordingError: the buffer cannot be read, or has such arrays already.
        OSError: the copy cannot be written.
    """
    store = ZarrStore(path)
    spans = find_episodes(store)[1]
    tables = [_read_forces(part / TABLE) if (part / TABLE).is_file() else {} for part in parts]
    sides = [side for side in SIDES if any(side in table for table in tables)] or SIDES
    forces, rows = PolicyForces(sides, columns, prefix), []
    for series, (begin, end) in zip(tables, spans.tolist(), strict=True):
        grasp = grasp_columns(combine_jaws(series)) if series else np.full((end - begin, 2), np.nan)
        rows.append(forces.rows_of(series, grasp))
        if len(rows[-1]) != end - begin:
            raise RecordingError(f"{path.name}: {len(rows[-1])} forces for {end - begin} pictures of {CAMERA}")
    arrays = _split(forces, np.concatenate(rows))
    same = sorted(arrays.keys() & set(store.list_members("data")))
    if same:
        raise RecordingError(f"{path.name}: has data/{same[0]} already; expected another --prefix")
    _write(path, target, _encode(store, arrays))
    return sum(map(bool, tables))


def _read_forces(path: Path) -> dict[str, ForceSeries]:
    """Return the forces by side of a table, whose jaws may be one case."""
    sides = {side: one for one in read_table(path)[0] for side in np.unique(one.column("side")).tolist()}
    return {side: one.at(one.column("side") == side) for side, one in sides.items()}


def _split(forces: PolicyForces, rows: NDArray[np.float32]) -> dict[str, NDArray[np.float32]]:
    """Return the arrays of the groups of rows (n, k), with their flags (n,), by their names."""
    arrays, begin = {}, 0
    for name, end in forces.groups.items():
        key = f"robot0_{name.replace('.', '_')}"
        arrays[key], arrays[f"{key}_valid"] = rows[:, begin:end], rows[:, end]
        begin = end + 1
    return arrays


def _encode(store: ZarrStore, arrays: Mapping[str, NDArray]) -> dict[str, bytes]:
    """Return the files of arrays, each of one chunk, uncompressed; and of all metadata if the store has such."""
    files, known = {}, store.find(_METADATA)
    metadata = json.loads(known) if known else {"metadata": {}}
    for key, values in arrays.items():
        about = {"zarr_format": 2, "shape": values.shape, "chunks": values.shape, "dtype": values.dtype.str}
        about |= {"compressor": None, "fill_value": 0.0, "order": "C", "filters": None}
        files[f"data/{key}/.zarray"] = json.dumps(about, indent=4).encode()
        files[f"data/{key}/{'.'.join('0' * values.ndim)}"] = np.ascontiguousarray(values).tobytes()
        metadata["metadata"][f"data/{key}/.zarray"] = about
    # sorted, as zarr expects the arrays of a group one after the other
    return files | ({_METADATA: json.dumps(metadata, indent=4, sort_keys=True).encode()} if known else {})


def _write(path: Path, target: Path, files: Mapping[str, bytes]) -> None:
    """Copy a buffer with new files in it, which take the place of old ones."""
    if path.is_file():
        shutil.copy2(path, target)
        with zipfile.ZipFile(target, "a") as file, warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # of two files the later one counts
            for name, content in files.items():
                file.writestr(name, content)
        return
    copy_files(path, target, {path / name for name in files}, lambda each: not each.name.startswith("."))
    for name, content in files.items():
        (target / name).parent.mkdir(parents=True, exist_ok=True)
        (target / name).write_bytes(content)
