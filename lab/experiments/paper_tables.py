"""The paper's static evaluations: cylinders at three places (Table I), and what knowing the place is worth (II)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from finforce_eval.errors import RecordingError
from finforce_eval.evaluate import evaluate_all
from finforce_eval.evaluation.contact_source import ContactChoice
from finforce_eval.evaluation.scoring import ONSET_FORCE, Evaluation
from finforce_eval.evaluation.setup import EvaluationSetup
from finforce_eval.recordings.tracks import Recording
from finforce_eval.table import AXES
from lab.experiments.experiment import SHARP, Case, Experiment, RunOptions, axis_sharpness, build_setup
from lab.harness import Figures

# Ø [mm] and height of the axis [mm] of the twin's cylinders, whose finger the paper's heights do not fit
DIAMETERS = (15, 25, 35)
HEIGHTS = {"upper": 58.0, "middle": 40.0, "lower": 24.0}
BENCH_HEIGHTS = {"upper": 60.0, "middle": 40.0, "lower": 20.0}  # of the bench recordings [mm]
QUICK_CASES = ((15, "upper"), (25, "middle"), (15, "lower"))
SHORT = {"levels": 1, "settle": 0.3, "record": 0.5, "displacement": 0.004}
# RMSE [N] of the paper, Table I by place and diameter, and Table II by real and assumed place
TABLE_I = {"upper": (0.22, 0.52, 0.57), "middle": (0.24, 0.28, 0.24), "lower": (0.69, 0.62, 1.21)}
TABLE_II = {
    "upper": {"estimate": 0.20, "upper": 0.22, "middle": 1.21, "lower": 5.91},
    "middle": {"estimate": 0.26, "upper": 0.93, "middle": 0.24, "lower": 4.93},
    "lower": {"estimate": 0.61, "upper": 4.40, "middle": 3.61, "lower": 0.69},
}
ESTIMATE = "estimate"
LEAST_SOLVED = 1.0  # [%] of the images under load, below which nothing is said of a contact
OTHERS = {"closest": "closest point", "paper": "Algorithm 1"}


def list_cylinders(options: RunOptions, chosen: Sequence[tuple[int, str]]) -> list[Case]:
    """Return cylinders on the twin's bench, or the bench recordings of one's own that are some of these.

    Raises:
        RecordingError: a recording does not say what is pressed on, and where.
    """
    if options.bags:
        return _list_own(options, chosen)
    cases = []
    for number, (diameter, place) in enumerate(chosen):
        changes = {"object": f"rod{diameter}", "height": 1e-3 * HEIGHTS[place]} | (SHORT if options.quick else {})
        words = {"diameter": diameter, "place": place, "height_mm": HEIGHTS[place]}
        cases.append(options.scene_case(f"cyl{diameter}_{place}", "bench_cylinder", changes, number, words=words))
    return cases


def _list_own(options: RunOptions, chosen: Sequence[tuple[int, str]]) -> list[Case]:
    cases = []
    for case, recording in options.read_bags(needed=("left",)):
        shape = recording.case.get("object")
        diameter, z = (shape.get(key) if isinstance(shape, Mapping) else None for key in ("diameter", "z"))
        place = next((place for place, height in BENCH_HEIGHTS.items() if height == z), None)
        if place is None or diameter not in DIAMETERS:
            sizes, heights = (", ".join(f"{v:g}" for v in values) for values in (DIAMETERS, BENCH_HEIGHTS.values()))
            raise RecordingError(
                f"{case.settings['bag']}: object.diameter {diameter!r} and object.z {z!r} in its case.json; expected a "
                f"cylinder of {sizes} mm at {heights} mm"
            )
        if (diameter, place) in chosen:
            words = {"diameter": diameter, "place": place, "height_mm": z}
            cases.append(replace(case, settings={**case.settings, "words": words}))
    if not cases:
        raise RecordingError(f"none of {len(options.bags)} recordings is one of {chosen}")
    return cases


def measure_contacts(
    options: RunOptions, case: Case, folder: Path, contacts: Mapping[str, ContactChoice]
) -> dict[str, Any]:
    """Return what `score_contact` says of a cylinder under each contact, by name."""
    with options.open_case(case, folder) as recording:
        return {
            "contacts": {
                name: score_contact(recording, build_setup(case.settings, contact))
                for name, contact in contacts.items()
            }
        }


def score_contact(recording: Recording, setup: EvaluationSetup) -> dict[str, Any]:
    """Return RMSE, NRMSD, bias and solved share of a recording, or why there are none."""
    try:
        evaluation = evaluate_all([recording], setup)
    except RecordingError as error:
        return {"rmse_N": float("nan"), "solved_pct": 0.0, "reason": str(error)}
    score = evaluation.total
    return {
        "rmse_N": score.all.rmse_N,
        "nrmsd_pct": score.cycles["all"]["nrmsd_pct"]["mean"],
        "bias_N": score.all.bias_N,
        "within_3_sigma_pct": score.all.within_3_sigma_pct,
        "sharpness": axis_sharpness(evaluation),
        "solved_pct": _share_solved(evaluation),
    }


def _share_solved(evaluation: Evaluation) -> float:
    """Return the share of the scored images with a true force that was answered [%]."""
    loaded = [
        (result.scored & (result.true_magnitude > ONSET_FORCE), result.solved) for result in evaluation.results.values()
    ]
    answered = sum(int((rows & solved).sum()) for rows, solved in loaded)
    return 100.0 * answered / max(sum(int(rows.sum()) for rows, _ in loaded), 1)


def _fixed(height_mm: float) -> ContactChoice:
    return ContactChoice(mode="fixed", height_mm=height_mm)


def list_bench(options: RunOptions) -> Sequence[Case]:
    """Return the cylinders of Table I."""
    every = [(diameter, place) for diameter in DIAMETERS for place in HEIGHTS]
    return list_cylinders(options, QUICK_CASES if options.quick else every)


def run_bench(options: RunOptions, case: Case, folder: Path) -> dict[str, Any]:
    """Return the errors on a cylinder."""
    own = _fixed(case.settings["words"]["height_mm"])
    return measure_contacts(options, case, folder, {"given": own, ESTIMATE: ContactChoice(mode="estimate")})


def find_bench(options: RunOptions, figures: Mapping[str, Mapping[str, Any]], folder: Path) -> Figures:
    """Return Table I."""
    tables, notes = {}, []
    for contact, words in (("given", "the place given, as in the paper"), (ESTIMATE, "the place estimated")):
        rows = []
        for place in HEIGHTS:
            cells = [_find_cell(figures, diameter, place, contact) for diameter in DIAMETERS]
            paper = TABLE_I[place]
            rows.append((place, *(f"{_format(one)} ({own:.2f})" for one, own in zip(cells, paper, strict=True))))
        tables[f"With {words}"] = pd.DataFrame(rows, columns=("RMSE/N", *(f"Ø{diameter}" for diameter in DIAMETERS)))
        known = [row["contacts"][contact]["rmse_N"] for row in figures.values()]
        known = [value for value in known if value is not None]
        if known:
            notes.append(f"With {words}: mean {np.mean(known):.3f} N, worst {np.max(known):.3f} N.")
    return Figures(tables=tables | tabulate_deviations(figures), notes=[*notes, "The paper's in brackets."])


def list_places(options: RunOptions) -> Sequence[Case]:
    """Return the places of Table II."""
    return list_cylinders(options, [(DIAMETERS[0], place) for place in (("middle",) if options.quick else HEIGHTS)])


def run_places(options: RunOptions, case: Case, folder: Path) -> dict[str, Any]:
    """Return the errors at a place under every contact."""
    heights = BENCH_HEIGHTS if options.bags else HEIGHTS
    contacts = {mode: ContactChoice(mode=mode) for mode in (ESTIMATE, *OTHERS)}
    contacts |= {place: _fixed(height) for place, height in heights.items()}
    return measure_contacts(options, case, folder, contacts)


def find_places(options: RunOptions, figures: Mapping[str, Mapping[str, Any]], folder: Path) -> Figures:
    """Return Table II."""
    rows = []
    for place, paper in TABLE_II.items():
        cells = {contact: _find_cell(figures, DIAMETERS[0], place, contact) for contact in paper}
        if any(cells.values()):
            others = (_format(_find_cell(figures, DIAMETERS[0], place, contact)) for contact in OTHERS)
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


def _find_cell(
    figures: Mapping[str, Mapping[str, Any]], diameter: int, place: str, contact: str
) -> Mapping[str, Any] | None:
    """Return what was measured on a cylinder under a contact; None where it was not."""
    for row in figures.values():
        if (row["diameter"], row["place"]) == (diameter, place):
            return row["contacts"].get(contact)
    return None


def _format(cell: Mapping[str, Any] | None) -> str:
    if cell is None:
        return "-"
    if cell["rmse_N"] is None or not np.isfinite(cell["rmse_N"]) or cell["solved_pct"] < LEAST_SOLVED:
        return "rejected"
    return f"{cell['rmse_N']:.2f}" + ("" if cell["solved_pct"] > 99.9 else f", {cell['solved_pct']:.0f} %")


BENCH = Experiment(
    name="bench",
    title="Table I: cylinders pressed on one jaw",
    about=(
        "The paper presses cylinders of 15, 25 and 35 mm on one jaw at three locations, in three levels up and down, "
        "three times, and gives the location to its solver. Here it is either given or estimated from the object's "
        "mesh and pose. On `twin` everything is rendered and the key points are detected."
    ),
    list_cases=list_bench,
    run=run_bench,
    find=find_bench,
)
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
