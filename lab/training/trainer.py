"""The training loop: steps, schedule, averaged weights, log and checkpoints."""

from __future__ import annotations

import json
import time
from dataclasses import dataclass
from math import cos, pi
from pathlib import Path

import numpy as np
from tqdm import tqdm

from lab.training.augment import AugmentSettings
from lab.training.checkpoint import Checkpoint, save_checkpoint
from lab.training.dataset import FingerPictures
from lab.training.errors import CheckpointError
from lab.training.loading import LoadingSettings, load_batches
from lab.training.losses import Batch, Losses, compute_losses, to_layers
from lab.training.network import FingerNetwork
from lab.training.optional import import_torch
from lab.training.recipe import Recipe, Schedule
from lab.training.scoring import Detections, Score, gather_detections, score_detections

torch = import_torch()

CHECKPOINT, LOG = "checkpoint.pt", "log.jsonl"
SMOOTHING = 0.98  # part of the shown losses that stays in each step
PARTS = ("coarse", "fine", "likely", "seen")


@dataclass(frozen=True, kw_only=True, eq=False)
class TrainingImages:
    """The pictures of one training, which share no finger: those learnt from and those that judge it."""

    train: FingerPictures
    validation: FingerPictures


class Trainer:
    """A network, its average and its optimiser, and how far they are.

    Args:
        recipe: how to train.
        network: to begin with; random weights when absent.
    """

    def __init__(self, recipe: Recipe, network: FingerNetwork | None = None) -> None:
        torch.manual_seed(recipe.seed)
        self.recipe = recipe
        self.device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
        self.network = (network or FingerNetwork()).to(self.device, memory_format=torch.channels_last)
        averaging = torch.optim.swa_utils
        self.average = averaging.AveragedModel(self.network, avg_fn=self._average, use_buffers=True)
        self.optimizer = torch.optim.AdamW(self.network.parameters(), lr=recipe.rate, weight_decay=recipe.decay)
        self.step, self.elapsed = 0, 0.0

    @property
    def progress(self) -> float:
        """How much of the training is done, 0 to 1."""
        return measure_progress(self.step, self.elapsed, self.recipe)

    def learn(self, batch: Batch) -> Losses:
        """Take one step on a batch and return its losses."""
        self.network.train()
        for group in self.optimizer.param_groups:
            group["lr"] = compute_rate(self.progress, self.recipe)
        losses = compute_losses(self.network, batch.to(self.device), low=has_bfloat16(self.device))
        self.optimizer.zero_grad(set_to_none=True)
        losses.total.backward()
        torch.nn.utils.clip_grad_norm_(self.network.parameters(), self.recipe.clip)
        self.optimizer.step()
        self.average.update_parameters(self.network)
        self.step += 1
        return losses

    def _average(self, kept: torch.Tensor, new: torch.Tensor, count: torch.Tensor) -> torch.Tensor:
        """Return the running average of a tensor; the first steps, of hardly trained weights, are forgotten fast."""
        stay = min(self.recipe.average, (1.0 + int(count)) / (10.0 + int(count)))
        return torch.lerp(new, kept, stay) if new.is_floating_point() else new

    def score(self, pictures: FingerPictures) -> Score:
        """Return how well the averaged network finds the key points of pictures."""
        return score_detections(detect(self.average.module.eval(), pictures))

    def save(self, folder: Path) -> None:
        """Write the checkpoint of a run."""
        checkpoint = Checkpoint(
            shape=self.network.shape,
            averaged=self.average.module.state_dict(),
            network=self.network.state_dict(),
            optimizer=self.optimizer.state_dict(),
            step=self.step,
            elapsed=self.elapsed,
        )
        save_checkpoint(folder / CHECKPOINT, checkpoint)

    def resume(self, checkpoint: Checkpoint) -> None:
        """Go on from a checkpoint.

        Raises:
            CheckpointError: it is of another network.
        """
        if checkpoint.shape != self.network.shape:
            raise CheckpointError(f"got a checkpoint of {checkpoint.shape}, expected one of {self.network.shape}")
        self.network.load_state_dict(checkpoint.network)
        self.average.module.load_state_dict(checkpoint.averaged)
        self.average.n_averaged.fill_(checkpoint.step)
        self.optimizer.load_state_dict(checkpoint.optimizer)
        self.step, self.elapsed = checkpoint.step, checkpoint.elapsed


def measure_progress(step: int, elapsed: float, recipe: Schedule) -> float:
    """Return how much is done, 0 to 1, after some steps and seconds: by steps where the recipe counts them."""
    return min(step / recipe.steps if recipe.steps else elapsed / (60.0 * recipe.minutes), 1.0)


def compute_rate(progress: float, recipe: Schedule) -> float:
    """Return the learning rate at a progress from 0 to 1: a linear rise, then half a cosine down to a hundredth."""
    if progress < recipe.warm_up:
        return recipe.rate * (0.02 + 0.98 * progress / recipe.warm_up)
    down = (progress - recipe.warm_up) / (1.0 - recipe.warm_up)
    return recipe.rate * (0.01 + 0.99 * 0.5 * (1.0 + cos(pi * down)))


def has_bfloat16(device: torch.device) -> bool:
    """Tell whether a device multiplies bfloat16 faster than float32: GPUs of late, processors only with tiles (AMX)."""
    if device.type == "cuda":
        return torch.cuda.is_bf16_supported()
    return bool(getattr(torch.cpu, "_is_amx_tile_supported", lambda: False)())


@torch.no_grad()
def detect(network: FingerNetwork, pictures: FingerPictures, batch: int = 32) -> Detections:
    """Return what a network finds of the key points in the middle of padded pictures."""
    device, count = next(network.parameters()).device, int(pictures.keypoints.max())
    found: list[list[np.ndarray]] = []
    for start in range(0, len(pictures), batch):
        rows = slice(start, start + batch)
        templates = torch.from_numpy(pictures.template[pictures.finger[rows]])
        images = torch.from_numpy(np.ascontiguousarray(pictures.middle[rows]))
        rest = torch.from_numpy(pictures.rest[rows, :count])
        parts = network(*(part.to(device) for part in (to_layers(images), to_layers(templates), rest)))
        found.append([part.float().cpu().numpy() for part in parts])
    pixels, logits, spread = (np.concatenate(column) for column in zip(*found, strict=True))
    return gather_detections(pictures, pixels, 1.0 / (1.0 + np.exp(-logits)), np.exp(spread))


def train(trainer: Trainer, pictures: TrainingImages, augmentation: AugmentSettings, folder: Path) -> Score:
    """Train until the recipe's end, with a log of losses and scores and a checkpoint beside it.

    Returns:
        The score of the averaged network at the end.
    """
    recipe = trainer.recipe
    folder.mkdir(parents=True, exist_ok=True)
    torch.set_num_threads(recipe.threads)
    loading = LoadingSettings(size=recipe.batch, workers=recipe.workers, seed=recipe.seed, first=trainer.step)
    batches = load_batches(pictures.train, augmentation, loading)
    began, next_evaluation = time.monotonic() - trainer.elapsed, trainer.elapsed + 60.0 * recipe.evaluate_every
    shown: dict[str, float] = {}
    with tqdm(total=100.0, desc="train", unit="%", bar_format="{l_bar}{bar}|{postfix}") as bar:
        while trainer.progress < 1.0:
            losses = trainer.learn(next(batches))
            for name in PARTS:
                value = float(getattr(losses, name).detach())
                shown[name] = SMOOTHING * shown.get(name, value) + (1.0 - SMOOTHING) * value
            trainer.elapsed = time.monotonic() - began
            bar.update(100.0 * trainer.progress - bar.n)
            bar.set_postfix({"step": trainer.step, **{name: f"{value:.3f}" for name, value in shown.items()}})
            if trainer.elapsed >= next_evaluation and trainer.progress < 1.0:
                next_evaluation += 60.0 * recipe.evaluate_every
                _report(trainer, pictures.validation, shown, folder)
        return _report(trainer, pictures.validation, shown, folder)


def _report(trainer: Trainer, validation: FingerPictures, shown: dict[str, float], folder: Path) -> Score:
    """Score the averaged network, add a line to the log, write the checkpoint."""
    score = trainer.score(validation)
    line = {
        "step": trainer.step,
        "minutes": round(trainer.elapsed / 60.0, 2),
        "rate": trainer.optimizer.param_groups[0]["lr"],
    }
    line |= {name: round(value, 5) for name, value in shown.items()} | score.as_row()
    with (folder / LOG).open("a", encoding="utf-8") as log:
        log.write(json.dumps(line) + "\n")
    tqdm.write(json.dumps(line))
    trainer.save(folder)
    return score
