"""Images to features to a force: an encoder of each image and a transformer over ten of them.

After the comparison of K. Zuo et al. (RA-L 2026), which follows Zhu et al.: a ResNet-50 encodes the images. The small
encoder is for a CPU.
"""

from __future__ import annotations

from typing import Any

from finforce.optional import import_library
from lab.experiments.network import SHOWN
from lab.training.commands import PURPOSE, RecipeError, import_torch

torch = import_torch()
nn = torch.nn

SMALL, RESNET = "small", "resnet50"
BACKBONES = (SMALL, RESNET)
WIDTH, HEADS, LAYERS = 128, 4, 2  # of the transformer
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
        self.out = nn.Sequential(nn.Conv2d(CHANNELS[-1], 16, 1), nn.ReLU(), nn.Flatten(), nn.LazyLinear(WIDTH))

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
    resnet.fc = nn.Linear(resnet.fc.in_features, WIDTH)
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
        self.place = nn.Parameter(0.02 * torch.randn(SHOWN, WIDTH))
        layer = nn.TransformerEncoderLayer(WIDTH, HEADS, 2 * WIDTH, dropout=0.1, batch_first=True, norm_first=True)
        self.transformer = nn.TransformerEncoder(layer, LAYERS, enable_nested_tensor=False)
        self.head = nn.Sequential(nn.LayerNorm(WIDTH), nn.Linear(WIDTH, 64), nn.ReLU(), nn.Linear(64, 1))
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
        return self.judge(features.view(-1, SHOWN, WIDTH))
