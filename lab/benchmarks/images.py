"""From images to forces on twin scenes that no network was trained on, against true key points; tables and JSON.

    python -m lab.benchmarks.images FOLDER [--json report/images.json] [--seeds 2] [--scenes NAME ...] [--model NETWORK]
    python -m lab.benchmarks.images FOLDER --jaws umi xlerobot ssg48_fin_ray_3 --scenes cylinder

The scenes are recorded into FOLDER once and read again later. Every seed has its own textures, lights, background and
noise; the finger is the one of the calibration `twin`. Another jaw than `bench` is found by the network of any finger
and calibrated with true key points on the same recording: what images add is then what the key points add. The
detector's times are of this machine under its present load; a product of two matrices of 512 x 512 says what that is.
"""

import argparse
import json
from collections.abc import Mapping, Sequence
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from finforce.errors import FinforceError
from finforce_eval.cli.main import main as finforce
from finforce_eval.machine import write_figures
from lab.bench.detection import time_product
from lab.bench.scenes import BENCH, FIRST_SEED, UNSEEN, record_unseen

SOURCES = ("images", "truth")
WIDTH = 34  # of the first column
COLUMNS = (
    ("px p50", "pixel_median_px"),
    ("px p95", "pixel_p95_px"),
    ("mm p50", "point_median_mm"),
    ("mm p95", "point_p95_mm"),
    ("hidden+ %", "hidden_accepted_pct"),
    ("visible- %", "visible_lost_pct"),
)


def evaluate(bag: Path, source: str, words: Sequence[str]) -> dict[str, Any] | None:
    """Return what `finforce evaluate` says of a recording by key points of a source; None when it tells no force."""
    answer = bag / f"{source}.json"
    answer.unlink(missing_ok=True)
    if finforce(["evaluate", str(bag), "--from", source, "--json", str(answer), *words]) != 0:
        return None
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


def measure(name: str, seed: int, jaw: str, options: argparse.Namespace) -> dict[str, Any]:
    """Return the figures of one case, seed and jaw; of a source that tells no force there are none.

    Raises:
        FinforceError: the case cannot be recorded or calibrated.
    """
    bag = record_unseen(name, seed, options.folder, jaw)
    words = ["--jaw", jaw, "--calibration", calibrate(bag, jaw)]
    model = ["--detector", f"model={options.model}"] if options.model else []
    found = {source: evaluate(bag, source, [*words, *(model if source == "images" else ())]) for source in SOURCES}
    images = found["images"] or {}
    return {
        "case": name,
        "jaw": jaw,
        "seed": seed,
        "rmse_N": {source: answer and answer["all"]["rmse_N"] for source, answer in found.items()},
        "solved_pct": {
            source: answer and 100.0 * (1.0 - answer["record_skipped"] / answer["record_frames"])
            for source, answer in found.items()
        },
        "sight": images.get("sight"),
        "detector_ms": images.get("detector_ms"),
        "delay": images.get("delay"),
    }


def format_row(label: str, figures: Mapping[str, Any]) -> str:
    """Return one line of the table."""
    images, truth = (figures["rmse_N"][source] for source in SOURCES)
    if images is None or truth is None:
        told = "" if truth is None else f"{truth:>9.3f}"
        return f"{label:<{WIDTH}}{'':>{11 * len(COLUMNS)}}{told:>9}{'none told':>11}"
    seen = [figures["sight"][key] for _, key in COLUMNS]  # None of hidden points where none was hidden
    sight = "".join(f"{'-':>11}" if value is None else f"{value:>11.2f}" for value in seen)
    force = f"{truth:>9.3f}{images:>9.3f}{images - truth:>+9.3f}{figures['solved_pct']['images']:>9.1f}"
    delay = figures["delay"] or {}
    late = delay.get("median_ms")
    times = f"{figures['detector_ms']['p50']:>8.1f}{figures['detector_ms']['p95']:>8.1f}"
    return f"{label:<{WIDTH}}{sight}{force}{times}{late if late is not None else float('nan'):>9.0f}"


def print_table(rows: Sequence[Mapping[str, Any]]) -> None:
    """Print a line per case, jaw and seed."""
    names = "".join(f"{title:>11}" for title, _ in COLUMNS)
    force = f"{'true/N':>9}{'image/N':>9}{'added':>9}{'solved%':>9}"
    print(f"{'':<{WIDTH}}{names}{force}{'ms p50':>8}{'p95':>8}{'late/ms':>9}")
    for row in rows:
        print(format_row(f"{row['case']} {Path(row['jaw']).stem} {row['seed']}", row))
    print(
        "true, image: RMSE of the force with key points that are true and that were found; late: from 0.02 N of true "
        "force to an estimate above 0.1 N."
    )


def summarise(rows: Sequence[Mapping[str, Any]]) -> dict[str, float]:
    """Return medians and worst values over the rows in which a force was told, and how many those are."""
    told = [row for row in rows if None not in row["rmse_N"].values()]
    summary: dict[str, float] = {"rows": len(rows), "told": len(told)}
    if not told:
        return summary
    added = [row["rmse_N"]["images"] - row["rmse_N"]["truth"] for row in told]
    summary |= {"added_median_N": float(np.median(added)), "added_worst_N": float(np.max(added))}
    for _, key in COLUMNS:
        values = [row["sight"][key] for row in told if row["sight"][key] is not None]
        summary |= {f"{key}_median": float(np.median(values)), f"{key}_worst": float(np.max(values))}
    return summary


def main() -> None:
    """Measure what was asked for."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path, help="of the recordings")
    parser.add_argument("--json", metavar="OUT", help="write the figures as JSON")
    parser.add_argument("--seeds", type=int, default=1, help="recordings per case (1)")
    parser.add_argument("--scenes", nargs="+", default=list(UNSEEN), choices=list(UNSEEN), help="cases (all)")
    parser.add_argument("--jaws", nargs="+", default=[BENCH], help="shipped jaws or jaw files (bench)")
    parser.add_argument("--model", help="folder of another network than the shipped one")
    options = parser.parse_args()
    rows, failed = [], {}
    seeds = range(FIRST_SEED, FIRST_SEED + options.seeds)
    for name, jaw, seed in product(options.scenes, options.jaws, seeds):
        try:
            rows.append(measure(name, seed, jaw, options))
        except FinforceError as error:  # a finger that cannot be used is a finding, too
            failed[f"{name} {Path(jaw).stem} {seed}"] = str(error)
            print(f"failed: {error}")
            continue
        print_table(rows[-1:])
    yardstick = 1e3 * float(np.median([time_product() for _ in range(25)]))
    print_table(rows)
    print(f"Product of two matrices of 512 x 512: {yardstick:.2f} ms. {summarise(rows)}")
    if options.json:
        write_figures(
            options.json, {"rows": rows, "failed": failed, "summary": summarise(rows), "yardstick_ms": yardstick}
        )


if __name__ == "__main__":
    main()
