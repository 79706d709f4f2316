"""From images to forces on twin scenes that no network was trained on, against true key points; tables and JSON.

    python benchmarks/images.py FOLDER [--json report/images.json] [--seeds 2] [--scenes NAME ...] [--model NETWORK]

The scenes are recorded into FOLDER once and read again later. Every seed has its own textures, lights, background and
noise; the finger is the one of the calibration `twin`. The detector's times are of this machine under its present load;
a product of two matrices of 512 x 512 beside them says what that is.
"""

import argparse
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from finforce.errors import FinforceError
from finforce_eval.bench.detection import time_product
from finforce_eval.bench.scenes import FIRST_SEED, UNSEEN, record_unseen
from finforce_eval.cli.main import main as finforce
from finforce_eval.machine import write_figures

SOURCES = ("images", "truth")
COLUMNS = (
    ("px p50", "pixel_median_px"),
    ("px p95", "pixel_p95_px"),
    ("mm p50", "point_median_mm"),
    ("mm p95", "point_p95_mm"),
    ("hidden+ %", "hidden_accepted_pct"),
    ("visible- %", "visible_lost_pct"),
)


def evaluate(bag: Path, source: str, options: Sequence[str]) -> dict[str, Any]:
    """Return what `finforce evaluate` says of a recording with key points from a source.

    Raises:
        FinforceError: nothing could be evaluated.
    """
    answer = bag / f"{source}.json"
    answer.unlink(missing_ok=True)
    words = ["evaluate", str(bag), "--from", source, "--calibration", "twin", "--json", str(answer), *options]
    if finforce(words) != 0:
        raise FinforceError(f"{bag.name}: --from {source}: nothing to be scored")
    return json.loads(answer.read_text(encoding="utf-8"))["all"]


def measure(name: str, seed: int, folder: Path, options: Sequence[str]) -> dict[str, Any]:
    """Return the figures of one case and seed."""
    bag = record_unseen(name, seed, folder)
    found = {source: evaluate(bag, source, options if source == "images" else ()) for source in SOURCES}
    return {
        "case": name,
        "seed": seed,
        "rmse_N": {source: found[source]["all"]["rmse_N"] for source in SOURCES},
        "solved_pct": {
            source: 100.0 * (1.0 - found[source]["record_skipped"] / found[source]["record_frames"])
            for source in SOURCES
        },
        "sight": found["images"]["sight"],
        "detector_ms": found["images"]["detector_ms"],
        "delay": found["images"].get("delay"),
    }


def format_row(label: str, figures: Mapping[str, Any]) -> str:
    """Return one line of the table."""
    sight = "".join(f"{figures['sight'][key]:>11.2f}" for _, key in COLUMNS)
    images, truth = (figures["rmse_N"][source] for source in SOURCES)
    force = f"{truth:>9.3f}{images:>9.3f}{images - truth:>+9.3f}{figures['solved_pct']['images']:>9.1f}"
    delay = figures["delay"] or {}
    late = delay.get("median_ms")
    times = f"{figures['detector_ms']['p50']:>8.1f}{figures['detector_ms']['p95']:>8.1f}"
    return f"{label:<18}{sight}{force}{times}{late if late is not None else float('nan'):>9.0f}"


def print_table(rows: Sequence[Mapping[str, Any]]) -> None:
    """Print a line per case and seed."""
    names = "".join(f"{title:>11}" for title, _ in COLUMNS)
    print(f"{'':<18}{names}{'true/N':>9}{'image/N':>9}{'added':>9}{'solved%':>9}{'ms p50':>8}{'p95':>8}{'late/ms':>9}")
    for row in rows:
        print(format_row(f"{row['case']} {row['seed']}", row))
    print(
        "true, image: RMSE of the force with key points that are true and that were found; late: from 0.02 N of true "
        "force to an estimate above 0.1 N."
    )


def summarise(rows: Sequence[Mapping[str, Any]]) -> dict[str, float]:
    """Return medians and worst values over the rows."""
    added = [row["rmse_N"]["images"] - row["rmse_N"]["truth"] for row in rows]
    summary = {"added_median_N": float(np.median(added)), "added_worst_N": float(np.max(added))}
    for _, key in COLUMNS:
        values = [row["sight"][key] for row in rows if row["sight"][key] is not None]
        summary |= {f"{key}_median": float(np.median(values)), f"{key}_worst": float(np.max(values))}
    return summary


def main() -> None:
    """Measure what was asked for."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path, help="of the recordings")
    parser.add_argument("--json", metavar="OUT", help="write the figures as JSON")
    parser.add_argument("--seeds", type=int, default=1, help="recordings per case (1)")
    parser.add_argument("--scenes", nargs="+", default=list(UNSEEN), choices=list(UNSEEN), help="cases (all)")
    parser.add_argument("--model", help="folder of another network than the shipped one")
    options = parser.parse_args()
    words = ["--detector", f"model={options.model}"] if options.model else []
    rows = []
    for name in options.scenes:
        for seed in range(FIRST_SEED, FIRST_SEED + options.seeds):
            rows.append(measure(name, seed, options.folder, words))
            print_table(rows[-1:])
    yardstick = 1e3 * float(np.median([time_product() for _ in range(25)]))
    print_table(rows)
    print(f"Product of two matrices of 512 x 512: {yardstick:.2f} ms. {summarise(rows)}")
    if options.json:
        write_figures(options.json, {"rows": rows, "summary": summarise(rows), "yardstick_ms": yardstick})


if __name__ == "__main__":
    main()
