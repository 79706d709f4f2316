"""Verifies the true contact places of an evaluation against shapes of an independent program.

    python -m lab.benchmarks.verify_places RECORDINGS TRUTH [--json report/places.json]

RECORDINGS holds the bench recordings, TRUTH the shapes NAME.npz behind them (mm, N, jaw frame). Both places are heights
on the undeformed surface; the evaluation's needs the solver's deformed surface, the other the true one.
"""

import argparse
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from finforce_eval.evaluation.evaluate import evaluate_recording
from finforce_eval.evaluation.places import InnerSurface
from finforce_eval.evaluation.setup import EvaluationSetup, make_setup
from finforce_eval.machine import write_figures
from finforce_eval.recordings.recording import read_recording
from finforce_eval.recordings.tracks import Recording
from finforce_ifea.jaw.face import FaceLine


def true_places(path: Path, recording: Recording, face_x: float) -> dict[float, tuple[float, float]]:
    """Return by depth [mm] the true place and how far from the cylinder's surface the true surface is met [mm]."""
    data, case = np.load(path), recording.case["object"]
    surface = InnerSurface(1e-3 * data["vertices0"], FaceLine.flat(face_x))
    places = {}
    for depth, force, vertices in zip(data["depth"], data["force"], 1e-3 * data["vertices"], strict=True):
        axis = np.array([face_x + 0.5e-3 * case["diameter"] - 1e-3 * depth, 1e-3 * case["z"]])
        direction = force[[0, 2]] / np.linalg.norm(force[[0, 2]])
        height = surface.cut(vertices, axis, direction)
        met = [np.interp(height, surface.heights, line) for line in surface.middle_line(vertices).T]
        gap = np.linalg.norm(met - axis) - 0.5e-3 * case["diameter"]
        places[float(depth)] = (1e3 * height, 1e3 * float(gap))
    return places


def evaluated_places(recording: Recording, setup: EvaluationSetup) -> dict[float, float]:
    """Return by displacement [mm] the place that the evaluation takes for true, median of the first loading [mm]."""
    stop = int(recording.phases.stamps[np.argmax(recording.phases.cycle == 1)])
    first = recording.between(0, stop)
    result = evaluate_recording(first, setup.jaw, setup.source(first), factory=setup.estimator)
    depth = first.phases.displacement_at(result.stamps)
    held: NDArray[np.bool_] = result.scored & (result.direction == "load") & np.isfinite(result.contact.truth)
    return {float(d): 1e3 * float(np.median(result.contact.truth[held & (depth == d)])) for d in np.unique(depth[held])}


def main() -> None:
    """Compare, print the differences, write the JSON."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("recordings", type=Path)
    parser.add_argument("truth", type=Path)
    parser.add_argument("--json", metavar="OUT", help="write the differences as JSON")
    options = parser.parse_args()
    setup = make_setup(
        argparse.Namespace(
            jaw="bench", solver="default", mesh="default", contact=["fixed:case"], calibration="bench", set=[]
        )
    )
    differences: dict[str, dict[float, float]] = {}
    gaps: list[float] = []
    for folder in tqdm(sorted(path.parent for path in options.recordings.glob("*/metadata.yaml")), disable=None):
        recording = read_recording(folder)
        truth = true_places(options.truth / f"{recording.name}.npz", recording, setup.jaw.inner_face_x)
        found = evaluated_places(recording, setup)
        differences[recording.name] = {depth: found[depth] - truth[depth][0] for depth in found if depth in truth}
        gaps += [abs(gap) for _, gap in truth.values()]
        print(recording.name, {depth: round(value, 3) for depth, value in differences[recording.name].items()})
    sizes = np.abs([value for case in differences.values() for value in case.values()])
    print(
        f"{len(sizes)} held loads: difference median {np.median(sizes):.3f}, p95 {np.percentile(sizes, 95):.3f}, "
        f"max {sizes.max():.3f} mm; the line meets the true surface within {max(gaps):.3f} mm of the cylinder."
    )
    if options.json:
        write_figures(options.json, {**setup.about, "difference_mm": differences, "gap_max_mm": max(gaps)})


if __name__ == "__main__":
    main()
