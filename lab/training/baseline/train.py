"""Trains the end-to-end network: `python -m lab.training.baseline.train DATA -o RUN`."""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from finforce.settings import setting
from finforce_eval.evaluation.results import ONSET
from finforce_eval.evaluation.scoring import rms
from lab.experiments.force_network import HEIGHT, KIND, LAYOUT, SHOWN, WIDTH
from lab.training.arguments import add_settings, one_line_errors, settings_from
from lab.training.baseline.network import BACKBONES, SMALL, EndToEnd
from lab.training.baseline.scenes import TRAIN, VALIDATION, GraspFilm, load_films
from lab.training.checkpoint import save_whole
from lab.training.errors import CheckpointError
from lab.training.export import write_onnx
from lab.training.optional import import_torch
from lab.training.recipe import Schedule
from lab.training.trainer import compute_rate, has_bfloat16, measure_progress

torch = import_torch()

CHECKPOINT, LOG, NETWORK = "checkpoint.pt", "log.jsonl", "force_network.onnx"
SEGMENT = 24  # images in a row that share their features: 15 windows of ten


@dataclass(frozen=True, kw_only=True)
class BaselineRecipe(Schedule):
    """How the end-to-end network is trained."""

    minutes: float = setting(180.0, "time that training may take, evaluation included", "min", 0.01, 10_000.0)
    batch: int = setting(8, "pieces of 24 images per step", "", 1, 4096)
    rate: float = setting(1e-3, "largest learning rate of AdamW", "", 1e-6, 1.0)
    decay: float = setting(5e-2, "weight decay of AdamW", "", 0.0, 1.0)
    clip: float = setting(1.0, "largest norm of the gradient", "", 1e-3, 1e6)
    shift: int = setting(6, "largest shift of the images", "px", 0, 40)
    light: float = setting(0.3, "largest change of brightness and of contrast", "-", 0.0, 0.9)
    noise: float = setting(4.0, "largest standard deviation of a pixel's noise", "", 0.0, 50.0)


def draw_batch(films: Sequence[GraspFilm], recipe: BaselineRecipe, rng: np.random.Generator) -> tuple[NDArray, NDArray]:
    """Return images (b, 24, h, w, 3) uint8 and forces (b, 24) [N] of pieces of grasps, each one seen differently."""
    images, forces = [], []
    for _ in range(recipe.batch):
        film = films[rng.integers(len(films))]
        first = rng.integers(len(film.force) - SEGMENT + 1)
        piece = slice(first, first + SEGMENT)
        images.append(alter_images(film.images[piece], recipe, rng))
        forces.append(film.force[piece])
    return np.stack(images), np.stack(forces)


def alter_images(images: NDArray[np.uint8], recipe: BaselineRecipe, rng: np.random.Generator) -> NDArray[np.uint8]:
    """Return images (n, h, w, 3) all shifted, mirrored and lit alike, with noise of their own."""
    shift = rng.integers(-recipe.shift, recipe.shift + 1, size=2)
    seen = np.roll(images, shift, axis=(1, 2))
    if rng.random() < 0.5:
        seen = seen[:, :, ::-1]  # the smaller of two forces is the same
    gain, offset = 1.0 + rng.uniform(-recipe.light, recipe.light), 128.0 * rng.uniform(-recipe.light, recipe.light)
    noise = rng.normal(0.0, rng.uniform(0.0, recipe.noise) + 1e-3, seen.shape).astype(np.float32)
    return np.clip(np.float32(gain) * seen + np.float32(offset) + noise, 0.0, 255.0).astype(np.uint8)


class BaselineTrainer:
    """One training.

    Attributes:
        network: that is trained.
        step: batches seen.
        elapsed: time spent on them [s].
    """

    def __init__(self, recipe: BaselineRecipe, backbone: str = SMALL) -> None:
        self.recipe = recipe
        torch.manual_seed(recipe.seed)
        torch.set_num_threads(recipe.threads)
        self.device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
        self.network = EndToEnd(backbone)
        self.network(torch.zeros(2, SHOWN, HEIGHT, WIDTH, 3))  # gives lazy parts their size
        self.network.to(self.device, memory_format=torch.channels_last)
        parameters = self.network.parameters()
        self.optimizer = torch.optim.AdamW(parameters, lr=recipe.rate, weight_decay=recipe.decay)
        self.step, self.elapsed = 0, 0.0

    @property
    def progress(self) -> float:
        """How much of the training is done, 0 to 1."""
        return measure_progress(self.step, self.elapsed, self.recipe)

    def learn(self, images: NDArray[np.uint8], forces: NDArray) -> float:
        """Take one step on images (b, 24, h, w, 3) and forces (b, 24) [N]; return the loss."""
        self.network.train()
        for group in self.optimizer.param_groups:
            group["lr"] = compute_rate(self.progress, self.recipe)
        count = len(images)
        pictures = torch.from_numpy(images).to(self.device).flatten(0, 1)
        with torch.autocast(self.device.type, torch.bfloat16, enabled=has_bfloat16(self.device)):
            features = self.network.encode(pictures).view(count, SEGMENT, -1)
        windows = features.float().unfold(1, SHOWN, 1).permute(0, 1, 3, 2).flatten(0, 1)
        true = torch.from_numpy(forces[:, SHOWN - 1 :]).to(self.device).flatten()
        loss = torch.nn.functional.smooth_l1_loss(self.network.judge(windows), true, beta=0.2)
        self.optimizer.zero_grad(set_to_none=True)
        loss.backward()
        torch.nn.utils.clip_grad_norm_(self.network.parameters(), self.recipe.clip)
        self.optimizer.step()
        self.step += 1
        return float(loss.detach())

    @torch.no_grad()
    def score(self, films: Sequence[GraspFilm]) -> dict[str, float]:
        """Return the RMSE over all images of grasps, and over those under load [N]."""
        self.network.eval()
        errors, true = [], []
        for film in films:
            pictures = torch.from_numpy(film.images).to(self.device)
            features = torch.cat([self.network.encode(part) for part in pictures.split(64)])
            windows = features.unfold(0, SHOWN, 1).permute(0, 2, 1)
            errors.append(self.network.judge(windows).cpu().numpy() - film.force[SHOWN - 1 :])
            true.append(film.force[SHOWN - 1 :])
        error, force = np.concatenate(errors), np.concatenate(true)
        return {"rmse_N": rms(error), "held_N": rms(error[force > ONSET])}

    def save(self, folder: Path) -> None:
        """Write a checkpoint; the one before it stays whole until the new one is complete."""
        states = {"network": self.network.state_dict(), "optimizer": self.optimizer.state_dict()}
        about = {"backbone": self.network.backbone, "step": self.step, "elapsed": self.elapsed}
        save_whole({**about, **states}, folder / CHECKPOINT)

    def resume(self, path: Path) -> None:
        """Go on from a checkpoint.

        Raises:
            CheckpointError: the file is missing, or of another network.
        """
        try:
            content = torch.load(path, map_location=self.device, weights_only=True)
            self.network.load_state_dict(content["network"])
            self.optimizer.load_state_dict(content["optimizer"])
            self.step, self.elapsed = int(content["step"]), float(content["elapsed"])
        except Exception as error:  # torch raises whatever its unpickler does
            reason = str(error).partition("\n")[0]
            expected = f"expected a checkpoint of lab.training.baseline.train with {self.network.backbone}"
            raise CheckpointError(f"{path}: {reason}; {expected}") from error


def write_network(network: EndToEnd, path: Path, said: dict[str, Any]) -> None:
    """Write the network as ONNX, with what is said of it in its metadata."""
    example = torch.zeros(1, SHOWN, HEIGHT, WIDTH, 3, dtype=torch.uint8)
    about = {"kind": KIND, "backbone": network.backbone, **said}
    write_onnx(network.cpu(), (example,), LAYOUT, path, about, {})


def train(trainer: BaselineTrainer, films: Sequence[GraspFilm], held_out: Sequence[GraspFilm], folder: Path) -> None:
    """Train until the recipe's end, with a log, a checkpoint and at last the network's file."""
    recipe, loss = trainer.recipe, 0.0
    rng = np.random.default_rng((recipe.seed, trainer.step))
    films = [film for film in films if len(film.force) >= SEGMENT]
    began, due = time.monotonic() - trainer.elapsed, trainer.elapsed + 60.0 * recipe.evaluate_every
    with tqdm(total=100.0, desc="train", unit="%", bar_format="{l_bar}{bar}|{postfix}", disable=None) as bar:
        while trainer.progress < 1.0:
            loss += 0.02 * (trainer.learn(*draw_batch(films, recipe, rng)) - loss)
            trainer.elapsed = time.monotonic() - began
            bar.update(100.0 * trainer.progress - bar.n)
            bar.set_postfix(step=trainer.step, loss=f"{loss:.4f}")
            if trainer.elapsed >= due or trainer.progress >= 1.0:
                due += 60.0 * recipe.evaluate_every
                line = {"step": trainer.step, "minutes": round(trainer.elapsed / 60.0, 2), "loss": round(loss, 5)}
                line |= {name: round(value, 4) for name, value in trainer.score(held_out).items()}
                with (folder / LOG).open("a", encoding="utf-8") as log:
                    log.write(json.dumps(line) + "\n")
                tqdm.write(json.dumps(line))
                trainer.save(folder)
    images = sum(len(film.force) for film in films)
    said = {"grasps": len(films), "images": images, "steps": trainer.step, "minutes": round(trainer.elapsed / 60.0, 1)}
    write_network(trainer.network.eval(), folder / NETWORK, said)


def main(arguments: Sequence[str] | None = None) -> None:
    """Train on the grasps of a folder; leave log, checkpoint and the network's file in another one."""
    parser = argparse.ArgumentParser(prog="python -m lab.training.baseline.train", description=__doc__)
    parser.add_argument("dataset", type=Path, help="folder of lab.training.baseline.scenes")
    parser.add_argument("-o", "--output", type=Path, required=True, help="folder of the run")
    parser.add_argument("--backbone", choices=BACKBONES, default=SMALL, help="encoder of the images (small)")
    parser.add_argument("--resume", action="store_true", help="go on from the checkpoint in the folder of the run")
    add_settings(parser, BaselineRecipe)
    options = parser.parse_args(arguments)
    with one_line_errors():
        trainer = BaselineTrainer(settings_from(options, BaselineRecipe), options.backbone)
        if options.resume:
            trainer.resume(options.output / CHECKPOINT)
        options.output.mkdir(parents=True, exist_ok=True)
        train(trainer, load_films(options.dataset, TRAIN), load_films(options.dataset, VALIDATION), options.output)
    print(f"{options.output / NETWORK}")


if __name__ == "__main__":
    main()
