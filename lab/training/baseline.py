"""Train the paper's baseline network, images to grasp force: `python -m lab.training.baseline DATA -o RUN`.

After K. Zuo et al. (RA-L 2026), who follow Zhu et al.: a residual encoder of each image, and a transformer over the
features of ten images in a row, whose last one tells the force. The paper's encoder is a ResNet-50; this one has the
same blocks, few enough for a CPU.
"""

from __future__ import annotations

import argparse
from collections import deque
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from finforce_eval.evaluation.scoring import ONSET_FORCE, rms
from finforce_eval.recordings.images import StampedImage
from lab.training.batches import AugmentSettings, change_light
from lab.training.commands import TrainingError, add_settings, import_torch, one_line_errors, settings_from
from lab.training.export import load_checkpoint
from lab.training.grasps import EDGE, GraspImages, load_grasps, shrink_image
from lab.training.network import build_convolution, build_stage, standardise
from lab.training.train import CHECKPOINT, Recipe, Training, has_bfloat16, to_layers

torch = import_torch()
nn = torch.nn

SHOWN = 10  # images that the network is given at a time
HEADS, LAYERS = 4, 2  # of the transformer
PIECE = 16  # images in a row that share their features: seven windows of ten
JUDGED = 14  # of so many grasps one is held back to judge the others' network
SHIFT = 4  # [px], largest shift of the images of a piece
ROUNDING = 0.2  # [N], error from which on the loss is linear
# As for key points, without what small images do not bear; images of a piece are changed side by side, all alike.
LIGHT = AugmentSettings(gradient=0.0, resample=0.0, blur=0.0)


@dataclass(frozen=True, kw_only=True)
class BaselineShape:
    """Sizes of the network.

    Attributes:
        channels: of the encoder at strides 2, 4, 8 and 16.
        features: of an image.
    """

    channels: tuple[int, int, int, int] = (16, 32, 64, 96)
    features: int = 128


class BaselineNetwork(nn.Module):
    """Ten images to the grasp force in the last one."""

    def __init__(self, shape: BaselineShape | None = None) -> None:
        super().__init__()
        self.shape = shape = shape or BaselineShape()
        first, *later = shape.channels
        steps = zip(shape.channels[:-1], later, strict=True)
        self.encoder = nn.Sequential(
            build_convolution(3, first, stride=2),
            *(build_stage(inputs, outputs, 1, folded=False) for inputs, outputs in steps),
            nn.Conv2d(later[-1], 16, 1),  # where something is matters: no mean over the image
            nn.ReLU(),
            nn.Flatten(),
            nn.Linear(16 * (EDGE // 16) ** 2, shape.features),
        )
        self.order = nn.Parameter(0.02 * torch.randn(SHOWN, shape.features))
        layer = nn.TransformerEncoderLayer(
            shape.features, HEADS, 2 * shape.features, dropout=0.1, batch_first=True, norm_first=True
        )
        self.transformer = nn.TransformerEncoder(layer, LAYERS, enable_nested_tensor=False)
        self.head = nn.Sequential(nn.LayerNorm(shape.features), nn.Linear(shape.features, 1))

    def encode(self, images: torch.Tensor) -> torch.Tensor:
        """Return features (n, C) of images (n, h, w, 3) uint8."""
        return self.encoder(standardise(to_layers(images)))

    def judge(self, features: torch.Tensor) -> torch.Tensor:
        """Return the force (b,) [N] in the last of each row of features (b, SHOWN, C)."""
        return self.head(self.transformer(features + self.order)[:, -1])[:, 0]

    def follow(self, features: torch.Tensor) -> torch.Tensor:
        """Return the forces (n - SHOWN + 1,) [N] from the tenth image on, of features (n, C) of images in a row."""
        return self.judge(features.unfold(0, SHOWN, 1).permute(0, 2, 1))


def draw_pieces(
    grasps: GraspImages, rows: Sequence[int], count: int, rng: np.random.Generator
) -> Iterator[tuple[NDArray, NDArray]]:
    """Yield batches of some grasps: images (count, PIECE, EDGE, EDGE, 3) uint8 and forces (count, PIECE) [N]."""
    begins, ends = grasps.starts[:-1][rows], grasps.starts[1:][rows] - PIECE
    firsts = np.concatenate([np.arange(a, b + 1) for a, b in zip(begins, ends, strict=True)])
    while True:
        chosen = [slice(first, first + PIECE) for first in rng.choice(firsts, count)]
        images = np.stack([change_piece(grasps.images[piece], rng) for piece in chosen])
        yield images, np.stack([grasps.force[piece] for piece in chosen])


def change_piece(images: NDArray[np.uint8], rng: np.random.Generator) -> NDArray[np.uint8]:
    """Return images (n, h, w, 3), all in the same other light, shifted alike, and perhaps mirrored."""
    moved = np.roll(images, rng.integers(-SHIFT, SHIFT + 1, 2), axis=(1, 2))
    if rng.random() < 0.5:
        moved = moved[:, :, ::-1]  # the smaller of two forces is the same
    strip = np.ascontiguousarray(np.concatenate(list(moved), axis=1))
    return np.stack(np.split(change_light(strip, LIGHT, rng), len(images), axis=1))


class BaselineTraining(Training):
    """The training of the baseline network."""

    def __init__(self, recipe: Recipe) -> None:
        torch.manual_seed(recipe.seed)
        super().__init__(recipe, BaselineNetwork())

    def measure(self, batch: tuple[NDArray, NDArray]) -> Mapping[str, torch.Tensor]:
        """Return the loss of images (b, PIECE, h, w, 3) and forces (b, PIECE) [N]."""
        images, forces = (torch.from_numpy(part).to(self.device) for part in batch)
        with torch.autocast(self.device.type, torch.bfloat16, enabled=has_bfloat16(self.device)):
            features = self.network.encode(images.flatten(0, 1)).view(*images.shape[:2], -1)
        windows = features.float().unfold(1, SHOWN, 1).permute(0, 1, 3, 2).flatten(0, 1)
        true = forces[:, SHOWN - 1 :].flatten()
        return {"force": nn.functional.smooth_l1_loss(self.network.judge(windows), true, beta=ROUNDING)}

    @torch.no_grad()
    def score(self, grasps: GraspImages, rows: Sequence[int]) -> dict[str, float]:
        """Return the RMSE [N] on the grasps of some numbers: of all images, and of those with a force above 0.02 N."""
        network, errors, true = self.averaged.eval(), [], []
        for first, last in zip(grasps.starts[:-1][rows], grasps.starts[1:][rows], strict=True):
            images = torch.from_numpy(grasps.images[first:last]).to(self.device)
            found = network.follow(torch.cat([network.encode(part) for part in images.split(64)]))
            true.append(grasps.force[first + SHOWN - 1 : last])
            errors.append(found.cpu().numpy() - true[-1])
        error, force = np.concatenate(errors), np.concatenate(true)
        return {"rmse_N": rms(error), "held_N": rms(error[force > ONSET_FORCE])}

    def train(self, grasps: GraspImages, folder: Path) -> None:
        """Train on most grasps; those held back judge it."""
        numbers, long_enough = np.arange(len(grasps.starts) - 1), np.diff(grasps.starts) >= PIECE
        is_judged = numbers % JUDGED == 0
        learnt, judged = (np.flatnonzero(part & long_enough) for part in (~is_judged, is_judged))
        rng = np.random.default_rng((self.recipe.seed, self.step))
        batches = draw_pieces(grasps, learnt, self.recipe.batch, rng)
        self.run(batches, lambda: self.score(grasps, judged), folder)


def load_baseline(path: str | Path) -> BaselineNetwork:
    """Return the averaged network of a checkpoint, ready to run.

    Raises:
        TrainingError: the file is missing, or of another network.
    """
    content = load_checkpoint(path)
    try:
        network = BaselineNetwork(BaselineShape(**content["shape"]))
        network.load_state_dict(content["averaged"])
    except (KeyError, TypeError, RuntimeError) as error:
        raise TrainingError(f"{path}: {error!r}; expected a checkpoint of lab.training.baseline") from error
    return network.eval()


@torch.no_grad()
def follow_images(network: BaselineNetwork, images: Iterable[StampedImage]) -> dict[int, float]:
    """Return the grasp force [N] in images by their stamps [ns], from the tenth one on."""
    shown: deque[torch.Tensor] = deque(maxlen=SHOWN)
    forces = {}
    for stamp, image in images:
        shown.append(network.encode(torch.from_numpy(shrink_image(image.color)[None])))
        if len(shown) == SHOWN:
            forces[int(stamp)] = float(network.follow(torch.cat(list(shown)))[0])
    return forces


def main(arguments: Sequence[str] | None = None) -> None:
    """Train on the grasps of a folder; leave log and checkpoint in another one."""
    parser = argparse.ArgumentParser(prog="python -m lab.training.baseline", description=__doc__)
    parser.add_argument("dataset", type=Path, help="folder of lab.training.grasps")
    parser.add_argument("-o", "--output", type=Path, required=True, help="folder of the run")
    parser.add_argument("--resume", action="store_true", help="resume from the checkpoint in the run folder")
    add_settings(parser, Recipe)
    parser.set_defaults(batch=8, rate=1e-3, decay=5e-2, clip=1.0)
    options = parser.parse_args(arguments)
    with one_line_errors():
        training = BaselineTraining(settings_from(options, Recipe))
        if options.resume:
            training.resume(load_checkpoint(options.output / CHECKPOINT))
        training.train(load_grasps(options.dataset), options.output)
    print(options.output / CHECKPOINT)


if __name__ == "__main__":
    main()
