"""Training of the network for any finger: `python -m training.finger_trainer DATA -o RUN`."""

from __future__ import annotations

import argparse
import json
import time
from dataclasses import asdict
from pathlib import Path

import numpy as np
from tqdm import tqdm

from finforce.optional import import_cv2
from training.arguments import one_line_errors
from training.augment import AugmentSettings, augment
from training.finger_dataset import MARGIN, TRAIN, VALIDATION, FingerPictures, load_pictures
from training.finger_network import LARGEST_SPREAD, FingerNetwork, NetworkShape, standardise
from training.optional import import_torch
from training.recipe import Recipe
from training.scoring import Detections, score_detections
from training.trainer import compute_rate, has_bfloat16

torch = import_torch()
POINTS = 8  # of a picture that the fine part looks at in one step
FAR, FAR_SHARE, NEAR = (
    9.0,
    0.25,
    2.5,
)  # px by which guesses are off: some anywhere up to FAR, others with deviation NEAR
WRONG = 0.1  # share of the pictures whose template is not theirs, so that nothing of it can be seen ...
WRONG_FINGER = 0.6  # ... of which so many show another finger; the others are mirrored or upside down
SHARPNESS = 0.05  # px; smaller errors count by their square


class BatchMaker(torch.utils.data.Dataset):
    """Augmented batches by number: the same ones with the same seed, in whatever process."""

    def __init__(self, pictures: FingerPictures, settings: AugmentSettings, seed: int, size: int) -> None:
        self.pictures, self.settings, self.seed, self.size = pictures, settings, seed, size

    def __len__(self) -> int:
        return 1 << 30

    def __getitem__(self, number: int) -> list[torch.Tensor]:
        rng = np.random.default_rng((self.seed, number))
        data = self.pictures
        rows = rng.integers(0, len(data), self.size)
        samples = [augment(data.picture[i], data.place[i], data.visible[i], self.settings, rng) for i in rows]
        pictures = [sample.picture for sample in samples]
        places, visible = (np.stack([getattr(sample, name) for sample in samples]) for name in ("points", "visible"))
        told = rows.copy()
        for k in np.flatnonzero(rng.random(self.size) < WRONG):
            places[k], visible[k] = np.nan, False
            chance = rng.random()
            if chance < WRONG_FINGER:
                told[k] = rng.choice(np.flatnonzero(data.finger != data.finger[rows[k]]))
            else:  # mirrored or upside down
                pictures[k] = pictures[k][:, ::-1] if chance < 0.5 * (1.0 + WRONG_FINGER) else pictures[k][::-1, ::-1]
        columns = (
            np.stack(pictures),
            data.template[data.finger[told]],
            data.rest[told],
            places,
            visible,
            data.keypoints[told],
        )
        return [torch.from_numpy(np.ascontiguousarray(column)) for column in columns]


def to_layers(images: torch.Tensor) -> torch.Tensor:
    """Return images (B, h, w, 3) uint8 as (B, 3, h, w) from 0 to 1."""
    return images.permute(0, 3, 1, 2).float() / 255.0


def compute_losses(network: FingerNetwork, batch: list[torch.Tensor], device: torch.device) -> dict[str, torch.Tensor]:
    """Return the parts of the loss of a batch."""
    pictures, templates, rest, places, visible, keypoints = (part.to(device) for part in batch)
    known = torch.isfinite(places).all(dim=2) & (places.abs() < 600.0).all(dim=2)
    with torch.autocast(device.type, torch.bfloat16, enabled=has_bfloat16(device)):
        pictures, templates = standardise(to_layers(pictures)), to_layers(templates)
        moves, features = network.register(pictures, templates)
        guess = rest + network.read(moves, rest)
        places = torch.where(known[..., None], places, guess.detach())
        away = torch.sqrt((guess - places).square().sum(dim=2) + 0.25)
        weight = known * torch.where(visible, 1.0, 0.4)
        coarse = (weight * away).sum() / weight.sum().clamp(min=1.0)
        chosen = _choose(keypoints, rest.shape[1], device)
        rest, places, visible = (_take(part, chosen) for part in (rest, places, visible))
        count = rest.shape[:2]
        far = torch.rand(count, device=device) < FAR_SHARE
        noise = torch.where(
            far[..., None],
            FAR * (2.0 * torch.rand((*count, 2), device=device) - 1.0),
            NEAR * torch.randn((*count, 2), device=device),
        )
        found, judged = network.compare(pictures, templates, rest, places + noise, network.read(features, rest))
    shown = visible.float()
    logit, spread = judged[..., 0].float(), judged[..., 1].float().clamp(-LARGEST_SPREAD, LARGEST_SPREAD)
    error = torch.sqrt((found - places).square().sum(dim=2) + SHARPNESS**2)
    likely = (shown * (error * torch.exp(-spread) + 2.0 * spread)).sum() / shown.sum().clamp(min=1.0)
    plain = (shown * error).sum() / shown.sum().clamp(min=1.0)
    seen = torch.nn.functional.binary_cross_entropy_with_logits(logit, shown)
    return {"coarse": 0.3 * coarse, "fine": 0.5 * plain, "likely": 0.3 * likely, "seen": seen}


def _choose(keypoints: torch.Tensor, points: int, device: torch.device) -> torch.Tensor:
    """Return the indices (B, POINTS) of points that the fine part looks at: the mark, key points, two anywhere."""
    batch = len(keypoints)
    drawn = (torch.rand(batch, POINTS, device=device) * keypoints[:, None]).long()
    drawn[:, 0] = 0
    drawn[:, -2:] = torch.randint(0, points, (batch, 2), device=device)
    return drawn


def _take(values: torch.Tensor, chosen: torch.Tensor) -> torch.Tensor:
    """Return values (B, P, ...) of chosen points (B, k, ...)."""
    return values[torch.arange(len(values), device=values.device)[:, None], chosen]


@torch.no_grad()
def detect(network: FingerNetwork, pictures: FingerPictures, batch: int = 32) -> tuple[Detections, np.ndarray]:
    """Return what a network finds in the key points of pictures without their padding, and the deviations it states."""
    device = next(network.parameters()).device
    count = int(pictures.keypoints.max())
    found: list[list[np.ndarray]] = []
    for start in range(0, len(pictures), batch):
        rows = slice(start, start + batch)
        images = torch.from_numpy(pictures.picture[rows, MARGIN:-MARGIN, MARGIN:-MARGIN].copy())
        templates = torch.from_numpy(pictures.template[pictures.finger[rows]])
        rest = torch.from_numpy(pictures.rest[rows, :count])
        parts = network(*(part.to(device) for part in (to_layers(images), to_layers(templates), rest)))
        found.append([part.float().cpu().numpy() for part in parts])
    pixels, logits, spread = (np.concatenate(column) for column in zip(*found, strict=True))
    points = pictures.place[:, :count] - MARGIN
    is_key = np.arange(count) < pictures.keypoints[:, None]
    size = np.array(images.shape[2:0:-1])
    with np.errstate(invalid="ignore"):
        inside = ((points >= 0.0) & (points <= size - 1)).all(axis=2)
    likelihood = 1.0 / (1.0 + np.exp(-logits))
    points = np.where(is_key[..., None], points, np.nan)
    detections = Detections(
        pixels=pixels,
        likelihood=np.where(is_key, likelihood, 0.0),
        points=points,
        visible=pictures.visible[:, :count] & inside & is_key,
    )
    return detections, np.exp(spread)


class FingerTrainer:
    """A network, its average and its optimiser, and how far they are."""

    def __init__(self, recipe: Recipe, network: FingerNetwork | None = None) -> None:
        torch.manual_seed(recipe.seed)
        self.recipe = recipe
        self.device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
        network = network or FingerNetwork(NetworkShape())
        self.network = network.to(self.device, memory_format=torch.channels_last)
        self.average = torch.optim.swa_utils.AveragedModel(self.network, avg_fn=self._average, use_buffers=True)
        self.optimizer = torch.optim.AdamW(self.network.parameters(), lr=recipe.rate, weight_decay=recipe.decay)
        self.step, self.elapsed = 0, 0.0

    @property
    def progress(self) -> float:
        """How much of the training is done, 0 to 1: by steps where the recipe counts them, else by time."""
        if self.recipe.steps:
            return min(self.step / self.recipe.steps, 1.0)
        return min(self.elapsed / (60.0 * self.recipe.minutes), 1.0)

    def learn(self, batch: list[torch.Tensor]) -> dict[str, torch.Tensor]:
        """Take one step on a batch and return the parts of its loss."""
        self.network.train()
        for group in self.optimizer.param_groups:
            group["lr"] = compute_rate(self.progress, self.recipe)
        losses = compute_losses(self.network, batch, self.device)
        self.optimizer.zero_grad(set_to_none=True)
        sum(losses.values()).backward()
        torch.nn.utils.clip_grad_norm_(self.network.parameters(), self.recipe.clip)
        self.optimizer.step()
        self.average.update_parameters(self.network)
        self.step += 1
        return losses

    def _average(self, kept: torch.Tensor, new: torch.Tensor, count: torch.Tensor) -> torch.Tensor:
        stay = min(self.recipe.average, (1.0 + int(count)) / (10.0 + int(count)))
        return torch.lerp(new, kept, stay) if new.is_floating_point() else new

    def save(self, path: Path) -> None:
        """Write a checkpoint."""
        content = {
            "shape": asdict(self.network.shape),
            "averaged": self.average.module.state_dict(),
            "network": self.network.state_dict(),
            "optimizer": self.optimizer.state_dict(),
            "step": self.step,
            "elapsed": self.elapsed,
        }
        unfinished = path.with_suffix(".part")
        torch.save(content, unfinished)
        unfinished.rename(path)

    def resume(self, path: Path) -> None:
        """Go on from a checkpoint."""
        content = torch.load(path, map_location="cpu", weights_only=True)
        self.network.load_state_dict(content["network"])
        self.average.module.load_state_dict(content["averaged"])
        self.average.n_averaged.fill_(content["step"])
        self.optimizer.load_state_dict(content["optimizer"])
        self.step, self.elapsed = content["step"], content["elapsed"]


def _one_thread(_: int) -> None:
    import_cv2().setNumThreads(1)
    torch.set_num_threads(1)


def train(trainer: FingerTrainer, data: Path, settings: AugmentSettings, folder: Path) -> None:
    """Train until the recipe's end, with a log and a checkpoint; shards that appear meanwhile are taken up."""
    recipe = trainer.recipe
    folder.mkdir(parents=True, exist_ok=True)
    torch.set_num_threads(recipe.threads)
    validation = load_pictures(data, VALIDATION, recipe.validation)
    began, smooth = time.monotonic() - trainer.elapsed, {}
    with tqdm(total=100.0, desc="train", unit="%", bar_format="{l_bar}{bar}|{postfix}") as bar:
        while trainer.progress < 1.0:
            pictures = load_pictures(data, TRAIN)
            maker = BatchMaker(pictures, settings, recipe.seed + trainer.step, recipe.batch)
            loader = torch.utils.data.DataLoader(
                maker,
                batch_size=None,
                num_workers=recipe.workers,
                prefetch_factor=4 if recipe.workers else None,
                worker_init_fn=_one_thread,
            )
            until = trainer.elapsed + 60.0 * recipe.evaluate_every
            for batch in loader:
                losses = trainer.learn(batch)
                for name, value in losses.items():
                    smooth[name] = 0.98 * smooth.get(name, float(value)) + 0.02 * float(value)
                trainer.elapsed = time.monotonic() - began
                bar.update(100.0 * trainer.progress - bar.n)
                bar.set_postfix({"step": trainer.step, **{name: f"{value:.3f}" for name, value in smooth.items()}})
                if trainer.elapsed >= until or trainer.progress >= 1.0:
                    break
            del loader
            detections, _ = detect(trainer.average.module.eval(), validation)
            line = {"step": trainer.step, "minutes": round(trainer.elapsed / 60.0, 2), "pictures": len(pictures)}
            line |= {name: round(value, 4) for name, value in smooth.items()} | score_detections(detections).as_row()
            with (folder / "log.jsonl").open("a", encoding="utf-8") as log:
                log.write(json.dumps(line) + "\n")
            tqdm.write(json.dumps(line))
            trainer.save(folder / "checkpoint.pt")


def main() -> None:
    """Train a network."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("data", type=Path)
    parser.add_argument("-o", "--output", type=Path, required=True)
    parser.add_argument("--minutes", type=float, default=80.0)
    parser.add_argument("--batch", type=int, default=32)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--rate", type=float, default=2e-3)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--evaluate-every", type=float, default=8.0)
    parser.add_argument("--resume", type=Path)
    options = parser.parse_args()
    with one_line_errors():
        recipe = Recipe(
            minutes=options.minutes,
            batch=options.batch,
            threads=options.threads,
            workers=options.workers,
            rate=options.rate,
            seed=options.seed,
            evaluate_every=options.evaluate_every,
        )
        trainer = FingerTrainer(recipe)
        if options.resume:
            trainer.resume(options.resume)
        train(trainer, options.data, AugmentSettings(), options.output)


if __name__ == "__main__":
    main()
