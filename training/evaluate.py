"""Judges an exported network on labelled pictures: `python -m training.evaluate FOLDER DATASET --worst worst.png`.

Knows no PyTorch: it runs the network as the product does.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from tqdm import tqdm

from finforce_keypoints.networks.model import KeypointModel, ModelOverrides
from training.arguments import one_line_errors
from training.augment import AugmentSettings, TrainingSample, augment, crop_centre
from training.dataset import VALIDATION, LabelledPictures, load_pictures
from training.drawing import draw_sheet
from training.scoring import THRESHOLD, Detections, Score, find_worst, score_detections

BATCH = 32
THRESHOLDS = (0.2, 0.4, 0.6, 0.8, 0.9)
# mean of all colours; a D405 in its own exposure is near 100
LIGHT_LEVELS = {"dark (below 15)": (0.0, 15.0), "dim (15 to 50)": (15.0, 50.0), "bright (above 50)": (50.0, 256.0)}


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the scores of a network as a table, write them as JSON, and draw the worst pictures."""
    parser = argparse.ArgumentParser(prog="python -m training.evaluate", description=__doc__)
    parser.add_argument("network", type=Path, help="folder of an exported network")
    parser.add_argument("dataset", type=Path, help="folder of shards")
    parser.add_argument("--part", default=VALIDATION, help=f"which shards ({VALIDATION})")
    parser.add_argument("--limit", type=int, help="judge on the first so many pictures only")
    parser.add_argument("--threshold", type=float, default=THRESHOLD, help=f"likelihood to accept ({THRESHOLD})")
    parser.add_argument("--augmented", action="store_true", help="change the pictures as in training")
    parser.add_argument("--pooled", action="store_true", help="average the places around each peak")
    parser.add_argument("--worst", type=Path, help="picture file for the worst pictures")
    parser.add_argument("--json", type=Path, help="file for the scores")
    options = parser.parse_args(arguments)
    with one_line_errors():
        pictures = load_pictures(options.dataset, options.part, options.limit)
        samples = augment_all(pictures) if options.augmented else crop_all(pictures)
        detections = detect_samples(build_model(options.network, options.pooled), samples)
    scores = score_groups(detections, samples, pictures.light, options.threshold)
    scores |= {f"likelihood from {limit:g}": score_detections(detections, limit) for limit in THRESHOLDS}
    print(format_scores(scores))
    if options.json:
        options.json.write_text(json.dumps({name: score.as_row() for name, score in scores.items()}, indent=1))
    if options.worst:
        worst = find_worst(detections, 20, options.threshold)
        draw_sheet(options.worst, [samples[i] for i in worst], detections.take(worst), options.threshold)


def build_model(folder: str | Path, pooled: bool = False) -> KeypointModel:
    """Return an exported network, on one thread; raises ModelError where it cannot be used."""
    return KeypointModel(folder, overrides=ModelOverrides(pooled=pooled or None), threads=1)


def detect_with_model(folder: str | Path, pictures: LabelledPictures) -> Detections:
    """Return what an exported network finds in the middle of padded pictures."""
    return detect_samples(build_model(folder), crop_all(pictures))


def crop_all(pictures: LabelledPictures) -> list[TrainingSample]:
    """Return the pictures without their padding."""
    columns = zip(pictures.picture, pictures.xz, pictures.visible, strict=True)
    return [crop_centre(*column) for column in columns]


def augment_all(pictures: LabelledPictures, seed: int = 0) -> list[TrainingSample]:
    """Return the pictures changed as in training, the same ones for the same seed."""
    rng = np.random.default_rng(seed)
    columns = zip(pictures.picture, pictures.xz, pictures.visible, strict=True)
    return [augment(*column, AugmentSettings(), rng) for column in columns]


def detect_samples(model: KeypointModel, samples: Sequence[TrainingSample]) -> Detections:
    """Return what a network finds, decoded as in the product, with a progress bar."""
    found = []
    for start in tqdm(range(0, len(samples), BATCH), desc="detect", unit="batch", leave=False):
        found.append(model.locate(np.stack([sample.picture for sample in samples[start : start + BATCH]])))
    return Detections(
        pixels=np.concatenate([peaks.pixels for peaks in found]),
        likelihood=np.concatenate([peaks.likelihood for peaks in found]),
        points=np.stack([sample.points for sample in samples]),
        visible=np.stack([sample.visible for sample in samples]),
    )


def score_groups(
    detections: Detections, samples: Sequence[TrainingSample], light: np.ndarray | None, threshold: float
) -> dict[str, Score]:
    """Return the scores of all pictures, of each level of light and of each light's name."""
    level = np.array([sample.picture.mean() for sample in samples])
    groups = {"all": np.ones(len(samples), dtype=bool)}
    groups |= {name: (level >= low) & (level < high) for name, (low, high) in LIGHT_LEVELS.items()}
    if light is not None:
        groups |= {f"light {name}": light == name for name in np.unique(light) if name}
    return {name: score_detections(detections.take(mask), threshold) for name, mask in groups.items() if mask.any()}


def format_scores(scores: Mapping[str, Score]) -> str:
    """Return scores as a table."""
    lines = [f"{'pictures':>20} {'n':>6} {'median px':>9} {'p95 px':>7} {'hidden accepted':>15} {'visible lost':>12}"]
    for name, score in scores.items():
        lines.append(
            f"{name:>20} {score.pictures:6d} {score.median:9.3f} {score.p95:7.3f} "
            f"{100.0 * score.hidden_accepted:13.2f} % {100.0 * score.visible_lost:10.2f} %"
        )
    return "\n".join(lines)


if __name__ == "__main__":
    main()
