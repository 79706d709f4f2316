"""Label files of DeepLabCut, `CollectedData_*.csv`, old and new style."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

import numpy as np
from numpy.typing import NDArray

from lab.training.errors import LabelFileError

SCORER, INDIVIDUALS, BODYPARTS, COORDS = HEADERS = ("scorer", "individuals", "bodyparts", "coords")
FOLDER = "labeled-data"  # how the index of a frame begins
_SINGLE = "single"  # DeepLabCut's individual for body parts that are there once


@dataclass(frozen=True, kw_only=True, eq=False)
class Labels:
    """Points that somebody marked in n images.

    Attributes:
        images: (n,) paths relative to the DeepLabCut project, with slashes: labeled-data/VIDEO/img0001.png.
        names: (K,) of the body parts; INDIVIDUAL_BODYPART where there are several individuals.
        points: (n, K, 2) column and row [px]; NaN where a point was not marked because it is hidden.
    """

    images: tuple[str, ...]
    names: tuple[str, ...]
    points: NDArray


@dataclass(frozen=True, kw_only=True, eq=False)
class _Columns:
    """What the header says of the columns after the index: names, "x", "y" or "likelihood"."""

    names: list[str]
    coords: list[str]


def read_labels(path: str | Path) -> Labels:
    """Read a label file.

    Args:
        path: a CSV file whose index is one column (labeled-data/VIDEO/IMAGE) or three (labeled-data, VIDEO, IMAGE);
            the row `individuals` of multi-animal projects, backslashes and empty cells are understood.

    Raises:
        LabelFileError: the file cannot be read, lacks a header or its rows do not fit it.
    """
    path = Path(path)
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            rows = [row for row in csv.reader(file) if any(cell.strip() for cell in row)]
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise LabelFileError(f"{path}: {error}; expected DeepLabCut's CollectedData_SCORER.csv") from error
    try:
        return parse_labels(rows)
    except LabelFileError as error:
        raise LabelFileError(f"{path.name}: {error}") from error


def parse_labels(rows: Sequence[Sequence[str]]) -> Labels:
    """Return the labels of a file's rows of cells; see `read_labels`.

    Raises:
        LabelFileError: a header row is missing, or a row does not fit it.
    """
    header = {row[0].strip(): row for row in rows if row[0].strip() in HEADERS}
    frames = [row for row in rows if row[0].strip() not in HEADERS]
    for needed in (BODYPARTS, COORDS):
        if needed not in header:
            raise LabelFileError(f"no row '{needed}'; expected the header rows scorer, bodyparts and coords")
    if not frames:
        raise LabelFileError("no frame after the header; expected a row per image")
    index = 3 if frames[0][0].strip() == FOLDER else 1
    columns = _read_columns(header, index)
    names = list(dict.fromkeys(columns.names))
    points = np.full((len(frames), len(names), 2), np.nan)
    for number, row in enumerate(frames):
        _fill_points(points[number], row[index:], columns, names)
    points[np.isnan(points).any(axis=2)] = np.nan
    images = tuple(_join_index(row[:index]) for row in frames)
    repeated = sorted({image for image in images if images.count(image) > 1})
    if repeated:
        raise LabelFileError(f"{repeated[0]} stands in {images.count(repeated[0])} rows; expected one row per image")
    return Labels(images=images, names=tuple(names), points=points)


def _read_columns(header: dict[str, Sequence[str]], index: int) -> _Columns:
    """Return the names and coordinates of the columns after the index."""
    parts, coords = ([cell.strip() for cell in header[key][index:]] for key in (BODYPARTS, COORDS))
    people = [cell.strip() for cell in header.get(INDIVIDUALS, [])[index:]]
    if len(parts) != len(coords) or (people and len(people) != len(parts)):
        raise LabelFileError(f"{len(parts)} body parts for {len(coords)} coordinates; expected rows of equal length")
    several = len(set(people) - {_SINGLE}) > 1
    names = [
        f"{person}_{part}" if several and person != _SINGLE else part
        for person, part in zip(people or [_SINGLE] * len(parts), parts, strict=True)
    ]
    pairs = list(zip(names, coords, strict=True))
    if len(set(pairs)) != len(pairs) or {(name, axis) for name in names for axis in "xy"} - set(pairs):
        raise LabelFileError("the columns are not one x and one y of every body part")
    return _Columns(names=names, coords=coords)


def _fill_points(points: NDArray, cells: Sequence[str], columns: _Columns, names: list[str]) -> None:
    """Write the numbers of one row into points (K, 2)."""
    if len(cells) != len(columns.names):
        raise LabelFileError(f"a row of {len(cells)} values; the header has {len(columns.names)} columns")
    for name, axis, cell in zip(columns.names, columns.coords, cells, strict=True):
        if axis not in ("x", "y"):
            continue
        try:
            value = float(cell) if cell.strip() else np.nan
        except ValueError as error:
            raise LabelFileError(f"{name} {axis}: got {cell!r}, expected a number of pixels, or nothing") from error
        points[names.index(name), "xy".index(axis)] = value if np.isfinite(value) else np.nan


def _join_index(cells: Sequence[str]) -> str:
    """Return the path of a frame, with slashes."""
    return str(PurePosixPath("/".join(cell.strip() for cell in cells).replace("\\", "/")))
