"""A small heat map network with location refinement."""

from __future__ import annotations

from dataclasses import dataclass, replace

from training.optional import import_torch

torch = import_torch()
nn = torch.nn

STRIDE = 4  # input pixels per cell of the outputs
DEEPEST = 16  # input pixels per cell of the coarsest features
LOCREF_STD = 7.2801  # input pixels per unit of the location refinement, DeepLabCut's


@dataclass(frozen=True, kw_only=True)
class NetworkShape:
    """Sizes of the network; the defaults run a batch of two in about 3 ms on two cores.

    Attributes:
        points: number of key points, the reference point included.
        height: of the input [px], a multiple of 16.
        width: of the input [px], a multiple of 16.
        channels: of the features at strides 2, 4, 8 and 16.
        blocks: residual blocks at strides 4, 8 and 16 on the way down.
        folded: whether convolutions have a bias instead of batch norm, as in an exported network.
    """

    points: int = 16
    height: int = 224
    width: int = 176
    channels: tuple[int, int, int, int] = (16, 32, 64, 96)
    blocks: tuple[int, int, int] = (1, 2, 2)
    folded: bool = False


class ResidualBlock(nn.Module):
    """Two dense 3 x 3 convolutions beside the identity, y = relu(x + B(relu(A x))); channels and size stay."""

    def __init__(self, channels: int, folded: bool = False) -> None:
        super().__init__()
        self.first = build_convolution(channels, channels, folded=folded)
        self.second = build_convolution(channels, channels, folded=folded, activate=False)

    def forward(self, features: torch.Tensor) -> torch.Tensor:
        """Return features of the same shape (B, C, h, w)."""
        return torch.relu(features + self.second(self.first(features)))


class KeypointNetwork(nn.Module):
    """Pictures to heat maps and location refinements, in the layout of DeepLabCut.

    Each picture's colours are first brought to mean 0 and variance 1, so that the light's level and hue matter little.
    Features go down to stride 16, where a learned map of places is added (all pictures show the jaw in nearly the same
    place), and come up again by nearest-neighbour upsampling with skip connections to stride 4.
    """

    def __init__(self, shape: NetworkShape | None = None) -> None:
        super().__init__()
        self.shape = shape = shape or NetworkShape()
        finest, fine, middle, coarse = shape.channels
        folded = shape.folded
        self.standardise = nn.InstanceNorm2d(3, eps=1e-3)
        self.stem = build_convolution(3, finest, stride=2, folded=folded)
        self.down4 = _build_stage(finest, fine, shape.blocks[0], folded)
        self.down8 = _build_stage(fine, middle, shape.blocks[1], folded)
        self.down16 = _build_stage(middle, coarse, shape.blocks[2], folded)
        self.places = nn.Parameter(torch.zeros(1, coarse, shape.height // DEEPEST, shape.width // DEEPEST))
        self.up8 = build_convolution(coarse, middle, kernel=1, folded=folded, activate=False)
        self.merge8 = ResidualBlock(middle, folded)
        self.up4 = build_convolution(middle, fine, kernel=1, folded=folded, activate=False)
        self.merge4 = ResidualBlock(fine, folded)
        self.heatmap = nn.Conv2d(fine, shape.points, 1)
        self.locref = nn.Conv2d(fine, 2 * shape.points, 1)
        nn.init.constant_(self.heatmap.bias, -4.0)  # most cells are empty: start from a likelihood of 2 %

    def forward(self, pictures: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the logits of the heat maps and the location refinements.

        Args:
            pictures: (B, 3, height, width) RGB, normalised with ImageNet's mean and standard deviation.

        Returns:
            logits (B, K, height / 4, width / 4), and dx, dy (B, 2K, height / 4, width / 4), interleaved, in LOCREF_STD.
        """
        fine = self.down4(self.stem(self.standardise(pictures)))
        middle = self.down8(fine)
        coarse = self.down16(middle) + self.places
        middle = self.merge8(torch.relu(middle + _double(self.up8(coarse))))
        fine = self.merge4(torch.relu(fine + _double(self.up4(middle))))
        return self.heatmap(fine), self.locref(fine)


class ExportedNetwork(nn.Module):
    """A trained network as it is shipped: batch norm folded into the convolutions, heat maps between 0 and 1."""

    def __init__(self, network: KeypointNetwork) -> None:
        super().__init__()
        self.network = fold_batch_norm(network)

    def forward(self, pictures: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return heat maps (B, K, h, w) in [0, 1] and location refinements (B, 2K, h, w)."""
        logits, locref = self.network(pictures)
        return torch.sigmoid(logits), locref


def build_convolution(
    inputs: int, outputs: int, *, kernel: int = 3, stride: int = 1, folded: bool = False, activate: bool = True
) -> nn.Sequential:
    """Return a convolution, batch norm (none when folded) and ReLU (none when not activated)."""
    layers = [
        nn.Conv2d(inputs, outputs, kernel, stride, kernel // 2, bias=folded),
        nn.Identity() if folded else nn.BatchNorm2d(outputs),
        nn.ReLU() if activate else nn.Identity(),
    ]
    return nn.Sequential(*layers)


def fold_batch_norm(network: KeypointNetwork) -> KeypointNetwork:
    """Return a copy in evaluation mode, each batch norm folded into the convolution before it."""
    state = dict(network.state_dict())
    folded = KeypointNetwork(replace(network.shape, folded=True))
    for name, module in network.named_modules():
        if isinstance(module, nn.Sequential) and isinstance(module[1], nn.BatchNorm2d):
            fused = nn.utils.fusion.fuse_conv_bn_eval(module[0].eval(), module[1].eval())
            state[f"{name}.0.weight"], state[f"{name}.0.bias"] = fused.weight, fused.bias
    folded.load_state_dict({name: state[name] for name in folded.state_dict()})
    return folded.eval()


def _build_stage(inputs: int, outputs: int, blocks: int, folded: bool) -> nn.Sequential:
    """Return a halving of the resolution and the residual blocks after it."""
    return nn.Sequential(
        build_convolution(inputs, outputs, stride=2, folded=folded),
        *(ResidualBlock(outputs, folded) for _ in range(blocks)),
    )


def _double(features: torch.Tensor) -> torch.Tensor:
    """Return features at twice the resolution, each cell repeated."""
    return nn.functional.interpolate(features, scale_factor=2, mode="nearest")
