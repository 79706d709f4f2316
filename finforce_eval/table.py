"""Force over time as one table: a row for each image and jaw, named columns with units, written as Parquet."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any
from uuid import uuid4

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import ArrayLike, NDArray

from finforce.errors import one_line
from finforce.messages import SECOND
from finforce_eval.errors import RecordingError

AXES = "xyz"
# Vectors in the jaw frame, a column for each axis, and their units.
VECTORS = {
    "force": "N",  # that the object applies to the jaw; NaN where it is not trusted
    "torque": "N m",  # about the jaw's origin
    "force_stddev": "N",
    "torque_stddev": "N m",
    "true_force": "N",  # as measured; NaN where it was not
    "true_torque": "N m",
    "contact_location": "m",  # where the force acts on the undeformed jaw
    "contact_point": "m",  # the same on the deformed one
    "gravity": "",  # its direction in the gripper's frame
}
# All other columns and their units; those with "each" hold a list per row.
UNITS = {
    "case": "",  # name of the recording, with the jaw where there are two
    "side": "",  # left or right
    "stamp": "ns",  # of the image
    "magnitude_stddev": "N",
    "status": "",  # the estimator's own word
    "message": "",  # its words where there is no force
    "residual": "m",  # weighted rms of the key points used
    "used": "each key point",
    "step_ms": "ms",  # of the solver
    "detector_ms": "ms",  # from image to key points; NaN where it was not timed
    "latency_ms": "ms",  # from what the call began with, images or key points, to the force
    "cycle": "",  # of loading, 0 without phases
    "direction": "",  # load, unload, or "" without phases
    "scored": "",  # in a record phase; every image without phases
    "contact_source": "",  # what gave the contact
    "contact_height": "m",  # weighted mean on the undeformed surface of the contact that the image was solved with
    "true_height": "m",  # of the pressure centre of the measured force
    "touching": "",  # whether the object touches, as the solver decides
    "contact_status": "",  # the contact estimator's own word
    "contact_ms": "ms",  # of the contact estimator
    "points_x": "m, each contact point",
    "points_y": "m, each contact point",
    "points_z": "m, each contact point",
    "points_weight": "each contact point",
    "points_touching": "",  # whether the contact was given as touching
    "pixel_error": "px, each key point",  # NaN where the point was hidden, or no pixel was named
    "point_error": "m, each key point",  # in the jaw frame; NaN where the point was not accepted
    "visible": "each key point",  # the camera could see it
    "accepted": "each key point",  # it was handed on to the solver
    "jaw_distance": "m",  # between the jaws, as it was seen
    "true_jaw_distance": "m",
    "elevation": "m",  # of the gripper
    "grasp_force": "N",  # of the gripper: the smaller of the jaws' forces
    "grasp_stddev": "N",
}
WAITING = "waiting"  # status of an image that the tare still needs
_ABOUT = b"finforce"
_LISTS = {name for name, unit in UNITS.items() if "each" in unit}


class ForceSeries:
    """The rows of one jaw of one recording, with its columns as arrays.

    Args:
        table: the rows, in the order of their stamps.
    """

    def __init__(self, table: pd.DataFrame) -> None:
        self.table = table

    @classmethod
    def build(cls, name: str, side: str, stamps: ArrayLike, **columns: Any) -> ForceSeries:
        """Return the rows of a jaw.

        Args:
            name: of the case.
            side: "left" or "right".
            stamps: (n,) of the images [ns].
            columns: see `VECTORS`, (n, 3), and `UNITS`, (n,), (n, k) or one value for all; None is left out.
        """
        table = pd.DataFrame({"stamp": np.asarray(stamps, dtype=np.int64)})
        table.attrs = {"case": name, "side": side}
        return cls(table.assign(case=name, side=side)).with_columns(**columns)

    def with_columns(self, **columns: Any) -> ForceSeries:
        """Return the rows with other columns; see `build`."""
        known: dict[str, Any] = {}
        for name, values in columns.items():
            if values is None:
                continue
            if name in VECTORS:
                array = np.asarray(values, dtype=np.float64).reshape(-1, 3)
                known |= {f"{name}_{axis}": array[:, number] for number, axis in enumerate(AXES)}
            elif name in _LISTS:
                known[name] = pd.Series(list(values), dtype=object)
            else:
                known[name] = values
        return ForceSeries(self.table.assign(**known))

    def at(self, rows: NDArray) -> ForceSeries:
        """Return some rows, by a mask (n,) or their numbers."""
        chosen = self.table[rows] if rows.dtype == bool else self.table.iloc[rows]
        return ForceSeries(chosen.reset_index(drop=True))

    def renamed(self, name: str) -> ForceSeries:
        """Return the rows under another name of the case."""
        return self.with_columns(case=name)

    def __len__(self) -> int:
        """Images."""
        return len(self.table)

    def has(self, name: str) -> bool:
        """Say whether a column, or the first of a vector, is there."""
        return name in self.table or f"{name}_x" in self.table

    def column(self, name: str) -> NDArray:
        """Return a column (n,), one of lists (n, k), or a vector (n, 3); NaN (n,) or (n, 3) where it is not there."""
        if name in VECTORS:
            if not self.has(name):
                return np.full((len(self), 3), np.nan)
            return np.column_stack([self.table[f"{name}_{axis}"].to_numpy(np.float64) for axis in AXES])
        if name not in self.table:
            return np.full(len(self), np.nan)
        values = self.table[name]
        if name in _LISTS:
            return np.array([np.asarray(row) for row in values])
        return values.to_numpy(dtype=str) if isinstance(values.dtype, pd.StringDtype) else values.to_numpy()

    @property
    def name(self) -> str:
        """Name of the case."""
        return str(self.table["case"].iloc[0] if len(self) else self.table.attrs["case"])

    @property
    def side(self) -> str:
        """The side of the jaw, "left" or "right"."""
        return str(self.table["side"].iloc[0] if len(self) else self.table.attrs["side"])

    @property
    def stamps_ns(self) -> NDArray[np.int64]:
        """Image times (n,) [ns]."""
        return self.column("stamp")

    @property
    def stamps(self) -> NDArray[np.float64]:
        """Image times (n,) [s]."""
        return SECOND * self.stamps_ns

    @property
    def seconds(self) -> NDArray[np.float64]:
        """Time since the first image (n,) [s]."""
        return (self.stamps_ns - self.stamps_ns[0]) * 1e-9

    @property
    def force(self) -> NDArray[np.float64]:
        """Estimate (n, 3) [N], NaN where it is not trusted."""
        return self.column("force")

    @property
    def true_force(self) -> NDArray[np.float64]:
        """Measured force (n, 3) [N], NaN where it was not measured."""
        return self.column("true_force")

    @property
    def solved(self) -> NDArray[np.bool_]:
        """Images with a trusted estimate (n,)."""
        return np.isfinite(self.force).all(axis=1)

    @property
    def magnitude(self) -> NDArray[np.float64]:
        """Norm of the estimate (n,) [N]."""
        return np.linalg.norm(self.force, axis=1)

    @property
    def true_magnitude(self) -> NDArray[np.float64]:
        """Norm of the true force (n,) [N]."""
        return np.linalg.norm(self.true_force, axis=1)

    @property
    def error(self) -> NDArray[np.float64]:
        """Norm of the estimate minus norm of the truth (n,) [N]; NaN where either is missing."""
        return self.magnitude - self.true_magnitude

    @property
    def lag(self) -> NDArray[np.float64]:
        """Time from what the call began with, images or key points, to the force (n,) [s]."""
        return 1e-3 * self.column("latency_ms" if self.has("latency_ms") else "step_ms")

    @property
    def scored(self) -> NDArray[np.bool_]:
        """Images in a `record` phase (n,); every image without phases."""
        return self.column("scored").astype(bool)

    @property
    def counted(self) -> NDArray[np.bool_]:
        """Images that enter the score (n,): scored, solved, and with a truth."""
        return self.scored & np.isfinite(self.error)


def stddev_along(force: NDArray[np.float64], stddev: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the standard deviation along each force (n,) [N] of forces and deviations along the axes (n, 3) [N]."""
    norm = np.linalg.norm(force, axis=1, keepdims=True)
    along = np.divide(force, norm, out=np.zeros_like(force), where=norm > 0.0)
    return np.linalg.norm(along * stddev, axis=1)


def unit_of(column: str) -> str:
    """Return the unit of a column."""
    return UNITS.get(column, VECTORS.get(column[:-2], ""))


def write_table(path: Path, series: Sequence[ForceSeries], about: Mapping[str, Any]) -> None:
    """Write the rows of all jaws of a recording as one Parquet file that is whole or not there.

    Args:
        path: of the file.
        series: of the jaws.
        about: settings and machine of the run, as JSON in the metadata of the file.

    Raises:
        OSError: it cannot be written.
    """
    table = pa.Table.from_pandas(pd.concat([each.table for each in series], ignore_index=True), preserve_index=False)
    fields = [field.with_metadata({"unit": unit_of(field.name)}) for field in table.schema]
    metadata = {**(table.schema.metadata or {}), _ABOUT: json.dumps(dict(about)).encode()}
    part = path.with_name(f".{path.name}.{uuid4().hex}.part")
    try:
        pq.write_table(table.cast(pa.schema(fields, metadata=metadata)), part)
        os.replace(part, path)
    finally:
        part.unlink(missing_ok=True)


def read_table(path: Path) -> tuple[list[ForceSeries], dict[str, Any]]:
    """Return the series of a file by `write_table`, and what it says about them.

    Raises:
        RecordingError: the file is damaged, or another program's.
    """
    try:
        table = pq.read_table(path)
        if _ABOUT not in (table.schema.metadata or {}):
            raise LookupError("a table of another program")
        about = json.loads(table.schema.metadata[_ABOUT])
        jaws = table.to_pandas().groupby(["case", "side"], sort=False, dropna=False)
        series = [ForceSeries(_drop_unknown(rows)) for _, rows in jaws]
    except Exception as error:  # pyarrow and its decompressors each have their own classes
        raise RecordingError(f"{path}: {one_line(error)}; expected what finforce evaluate --out writes") from error
    return series, about


def _drop_unknown(rows: pd.DataFrame) -> pd.DataFrame:
    """Return rows without the columns that another jaw of the file has and this one not."""
    unknown = [name for name in rows if name not in ("case", "stamp") and rows[name].isna().all()]
    kept = [name for name in unknown if name[:-2] in ("force", "true_force")]
    return rows.drop(columns=[name for name in unknown if name not in kept]).reset_index(drop=True)
