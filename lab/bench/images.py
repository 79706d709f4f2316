"""From images to forces on twin scenes that no network was trained on, beside true key points.

The scenes are recorded into a folder once and read again later. Every seed has its own textures, lights, background and
noise; the finger is the one of the calibration `twin`. Another jaw than `bench` is found by the network of any finger
and calibrated with true key points on the same recording: what images add is then what the key points add.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from finforce.errors import FinforceError
from finforce_eval.cli.main import main as finforce
from lab.harness import Figures, time_calls
from lab.scenes import TwinScene, find_scene

# Name of a case: scene, and what is changed in it; no object is one of the shapes trained on.
UNSEEN: dict[str, tuple[str, dict[str, Any]]] = {
    "cylinder": ("grasp_cylinder", {}),
    "cube": ("grasp_cube", {}),
    "asymmetric": ("grasp_asymmetric", {}),
    "bottle": ("grasp_cylinder", {"object": "bottle", "scale": 0.45, "turn_x": 1.5708}),
    "shifting": ("shifting", {}),
    "fast close": ("fast_close", {}),
    "bench middle": ("bench_cylinder", {}),
    "bench lower": ("bench_cylinder_lower", {}),
    "weight": ("weight_turn", {}),
    "weight, dim": ("weight_turn_dim", {}),
}
FIRST_SEED = 101
BENCH = "bench"  # the jaw that the scenes are made for
QUICK_SCENE = "cylinder"


def measure(
    quick: bool, folder: Path | str | None = None, jaw: str = BENCH, count: int = 1, model: str = ""
) -> Figures:
    """Return pixel errors and force errors of every scene, seed and jaw.

    Args:
        quick: one scene.
        folder: of the recordings; that of rendered scenes in the user's cache without one.
        jaw: shipped jaws or jaw files, separated by commas.
        count: seeds of each scene.
        model: folder of another network than the shipped one.
    """
    scenes = [QUICK_SCENE] if quick else list(UNSEEN)
    rows, notes = [], []
    for scene, name, seed in product(scenes, jaw.split(","), range(FIRST_SEED, FIRST_SEED + count)):
        about = {"scene": scene, "jaw": Path(name).stem, "seed": seed}
        scenario, changes = UNSEEN[scene]
        unseen = TwinScene(scenario=scenario, seed=seed, changes={**changes, "jaw": name}, farthest=math.inf)
        try:
            rows.append(about | measure_scene(find_scene(unseen, Path(folder) if folder else None), name, model))
        except FinforceError as error:  # a finger that cannot be used is a finding, too
            notes.append(f"{' '.join(map(str, about.values()))}: {error}")
    matrix = np.random.default_rng(0).standard_normal((512, 512)).astype(np.float32)
    product_ms = 1e3 * float(np.median(time_calls(lambda: matrix @ matrix, 25)))
    meaning = (
        "True, image: RMSE of the force with key points that are true and that were found; late: from 0.02 N of true "
        f"force to an estimate above 0.1 N. A product of two matrices of 512 x 512 takes {product_ms:.2f} ms here."
    )
    return Figures(tables={"images": pd.DataFrame(rows)}, notes=[meaning, *notes])


def measure_scene(bag: Path, jaw: str, model: str) -> dict[str, Any]:
    """Return the errors of the key points in images, and of the forces with these and with true ones.

    Raises:
        FinforceError: the jaw cannot be calibrated there, or no force is told.
    """
    words = ["--jaw", jaw, "--calibration", calibrate(bag, jaw)]
    images = evaluate(bag, "images", [*words, *(["--detector", f"model={model}"] if model else [])])
    true, found = evaluate(bag, "truth", words)["all"]["rmse_N"], images["all"]["rmse_N"]
    return {
        **sight_columns(images["sight"]),
        "true/N": true,
        "image/N": found,
        "added/N": found - true,
        "solved/%": 100.0 * (1.0 - images["record_skipped"] / images["record_frames"]),
        "detector p50/ms": images["detector_ms"]["p50"],
        "detector p95/ms": images["detector_ms"]["p95"],
        "late/ms": (images["delay"] or {}).get("median_ms") or np.nan,
    }


def sight_columns(stats: Mapping[str, float | None]) -> dict[str, float]:
    """Return the numbers of `detection_stats`, how well key points were seen, as columns of a table."""
    found = {name: np.nan if value is None else value for name, value in stats.items()}
    return {
        "pixel error median/px": found["pixel_median_px"],
        "pixel error p95/px": found["pixel_p95_px"],
        "point error median/mm": found["point_median_mm"],
        "point error p95/mm": found["point_p95_mm"],
        "hidden accepted/%": found["hidden_accepted_pct"],
        "visible lost/%": found["visible_lost_pct"],
    }


def evaluate(bag: Path, source: str, words: Sequence[str]) -> dict[str, Any]:
    """Return what `finforce evaluate` tells of a recording by key points of a source.

    Raises:
        FinforceError: it tells no force.
    """
    answer = bag / f"{source}.json"
    answer.unlink(missing_ok=True)
    if finforce(["evaluate", str(bag), "--from", source, "--json", str(answer), *words]) != 0:
        raise FinforceError(f"{bag.name}: no force with key points from {source}")
    return json.loads(answer.read_text(encoding="utf-8"))["all"]


def calibrate(bag: Path, jaw: str) -> str:
    """Return the calibration of a jaw in a recording: the twin's own, or a file made there by true key points.

    Raises:
        FinforceError: it cannot be calibrated.
    """
    if jaw == BENCH:
        return "twin"
    file = bag / "calibration.yaml"
    if not file.exists() and finforce(["calibrate", str(bag), "--jaw", jaw, "--from", "truth", "-o", str(file)]) != 0:
        raise FinforceError(f"{bag.name}: {jaw} cannot be calibrated there")
    return str(file)
