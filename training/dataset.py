"""Shards of padded, rectified pictures with their points, on disk and in memory."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from zipfile import BadZipFile

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from training.errors import DatasetError

MARGIN = 28  # px of padding all round, room for shifting and turning a picture
TRAIN, VALIDATION = "train", "val"  # how the names of shards begin


@dataclass(frozen=True, kw_only=True, eq=False)
class LabelledPictures:
    """Pictures of one jaw with the places of its points.

    Attributes:
        picture: (n, h, w, 3) uint8 RGB, rectified to the jaw's side plane, with MARGIN pixels of padding all round.
        xz: (n, K, 2) float32 column and row of the points in the padded picture [px]; NaN where not known.
        visible: (n, K) bool, whether a point can be seen.
        names: (K,) names of the points, the reference point last; () where the shards do not tell.
        light: (n,) str, the name of a picture's light; "" where the shards do not tell.
    """

    picture: NDArray
    xz: NDArray
    visible: NDArray
    names: tuple[str, ...] = ()
    light: NDArray | None = None

    def __post_init__(self) -> None:
        count, points = self.visible.shape if self.visible.ndim == 2 else (-1, -1)
        fits = self.picture.ndim == 4 and self.picture.shape[::3] == (count, 3)
        if not fits or self.xz.shape != (count, points, 2) or len(self.names) not in (0, points):
            raise DatasetError(
                f"picture {self.picture.shape}, xz {self.xz.shape}, visible {self.visible.shape}, {len(self.names)} "
                "names; expected (n, h, w, 3), (n, K, 2), (n, K) and K names"
            )
        if self.picture.dtype != np.uint8 or self.visible.dtype != bool:
            raise DatasetError(
                f"picture of {self.picture.dtype} and visible of {self.visible.dtype}; expected uint8 and bool"
            )
        if not np.isfinite(self.xz[self.visible]).all():
            raise DatasetError("xz: a visible point has no place; mark it as not visible")

    def __len__(self) -> int:
        return len(self.picture)

    def take(self, indices: NDArray) -> LabelledPictures:
        """Return the pictures of some indices (m,)."""
        light = None if self.light is None else self.light[indices]
        return LabelledPictures(
            picture=self.picture[indices],
            xz=self.xz[indices],
            visible=self.visible[indices],
            names=self.names,
            light=light,
        )


def save_shard(path: str | Path, pictures: LabelledPictures) -> None:
    """Write one shard, `train_*.npz` or `val_*.npz`."""
    content = {"picture": pictures.picture, "xz": pictures.xz, "visible": pictures.visible}
    if pictures.names:
        content["names"] = np.array(pictures.names)
    if pictures.light is not None:
        content["light"] = pictures.light
    np.savez_compressed(path, **content)


def load_shard(path: str | Path) -> LabelledPictures:
    """Read one shard.

    Raises:
        DatasetError: the file cannot be read, or lacks an array, or its arrays do not fit each other.
    """
    try:
        with np.load(path, allow_pickle=False) as content:
            names = tuple(map(str, content["names"])) if "names" in content else ()
            light = content["light"].astype(str) if "light" in content else None
            return LabelledPictures(
                picture=content["picture"],
                xz=content["xz"].astype(np.float32),
                visible=content["visible"].astype(bool),
                names=names,
                light=light,
            )
    except (OSError, EOFError, ValueError, KeyError, BadZipFile) as error:
        raise DatasetError(f"{path}: {error}; expected a shard with picture, xz and visible") from error


def load_pictures(folder: str | Path, part: str, limit: int | None = None) -> LabelledPictures:
    """Read all shards of one part of a data set into memory, with a progress bar.

    Args:
        folder: of the shards.
        part: TRAIN or VALIDATION; shards, never pictures of one shard, separate the two.
        limit: the number of pictures that is enough; all when absent.

    Raises:
        DatasetError: there is no shard of this part, or one cannot be used.
    """
    paths = sorted(Path(folder).glob(f"{part}_*.npz"))
    if not paths:
        raise DatasetError(f"{folder}: no shard {part}_*.npz; make some with python -m training.make_dataset")
    shards: list[LabelledPictures] = []
    for path in tqdm(paths, desc=f"read {part}", unit="shard", leave=False):
        shards.append(load_shard(path))
        if limit is not None and sum(map(len, shards)) >= limit:
            break
    return join_pictures(shards)


def join_pictures(shards: list[LabelledPictures]) -> LabelledPictures:
    """Return the pictures of several shards one after the other.

    Raises:
        DatasetError: they differ in size, in their points or in their names.
    """
    kinds = {(shard.picture.shape[1:], shard.visible.shape[1], shard.names) for shard in shards}
    if len(kinds) != 1:
        raise DatasetError(f"shards of {len(kinds)} kinds (size, number and names of points); expected one kind")
    lights = [np.full(len(shard), "") if shard.light is None else shard.light for shard in shards]
    return LabelledPictures(
        picture=np.concatenate([shard.picture for shard in shards]),
        xz=np.concatenate([shard.xz for shard in shards]),
        visible=np.concatenate([shard.visible for shard in shards]),
        names=shards[0].names,
        light=np.concatenate(lights),
    )


def iterate_batches(count: int, size: int, rng: np.random.Generator) -> Iterator[NDArray]:
    """Yield batches (size,) of indices below `count` without end, each index once per round, in random order."""
    left = np.empty(0, dtype=int)
    while True:
        while len(left) < size:
            left = np.concatenate((left, rng.permutation(count)))
        yield left[:size]
        left = left[size:]
