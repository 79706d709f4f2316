"""Errors of found points, hidden points accepted and visible points lost."""

from __future__ import annotations

from dataclasses import asdict, dataclass

import numpy as np
from numpy.typing import NDArray

THRESHOLD = 0.6  # DeepLabCut's cut-off of the likelihood
LIKELIHOOD_EDGES = np.array([0.0, 0.05, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 0.95, 0.98, 1.0])
FEWEST = 30  # points in a range of likelihoods, for a standard deviation of their errors
LEAST_STDDEV = 0.1  # px; no label is better than this


@dataclass(frozen=True, kw_only=True, eq=False)
class Detections:
    """What a network says of n pictures, and what is true of them.

    Attributes:
        pixels: (n, K, 2) found column and row [px].
        likelihood: (n, K) from 0 to 1.
        points: (n, K, 2) true column and row [px].
        visible: (n, K) bool, whether they can be seen.
    """

    pixels: NDArray
    likelihood: NDArray
    points: NDArray
    visible: NDArray

    @property
    def errors(self) -> NDArray:
        """Distances (n, K) between found and true points [px]."""
        return np.linalg.norm(self.pixels - self.points, axis=2)

    def take(self, indices: NDArray) -> Detections:
        """Return the pictures of some indices or of a mask (n,)."""
        return Detections(
            pixels=self.pixels[indices],
            likelihood=self.likelihood[indices],
            points=self.points[indices],
            visible=self.visible[indices],
        )


@dataclass(frozen=True, kw_only=True)
class Score:
    """How well points were found; NaN where nothing was to be scored.

    Attributes:
        pictures: number of pictures.
        median: error of visible, accepted points [px].
        p95: of the same [px].
        worst: of the same [px].
        hidden_accepted: part of the hidden points above the threshold.
        visible_lost: part of the visible points below it.
    """

    pictures: int
    median: float
    p95: float
    worst: float
    hidden_accepted: float
    visible_lost: float

    def as_row(self) -> dict[str, float]:
        """Return the numbers, rounded for a log."""
        return {name: round(float(value), 5) for name, value in asdict(self).items()}


def score_detections(detections: Detections, threshold: float = THRESHOLD) -> Score:
    """Return the errors of the visible points that are accepted at a likelihood, and how many are wrongly taken."""
    accepted = detections.likelihood >= threshold
    errors = detections.errors[accepted & detections.visible]
    quantiles = np.quantile(errors, (0.5, 0.95, 1.0)) if errors.size else np.full(3, np.nan)
    return Score(
        pictures=len(detections.pixels),
        median=quantiles[0],
        p95=quantiles[1],
        worst=quantiles[2],
        hidden_accepted=_mean(accepted[~detections.visible]),
        visible_lost=_mean(~accepted[detections.visible]),
    )


def fit_stddev(detections: Detections) -> list[list[float]]:
    """Return rows of likelihood and standard deviation [px] along one axis, both rising or falling steadily.

    In every range of likelihoods, hidden points included (they are wherever the network says), the standard deviation
    is that of the errors whose largest part in a hundred is cut off at the rest's largest: a mistaken point must widen
    it, one in a thousand must not. A higher likelihood never has the larger deviation.
    """
    likelihood = detections.likelihood.ravel()
    errors = (detections.pixels - detections.points).reshape(-1, 2)
    rows: list[list[float]] = []
    known = np.isfinite(errors).all(axis=1)
    for low, high in zip(LIKELIHOOD_EDGES[:-1], LIKELIHOOD_EDGES[1:], strict=True):
        chosen = known & (likelihood >= low) & ((likelihood < high) | (high == 1.0))
        if chosen.sum() < FEWEST:
            continue
        squares = (errors[chosen] ** 2).mean(axis=1)
        stddev = np.sqrt(np.minimum(squares, np.quantile(squares, 0.99)).mean())
        rows.append([float(np.median(likelihood[chosen])), max(float(stddev), LEAST_STDDEV)])
    for row, after in zip(rows[-2::-1], rows[:0:-1], strict=True):
        row[1] = max(row[1], after[1])
    return [[round(value, 4) for value in row] for row in rows]


def find_worst(detections: Detections, count: int, threshold: float = THRESHOLD) -> NDArray:
    """Return the indices (count,) of the pictures with the largest error of an accepted point, hidden ones included."""
    accepted = detections.likelihood >= threshold
    lost = np.where(detections.visible & ~accepted, 5.0, 0.0)
    wrong = np.where(accepted & ~detections.visible, 10.0, 0.0)
    errors = np.where(accepted & detections.visible, np.nan_to_num(detections.errors), 0.0)
    return np.argsort(-(errors + lost + wrong).max(axis=1), kind="stable")[:count]


def _mean(values: NDArray) -> float:
    return float(values.mean()) if values.size else float("nan")
