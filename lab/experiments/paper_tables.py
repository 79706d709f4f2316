"""The paper's Table II: a cylinder pressed at three places, and what knowing the place is worth."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from finforce_eval.errors import RecordingError
from finforce_eval.evaluation.batch import evaluate_all
from finforce_eval.evaluation.contact_source import ContactChoice
from finforce_eval.evaluation.scoring import ONSET_FORCE
from finforce_eval.evaluation.setup import EvaluationSetup
from finforce_eval.recordings.tracks import Recording
from finforce_eval.table import AXES
from lab.experiments.experiment import SHARP, Case, Experiment, RunOptions, axis_sharpness, build_setup
from lab.harness import Figures

DIAMETER = 15  # [mm] of the cylinder
HEIGHTS = {"upper": 58.0, "middle": 40.0, "lower": 24.0}  # of its axis [mm] on the twin's finger, not the paper's
# Of the bench recordings [mm].
BENCH_DIAMETERS, BENCH_HEIGHTS = (15, 25, 35), {"upper": 60.0, "middle": 40.0, "lower": 20.0}
SHORT = {"levels": 1, "settle": 0.3, "record": 0.5, "displacement": 0.004}
# RMSE [N] of the paper by real and assumed place
TABLE_II = {
    "upper": {"estimate": 0.20, "upper": 0.22, "middle": 1.21, "lower": 5.91},
    "middle": {"estimate": 0.26, "upper": 0.93, "middle": 0.24, "lower": 4.93},
    "lower": {"estimate": 0.61, "upper": 4.40, "middle": 3.61, "lower": 0.69},
}
ESTIMATE = "estimate"
LEAST_SOLVED = 1.0  # [%] of the images under load, below which nothing is said of a contact
OTHERS = {"closest": "closest point", "paper": "Algorithm 1"}


def list_places(options: RunOptions) -> Sequence[Case]:
    """Return the cylinder at its places on the twin's bench, or those of the bench recordings of one's own.

    Raises:
        RecordingError: a recording does not say what is pressed on, and where.
    """
    places = ("middle",) if options.quick else tuple(HEIGHTS)
    if options.bags:
        return _list_own(options, places)
    cases = []
    for number, place in enumerate(places):
        changes = {"object": f"rod{DIAMETER}", "height": 1e-3 * HEIGHTS[place]} | (SHORT if options.quick else {})
        name = f"cyl{DIAMETER}_{place}"
        cases.append(options.scene_case(name, "bench_cylinder", changes, number, words={"place": place}))
    return cases


def _list_own(options: RunOptions, places: Sequence[str]) -> list[Case]:
    cases = []
    for case, recording in options.read_bags(needed=("left",)):
        shape = recording.case.get("object")
        diameter, z = (shape.get(key) if isinstance(shape, Mapping) else None for key in ("diameter", "z"))
        place = next((place for place, height in BENCH_HEIGHTS.items() if height == z), None)
        if place is None or diameter not in BENCH_DIAMETERS:
            known = (BENCH_DIAMETERS, BENCH_HEIGHTS.values())
            sizes, heights = (", ".join(f"{value:g}" for value in values) for values in known)
            raise RecordingError(
                f"{case.settings['bag']}: object.diameter {diameter!r} and object.z {z!r} in its case.json; expected a "
                f"cylinder of {sizes} mm at {heights} mm"
            )
        if diameter == DIAMETER and place in places:
            cases.append(replace(case, settings={**case.settings, "words": {"place": place}}))
    if not cases:
        raise RecordingError(f"none of {len(options.bags)} recordings is of {DIAMETER} mm at {', '.join(places)}")
    return cases


def run_places(options: RunOptions, case: Case, folder: Path) -> dict[str, Any]:
    """Return what `score_contact` says of the cylinder under every contact, by name."""
    heights = BENCH_HEIGHTS if options.bags else HEIGHTS
    contacts = {mode: ContactChoice(mode=mode) for mode in (ESTIMATE, *OTHERS)}
    contacts |= {place: ContactChoice(mode="fixed", height_mm=height) for place, height in heights.items()}
    with options.open_case(case, folder) as recording:
        setups = {name: build_setup(case.settings, contact) for name, contact in contacts.items()}
        return {"contacts": {name: score_contact(recording, setup) for name, setup in setups.items()}}


def score_contact(recording: Recording, setup: EvaluationSetup) -> dict[str, Any]:
    """Return RMSE, NRMSD, bias and solved share of a recording, or why there are none."""
    try:
        evaluation = evaluate_all([recording], setup)
    except RecordingError as error:
        return {"rmse_N": float("nan"), "solved_pct": 0.0, "reason": str(error)}
    score = evaluation.total
    # of the scored images with a true force
    loaded = [
        (result.scored & (result.true_magnitude > ONSET_FORCE), result.solved) for result in evaluation.results.values()
    ]
    answered = sum(int((rows & solved).sum()) for rows, solved in loaded)
    return {
        "rmse_N": score.all.rmse_N,
        "nrmsd_pct": score.cycles["all"]["nrmsd_pct"]["mean"],
        "bias_N": score.all.bias_N,
        "within_3_sigma_pct": score.all.within_3_sigma_pct,
        "sharpness": axis_sharpness(evaluation),
        "solved_pct": 100.0 * answered / max(sum(int(rows.sum()) for rows, _ in loaded), 1),
    }


def find_places(options: RunOptions, figures: Mapping[str, Mapping[str, Any]], folder: Path) -> Figures:
    """Return Table II."""
    rows = []
    for place, paper in TABLE_II.items():
        cells = {contact: _find_cell(figures, place, contact) for contact in paper}
        if any(cells.values()):
            others = (_format(_find_cell(figures, place, contact)) for contact in OTHERS)
            ours = (f"{_format(cells[contact])} ({own:.2f})" for contact, own in paper.items())
            rows.append((place, *ours, *others))
    head = ("really at", "estimated", *(f"fixed {place}" for place in HEIGHTS), *OTHERS.values())
    note = "RMSE [N] over the record phases, the paper's in brackets; %: share of the images that was answered."
    return Figures(tables={"Ø15": pd.DataFrame(rows, columns=head)} | tabulate_deviations(figures), notes=[note])


def tabulate_deviations(figures: Mapping[str, Mapping[str, Any]]) -> dict[str, pd.DataFrame]:
    """Return how many errors of each case and contact are within three stated deviations, and how sharp these are."""
    rows = [
        {
            "case": name,
            "contact": contact,
            **{f"{axis} within 3σ/%": share for axis, share in zip(AXES, cell["within_3_sigma_pct"], strict=True)},
            **{heading: cell["sharpness"][column[-1]] for column, heading in SHARP.items()},
        }
        for name, row in figures.items()
        for contact, cell in row["contacts"].items()
        if cell.get("within_3_sigma_pct")
    ]
    return {"Stated deviations": pd.DataFrame(rows).astype(float, errors="ignore")} if rows else {}


def _find_cell(figures: Mapping[str, Mapping[str, Any]], place: str, contact: str) -> Mapping[str, Any] | None:
    """Return what was measured at a place under a contact; None where it was not."""
    for row in figures.values():
        if row["place"] == place:
            return row["contacts"].get(contact)
    return None


def _format(cell: Mapping[str, Any] | None) -> str:
    if cell is None:
        return "-"
    if cell["rmse_N"] is None or not np.isfinite(cell["rmse_N"]) or cell["solved_pct"] < LEAST_SOLVED:
        return "rejected"
    return f"{cell['rmse_N']:.2f}" + ("" if cell["solved_pct"] > 99.9 else f", {cell['solved_pct']:.0f} %")


PLACES = Experiment(
    name="places",
    title="Table II: value of knowing the contact location",
    about=(
        "The paper presses a cylinder of 15 mm at three locations and solves each with all three fixed locations and "
        "with its contact estimator. A location that the key points do not fit is rejected here instead of answered; "
        "such a cell shows what was answered."
    ),
    list_cases=list_places,
    run=run_places,
    find=find_places,
)
