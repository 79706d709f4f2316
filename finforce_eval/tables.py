"""Scores as text: the paper's table for the terminal and for Markdown, and the JSON of `evaluate`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

from finforce_eval.evaluate import Evaluation
from finforce_eval.scoring import CaseScore, Spread, Stats

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
    return "\n".join([*lines, "", *summary_lines(evaluation)])


def _join(cells: Sequence[str], widths: Sequence[int]) -> str:
    """Set the first cell to the left and the others to the right."""
    rest = (cell.rjust(width) for cell, width in zip(cells[1:], widths[1:], strict=True))
    return "  ".join([cells[0].ljust(widths[0]), *rest])


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
    ]


def markdown_table(evaluation: Evaluation) -> str:
    """Return the table in Markdown."""
    head = ["case", *(f"{phase}: {name}" for phase in PHASES for name in HEADER), "bias/N", "solved/%"]
    lines = ["| " + " | ".join(head) + " |", "|---" + "|---:" * (len(head) - 1) + "|"]
    lines += ["| " + " | ".join(row) + " |" for row in table_rows(evaluation)]
    return "\n".join(lines)


def evaluation_json(evaluation: Evaluation, **about: Any) -> dict[str, Any]:
    """Return the object that `evaluate --json` writes.

    Args:
        evaluation: the scores.
        about: what else stands at the top: jaw, solver, contact, ...
    """
    cases = {name: asdict(score) for name, score in evaluation.scores.items()}
    return {"cases": cases, "all": asdict(evaluation.total), "force_range_N": evaluation.span, **about}
