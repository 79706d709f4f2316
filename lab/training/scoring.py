"""Errors of found points, hidden points accepted and visible points lost."""

from __future__ import annotations

from dataclasses import asdict, dataclass

import numpy as np
from numpy.typing import NDArray

from lab.training.dataset import MARGIN, FingerPictures

THRESHOLD = 0.6  # DeepLabCut's cut-off of the likelihood


@dataclass(frozen=True, kw_only=True, eq=False)
class Detections:
    """What a network says of n pictures, and what is true of them.

    Attributes:
        pixels: (n, K, 2) found column and row [px].
        likelihood: (n, K) from 0 to 1.
        points: (n, K, 2) true column and row [px].
        visible: (n, K) bool, whether they can be seen.
        stddev: (n, K) stated deviation along an axis [px].
        counts: (n, K) bool, whether there is such a point: pictures have different numbers of them.
    """

    pixels: NDArray
    likelihood: NDArray
    points: NDArray
    visible: NDArray
    stddev: NDArray
    counts: NDArray

    @property
    def errors(self) -> NDArray:
        """Distances (n, K) between found and true points [px]."""
        return np.linalg.norm(self.pixels - self.points, axis=2)

    def take(self, indices: NDArray) -> Detections:
        """Return the pictures of some indices or of a mask (n,)."""
        return Detections(**{name: getattr(self, name)[indices] for name in self.__dataclass_fields__})


def gather_detections(pictures: FingerPictures, pixels: NDArray, likelihood: NDArray, stddev: NDArray) -> Detections:
    """Return what was found in the middle of padded pictures beside what is true of them, of the first K points."""
    count = pixels.shape[1]
    points = pictures.place[:, :count] - MARGIN
    with np.errstate(invalid="ignore"):
        inside = ((points >= 0.0) & (points <= np.array(pictures.middle.shape[2:0:-1]) - 1)).all(axis=2)
    counts = np.arange(count) < pictures.keypoints[:, None]
    visible = pictures.visible[:, :count] & inside & counts
    return Detections(
        pixels=pixels, likelihood=likelihood, points=points, visible=visible, stddev=stddev, counts=counts
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
        hidden_accepted=_mean(accepted[~detections.visible & detections.counts]),
        visible_lost=_mean(~accepted[detections.visible]),
    )


def fit_factor(detections: Detections, threshold: float = THRESHOLD) -> float:
    """Return what stated deviations are to be multiplied with to be standard deviations along an axis.

    Of normal errors in a plane 68.3 % lie within 1.52 deviations and 90 % within 2.15; those of a network have longer
    tails, and the larger factor counts.
    """
    good = detections.visible & (detections.likelihood >= threshold)
    ratio = detections.errors[good] / detections.stddev[good]
    return float(max(np.quantile(ratio, 0.683) / 1.52, np.quantile(ratio, 0.9) / 2.15))


def fit_shift(detections: Detections, lost: float, threshold: float = THRESHOLD) -> float:
    """Return what is to be added to logits so that the threshold loses a share of the points that can be seen."""
    last = np.clip(np.quantile(detections.likelihood[detections.visible], lost), 1e-6, 1.0 - 1e-6)
    return float(np.log(threshold / (1.0 - threshold)) - np.log(last / (1.0 - last)))


def find_worst(detections: Detections, count: int, threshold: float = THRESHOLD) -> NDArray:
    """Return the indices (count,) of the pictures with the largest error of an accepted point, hidden ones included."""
    accepted = detections.likelihood >= threshold
    lost = np.where(detections.visible & ~accepted, 5.0, 0.0)
    wrong = np.where(accepted & ~detections.visible & detections.counts, 10.0, 0.0)
    errors = np.where(accepted & detections.visible, np.nan_to_num(detections.errors), 0.0)
    return np.argsort(-(errors + lost + wrong).max(axis=1), kind="stable")[:count]


def _mean(values: NDArray) -> float:
    return float(values.mean()) if values.size else float("nan")
