"""Judges an exported network on labelled pictures: `python -m lab.training.evaluate FOLDER DATASET --worst worst.png`.

Knows no PyTorch: it runs the network as the product does.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from tqdm import tqdm

from finforce_keypoints.networks.side_network import SideNetwork
from lab.training.arguments import one_line_errors
from lab.training.dataset import VALIDATION, FingerPictures, load_pictures
from lab.training.drawing import draw_sheet
from lab.training.scoring import THRESHOLD, Detections, Score, find_worst, gather_detections, score_detections

BATCH = 16
THRESHOLDS = (0.2, 0.4, 0.6, 0.8, 0.9)
# mean of all colours; a D405 in its own exposure is near 100
LIGHT_LEVELS = {"dark (below 15)": (0.0, 15.0), "dim (15 to 50)": (15.0, 50.0), "bright (above 50)": (50.0, 256.0)}


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the scores of a network as a table, write them as JSON, and draw the worst pictures."""
    parser = argparse.ArgumentParser(prog="python -m lab.training.evaluate", description=__doc__)
    parser.add_argument("network", type=Path, help="folder of an exported network")
    parser.add_argument("dataset", type=Path, help="folder of shards")
    parser.add_argument("--part", default=VALIDATION, help=f"which shards ({VALIDATION})")
    parser.add_argument("--limit", type=int, help="judge on the first so many pictures only")
    parser.add_argument("--threshold", type=float, default=THRESHOLD, help=f"likelihood to accept ({THRESHOLD})")
    parser.add_argument("--worst", type=Path, help="picture file for the worst pictures")
    parser.add_argument("--json", type=Path, help="file for the scores")
    options = parser.parse_args(arguments)
    with one_line_errors():
        pictures = load_pictures(options.dataset, options.part, options.limit)
        detections = detect(SideNetwork(options.network, threads=1), pictures)
    scores = score_groups(detections, pictures, options.threshold)
    scores |= {f"likelihood from {limit:g}": score_detections(detections, limit) for limit in THRESHOLDS}
    print(format_scores(scores))
    if options.json:
        options.json.write_text(json.dumps({name: score.as_row() for name, score in scores.items()}, indent=1))
    if options.worst:
        worst = find_worst(detections, 20, options.threshold)
        draw_sheet(options.worst, pictures.middle[worst], detections.take(worst), options.threshold)


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


def score_groups(detections: Detections, pictures: FingerPictures, threshold: float) -> dict[str, Score]:
    """Return the scores of all pictures and of each level of light."""
    level = pictures.middle.mean(axis=(1, 2, 3))
    groups = {"all": np.ones(len(pictures), dtype=bool)}
    groups |= {name: (level >= low) & (level < high) for name, (low, high) in LIGHT_LEVELS.items()}
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
