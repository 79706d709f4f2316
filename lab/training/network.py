"""A network that finds the points of any finger: it is given the finger's template beside the picture.

A coarse part registers the two: it tells, at every place of the template, by how much the material there has moved. A
fine part then compares small pieces of picture and template around each point, and tells where exactly the point is,
how sure that is, and whether it can be seen at all.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

from lab.training.commands import import_torch

torch = import_torch()
nn = torch.nn

PIECE = 32  # px of the pieces that the fine part compares
COARSE_CELL = 8  # px of the full picture between the displacements
SPAN = 16.0  # px of displacement per unit of the coarse part's output
VARIANCE = 1e-4  # of a colour, 0 to 1, below which it is not stretched further
LARGEST_SPREAD = 4.0  # of the logarithm of a standard deviation, either way


@dataclass(frozen=True, kw_only=True)
class NetworkShape:
    """Sizes of the network.

    Attributes:
        height: of the picture [px], a multiple of 32.
        width: of the picture [px], a multiple of 16.
        coarse: channels of the coarse part at strides 4, 8, 16 and 32 of the picture; multiples of 16 are fastest.
        fine: channels of the fine part at strides 2 and 4.
        folded: True if convolutions have a bias instead of batch norm, as in an exported network.
    """

    height: int = 224
    width: int = 176
    coarse: tuple[int, int, int, int] = (16, 32, 64, 96)
    fine: tuple[int, int] = (24, 64)
    folded: bool = False


class _ResidualBlock(nn.Module):
    """Two dense 3 x 3 convolutions beside the identity, y = relu(x + B(relu(A x))); channels and size stay."""

    def __init__(self, channels: int, folded: bool = False) -> None:
        super().__init__()
        self.first = build_convolution(channels, channels, folded=folded)
        self.second = build_convolution(channels, channels, folded=folded, activate=False)

    def forward(self, features: torch.Tensor) -> torch.Tensor:
        """Return features of the same shape (B, C, h, w)."""
        return torch.relu(features + self.second(self.first(features)))


class _CoarsePart(nn.Module):
    """Picture and template at half size to displacements every eighth pixel of the template, and features there."""

    def __init__(self, shape: NetworkShape) -> None:
        super().__init__()
        finest, fine, middle, coarse = shape.coarse
        folded = shape.folded
        self.stem = build_convolution(6, finest, stride=2, folded=folded)
        self.down8 = build_stage(finest, fine, 2, folded)
        self.down16 = build_stage(fine, middle, 2, folded)
        self.down32 = build_stage(middle, coarse, 2, folded)
        rows, columns = shape.height // 32, -(-shape.width // 32)
        self.places = nn.Parameter(torch.zeros(1, coarse, rows, columns))
        self.up16 = build_convolution(coarse, middle, kernel=1, folded=folded, activate=False)
        self.merge16 = _ResidualBlock(middle, folded)
        self.up8 = build_convolution(middle, fine, kernel=1, folded=folded, activate=False)
        self.merge8 = _ResidualBlock(fine, folded)
        self.moves = nn.Conv2d(fine, 2, 1)

    def forward(self, pictures: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return displacements (B, 2, h / 8, w / 8) in SPAN and features (B, C, h / 8, w / 8)."""
        fine = self.down8(self.stem(pictures))
        middle = self.down16(fine)
        coarse = self.down32(middle) + self.places
        middle = self.merge16(torch.relu(middle + _double(self.up16(coarse), middle)))
        fine = self.merge8(torch.relu(fine + _double(self.up8(middle), fine)))
        return self.moves(fine), fine


class _FinePart(nn.Module):
    """Pieces of picture and template (N, 6, PIECE, PIECE) to the place of the template's middle in the picture."""

    def __init__(self, shape: NetworkShape) -> None:
        super().__init__()
        finest, fine = shape.fine
        folded = shape.folded
        self.stem = build_convolution(6, finest, stride=2, folded=folded)
        self.level2 = _ResidualBlock(finest, folded)
        self.down4 = build_stage(finest, fine, 2, folded)
        self.votes = nn.Conv2d(fine, 3, 1)
        self.judge = nn.Sequential(nn.Linear(2 * fine + shape.coarse[1], 32), nn.ReLU(), nn.Linear(32, 2))
        steps = (torch.arange(PIECE // 4) + 0.5) * 4.0 - 0.5 * PIECE
        self.register_buffer("centres", torch.stack(torch.meshgrid(steps, steps, indexing="xy")).reshape(1, 2, -1))

    def forward(self, pieces: torch.Tensor, context: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return how far each point is from its piece's middle (N, 2) [px], and logit and log deviation (N, 2)."""
        features = self.down4(self.level2(self.stem(pieces)))
        votes = self.votes(features).flatten(2).float()
        share = torch.softmax(votes[:, 2], dim=1)
        offset = ((self.centres + 4.0 * votes[:, :2]) * share[:, None]).sum(dim=2)
        flat = features.flatten(2).float()
        seen = torch.cat((flat.mean(dim=2), (flat * share[:, None]).sum(dim=2), context), dim=1)
        return offset, self.judge(seen)


class FingerNetwork(nn.Module):
    """Pictures, templates and points at rest to where the points are."""

    def __init__(self, shape: NetworkShape | None = None) -> None:
        super().__init__()
        self.shape = shape = shape or NetworkShape()
        self.coarse, self.fine = _CoarsePart(shape), _FinePart(shape)
        rows, columns = torch.meshgrid(torch.arange(PIECE), torch.arange(PIECE), indexing="ij")
        window = torch.stack((columns, rows), dim=-1).float() - 0.5 * (PIECE - 1)
        self.register_buffer("window", window.reshape(1, 1, PIECE * PIECE, 2))

    def register(self, pictures: torch.Tensor, templates: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return displacements [px] and features every eighth pixel of the templates, float32."""
        both = torch.cat((pictures, templates), dim=1)
        moves, features = self.coarse(nn.functional.avg_pool2d(both, 2))
        return SPAN * moves.float(), features.float()

    def read(self, maps: torch.Tensor, points: torch.Tensor) -> torch.Tensor:
        """Return maps (B, C, h / 8, w / 8) at places (B, K, 2) [px] of the template, as (B, K, C)."""
        return _sample(maps, (points + 0.5) / COARSE_CELL - 0.5)[..., 0].transpose(1, 2)

    def compare(
        self,
        pictures: torch.Tensor,
        templates: torch.Tensor,
        rest: torch.Tensor,
        guess: torch.Tensor,
        context: torch.Tensor,
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Return places (B, K, 2) [px] near guesses, and logits and log deviations (B, K, 2)."""
        count = rest.shape[0] * rest.shape[1]
        pieces = torch.cat((self._cut(pictures, guess), self._cut(templates, rest)), dim=1)
        offset, judged = self.fine(pieces, context.reshape(count, -1))
        return guess + offset.reshape(guess.shape), judged.reshape(guess.shape)

    def _cut(self, maps: torch.Tensor, centres: torch.Tensor) -> torch.Tensor:
        """Return pieces (B K, C, PIECE, PIECE) of maps (B, C, h, w) around places (B, K, 2) [px]."""
        batch, channels = maps.shape[:2]
        places = (centres[:, :, None] + self.window).reshape(batch, -1, 2)
        pieces = _sample(maps, places)[..., 0].reshape(batch, channels, -1, PIECE * PIECE)
        return pieces.transpose(1, 2).reshape(-1, channels, PIECE, PIECE)

    def forward(
        self, pictures: torch.Tensor, templates: torch.Tensor, rest: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Find points.

        Args:
            pictures: (B, 3, height, width) RGB, 0 to 1.
            templates: (B, 3, height, width), 0 to 1.
            rest: (B, K, 2) columns and rows of the points in the template [px].

        Returns:
            places (B, K, 2) [px], logits of being visible (B, K), logarithms of the deviation [px] (B, K).
        """
        pictures = standardise(pictures)
        moves, features = self.register(pictures, templates)
        guess = rest + self.read(moves, rest)
        places, judged = self.compare(pictures, templates, rest, guess, self.read(features, rest))
        return places, judged[..., 0], judged[..., 1].clamp(-LARGEST_SPREAD, LARGEST_SPREAD)


class ExportedCoarse(nn.Module):
    """The coarse part as it is shipped: bytes in, guesses out, with what the fine part needs to go on."""

    def __init__(self, network: FingerNetwork) -> None:
        super().__init__()
        self.network = network

    def forward(
        self, pictures: torch.Tensor, templates: torch.Tensor, points: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:
        """Return guesses (B, K, 2) [px], context (B, K, C), and each colour's mean and gain (B, 3).

        Args:
            pictures: (B, h, w, 3) uint8.
            templates: (B, h / 2, w / 2, 3) uint8, at half size.
            points: (B, K, 2) in the templates at full size [px].
        """
        layers = pictures.permute(0, 3, 1, 2).float()  # sums of planes are quicker than of pixels in turn
        mean = layers.mean(dim=(2, 3))
        gain = torch.rsqrt((layers * layers).mean(dim=(2, 3)) - mean * mean + VARIANCE * 255.0**2)
        half = nn.functional.avg_pool2d(layers, 2)
        half = (half - mean[:, :, None, None]) * gain[:, :, None, None]
        moves, features = self.network.coarse(torch.cat((half, templates.permute(0, 3, 1, 2).float() / 255.0), dim=1))
        return points + SPAN * self.network.read(moves, points), self.network.read(features, points), mean, gain


class ExportedFine(nn.Module):
    """The fine part as it is shipped: pieces in bytes in, offsets, likelihoods and deviations out."""

    def __init__(self, network: FingerNetwork) -> None:
        super().__init__()
        self.part = network.fine

    def forward(
        self,
        pieces: torch.Tensor,
        templates: torch.Tensor,
        context: torch.Tensor,
        mean: torch.Tensor,
        gain: torch.Tensor,
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Return offsets (N, 2) [px], likelihoods (N,) and deviations (N,) [px].

        Args:
            pieces: (N, PIECE, PIECE, 3) uint8, of pictures around guesses.
            templates: the same of templates around the points at rest.
            context: (N, C).
            mean: (N, 3) of the pictures.
            gain: (N, 3) of the pictures.
        """
        seen = (pieces.permute(0, 3, 1, 2).float() - mean[:, :, None, None]) * gain[:, :, None, None]
        both = torch.cat((seen, templates.permute(0, 3, 1, 2).float() / 255.0), dim=1)
        offset, judged = self.part(both, context)
        return offset, torch.sigmoid(judged[:, 0]), torch.exp(judged[:, 1].clamp(-LARGEST_SPREAD, LARGEST_SPREAD))


def standardise(pictures: torch.Tensor) -> torch.Tensor:
    """Return pictures (B, 3, h, w) with mean 0 and variance 1 in each colour."""
    mean = pictures.mean(dim=(2, 3), keepdim=True)
    centred = pictures - mean
    return centred * torch.rsqrt(centred.square().mean(dim=(2, 3), keepdim=True) + VARIANCE)


def _sample(maps: torch.Tensor, places: torch.Tensor) -> torch.Tensor:
    """Return maps (B, C, h, w) at places (B, n, 2), column and row, as (B, C, n, 1); 0 outside."""
    size = torch.tensor([maps.shape[3], maps.shape[2]], dtype=maps.dtype, device=maps.device)
    grid = (2.0 * places + 1.0) / size - 1.0
    return nn.functional.grid_sample(
        maps, grid[:, :, None], mode="bilinear", padding_mode="border", align_corners=False
    )


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


def fold_batch_norm(network: FingerNetwork) -> FingerNetwork:
    """Return a copy in evaluation mode, each batch norm folded into the convolution before it."""
    state = dict(network.state_dict())
    folded = FingerNetwork(replace(network.shape, folded=True))
    for name, module in network.named_modules():
        if isinstance(module, nn.Sequential) and len(module) == 3 and isinstance(module[1], nn.BatchNorm2d):
            fused = nn.utils.fusion.fuse_conv_bn_eval(module[0].eval(), module[1].eval())
            state[f"{name}.0.weight"], state[f"{name}.0.bias"] = fused.weight, fused.bias
    folded.load_state_dict({name: state[name] for name in folded.state_dict()})
    return folded.eval()


def build_stage(inputs: int, outputs: int, blocks: int, folded: bool) -> nn.Sequential:
    """Return a halving of the resolution and the residual blocks after it."""
    return nn.Sequential(
        build_convolution(inputs, outputs, stride=2, folded=folded),
        *(_ResidualBlock(outputs, folded) for _ in range(blocks)),
    )


def _double(features: torch.Tensor, like: torch.Tensor) -> torch.Tensor:
    """Return features at the resolution of others, twice their own: each cell repeated."""
    return nn.functional.interpolate(features, size=like.shape[2:], mode="nearest")
