"""What the contact is worth: the paper's Table II on the Ø15 recordings, and the price of estimating it on all of them.

    python benchmarks/contact_ablation.py RECORDINGS [--calibration bench] [--solver paper] [--json report/contact.json]

RECORDINGS is the folder that holds the bench recordings. A wrong fixed place is refused by the solver rather than
answered where the key points do not fit it; such a cell shows what was solved of the record phases.
"""

import argparse
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from tqdm import tqdm

from finforce_eval.cli.parser import add_jaw_options
from finforce_eval.errors import RecordingError
from finforce_eval.evaluation.contact_source import parse_contacts
from finforce_eval.evaluation.evaluate import evaluate_recording, score_results
from finforce_eval.evaluation.machine import write_figures
from finforce_eval.evaluation.results import CaseResult
from finforce_eval.evaluation.scoring import CaseScore
from finforce_eval.evaluation.setup import EvaluationSetup, make_setup
from finforce_eval.recordings.recording import read_recording
from finforce_eval.recordings.tracks import Recording

PLACES = {"upper": 60, "middle": 40, "lower": 20}
COLUMNS = {
    "estimator": "estimate",
    **{f"fixed {name}": f"fixed:{height}" for name, height in PLACES.items()},
    "closest": "closest",
    "paper": "paper",
}
FIXED = "fixed:case"
DIAMETER = 15


@dataclass(frozen=True, kw_only=True)
class Cell:
    """One recording under one contact: its score, or why there is none."""

    case: str
    contact: str
    score: CaseScore | None
    reason: str = ""

    @property
    def rmse(self) -> float | None:
        """RMSE over the record phases [N]."""
        return None if self.score is None else self.score.all.rmse_N

    @property
    def solved(self) -> float:
        """Share of the record phases that was solved [%]."""
        if self.score is None:
            return 0.0
        return 100.0 * (1.0 - self.score.record_skipped / max(self.score.record_frames, 1))


def measure(recording: Recording, contact: str, setup: EvaluationSetup, progress: Callable[[int], Any]) -> Cell:
    """Return the score of one recording under one contact."""
    setup = replace(setup, contacts=parse_contacts([contact]))
    try:
        source = setup.source(recording)
        result: CaseResult = evaluate_recording(
            recording, setup.jaw, source, factory=setup.estimator, progress=progress
        )
    except RecordingError as error:
        return Cell(case=recording.name, contact=contact, score=None, reason=str(error))
    score = score_results([result], [recording]).total
    return Cell(case=recording.name, contact=contact, score=score)


def measure_all(recordings: Sequence[Recording], setup: EvaluationSetup) -> dict[tuple[str, str], Cell]:
    """Return every cell of both tables by recording and contact, under one progress bar."""
    pairs = [(recording, contact) for recording in recordings for contact in ("estimate", FIXED)]
    for recording in recordings:
        if _place(recording):
            pairs += [(recording, contact) for contact in COLUMNS.values() if contact != "estimate"]
    cells = {}
    frames = sum(len(recording.jaw("left").keypoints.stamps) for recording, _ in pairs)
    with tqdm(total=frames, unit="frame", disable=None) as bar:
        for recording, contact in pairs:
            bar.set_description(f"{recording.name}, {contact}")
            begin = bar.n
            cells[recording.name, contact] = measure(recording, contact, setup, bar.update)
            # a recording that was refused half way is done as well
            bar.update(len(recording.jaw("left").keypoints.stamps) - (bar.n - begin))
    return cells


def _place(recording: Recording) -> str:
    """Return where the Ø15 cylinder presses, empty for other recordings."""
    shape = recording.case.get("object", {})
    names = {height: name for name, height in PLACES.items()}
    return names.get(shape.get("z"), "") if shape.get("diameter") == DIAMETER else ""


def format_ablation(recordings: Sequence[Recording], cells: Mapping[tuple[str, str], Cell]) -> str:
    """Return Table II: real place downwards, contact to the right, RMSE [N] and solved share where below 100 %."""
    lines = [
        f"RMSE [N] on Ø{DIAMETER}",
        "| real place | " + " | ".join(COLUMNS) + " |",
        "|---" * (1 + len(COLUMNS)) + "|",
    ]
    placed = {_place(recording): recording for recording in recordings}
    for place in PLACES:
        if place in placed:
            row = [_format_cell(cells[placed[place].name, contact]) for contact in COLUMNS.values()]
            lines.append(f"| {place} | " + " | ".join(row) + " |")
    return "\n".join(lines)


def _format_cell(cell: Cell) -> str:
    if cell.rmse is None:
        return "refused"
    spread = cell.score.cycles["all"].rmse_N.std
    text = f"{cell.rmse:.2f}" if spread is None else f"{cell.rmse:.2f} ± {spread:.2f}"
    return text if cell.solved > 99.9 else f"{text} ({cell.solved:.0f} % solved)"


def format_price(recordings: Sequence[Recording], cells: Mapping[tuple[str, str], Cell]) -> str:
    """Return what estimating the contact adds to the RMSE of each recording, and how well the place was known."""
    lines = [
        "| recording | fixed:case: RMSE/N | estimate: RMSE/N | added/N | place median/mm | p95/mm | onset median "
        "| latest | contact p50/ms | p99/ms |",
        "|---" + "|---:" * 9 + "|",
    ]
    for recording in recordings:
        fixed, found = cells[recording.name, FIXED], cells[recording.name, "estimate"]
        if fixed.rmse is None or found.rmse is None:
            lines.append(f"| {recording.name} | {_format_cell(fixed)} | {_format_cell(found)} |" + " - |" * 7)
            continue
        place, onset, step = found.score.place, found.score.onset, found.score.contact_ms
        numbers = (place.median_mm, place.p95_mm, onset.median_frames, onset.max_frames, step.p50, step.p99)
        errors = f"{fixed.rmse:.3f} | {found.rmse:.3f} | {found.rmse - fixed.rmse:+.3f}"
        others = " | ".join("-" if value is None else f"{value:.2f}" for value in numbers)
        lines.append(f"| {recording.name} | {errors} | {others} |")
    return "\n".join([*lines, "", *_summary(cells)])


def _summary(cells: Mapping[tuple[str, str], Cell]) -> list[str]:
    """Return mean and worst RMSE of both contacts."""
    lines = []
    for contact in (FIXED, "estimate"):
        known = {cell.case: cell.rmse for cell in cells.values() if cell.contact == contact and cell.rmse is not None}
        if known:
            worst = max(known, key=known.__getitem__)
            mean = sum(known.values()) / len(known)
            lines.append(f"{contact}: mean RMSE {mean:.3f} N of {len(known)}, worst {known[worst]:.3f} N ({worst}).")
    return lines


def main() -> None:
    """Evaluate, print both tables, write the JSON."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("recordings", type=Path, help="folder that holds the bench recordings")
    add_jaw_options(parser)
    parser.add_argument("--calibration", default="bench", metavar="FILE", help="calibration (bench)")
    parser.add_argument("--json", metavar="OUT", help="write the scores as JSON")
    options = parser.parse_args()
    setup = make_setup(options)
    folders = sorted(path.parent for path in options.recordings.glob("*/metadata.yaml"))
    recordings = [read_recording(folder) for folder in folders]
    cells = measure_all(recordings, setup)
    print(format_ablation(recordings, cells), format_price(recordings, cells), sep="\n\n")
    if options.json:
        content = [asdict(cell) | {"solved_pct": cell.solved} for cell in cells.values()]
        write_figures(options.json, {**setup.about, "cells": content})


if __name__ == "__main__":
    main()
