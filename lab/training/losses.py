"""What is wanted of the coarse and the fine part, in one number."""

from __future__ import annotations

from dataclasses import dataclass

from lab.training.batches import Batch
from lab.training.commands import import_torch
from lab.training.network import LARGEST_SPREAD, FingerNetwork, standardise

torch = import_torch()
POINTS = 12  # of a picture that the fine part looks at in one step
COVERED = 4  # of them that are key points which cannot be seen, where there are any
ANYWHERE = 2  # of them that need not be key points
# px by which guesses are off: some anywhere up to FAR, others with deviation NEAR
FAR, FAR_SHARE, NEAR = 9.0, 0.25, 1.5
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

    @property
    def total(self) -> torch.Tensor:
        """The sum that is minimised."""
        return self.coarse + self.fine + self.likely + self.seen


def compute_losses(network: FingerNetwork, batch: Batch, *, low: bool) -> Losses:
    """Return the losses of a batch.

    The coarse part learns from all points whose place is known, hidden ones less. The fine part sees some of them, from
    guesses that are off by chance, and says of an error e with its deviation b that its density is exp(-e / b) / b^2.

    Args:
        network: in training mode.
        batch: on the network's device.
        low: whether to compute in bfloat16.
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
        found, judged = network.compare(
            pictures, templates, rest, places + _draw_miss(rest), network.read(features, rest)
        )
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


def _draw_miss(rest: torch.Tensor) -> torch.Tensor:
    """Return by how much guesses (B, k, 2) are off [px]."""
    far = torch.rand(rest.shape[:2], device=rest.device) < FAR_SHARE
    anywhere = FAR * (2.0 * torch.rand(rest.shape, device=rest.device) - 1.0)
    return torch.where(far[..., None], anywhere, NEAR * torch.randn(rest.shape, device=rest.device))
