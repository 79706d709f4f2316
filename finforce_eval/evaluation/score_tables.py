"""Scores as tables, for a terminal, a page and JSON."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from finforce.messages import SECOND
from finforce_eval.evaluation.comparison import error_blocks
from finforce_eval.evaluation.scoring import PHASES, CaseScore, Evaluation, Stats
from finforce_eval.table import AXES, ForceSeries
from finforce_ifea.identification import find_drift

_CONTACT = (
    "Contact: distance from the true pressure centre along the undeformed surface above 0.2 N, of the contact given to "
    "the solver (given) and found by it (solved); onset: frames from 0.02 N of true force until `touching` lasts, one "
    "per loading cycle, negative is early; false: share of frames without true force reported as touching; ms: time "
    "of a step of the contact estimator."
)
_VECTOR = (
    "Force as a vector, in the record phases (record; below, by direction and cycle of all cases) and in all other "
    "images with a true force (moving): RMSE of the "
    "vector and along x, y, z of the jaw; images within three stated standard deviations; sharpness: RMS of the stated "
    "standard deviation over RMS of the error, 1 to 2 is good, below 1 too small, above 4 of no use; off: images with "
    "an error above 0.3 N along an axis."
)
_MAGNITUDE = ("rmse_N", "nrmsd_pct", "max_error_N", "bias_N")  # not scored of a net force
_DISTANCES = ("median_mm", "p95_mm", "max_mm")
_SIGHT = (
    "Key points: pixel error of visible points and error of accepted points in the jaw frame; hidden+: occluded points "
    "accepted; visible-: visible points lost; detector: time from image to key points of all jaws. Force: time from "
    "0.02 N of true force to an estimate above 0.1 N, with computation; rise: rise time of the true force."
)

UNITS_PER_NEWTON = {"gram-force": 101.97, "kilogram-force": 0.10197, "pound-force": 0.22481, "millinewtons": 1000.0}
UNIT_TOLERANCE = 0.15  # [-], of the ratio of true and estimated forces, by which a unit is told
ANOTHER_UNIT = 5.0  # factor that no finger's modulus explains
LAGS = np.arange(-20, 21) / 20.0  # [s], tried between true and estimated forces
ONE_CLOCK, CLEARLY = 0.1, 0.5  # [s] that is let pass; share of what does not fit, below which a lag is clear
IDLE_FORCE, LOADED_FORCE = 0.05, 0.5  # [N], estimates below which nothing presses, and above which much does
FEWEST = 15  # images by which true forces are doubted
BIAS = 0.3  # [N], of a sensor at rest, above which it is doubted


def build_table(head: Sequence[tuple[str, str]], rows: Sequence[Sequence[str]]) -> pd.DataFrame:
    """Return a table of texts with a row per case and one for all: group and name of each column, and the cells."""
    table = pd.DataFrame(rows, columns=pd.MultiIndex.from_tuples([("", "case"), *head]))
    return table.set_index(("", "case")).rename_axis(index=None)


def _score_rows(evaluation: Evaluation) -> list[tuple[str, CaseScore]]:
    """Return the scores by the name of the row."""
    return [*evaluation.scores.items(), ("all", evaluation.total)]


def _number(value: float | None, digits: int = 2) -> str:
    """Return a number, or a dash for none."""
    return "-" if value is None else f"{value:.{digits}f}"


def _numbers(values: Sequence[float | None], digits: int = 2) -> list[str]:
    return [_number(value, digits) for value in values]


def score_table(evaluation: Evaluation) -> pd.DataFrame:
    """Return RMSE, NRMSD (mean ± standard deviation over the cycles) and maximum error of each phase, and bias."""
    head = [(phase, name) for phase in PHASES for name in ("RMSE/N", "NRMSD/%", "max/N")]
    rows = []
    for name, score in _score_rows(evaluation):
        cells = [name]
        for phase in PHASES:
            cells += [_spread(score.cycles[phase][number]) for number in ("rmse_N", "nrmsd_pct")]
            cells.append(_number(getattr(score, phase).max_error_N))
        solved = 100.0 * (1.0 - score.record_skipped / max(score.record_frames, 1))
        rows.append([*cells, _number(score.all.bias_N), f"{solved:.1f}"])
    return build_table([*head, ("", "bias/N"), ("", "solved/%")], rows)


def _spread(spread: dict[str, float | None]) -> str:
    """Return mean and standard deviation over the cycles."""
    mean = _number(spread["mean"])
    return mean if spread["std"] is None else f"{mean}±{spread['std']:.2f}"


def vector_table(evaluation: Evaluation) -> pd.DataFrame:
    """Return how good force and stated deviations are axis by axis; no row where the truth is a magnitude."""
    groups = ("RMSE/N", "within 3 sigma/%", "sharpness")
    head = [("", "images"), ("", "n"), ("", "RMSE/N"), *((group, axis) for group in groups for axis in AXES)]
    rows = []
    for name, score in _score_rows(evaluation):
        stages = score.stages.items() if name == "all" else ()
        for images, stats in (("record", score.all), *stages, ("moving", score.moving)):
            if stats.axis_rmse_N is None:
                continue
            within, sharp = stats.within_3_sigma_pct or [None] * 3, stats.sharpness or [None] * 3
            cells = [*_numbers([stats.vector_rmse_N, *stats.axis_rmse_N]), *_numbers(within, 1), *_numbers(sharp, 1)]
            rows.append([name, images, str(stats.n), *cells, str(stats.n_off)])
    return build_table([*head, ("", "off")], rows)


def contact_table(evaluation: Evaluation) -> pd.DataFrame:
    """Return where the contact came from, location, onset and time; no row where nobody says."""
    head = [
        ("", "contact"),
        *((f"{group}/mm", name) for group in ("given", "solved") for name in ("median", "p95", "max")),
    ]
    head += [("onset/frames", name) for name in ("median", "first", "last", "missed", "false/%")]
    head += [("ms", "p50"), ("ms", "p99")]
    rows = []
    for name, score in _score_rows(evaluation):
        distances = [part[number] for part in (score.place, score.solved_place) for number in _DISTANCES]
        onset = score.onset
        frames = _numbers([onset[f"{which}_frames"] for which in ("median", "earliest", "max")], 0)
        missed = str(onset["missed"]) if onset["n"] + onset["missed"] else "-"
        times = _numbers([score.contact_ms["p50"], score.contact_ms["p99"]])
        source = _contact_source(evaluation.results.get(name))
        rows.append([name, source, *_numbers(distances), *frames, missed, _number(onset["false_pct"], 1), *times])
    known = any(map(_contact_source, evaluation.results.values()))
    return build_table(head, rows if known else [])


def sight_table(evaluation: Evaluation) -> pd.DataFrame:
    """Return how well key points were seen, and how late the force shows; no row where no detector ran."""
    head = [("pixels/px", "median"), ("pixels/px", "p95"), ("points/mm", "median"), ("points/mm", "p95")]
    head += [("share/%", "hidden+"), ("share/%", "visible-"), ("detector/ms", "p50"), ("detector/ms", "p95")]
    head += [("force shows after/ms", name) for name in ("median", "max", "missed", "rise")]
    rows = []
    for name, score in _score_rows(evaluation):
        sight, delay = score.sight, score.delay
        exact = [sight[number] for number in ("pixel_median_px", "pixel_p95_px", "point_median_mm", "point_p95_mm")]
        shares = [sight["hidden_accepted_pct"], sight["visible_lost_pct"]]
        shares += [score.detector_ms["p50"], score.detector_ms["p95"]]
        missed = str(delay["missed"]) if delay["n"] + delay["missed"] else "-"
        shown = [*_numbers([delay["median_ms"], delay["max_ms"]], 0), missed, _number(delay["rise_ms"], 0)]
        rows.append([name, *_numbers(exact), *_numbers(shares, 1), *shown])
    known = any(result.has("detector_ms") for result in evaluation.results.values())
    return build_table(head, rows if known else [])


def format_tables(evaluation: Evaluation) -> str:
    """Return all tables for a terminal, with a line of summary below the first."""
    lines = [score_table(evaluation).to_string(), "", *summary_lines(evaluation)]
    for make, meaning in ((vector_table, _VECTOR), (contact_table, _CONTACT), (sight_table, _SIGHT)):
        table = make(evaluation)
        if len(table):
            lines += ["", table.to_string(), meaning]
    if evaluation.manipulation:
        lines += ["", *format_manipulation(evaluation.manipulation)]
    return "\n".join(lines)


def summary_lines(evaluation: Evaluation) -> list[str]:
    """Return what the table's numbers mean, and the times."""
    total = evaluation.total
    times = ", ".join(f"{name} {_number(value)}" for name, value in total.step_ms.items())
    return [
        f"{mean_rmse(evaluation)} RMSE and NRMSD: mean ± standard deviation over the cycles, "
        f"{total.cycles['all']['n']} in all; NRMSD: over the force range {evaluation.span:.2f} N.",
        f"{total.frames} frames, {total.solved} solved, {total.skipped} skipped; in the record phases "
        f"{total.record_frames - total.record_skipped} of {total.record_frames} solved. Step: {times} ms.",
        *(said for result in evaluation.results.values() if (said := doubt_truth(result))),
    ]


def doubt_truth(case: ForceSeries) -> str:
    """Return what the true forces of a case look like, where that is not newtons of a tared sensor; else ""."""
    known = case.solved & np.isfinite(case.true_magnitude)
    found, true = case.magnitude[known], case.true_magnitude[known]
    idle, loaded = found < IDLE_FORCE, found > LOADED_FORCE
    at_rest = float(np.median(true[idle])) if idle.sum() >= FEWEST else 0.0
    if loaded.sum() >= FEWEST:
        factor = float(np.median((true[loaded] - at_rest) / found[loaded]))
        unit = min(UNITS_PER_NEWTON, key=lambda name: abs(np.log(max(factor, 1e-9) / UNITS_PER_NEWTON[name])))
        if abs(factor / UNITS_PER_NEWTON[unit] - 1.0) < UNIT_TOLERANCE:
            return f"{case.name}: the true forces are {factor:.3g} times the estimated ones: {unit}? expected newtons"
        if not 1.0 / ANOTHER_UNIT < factor < ANOTHER_UNIT:
            return f"{case.name}: the true forces are {factor:.3g} times the estimated ones: counts? expected newtons"
        if lag := find_lag(SECOND * case.stamps_ns[known], found, true):
            when = f"{abs(lag):.2f} s {'later' if lag > 0.0 else 'earlier'} than"
            return f"{case.name}: the true forces come {when} the estimated ones: expected stamps of one clock"
    if drift := find_drift(true[idle]):
        change = f"changes by {drift:+.2f} N where no force is estimated"
        return f"{case.name}: the true force {change}: does the sensor drift?"
    if at_rest > BIAS:
        return f"{case.name}: the true force is {at_rest:.2f} N where no force is estimated: is the sensor tared?"
    return ""


def find_lag(stamps: NDArray, found: NDArray, true: NDArray) -> float:
    """Return by how long true forces come after the estimated ones (n,), at some stamps [s], where that is clear.

    Returns:
        [s]; 0 where the forces do not resemble each other much more with a lag, whatever their scale.
    """
    with np.errstate(invalid="ignore", divide="ignore"):
        shifted = [np.interp(stamps + lag, stamps, true) for lag in LAGS]
        unlike = [1.0 - np.corrcoef(found, later)[0, 1] ** 2 for later in shifted]
    best, now = int(np.argmin(unlike)), unlike[len(LAGS) // 2]
    return float(LAGS[best]) if abs(LAGS[best]) > ONE_CLOCK and unlike[best] < CLEARLY * now else 0.0


def mean_rmse(evaluation: Evaluation) -> str:
    """Return the figure that stands for an evaluation, as a sentence: mean RMSE of the cases, and the worst."""
    rmse = {name: score.all.rmse_N for name, score in evaluation.scores.items()}
    worst = max(rmse, key=lambda name: rmse[name] or 0.0)
    return (
        f"Mean RMSE of {len(rmse)} case{'s' if rmse.keys() - {worst} else ''}: "
        f"{_number(evaluation.total.mean_rmse_N, 3)} N, worst {_number(rmse[worst], 3)} N ({worst})."
    )


def format_manipulation(scores: dict[str, Stats]) -> list[str]:
    """Return a line per recording with two jaws; none without any."""
    lines = []
    for name, score in scores.items():
        if score.vector_rmse_N is None:
            lines.append(f"{name}: no net force: never were both jaws answered")
            continue
        turn = "" if score.torque_rmse_Nm is None else f", torque by {1e3 * score.torque_rmse_Nm:.1f} N mm"
        lines.append(
            f"{name}: net force on the gripper off by {score.vector_rmse_N:.3f} N (x, y, z: "
            f"{' '.join(_numbers(score.axis_rmse_N))}){turn}, {score.answered_pct:.1f} % answered"
        )
    return lines


def evaluation_json(evaluation: Evaluation, **about: Any) -> dict[str, Any]:
    """Return the object that `evaluate --json` writes.

    Args:
        evaluation: the scores.
        about: further entries at the top: jaw, solver, contact, ...
    """
    cases = {}
    for name, score in evaluation.scores.items():
        result = evaluation.results[name]
        source = _contact_source(result)
        cases[name] = asdict(score) | ({"contact": source} if source else {}) | {"seconds": error_blocks(result)}
    net = {
        name: {number: value for number, value in asdict(score).items() if number not in _MAGNITUDE}
        for name, score in evaluation.manipulation.items()
    }
    top = {"manipulation": net} if net else {}
    return {"cases": cases, "all": asdict(evaluation.total), **top, "force_range_N": evaluation.span, **about}


def _contact_source(result: ForceSeries | None) -> str:
    """Return what gave the contact of a case, "" where nobody says."""
    is_known = result is not None and result.has("contact_source") and len(result)
    return str(result.column("contact_source")[0]) if is_known else ""
