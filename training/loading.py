"""Augmented batches, made in other processes while the network trains."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import islice

import numpy as np

from finforce.optional import import_cv2
from training.augment import MEAN, STD, AugmentSettings, TrainingSample, augment, crop_centre
from training.dataset import LabelledPictures, iterate_batches
from training.optional import import_torch

torch = import_torch()


@dataclass(frozen=True, kw_only=True, eq=False)
class Batch:
    """Pictures and where their points are.

    Attributes:
        pictures: (B, 3, h, w) float32 RGB, normalised; rows of pixels lie together in memory (channels last).
        points: (B, K, 2) float32 column and row [px]; 0 where not known.
        visible: (B, K) bool.
    """

    pictures: torch.Tensor
    points: torch.Tensor
    visible: torch.Tensor


@dataclass(frozen=True, kw_only=True)
class LoadingSettings:
    """How batches are made.

    Attributes:
        size: pictures in a batch.
        workers: processes that make them; 0 for none but this one.
        seed: of order and augmentation.
        first: number of the first batch, to go on where another run ended.
    """

    size: int = 64
    workers: int = 1
    seed: int = 0
    first: int = 0


def load_batches(
    pictures: LabelledPictures, augmentation: AugmentSettings, settings: LoadingSettings
) -> Iterator[Batch]:
    """Yield augmented batches without end, each picture once per round, the same for the same seed."""
    loader = torch.utils.data.DataLoader(
        _BatchMaker(pictures, augmentation, settings.seed),
        sampler=_BatchOrder(len(pictures), settings),
        batch_size=None,
        num_workers=settings.workers,
        prefetch_factor=4 if settings.workers else None,
        worker_init_fn=_use_one_thread,
    )
    for images, points, visible in loader:
        yield Batch(pictures=normalise(images), points=points, visible=visible)


def stack_centres(pictures: LabelledPictures) -> Batch:
    """Return all pictures as they are, without their padding."""
    columns = zip(pictures.picture, pictures.xz, pictures.visible, strict=True)
    images, points, visible = _stack(crop_centre(*column) for column in columns)
    return Batch(pictures=normalise(images), points=points, visible=visible)


def normalise(images: torch.Tensor) -> torch.Tensor:
    """Return images (B, h, w, 3) uint8 as (B, 3, h, w) float32 with ImageNet's mean and deviation taken off."""
    scaled = images.to(torch.float32) * torch.tensor(1.0 / (255.0 * STD)) - torch.tensor(MEAN / STD)
    return scaled.permute(0, 3, 1, 2)


def _use_one_thread(_: int) -> None:
    """Keep OpenCV in a process of its own from taking the cores that the network needs."""
    import_cv2().setNumThreads(1)


class _BatchMaker(torch.utils.data.Dataset):
    """Batches by number and indices: the same ones with the same seed are alike in whatever process."""

    def __init__(self, pictures: LabelledPictures, augmentation: AugmentSettings, seed: int) -> None:
        self.pictures, self.augmentation, self.seed = pictures, augmentation, seed

    def __getitem__(self, key: tuple[int, np.ndarray]) -> list[torch.Tensor]:
        number, indices = key
        rng = np.random.default_rng((self.seed, number))
        columns = (self.pictures.picture, self.pictures.xz, self.pictures.visible)
        return _stack(augment(*(column[i] for column in columns), self.augmentation, rng) for i in indices)


class _BatchOrder(torch.utils.data.Sampler):
    """Numbers of batches with the indices of their pictures."""

    def __init__(self, count: int, settings: LoadingSettings) -> None:
        self.count, self.settings = count, settings

    def __iter__(self) -> Iterator[tuple[int, np.ndarray]]:
        order = iterate_batches(self.count, self.settings.size, np.random.default_rng(self.settings.seed))
        return islice(enumerate(order), self.settings.first, None)


def _stack(samples: Iterable[TrainingSample]) -> list[torch.Tensor]:
    """Return pictures (B, h, w, 3) uint8, points (B, K, 2), visible (B, K) of samples."""
    samples = list(samples)
    return [
        torch.from_numpy(np.stack([sample.picture for sample in samples])),
        torch.from_numpy(np.stack([np.nan_to_num(sample.points) for sample in samples])),
        torch.from_numpy(np.stack([sample.visible for sample in samples])),
    ]
