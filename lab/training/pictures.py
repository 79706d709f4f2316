"""Data sets of rectified pictures of many fingers with their templates, in memory and as shards on disk."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from finforce_eval.tasks import OK, EngineOptions, Manifest, Task, run_tasks
from lab.training.commands import TrainingError

MARGIN = 28  # px of padding all round, room for shifting and turning a picture
TRAIN, VALIDATION = "train", "val"  # how the names of shards begin
_COLUMNS = ("picture", "rest", "place", "visible", "template", "finger", "keypoints")


@dataclass(frozen=True, kw_only=True, eq=False)
class FingerPictures:
    """Pictures of the side planes of fingers, and where points of their material are.

    Attributes:
        picture: (n, h, w, 3) uint8 RGB, square to the side plane, with MARGIN pixels of padding all round.
        rest: (n, P, 2) float32 column and row of points of the finger at rest, in the template [px]; the mark first.
        place: (n, P, 2) float32 column and row of the same points in the padded picture [px]; NaN where not known.
        visible: (n, P) bool, whether a point can be seen.
        keypoints: (n,) how many of the points, from the first on, are key points; the others lie anywhere.
        template: (f, h', w', 3) uint8, the fingers at rest on the unpadded grid.
        finger: (n,) index of a picture's template.
    """

    picture: NDArray
    rest: NDArray
    place: NDArray
    visible: NDArray
    keypoints: NDArray
    template: NDArray
    finger: NDArray

    def __len__(self) -> int:
        return len(self.picture)

    @property
    def middle(self) -> NDArray:
        """The pictures (n, h', w', 3) without their padding."""
        return self.picture[:, MARGIN:-MARGIN, MARGIN:-MARGIN]

    def take(self, indices: NDArray) -> FingerPictures:
        """Return the pictures of some indices (m,), or of a mask (n,)."""
        columns = {name: getattr(self, name)[indices] for name in _COLUMNS if name != "template"}
        return FingerPictures(**columns, template=self.template)

    def widened(self, points: int) -> FingerPictures:
        """Return the same with as many points a picture: those that are missing are its own once more."""
        have = self.rest.shape[1]
        if have > points:
            raise TrainingError(f"{have} points a picture; expected at most {points}")
        own = np.arange(points) % have
        columns = {name: getattr(self, name)[:, own] for name in ("rest", "place", "visible")}
        others = {name: getattr(self, name) for name in _COLUMNS if name not in columns}
        return FingerPictures(**columns, **others)

    def mixed_with(self, many: FingerPictures) -> FingerPictures:
        """Return both sets, these pictures repeated until they are about half."""
        points = max(self.rest.shape[1], many.rest.shape[1])
        repeated = self.take(np.tile(np.arange(len(self)), max(1, round(len(many) / len(self)))))
        return FingerPictures.join([repeated.widened(points), many.widened(points)])

    @staticmethod
    def join(parts: Sequence[FingerPictures], picture: NDArray | None = None) -> FingerPictures:
        """Return several sets one after the other, with all their templates.

        Args:
            parts: the sets.
            picture: their pictures one after the other, where that is so already.

        Raises:
            TrainingError: their pictures differ in size or in the number of points.
        """
        if len({(part.picture.shape[1:], part.rest.shape[1:]) for part in parts}) != 1:
            raise TrainingError("shards of several kinds (size, number of points); expected one kind")
        starts = np.cumsum([0, *(len(part.template) for part in parts[:-1])])
        fingers = [part.finger + start for part, start in zip(parts, starts, strict=True)]
        columns = {"finger": np.concatenate(fingers)} | ({} if picture is None else {"picture": picture})
        for name in set(_COLUMNS) - columns.keys():
            columns[name] = np.concatenate([getattr(part, name) for part in parts])
        return FingerPictures(**columns)


def save_shard(path: Path, pictures: FingerPictures) -> None:
    """Write one shard, `train_*.npz` or `val_*.npz`; it appears whole or not at all."""
    unfinished = path.with_suffix(".part")
    with unfinished.open("wb") as file:
        np.savez(file, **{name: getattr(pictures, name) for name in _COLUMNS})
    unfinished.replace(path)


def load_shard(path: Path) -> FingerPictures:
    """Read one shard.

    Raises:
        TrainingError: the file cannot be read, or lacks an array.
    """
    with _reading(path), np.load(path, allow_pickle=False) as content:
        return FingerPictures(**{name: content[name] for name in _COLUMNS})


@contextmanager
def _reading(path: Path) -> Iterator[None]:
    """Name the file in whatever goes wrong with it in the `with` block."""
    try:
        yield
    except (OSError, EOFError, ValueError, KeyError, BadZipFile) as error:
        raise TrainingError(f"{path}: {error}; expected a shard with {', '.join(_COLUMNS)}") from error


def load_pictures(folder: Path, part: str, limit: int | None = None) -> FingerPictures:
    """Read the shards of one part of a data set into memory, with a progress bar.

    Args:
        folder: of the shards.
        part: TRAIN or VALIDATION; fingers, never pictures of one finger, separate the two.
        limit: the number of pictures that is enough; all when absent.

    Raises:
        TrainingError: there is no shard of this part, or one cannot be used, or they are of several kinds.
    """
    paths = sorted(folder.glob(f"{part}_*.npz"))
    if not paths:
        raise TrainingError(f"{folder}: no shard {part}_*.npz; make some with python -m lab.training.scenes")
    counts = [_count_pictures(path) for path in paths]
    if limit is not None:
        paths = paths[: int(np.searchsorted(np.cumsum(counts), limit)) + 1]
    shards, ends = [], np.cumsum(counts[: len(paths)])
    for path, end in tqdm(list(zip(paths, ends, strict=True)), desc=f"read {part}", unit="shard", leave=False):
        shard = load_shard(path)
        if not shards:  # filled as shards come: joined afterwards they would need twice the memory
            pictures = np.empty((ends[-1], *shard.picture.shape[1:]), np.uint8)
        if shard.picture.shape[1:] != pictures.shape[1:]:
            raise TrainingError(
                f"{path}: pictures {shard.picture.shape[1:]}, expected {pictures.shape[1:]} as before it"
            )
        own = pictures[end - len(shard) : end]
        own[:] = shard.picture
        shards.append(replace(shard, picture=own))
    return FingerPictures.join(shards, pictures)


def _count_pictures(path: Path) -> int:
    """Return how many pictures a shard has."""
    with _reading(path), np.load(path, allow_pickle=False) as content:
        return len(content["finger"])


def make_all(tasks: Sequence[Task], engine: EngineOptions, folder: Path, unit: str) -> list[dict[str, Any]]:
    """Make what is not made yet, and return the lines of all tasks.

    Args:
        tasks: each makes a file.
        engine: where they are carried out.
        folder: of the files, and of a manifest that lets a run go on where one was killed.
        unit: noun for a task, for the bar.

    Raises:
        TrainingError: one of them failed; which, and how many.
    """
    manifest = Manifest(folder)
    with manifest.alone():
        lines = run_tasks(tasks, engine, manifest, unit=unit)
    failed = [line for line in lines if line["status"] != OK]
    if failed:
        raise TrainingError(f"{len(failed)} of {len(lines)} failed, {failed[0]['name']} with: {failed[0]['error']}")
    return lines
