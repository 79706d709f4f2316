"""Judge an exported network on labelled pictures: `python -m lab.training.evaluate FOLDER DATASET`.

Knows no PyTorch: it runs the network as the product does.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from finforce_keypoints.networks.side_network import SideNetwork
from lab.training.commands import TrainingError, one_line_errors
from lab.training.pictures import MARGIN, VALIDATION, FingerPictures, load_pictures

THRESHOLD = 0.6  # DeepLabCut's cut-off of the likelihood
BATCH = 16
THRESHOLDS = (0.2, 0.4, 0.6, 0.8, 0.9)
# mean of all colours; a D405 in its own exposure is near 100
LIGHT_LEVELS = {"dark (below 15)": (0.0, 15.0), "dim (15 to 50)": (15.0, 50.0), "bright (above 50)": (50.0, 256.0)}


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the scores of a network as a table."""
    parser = argparse.ArgumentParser(prog="python -m lab.training.evaluate", description=__doc__)
    parser.add_argument("network", type=Path, help="folder of an exported network")
    parser.add_argument("dataset", type=Path, help=f"folder of shards {VALIDATION}_*.npz")
    options = parser.parse_args(arguments)
    with one_line_errors():
        pictures = load_pictures(options.dataset, VALIDATION)
        detections = detect(SideNetwork(options.network, threads=1), pictures)
    level = pictures.middle.mean(axis=(1, 2, 3))
    groups = {"all": np.ones(len(pictures), dtype=bool)}
    groups |= {name: (level >= low) & (level < high) for name, (low, high) in LIGHT_LEVELS.items()}
    scores = {name: score_detections(detections.take(mask)) for name, mask in groups.items() if mask.any()}
    scores |= {f"likelihood from {limit:g}": score_detections(detections, limit) for limit in THRESHOLDS}
    print(format_scores(scores))


def detect(network: SideNetwork, pictures: FingerPictures) -> Detections:
    """Return what a network finds of the key points in the middle of padded pictures, with a progress bar."""
    count, found = int(pictures.keypoints.max()), []
    for start in tqdm(range(0, len(pictures), BATCH), desc="detect", unit="batch", leave=False):
        rows = range(start, min(start + BATCH, len(pictures)))
        templates = [
            network.prepare(pictures.template[pictures.finger[row]], pictures.rest[row, :count]) for row in rows
        ]
        found.append(network.locate(pictures.middle[rows.start : rows.stop], templates))
    columns = (
        np.concatenate([getattr(places, name) for places in found]) for name in ("pixels", "likelihood", "stddev")
    )
    return gather_detections(pictures, *columns)


def format_scores(scores: Mapping[str, Score]) -> str:
    """Return scores as a table."""
    lines = [f"{'pictures':>20} {'n':>6} {'median px':>9} {'p95 px':>7} {'hidden accepted':>15} {'visible lost':>12}"]
    for name, score in scores.items():
        lines.append(
            f"{name:>20} {score.pictures:6d} {score.median:9.3f} {score.p95:7.3f} "
            f"{100.0 * score.hidden_accepted:13.2f} % {100.0 * score.visible_lost:10.2f} %"
        )
    return "\n".join(lines)


@dataclass(frozen=True, kw_only=True, eq=False)
class Detections:
    """The answers of a network to n pictures, and their truth.

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
    """The errors of the points found; NaN where nothing was to be scored.

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

    Raises:
        TrainingError: not one visible point is accepted.
    """
    good = detections.visible & (detections.likelihood >= threshold)
    if not good.any():
        raise TrainingError(
            f"no visible point is accepted at a likelihood of {threshold:g}; expected a longer training"
        )
    ratio = detections.errors[good] / detections.stddev[good]
    return float(max(np.quantile(ratio, 0.683) / 1.52, np.quantile(ratio, 0.9) / 2.15))


def fit_shift(detections: Detections, lost: float, threshold: float = THRESHOLD) -> float:
    """Return what is to be added to logits so that the threshold loses a share of the points that can be seen."""
    last = np.clip(np.quantile(detections.likelihood[detections.visible], lost), 1e-6, 1.0 - 1e-6)
    return float(np.log(threshold / (1.0 - threshold)) - np.log(last / (1.0 - last)))


def _mean(values: NDArray) -> float:
    return float(values.mean()) if values.size else float("nan")


if __name__ == "__main__":
    main()
