"""How the key points were seen and when the force showed, as text."""

from __future__ import annotations

from typing import TYPE_CHECKING

from finforce_eval.evaluation.markdown import markdown_rows
from finforce_eval.evaluation.scoring import CaseScore

if TYPE_CHECKING:
    from finforce_eval.evaluation.evaluate import Evaluation

HEADER = (
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
    if all(result.detector_ms is None for result in evaluation.results.values()):
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


def _join(cells: list[str], widths: list[int]) -> str:
    rest = (cell.rjust(width) for cell, width in zip(cells[1:], widths[1:], strict=True))
    return "  ".join([cells[0].ljust(widths[0]), *rest])


def markdown_sight(evaluation: Evaluation) -> list[str]:
    """Return the table in Markdown and what it means; no line where no detector ran."""
    rows = sight_rows(evaluation)
    if not rows:
        return []
    return ["", *markdown_rows(["case", *HEADER], rows), "", MEANING]
