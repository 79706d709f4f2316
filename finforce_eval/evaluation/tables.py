"""Scores as tables, for a terminal and in Markdown."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

from finforce_eval.evaluation.comparison import error_blocks
from finforce_eval.evaluation.evaluate import Evaluation
from finforce_eval.evaluation.manipulation import format_manipulation
from finforce_eval.evaluation.scoring import CaseScore, Spread, Stats
from finforce_eval.table import ForceSeries

PHASES = ("all", "load", "unload")
HEADER = ("RMSE/N", "NRMSD/%", "max/N")


def format_number(value: float | None, digits: int = 2) -> str:
    """Return a number, or a dash for none."""
    return "-" if value is None else f"{value:.{digits}f}"


def _format_spread(spread: Spread) -> str:
    """Return mean and standard deviation over the cycles."""
    mean = format_number(spread.mean)
    return mean if spread.std is None else f"{mean}±{spread.std:.2f}"


def score_cells(score: CaseScore, phase: str) -> list[str]:
    """Return RMSE, NRMSD (mean ± standard deviation over the cycles) and maximum error of a phase."""
    cycles = score.cycles[phase]
    stats: Stats = getattr(score, phase)
    return [
        _format_spread(cycles.rmse_N),
        _format_spread(cycles.nrmsd_pct),
        format_number(stats.max_error_N),
    ]


def table_head() -> list[str]:
    """Return the names of the columns of `table_rows`."""
    return ["case", *(f"{phase}: {name}" for phase in PHASES for name in HEADER), "bias/N", "solved/%"]


def table_rows(evaluation: Evaluation) -> list[list[str]]:
    """Return one row per case and one for all: name, three numbers for each phase, bias, solved frames."""
    rows = []
    for name, score in [*evaluation.scores.items(), ("all", evaluation.total)]:
        solved = 100.0 * (1.0 - score.record_skipped / max(score.record_frames, 1))
        cells = [cell for phase in PHASES for cell in score_cells(score, phase)]
        rows.append([name, *cells, f"{format_number(score.all.bias_N)}", f"{solved:.1f}"])
    return rows


def format_table(evaluation: Evaluation) -> str:
    """Return the table for a terminal, with a line of summary below."""
    head = ["case", *HEADER * len(PHASES), "bias/N", "solved/%"]
    rows = table_rows(evaluation)
    widths = [max(len(row[i]) for row in [head, *rows]) for i in range(len(head))]
    groups = [sum(widths[1 + 3 * k : 4 + 3 * k]) + 4 for k in range(len(PHASES))]
    titles = (f" {phase} ".center(width, "-") for phase, width in zip(PHASES, groups, strict=True))
    lines = [" " * widths[0] + "  " + "  ".join(titles), _join(head, widths)]
    rule = "-" * len(lines[1])
    lines += [rule, *(_join(row, widths) for row in rows[:-1]), rule, _join(rows[-1], widths)]
    contact = format_contact_table(evaluation)
    below = ["", contact, *contact_lines()] if contact else []
    net = format_manipulation(evaluation.manipulation)
    below += ["", *net] if net else []
    below += format_sight(evaluation)
    return "\n".join([*lines, "", *summary_lines(evaluation), *below])


def _join(cells: Sequence[str], widths: Sequence[int]) -> str:
    """Set the first cell to the left and the others to the right."""
    rest = (cell.rjust(width) for cell, width in zip(cells[1:], widths[1:], strict=True))
    return "  ".join([cells[0].ljust(widths[0]), *rest])


CONTACT_HEADER = (
    "contact", "given: median/mm", "p95/mm", "max/mm", "solved: median/mm", "p95/mm", "max/mm",
    "onset: median", "earliest", "latest", "missed", "false touches/%", "p50/ms", "p99/ms",
)  # fmt: skip


def contact_rows(evaluation: Evaluation) -> list[list[str]]:
    """Return one row per case and one for all: where the contact came from, place, onset and time; none without any."""
    rows = []
    for name, score in [*evaluation.scores.items(), ("all", evaluation.total)]:
        result = evaluation.results.get(name)
        source = "" if result is None else _contact_source(result)
        places = [
            format_number(value)
            for place in (score.place, score.solved_place)
            for value in (place.median_mm, place.p95_mm, place.max_mm)
        ]
        onset = score.onset
        frames = [format_number(v, 0) for v in (onset.median_frames, onset.earliest_frames, onset.max_frames)]
        missed = str(onset.missed) if onset.n + onset.missed else "-"
        false = format_number(onset.false_pct, 1)
        times = [format_number(score.contact_ms.p50), format_number(score.contact_ms.p99)]
        rows.append([name, source, *places, *frames, missed, false, *times])
    return rows if any(map(_contact_source, evaluation.results.values())) else []


def format_contact_table(evaluation: Evaluation) -> str:
    """Return the contact's rows for a terminal, empty without any."""
    rows = contact_rows(evaluation)
    if not rows:
        return ""
    head = ["", "contact", "median", "p95", "max", "median", "p95", "max", "median", "first", "last", "missed",
            "false/%", "p50", "p99"]  # fmt: skip
    widths = [max(len(row[i]) for row in [head, *rows]) for i in range(len(head))]
    groups = (("", 0, 2), ("given/mm", 2, 5), ("solved/mm", 5, 8), ("onset/frames", 8, 13), ("ms", 13, 15))
    titles = [f" {t} ".center(sum(widths[a:b]) + 2 * (b - a - 1), "-" if t else " ") for t, a, b in groups]
    lines = ["  ".join(titles), _join(head, widths)]
    return "\n".join([*lines, "-" * len(lines[1]), *(_join(row, widths) for row in rows)])


def contact_lines() -> list[str]:
    """Return what the numbers of the contact mean."""
    return [
        "Contact: distance along the undeformed surface between the true pressure centre and the contact that the "
        "solver was given (given) and that it found (solved), above 0.2 N; onset: frames from 0.02 N of true force to "
        "the `touching` that stays, one per loading cycle, negative is early; false: share of the frames without true "
        "force that were said to touch; ms: a step of the contact estimator alone."
    ]


def summary_lines(evaluation: Evaluation) -> list[str]:
    """Return what the table's numbers mean, and the times."""
    total = evaluation.total
    step = total.step_ms
    rmse = {name: score.all.rmse_N for name, score in evaluation.scores.items()}
    worst = max(rmse, key=lambda name: rmse[name] or 0.0)
    return [
        f"Mean RMSE of {len(rmse)} case{'s' if rmse.keys() - {worst} else ''}: "
        f"{format_number(total.mean_rmse_N, 3)} N, worst {format_number(rmse[worst], 3)} N ({worst}). "
        f"RMSE and NRMSD: mean ± standard deviation over the cycles, {total.cycles['all'].n} in all; "
        f"NRMSD: over the force range {evaluation.span:.2f} N.",
        f"{total.frames} frames, {total.solved} solved, {total.skipped} skipped; in the record phases "
        f"{total.record_frames - total.record_skipped} of {total.record_frames} solved. "
        f"Step: p50 {format_number(step.p50)}, p95 {format_number(step.p95)}, "
        f"p99 {format_number(step.p99)}, max {format_number(step.max)} ms.",
        *vector_lines(total.all),
    ]


def vector_lines(stats: Stats) -> list[str]:
    """Return what is known of the force as a vector; nothing where the truth is a magnitude."""
    if stats.axis_rmse_N is None:
        return []
    line = f"As a vector: RMSE {format_number(stats.vector_rmse_N)} N, x/y/z {_per_axis(stats.axis_rmse_N, 2)} N"
    if stats.within_3_sigma_pct is not None:
        line += f", within three stated deviations x/y/z {_per_axis(stats.within_3_sigma_pct, 1)} %"
    return [f"{line}."]


def _per_axis(values: Sequence[float], digits: int) -> str:
    return "/".join(format_number(value, digits) for value in values)


def markdown_table(evaluation: Evaluation) -> str:
    """Return the table in Markdown."""
    return "\n".join(markdown_rows(table_head(), table_rows(evaluation)))


def markdown_contact_table(evaluation: Evaluation) -> list[str]:
    """Return the contact's table in Markdown and what it means; no line without any."""
    rows = contact_rows(evaluation)
    if not rows:
        return []
    return ["", *markdown_rows(["case", *CONTACT_HEADER], rows, texts=2), "", *contact_lines()]


def evaluation_json(evaluation: Evaluation, **about: Any) -> dict[str, Any]:
    """Return the object that `evaluate --json` writes.

    Args:
        evaluation: the scores.
        about: what else stands at the top: jaw, solver, contact, ...
    """
    cases = {
        name: asdict(score) | _contact_name(evaluation, name) | {"seconds": error_blocks(evaluation.results[name])}
        for name, score in evaluation.scores.items()
    }
    net = {name: asdict(score) for name, score in evaluation.manipulation.items()}
    both = {"manipulation": net} if net else {}
    return {"cases": cases, "all": asdict(evaluation.total), **both, "force_range_N": evaluation.span, **about}


def _contact_name(evaluation: Evaluation, name: str) -> dict[str, str]:
    """Return where the contact of a case came from."""
    source = _contact_source(evaluation.results[name])
    return {"contact": source} if source else {}


def _contact_source(result: ForceSeries) -> str:
    """Return what gave the contact of a case, "" where nobody says."""
    return str(result.column("contact_source")[0]) if result.has("contact_source") and len(result) else ""


SIGHT_HEADER = (
    "pixels: median/px", "p95/px", "points: median/mm", "p95/mm", "hidden accepted/%", "visible lost/%",
    "detector: p50/ms", "p95/ms", "force shows after/ms", "largest/ms", "missed", "true rise/ms",
)  # fmt: skip
SHORT = ("median", "p95", "median", "p95", "hidden+", "visible-", "p50", "p95", "median", "max", "missed", "rise")
GROUPS = (("", 0, 1), ("pixels/px", 1, 3), ("points/mm", 3, 5), ("share/%", 5, 7), ("detector/ms", 7, 9),
          ("force shows after/ms", 9, 13))  # fmt: skip
MEANING = (
    "Key points: distance in the image, over the points that were visible, and in the jaw frame, over those that were "
    "accepted; hidden+: hidden points that were accepted; visible-: visible points that were lost; detector: from "
    "image to key points of all jaws. Force: from 0.02 N of true force to an estimate above 0.1 N, computed; "
    "rise: what the true force takes from the one to the other."
)


def sight_rows(evaluation: Evaluation) -> list[list[str]]:
    """Return one row per case and one for all; none where no detector ran."""
    if not any(result.has("detector_ms") for result in evaluation.results.values()):
        return []
    return [[name, *_cells(score)] for name, score in [*evaluation.scores.items(), ("all", evaluation.total)]]


def _cells(score: CaseScore) -> list[str]:
    sight, delay = score.sight, score.delay
    exact = (sight.pixel_median_px, sight.pixel_p95_px, sight.point_median_mm, sight.point_p95_mm)
    shares = (sight.hidden_accepted_pct, sight.visible_lost_pct, score.detector_ms.p50, score.detector_ms.p95)
    shown = [_number(value, 0) for value in (delay.median_ms, delay.max_ms)]
    missed = str(delay.missed) if delay.n + delay.missed else "-"
    numbers = [*(_number(value, 2) for value in exact), *(_number(value, 1) for value in shares)]
    return [*numbers, *shown, missed, _number(delay.rise_ms, 0)]


def _number(value: float | None, digits: int) -> str:
    return "-" if value is None else f"{value:.{digits}f}"


def format_sight(evaluation: Evaluation) -> list[str]:
    """Return the lines for a terminal; none where no detector ran."""
    rows = sight_rows(evaluation)
    if not rows:
        return []
    table = [["", *SHORT], *rows]
    widths = [max(len(row[i]) for row in table) for i in range(len(table[0]))]
    titles = [f" {t} ".center(sum(widths[a:b]) + 2 * (b - a - 1), "-" if t else " ") for t, a, b in GROUPS]
    lines = [_join(row, widths) for row in table]
    return ["", "  ".join(titles), lines[0], "-" * len(lines[0]), *lines[1:], MEANING]


def markdown_sight(evaluation: Evaluation) -> list[str]:
    """Return the table in Markdown and what it means; no line where no detector ran."""
    rows = sight_rows(evaluation)
    if not rows:
        return []
    return ["", *markdown_rows(["case", *SIGHT_HEADER], rows), "", MEANING]


def markdown_rows(head: Sequence[str], rows: Sequence[Sequence[str]], texts: int = 1) -> list[str]:
    """Return the lines of a table whose first `texts` columns are words, the others numbers, to the right."""
    rule = "|---" * texts + "|---:" * (len(head) - texts) + "|"
    first, *rest = ("| " + " | ".join(row) + " |" for row in (head, *rows))
    return [first, rule, *rest]


def align_rows(head: Sequence[str], rows: Sequence[Sequence[str]], texts: int = 1) -> str:
    """Returns a table whose columns are as wide as their widest cell; the first `texts` columns are words."""
    cells = [list(head), *(list(row) for row in rows)]
    widths = [max(len(row[column]) for row in cells) for column in range(len(head))]
    padded = [
        [cell.ljust(width) if column < texts else cell.rjust(width)
         for column, (cell, width) in enumerate(zip(row, widths, strict=True))]
        for row in cells
    ]  # fmt: skip
    return "\n".join(markdown_rows(padded[0], padded[1:], texts))
