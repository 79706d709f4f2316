"""Train the key point network: `python -m lab.training.train DATASET -o RUN`."""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from math import cos, pi
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from finforce.settings import check_bounds, setting
from lab.training.batches import AugmentSettings, Batch, load_batches
from lab.training.commands import (
    TrainingError,
    add_settings,
    import_torch,
    one_line_errors,
    settings_from,
)
from lab.training.evaluate import Detections, Score, gather_detections, score_detections
from lab.training.export import load_checkpoint, read_network, save_checkpoint, shape_from, write_network
from lab.training.network import LARGEST_SPREAD, FingerNetwork, standardise
from lab.training.pictures import TRAIN, VALIDATION, FingerPictures, load_pictures

torch = import_torch()
POINTS = 12  # of a picture that the fine part looks at in one step
COVERED = 4  # of them that are key points which cannot be seen, where there are any
ANYWHERE = 2  # of them that need not be key points
# Errors of guesses.
FAR = 9.0  # [px], largest error of a fraction of them, evenly spread
FAR_SHARE = 0.25  # [-], that fraction
NEAR = 1.5  # [px], standard deviation of the others
FARTHEST = 600.0  # px; a place that a slanted view has thrown farther is not learnt
HIDDEN_WEIGHT = 6.0  # of a hidden point beside a visible one: to accept what is not there costs more than to lose one
SHARPNESS = 0.05  # px; smaller errors count by their square


@dataclass(frozen=True, kw_only=True, eq=False)
class Losses:
    """The parts of the loss of one batch, each weighted, as tensors without dimension.

    Attributes:
        coarse: mean distance of the guesses from where the points are.
        fine: the same of the found places, from guesses that are off.
        likely: minus the logarithm of the errors' probability under the stated deviations.
        seen: cross entropy of visibility.
    """

    coarse: torch.Tensor
    fine: torch.Tensor
    likely: torch.Tensor
    seen: torch.Tensor


def compute_losses(network: FingerNetwork, batch: Batch, *, low: bool) -> Losses:
    """Return the losses of a batch.

    The coarse part learns from all points whose place is known, hidden ones less. The fine part sees some of them, from
    guesses that are off by chance, and says of an error e with its deviation b that its density is exp(-e / b) / b^2.

    Args:
        network: in training mode.
        batch: on the network's device.
        low: True to compute in bfloat16.
    """
    device = batch.rest.device
    known = torch.isfinite(batch.places).all(dim=2) & (batch.places.abs() < FARTHEST).all(dim=2)
    with torch.autocast(device.type, torch.bfloat16, enabled=low):
        pictures, templates = standardise(to_layers(batch.pictures)), to_layers(batch.templates)
        moves, features = network.register(pictures, templates)
        guess = batch.rest + network.read(moves, batch.rest)
        places = torch.where(known[..., None], batch.places, guess.detach())
        away = torch.sqrt((guess - places).square().sum(dim=2) + 0.25)
        weight = known * torch.where(batch.visible, 1.0, 0.4)
        coarse = (weight * away).sum() / weight.sum().clamp(min=1.0)
        chosen = choose_points(batch)
        rest, places, visible = (_take(part, chosen) for part in (batch.rest, places, batch.visible))
        far = torch.rand(rest.shape[:2], device=rest.device) < FAR_SHARE
        anywhere = FAR * (2.0 * torch.rand(rest.shape, device=rest.device) - 1.0)
        missed = torch.where(far[..., None], anywhere, NEAR * torch.randn(rest.shape, device=rest.device))
        found, judged = network.compare(pictures, templates, rest, places + missed, network.read(features, rest))
    shown = visible.float()
    count = shown.sum().clamp(min=1.0)
    logit, spread = judged[..., 0].float(), judged[..., 1].float().clamp(-LARGEST_SPREAD, LARGEST_SPREAD)
    error = torch.sqrt((found - places).square().sum(dim=2) + SHARPNESS**2)
    return Losses(
        coarse=0.3 * coarse,
        fine=0.5 * (shown * error).sum() / count,
        likely=0.3 * (shown * (error * torch.exp(-spread) + 2.0 * spread)).sum() / count,
        seen=torch.nn.functional.binary_cross_entropy_with_logits(
            logit, shown, weight=torch.where(visible, 1.0, HIDDEN_WEIGHT)
        ),
    )


def to_layers(images: torch.Tensor) -> torch.Tensor:
    """Return images (B, h, w, 3) uint8 as (B, 3, h, w) from 0 to 1."""
    return images.permute(0, 3, 1, 2).float() / 255.0


def choose_points(batch: Batch) -> torch.Tensor:
    """Return the indices (B, POINTS) of what the fine part looks at: mark, hidden and other key points, any points."""
    count, points = batch.visible.shape
    device = batch.rest.device
    chosen = (torch.rand(count, POINTS, device=device) * batch.keypoints[:, None]).long()
    hidden = ~batch.visible & (torch.arange(points, device=device) < batch.keypoints[:, None])
    first = (torch.rand(count, points, device=device) + hidden).argsort(dim=1, descending=True)[:, :COVERED]
    chosen[:, 1 : 1 + COVERED] = torch.where(_take(hidden, first), first, chosen[:, 1 : 1 + COVERED])
    chosen[:, 0] = 0
    chosen[:, -ANYWHERE:] = torch.randint(0, points, (count, ANYWHERE), device=device)
    return chosen


def _take(values: torch.Tensor, chosen: torch.Tensor) -> torch.Tensor:
    """Return values (B, P, ...) of chosen points (B, k, ...)."""
    return values[torch.arange(len(values), device=values.device)[:, None], chosen]


CHECKPOINT, LOG = "checkpoint.pt", "log.jsonl"
SMOOTHING = 0.98  # part of the shown losses that stays in each step
FINETUNING_DIM = 0.15  # probability of little light: less than in the first training, as the user's light is known


@dataclass(frozen=True, kw_only=True)
class Recipe:
    """The duration and learning rate of a training; a run ends after its minutes, at whatever step."""

    minutes: float = setting(80.0, "time that training may take, evaluation included", "min", 0.01, 10_000.0)
    steps: int = setting(0, "batches until the end; 0: until the minutes are over, not repeatable", "", 0, 10**9)
    seed: int = setting(0, "of weights, order and augmentation", "", 0, 2**31)
    batch: int = setting(32, "pictures per step", "", 1, 4096)
    rate: float = setting(2e-3, "largest learning rate of AdamW", "", 1e-6, 1.0)
    warm_up: float = setting(0.04, "part of the time in which the rate rises", "-", 0.0, 0.5)
    decay: float = setting(1e-2, "weight decay of AdamW", "", 0.0, 1.0)
    clip: float = setting(5.0, "largest norm of the gradient", "", 1e-3, 1e6)
    threads: int = setting(1, "threads of the network's arithmetic", "", 1, 256)
    evaluate_every: float = setting(5.0, "time between evaluations and checkpoints", "min", 0.01, 10_000.0)
    average: float = setting(0.998, "part of the averaged weights that stays in each step", "", 0.0, 0.99999)
    workers: int = setting(1, "processes that make batches", "", 0, 256)
    validation: int = setting(1000, "pictures that an evaluation uses", "", 1, 1_000_000)

    def __post_init__(self) -> None:
        check_bounds(self, TrainingError)


def compute_rate(progress: float, recipe: Recipe) -> float:
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


class Training:
    """A network, its optimiser, its averaged weights, which are those that are kept, and how far they are.

    Args:
        recipe: duration and learning rate.
        network: to begin with; its `shape` is a record of its sizes.
    """

    def __init__(self, recipe: Recipe, network: torch.nn.Module) -> None:
        torch.set_num_threads(recipe.threads)
        self.recipe = recipe
        self.device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
        self.network = network.to(self.device, memory_format=torch.channels_last)
        self.optimizer = torch.optim.AdamW(self.network.parameters(), lr=recipe.rate, weight_decay=recipe.decay)
        averaging = torch.optim.swa_utils
        self._averaging = averaging.AveragedModel(self.network, avg_fn=self._average, use_buffers=True)
        self.averaged = self._averaging.module
        self.parts = {"network": self.network, "optimizer": self.optimizer, "averaged": self.averaged}
        self.step, self.elapsed = 0, 0.0

    @property
    def progress(self) -> float:
        """The share of the training done, 0 to 1: by steps where the recipe counts them."""
        recipe = self.recipe
        return min(self.step / recipe.steps if recipe.steps else self.elapsed / (60.0 * recipe.minutes), 1.0)

    def measure(self, batch: Any) -> Mapping[str, torch.Tensor]:
        """Return the losses of a batch by name; their sum is minimised."""
        raise NotImplementedError

    def learn(self, batch: Any) -> dict[str, float]:
        """Take one step on a batch and return its losses by name."""
        self.network.train()
        for group in self.optimizer.param_groups:
            group["lr"] = compute_rate(self.progress, self.recipe)
        losses = self.measure(batch)
        self.optimizer.zero_grad(set_to_none=True)
        sum(losses.values()).backward()
        torch.nn.utils.clip_grad_norm_(self.network.parameters(), self.recipe.clip)
        self.optimizer.step()
        self._averaging.update_parameters(self.network)
        self.step += 1
        return {name: float(loss.detach()) for name, loss in losses.items()}

    def resume(self, checkpoint: Mapping[str, Any]) -> None:
        """Go on from a checkpoint.

        Raises:
            TrainingError: it is of another network.
        """
        if checkpoint["shape"] != asdict(self.network.shape):
            raise TrainingError(f"got a checkpoint of {checkpoint['shape']}, expected one of {self.network.shape}")
        for name, part in self.parts.items():
            part.load_state_dict(checkpoint[name])
        self.step, self.elapsed = int(checkpoint["step"]), float(checkpoint["elapsed"])
        self._averaging.n_averaged.fill_(self.step)

    def run(self, batches: Iterator[Any], judge: Callable[[], Mapping[str, float]], folder: Path) -> None:
        """Train until the recipe's end, with a log of losses and scores and a checkpoint beside it.

        Args:
            batches: to learn from, without end.
            judge: returns scores of the averaged network by name.
            folder: of log and checkpoint.
        """
        folder.mkdir(parents=True, exist_ok=True)
        every = 60.0 * self.recipe.evaluate_every
        began, due = time.monotonic() - self.elapsed, self.elapsed + every
        shown: dict[str, float] = {}
        with tqdm(total=100.0, desc="train", unit="%", bar_format="{l_bar}{bar}|{postfix}", disable=None) as bar:
            while self.progress < 1.0:
                for name, value in self.learn(next(batches)).items():
                    shown[name] = SMOOTHING * shown.get(name, value) + (1.0 - SMOOTHING) * value
                self.elapsed = time.monotonic() - began
                bar.update(100.0 * self.progress - bar.n)
                bar.set_postfix({"step": self.step, **{name: f"{value:.3f}" for name, value in shown.items()}})
                if self.elapsed >= due and self.progress < 1.0:
                    due += every
                    self._report(shown, judge(), folder)
        self._report(shown, judge(), folder)

    def _report(self, shown: Mapping[str, float], scores: Mapping[str, float], folder: Path) -> None:
        """Add a line to the log, write the checkpoint."""
        line: dict[str, float] = {"step": self.step, "minutes": round(self.elapsed / 60.0, 2)}
        line |= {name: round(float(value), 5) for name, value in {**shown, **scores}.items()}
        with (folder / LOG).open("a", encoding="utf-8") as log:
            log.write(json.dumps(line) + "\n")
        tqdm.write(json.dumps(line))
        states = {name: part.state_dict() for name, part in self.parts.items()}
        about = {"shape": asdict(self.network.shape), "step": self.step, "elapsed": self.elapsed}
        save_checkpoint(folder / CHECKPOINT, about | states)

    def _average(self, kept: torch.Tensor, new: torch.Tensor, count: torch.Tensor) -> torch.Tensor:
        """Return the running average of a tensor; the first steps, of hardly trained weights, are forgotten fast."""
        stay = min(self.recipe.average, (1.0 + int(count)) / (10.0 + int(count)))
        return torch.lerp(new, kept, stay) if new.is_floating_point() else new


class FingerTraining(Training):
    """The training of the key point network, from random weights when none are given."""

    def __init__(self, recipe: Recipe, network: FingerNetwork | None = None) -> None:
        torch.manual_seed(recipe.seed)
        super().__init__(recipe, network or FingerNetwork())

    def measure(self, batch: Batch) -> Mapping[str, torch.Tensor]:
        """Return the losses of a batch by name."""
        return vars(compute_losses(self.network, batch.to(self.device), low=has_bfloat16(self.device)))

    def score(self, pictures: FingerPictures) -> Score:
        """Return how well the averaged network finds the key points of pictures."""
        return score_detections(detect(self.averaged.eval(), pictures))

    def train(
        self, pictures: FingerPictures, judging: FingerPictures, augmentation: AugmentSettings, folder: Path
    ) -> None:
        """Train on augmented pictures; those of other fingers judge it."""
        recipe = self.recipe
        batches = load_batches(
            pictures, augmentation, recipe.batch, workers=recipe.workers, seed=recipe.seed, first=self.step
        )
        self.run(batches, lambda: asdict(self.score(judging)), folder)


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


def refine(
    options: argparse.Namespace, teaching: FingerPictures, judging: FingerPictures, mixed: FingerPictures | None = None
) -> None:
    """Train an exported network further, and export it.

    Args:
        options: `network`, `output`, `minutes`, `rate`, `threads` and `seed`.
        teaching: a user's pictures.
        judging: pictures of theirs that it does not learn from.
        mixed: others against forgetting; half of what it sees is then theirs.
    """
    recipe = Recipe(
        minutes=options.minutes,
        rate=options.rate,
        threads=options.threads,
        seed=options.seed,
        batch=16,
        workers=0,  # a process that is split off after OpenCV or onnxruntime have made threads may wait for ever
        evaluate_every=max(options.minutes / 4.0, 0.02),
        average=0.99,
    )
    network, factor = read_network(options.network)
    training = FingerTraining(recipe, network)
    pictures = teaching if mixed is None else teaching.mixed_with(mixed)
    training.train(pictures, judging, AugmentSettings(dim=FINETUNING_DIM), options.output)
    write_network(training.averaged.eval(), options.output, factor)


def main(arguments: Sequence[str] | None = None) -> None:
    """Train on the shards of a folder and leave log and checkpoint in another one."""
    parser = argparse.ArgumentParser(prog="python -m lab.training.train", description=__doc__)
    parser.add_argument("dataset", type=Path, help="folder of shards train_*.npz and val_*.npz")
    parser.add_argument("-o", "--output", type=Path, required=True, help="folder of the run")
    parser.add_argument("--network", type=Path, help="begin with the weights of an exported network")
    parser.add_argument("--resume", action="store_true", help="resume from the checkpoint in the run folder")
    add_settings(parser, Recipe)
    options = parser.parse_args(arguments)
    with one_line_errors():
        recipe = settings_from(options, Recipe)
        pictures = load_pictures(options.dataset, TRAIN)
        judging = load_pictures(options.dataset, VALIDATION, recipe.validation)
        if options.resume:
            checkpoint = load_checkpoint(options.output / CHECKPOINT)
            training = FingerTraining(recipe, FingerNetwork(shape_from(checkpoint["shape"])))
            training.resume(checkpoint)
        else:
            training = FingerTraining(recipe, read_network(options.network)[0] if options.network else None)
        training.train(pictures, judging, AugmentSettings(), options.output)


if __name__ == "__main__":
    main()
