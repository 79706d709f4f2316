"""Augmented batches, made in other processes while the network trains."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import islice

import numpy as np

from finforce.optional import import_cv2
from lab.training.augment import AugmentSettings, augment
from lab.training.dataset import FingerPictures, iterate_batches
from lab.training.losses import Batch
from lab.training.optional import import_torch

torch = import_torch()
WRONG = 0.1  # share of the pictures whose template is not theirs, so that nothing of it can be seen ...
WRONG_FINGER = 0.6  # ... of which so many show another finger; the others are mirrored or upside down


@dataclass(frozen=True, kw_only=True)
class LoadingSettings:
    """How batches are made.

    Attributes:
        size: pictures in a batch.
        workers: processes that make them; 0 for none but this one.
        seed: of order and augmentation.
        first: number of the first batch, to go on where another run ended.
    """

    size: int = 32
    workers: int = 1
    seed: int = 0
    first: int = 0


def load_batches(pictures: FingerPictures, augmentation: AugmentSettings, settings: LoadingSettings) -> Iterator[Batch]:
    """Yield augmented batches without end, each picture once per round, the same for the same seed."""
    loader = torch.utils.data.DataLoader(
        _BatchMaker(pictures, augmentation, settings.seed),
        sampler=_BatchOrder(len(pictures), settings),
        batch_size=None,
        num_workers=settings.workers,
        prefetch_factor=4 if settings.workers else None,
        worker_init_fn=_use_one_thread,
    )
    for columns in loader:
        yield Batch(**columns)


def _use_one_thread(_: int) -> None:
    """Keep OpenCV in a process of its own from taking the cores that the network needs."""
    import_cv2().setNumThreads(1)


class _BatchMaker(torch.utils.data.Dataset):
    """Batches by number and indices: the same ones with the same seed are alike in whatever process."""

    def __init__(self, pictures: FingerPictures, augmentation: AugmentSettings, seed: int) -> None:
        self.pictures, self.augmentation, self.seed = pictures, augmentation, seed

    def __getitem__(self, key: tuple[int, np.ndarray]) -> dict[str, torch.Tensor]:
        number, rows = key
        rng, data = np.random.default_rng((self.seed, number)), self.pictures
        samples = [augment(data.picture[i], data.place[i], data.visible[i], self.augmentation, rng) for i in rows]
        pictures = [sample.picture for sample in samples]
        places, visible = (np.stack([getattr(sample, name) for sample in samples]) for name in ("points", "visible"))
        told = rows.copy()
        for k in np.flatnonzero(rng.random(len(rows)) < WRONG):
            others = np.flatnonzero(data.finger != data.finger[rows[k]])
            places[k], visible[k] = np.nan, False
            chance = rng.random()
            if chance < WRONG_FINGER and len(others):
                told[k] = rng.choice(others)
            elif chance < 0.5 * (1.0 + WRONG_FINGER):
                pictures[k] = pictures[k][:, ::-1]
            else:
                pictures[k] = pictures[k][::-1, ::-1]
        columns = {
            "pictures": np.stack(pictures),
            "templates": data.template[data.finger[told]],
            "rest": data.rest[told],
            "places": places,
            "visible": visible,
            "keypoints": data.keypoints[told],
        }
        return {name: torch.from_numpy(np.ascontiguousarray(column)) for name, column in columns.items()}


class _BatchOrder(torch.utils.data.Sampler):
    """Numbers of batches with the indices of their pictures."""

    def __init__(self, count: int, settings: LoadingSettings) -> None:
        self.count, self.settings = count, settings

    def __iter__(self) -> Iterator[tuple[int, np.ndarray]]:
        order = iterate_batches(self.count, self.settings.size, np.random.default_rng(self.settings.seed))
        return islice(enumerate(order), self.settings.first, None)
