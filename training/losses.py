"""Targets and losses of heat maps and location refinements."""

from __future__ import annotations

from dataclasses import dataclass

from training.network import LOCREF_STD, STRIDE
from training.optional import import_torch

torch = import_torch()
SHARPNESS = 0.05  # px; smaller errors count by their square
cross_entropy = torch.nn.functional.binary_cross_entropy_with_logits


@dataclass(frozen=True, kw_only=True)
class LossWeights:
    """What counts how much.

    Attributes:
        sigma: standard deviation of the heat maps' Gaussians [px].
        reach: cells around a point's own, each way, whose location refinement is trained.
        heatmap: weight of the heat maps' cross entropy, summed over the cells of a map.
        peak: weight of the cross entropy of visibility, taken at the point's cell, or at the highest one when hidden.
        locref: weight of the location error [1/px].
    """

    sigma: float = 7.0
    reach: int = 2
    heatmap: float = 0.1
    peak: float = 0.5
    locref: float = 0.5


@dataclass(frozen=True, kw_only=True, eq=False)
class Losses:
    """The parts of the loss of one batch, each weighted, as tensors without dimension."""

    heatmap: torch.Tensor
    peak: torch.Tensor
    locref: torch.Tensor

    @property
    def total(self) -> torch.Tensor:
        """The sum that is minimised."""
        return self.heatmap + self.peak + self.locref


def compute_losses(
    logits: torch.Tensor, locref: torch.Tensor, points: torch.Tensor, visible: torch.Tensor, weights: LossWeights
) -> Losses:
    """Return the losses of a batch.

    A visible point's heat map is to be exp(-d^2 / 2 sigma^2) at the distance d, a hidden one's zero. Location
    refinements are compared with (point - centre of the cell) / LOCREF_STD by their distance in pixels, weighted with
    the same Gaussian within the radius: an absolute error, so that the median counts and not a few mistaken points.

    Args:
        logits: (B, K, h, w) of the heat maps.
        locref: (B, 2K, h, w) dx and dy interleaved, in LOCREF_STD.
        points: (B, K, 2) column and row [px]; any number where not visible.
        visible: (B, K) bool.
        weights: of the parts.
    """
    shown = visible.to(logits.dtype)
    height, width = logits.shape[2:]
    known = torch.nan_to_num(points, nan=0.0)
    across = torch.exp(-(_steps(known[..., 0], width) ** 2) / (2.0 * weights.sigma**2))
    down = torch.exp(-(_steps(known[..., 1], height) ** 2) / (2.0 * weights.sigma**2))
    target = (down * shown[..., None])[..., :, None] * across[..., None, :]
    heatmap = cross_entropy(logits, target, reduction="none").sum(dim=(2, 3)).mean()
    cells = torch.floor(known / STRIDE).long()
    columns, rows = cells[..., 0].clamp(0, width - 1), cells[..., 1].clamp(0, height - 1)
    own = logits.flatten(2).gather(2, (rows * width + columns)[..., None])[..., 0]
    deciding = torch.where(visible, own, logits.amax(dim=(2, 3)))
    return Losses(
        heatmap=weights.heatmap * heatmap,
        peak=weights.peak * cross_entropy(deciding, shown),
        locref=weights.locref * _compute_place_loss(locref, known, visible, weights),
    )


def _steps(places: torch.Tensor, cells: int) -> torch.Tensor:
    """Return the steps (B, K, n) [px] from the centres (c + 0.5) STRIDE of n cells to places (B, K) along one axis."""
    return places[..., None] - (torch.arange(cells, device=places.device) + 0.5) * STRIDE


def _compute_place_loss(
    locref: torch.Tensor, points: torch.Tensor, visible: torch.Tensor, weights: LossWeights
) -> torch.Tensor:
    """Return the mean distance [px] between visible points (B, K, 2) and where the cells around them put them."""
    height, width = locref.shape[2:]
    window = torch.arange(-weights.reach, weights.reach + 1, device=points.device)
    steps = torch.stack(torch.meshgrid(window, window, indexing="xy"), dim=-1).reshape(-1, 2)
    cells = torch.floor(points / STRIDE).long()[:, :, None] + steps
    inside = ((cells >= 0) & (cells < torch.tensor([width, height], device=points.device))).all(dim=3)
    index = torch.where(inside, cells[..., 1] * width + cells[..., 0], 0)
    maps = locref.reshape(*points.shape, height * width)
    offsets = maps.gather(3, index[:, :, None].expand(-1, -1, 2, -1)).transpose(2, 3)
    aim = points[:, :, None] - (cells + 0.5) * STRIDE
    near = torch.exp(-aim.square().sum(dim=3) / (2.0 * weights.sigma**2)) * (inside & visible[..., None])
    distance = torch.sqrt((LOCREF_STD * offsets - aim).square().sum(dim=3) + SHARPNESS**2)
    return (near * distance).sum() / near.sum().clamp(min=1.0)
