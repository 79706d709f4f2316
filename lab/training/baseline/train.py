"""Trains the end-to-end network: `python -m lab.training.baseline.train DATA -o RUN`.

After the comparison of K. Zuo et al. (RA-L 2026), which follows Zhu et al.: an encoder of each image, a ResNet-50,
and a transformer over the features of ten images. A small encoder in its place is for a CPU.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from finforce.optional import import_library
from finforce.settings import setting
from finforce_eval.evaluation.scoring import ONSET_FORCE, rms
from lab.experiments.network import HEIGHT, KIND, LAYOUT, SHOWN, WIDTH
from lab.training.baseline.scenes import GraspFilm, load_films
from lab.training.commands import PURPOSE, RecipeError, add_settings, import_torch, one_line_errors, settings_from
from lab.training.export import load_checkpoint, write_onnx
from lab.training.pictures import TRAIN, VALIDATION
from lab.training.train import CHECKPOINT, Schedule, Training, has_bfloat16, train

torch = import_torch()
nn = torch.nn

NETWORK = "force_network.onnx"
SEGMENT = 24  # images in a row that share their features: 15 windows of ten
SMALL, RESNET = "small", "resnet50"
BACKBONES = (SMALL, RESNET)
FEATURES, HEADS, LAYERS = 128, 4, 2  # of the transformer
CHANNELS = (24, 48, 96, 128)
MEAN, SPREAD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)  # of colours, as the ResNet-50 was trained with


class Residual(nn.Module):
    """Two convolutions beside a short cut, half the size out."""

    def __init__(self, channels: int, out: int) -> None:
        super().__init__()
        self.first = nn.Sequential(nn.Conv2d(channels, out, 3, 2, 1, bias=False), nn.BatchNorm2d(out), nn.ReLU())
        self.second = nn.Sequential(nn.Conv2d(out, out, 3, 1, 1, bias=False), nn.BatchNorm2d(out))
        self.short = nn.Sequential(nn.Conv2d(channels, out, 1, 2, bias=False), nn.BatchNorm2d(out))

    def forward(self, x: Any) -> Any:
        """Return maps (n, out, h/2, w/2) of maps (n, channels, h, w)."""
        return torch.relu(self.second(self.first(x)) + self.short(x))


class SmallEncoder(nn.Module):
    """Three residual blocks; the last maps keep where something is, instead of a mean over the image."""

    def __init__(self) -> None:
        super().__init__()
        steps = zip((CHANNELS[0], *CHANNELS[:-1]), CHANNELS, strict=True)
        self.stem = nn.Sequential(
            nn.Conv2d(3, CHANNELS[0], 3, 2, 1, bias=False), nn.BatchNorm2d(CHANNELS[0]), nn.ReLU()
        )
        self.blocks = nn.Sequential(*(Residual(channels, out) for channels, out in list(steps)[1:]))
        self.out = nn.Sequential(nn.Conv2d(CHANNELS[-1], 16, 1), nn.ReLU(), nn.Flatten(), nn.LazyLinear(FEATURES))

    def forward(self, x: Any) -> Any:
        """Return features (n, 128) of pictures (n, 3, h, w)."""
        return self.out(self.blocks(self.stem(x)))


def build_encoder(backbone: str) -> Any:
    """Return the encoder of a name.

    Raises:
        RecipeError: there is none of this name.
        MissingDependencyError: torchvision is not installed.
    """
    if backbone == SMALL:
        return SmallEncoder()
    if backbone != RESNET:
        raise RecipeError(f"backbone {backbone!r}: expected one of {', '.join(BACKBONES)}")
    models = import_library("torchvision", PURPOSE).models
    resnet = models.resnet50(weights=None)
    resnet.fc = nn.Linear(resnet.fc.in_features, FEATURES)
    return resnet


class EndToEnd(nn.Module):
    """The whole network.

    Args:
        backbone: of `BACKBONES`.
    """

    def __init__(self, backbone: str = SMALL) -> None:
        super().__init__()
        self.backbone = backbone
        self.encoder = build_encoder(backbone)
        self.place = nn.Parameter(0.02 * torch.randn(SHOWN, FEATURES))
        layer = nn.TransformerEncoderLayer(
            FEATURES, HEADS, 2 * FEATURES, dropout=0.1, batch_first=True, norm_first=True
        )
        self.transformer = nn.TransformerEncoder(layer, LAYERS, enable_nested_tensor=False)
        self.head = nn.Sequential(nn.LayerNorm(FEATURES), nn.Linear(FEATURES, 64), nn.ReLU(), nn.Linear(64, 1))
        self.register_buffer("mean", torch.tensor(MEAN).view(1, 3, 1, 1))
        self.register_buffer("spread", torch.tensor(SPREAD).view(1, 3, 1, 1))

    def encode(self, pictures: Any) -> Any:
        """Return features (n, 128) of pictures (n, h, w, 3) from 0 to 255."""
        x = pictures.permute(0, 3, 1, 2).float() / 255.0
        return self.encoder((x - self.mean) / self.spread)

    def judge(self, features: Any) -> Any:
        """Return the force (b,) [N] in the last of each row of features (b, 10, 128)."""
        return self.head(self.transformer(features + self.place)[:, -1])[:, 0]

    def forward(self, images: Any) -> Any:
        """Return the force (b,) [N] in the last of each row of images (b, 10, h, w, 3) from 0 to 255."""
        features = self.encode(images.flatten(0, 1))
        return self.judge(features.view(-1, SHOWN, FEATURES))


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


class BaselineTraining(Training):
    """The training of the end-to-end network."""

    def __init__(self, recipe: BaselineRecipe, backbone: str = SMALL) -> None:
        torch.manual_seed(recipe.seed)
        network = EndToEnd(backbone)
        network(torch.zeros(2, SHOWN, HEIGHT, WIDTH, 3))  # gives lazy parts their size
        super().__init__(recipe, network, {"backbone": backbone})

    def learn(self, images: NDArray[np.uint8], forces: NDArray) -> dict[str, float]:
        """Take one step on images (b, 24, h, w, 3) and forces (b, 24) [N]; return the loss."""
        losses = []

        def measure() -> torch.Tensor:
            pictures = torch.from_numpy(images).to(self.device).flatten(0, 1)
            with torch.autocast(self.device.type, torch.bfloat16, enabled=has_bfloat16(self.device)):
                features = self.network.encode(pictures).view(len(images), SEGMENT, -1)
            windows = features.float().unfold(1, SHOWN, 1).permute(0, 1, 3, 2).flatten(0, 1)
            true = torch.from_numpy(forces[:, SHOWN - 1 :]).to(self.device).flatten()
            losses.append(torch.nn.functional.smooth_l1_loss(self.network.judge(windows), true, beta=0.2))
            return losses[0]

        self.descend(measure)
        return {"loss": float(losses[0].detach())}

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
        return {"rmse_N": rms(error), "held_N": rms(error[force > ONSET_FORCE])}

    def train(self, films: Sequence[GraspFilm], held_out: Sequence[GraspFilm], folder: Path) -> None:
        """Train on some grasps and be judged by others; write the network's file at last; see `train`."""
        rng = np.random.default_rng((self.recipe.seed, self.step))
        films = [film for film in films if len(film.force) >= SEGMENT]
        learning = (self.learn(*draw_batch(films, self.recipe, rng)) for _ in count())
        train(self, learning, lambda: self.score(held_out), folder)
        images, minutes = sum(len(film.force) for film in films), round(self.elapsed / 60.0, 1)
        said = {"grasps": len(films), "images": images, "steps": self.step, "minutes": minutes}
        write_network(self.network.eval(), folder / NETWORK, said)


def write_network(network: EndToEnd, path: Path, said: dict[str, Any]) -> None:
    """Write the network as ONNX, with what is said of it in its metadata."""
    example = torch.zeros(1, SHOWN, HEIGHT, WIDTH, 3, dtype=torch.uint8)
    about = {"kind": KIND, "backbone": network.backbone, **said}
    write_onnx(network.cpu(), (example,), LAYOUT, path, about, {})


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
        training = BaselineTraining(settings_from(options, BaselineRecipe), options.backbone)
        if options.resume:
            training.resume(load_checkpoint(options.output / CHECKPOINT))
        films, held_out = (load_films(options.dataset, part) for part in (TRAIN, VALIDATION))
        training.train(films, held_out, options.output)
    print(f"{options.output / NETWORK}")


if __name__ == "__main__":
    main()
