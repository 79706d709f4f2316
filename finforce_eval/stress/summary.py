"""What the trials of a stress family come to, and which rules they break."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from finforce_eval.evaluation.markdown import markdown_rows
from finforce_eval.stress.stress import LONGEST_STEP, Family, Trial, measure_longest

SIGMAS = 3.0
SHARE_WITHIN = 0.99


@dataclass(frozen=True, kw_only=True)
class Summary:
    """The trials of one family, or of one of its levels.

    Attributes:
        name: of the family or the level.
        n: trials.
        converged: share of them.
        sure: share of them.
        worst_residual: of converged answers, as the family scales it.
        worst_kkt: of sure answers.
        worst_error: of the force where the answer was sure [N].
        worst_sigmas: the same in stated standard deviations.
        within: share of the sure answers within three of them; NaN when none can be judged.
        median_sigmas: error over stated standard deviation in the median; 0.7 where it is stated exactly.
        median_stddev: of the sure answers [N].
        step_p50: median CPU time of a step [s].
        step_ratio: longest step over that.
        worst_condition: largest condition number.
        worst_balance: largest energy balance in magnitude.
        nans: answers with something that is not finite.
        refused: trials ended by one of our errors.
        crashed: trials ended by any other.
        hung: trials that met the time limit.
        broken: rules that are broken, in words.
    """

    name: str
    n: int
    converged: float
    sure: float
    worst_residual: float
    worst_kkt: float
    worst_error: float
    worst_sigmas: float
    within: float
    median_sigmas: float
    median_stddev: float
    step_p50: float
    step_ratio: float
    worst_condition: float
    worst_balance: float
    nans: int
    refused: int
    crashed: int
    hung: int
    broken: tuple[str, ...]


def summarise(name: str, trials: Sequence[Trial], *, least_sure: float = 0.0, timed: bool = True) -> Summary:
    """Return what trials come to and which rules they break.

    The rules: an answer that is sure is within three stated standard deviations in 99 % of cases; nothing hangs,
    crashes, or leaves that is not finite; no step exceeds ten times the median; enough answers are sure.
    """
    sure = [trial for trial in trials if trial.sure]
    sigmas = np.array([trial.sigmas for trial in sure])
    judged = sigmas[~np.isnan(sigmas)]
    steps = _known(trial.step_time for trial in trials)
    outcomes = Counter(trial.outcome for trial in trials)
    figures = {
        "n": len(trials),
        "converged": _share(trial.converged for trial in trials),
        "sure": _share(trial.sure for trial in trials),
        "worst_residual": _worst(trial.residual for trial in trials if trial.converged),
        "worst_kkt": _worst(trial.kkt for trial in sure),
        "worst_error": _worst(trial.force_error for trial in sure),
        "worst_sigmas": _worst(judged),
        "within": _share(judged <= SIGMAS),
        "median_sigmas": _median(judged),
        "median_stddev": _median(_known(trial.stddev for trial in sure)),
        "step_p50": _median(steps),
        "step_ratio": measure_longest(trials),
        "worst_condition": _worst(trial.condition for trial in trials),
        "worst_balance": _worst(abs(trial.energy_balance) for trial in trials),
        "nans": sum(trial.nan for trial in trials),
        **{name: outcomes[name] for name in ("refused", "crashed", "hung")},
    }
    return Summary(name=name, **figures, broken=tuple(_find_broken(figures, least_sure, timed)))


def summarise_family(family: Family, trials: Sequence[Trial]) -> Summary:
    """Return the summary of all trials of a family."""
    return summarise(family.name, trials, least_sure=family.least_sure, timed=family.timed)


def summarise_levels(trials: Sequence[Trial]) -> list[Summary]:
    """Return one summary per level, in the order in which they came; nothing is demanded of a level's time."""
    levels = dict.fromkeys(trial.level for trial in trials)
    return [summarise(level, [t for t in trials if t.level == level], timed=False) for level in levels]


def _find_broken(figures: dict, least_sure: float, timed: bool) -> Iterable[str]:
    if not figures["n"]:
        yield "no trial was run"
        return
    if figures["within"] < SHARE_WITHIN:
        yield f"{100 * figures['within']:.1f} % of the sure answers are within 3 sigma, expected 99 %"
    if figures["sure"] < least_sure:
        yield f"{100 * figures['sure']:.1f} % of the answers are sure, expected {100 * least_sure:g} %"
    if timed and figures["step_ratio"] > LONGEST_STEP:
        yield f"the longest step took {figures['step_ratio']:.1f} times the median, expected at most {LONGEST_STEP:g}"
    for name, words in (("nans", "answers are not finite"), ("crashed", "trials crashed"), ("hung", "trials hung")):
        if figures[name]:
            yield f"{figures[name]} {words}"


def _known(values: Iterable[float]) -> np.ndarray:
    """Return the values (n,) that are not NaN."""
    array = np.array(list(values), float)
    return array[~np.isnan(array)]


def _worst(values: Iterable[float]) -> float:
    known = _known(values)
    return float(known.max()) if len(known) else float("nan")


def _median(values: np.ndarray) -> float:
    return float(np.median(values)) if len(values) else float("nan")


def _share(values: Iterable[bool]) -> float:
    array = np.array(list(values), float)
    return float(array.mean()) if len(array) else float("nan")


HEAD = (
    *("family", "n", "conv. %", "sure %", "residual", "KKT", "error N", "worst σ", "in 3σ %", "median σ", "stated N"),
    *("p50 ms", "max/p50", "cond.", "energy", "NaN", "refused", "crashed", "hung"),
)


def summary_cells(summary: Summary) -> list[str]:
    """Return one row of the table."""
    numbers = (
        _cell(100 * summary.converged, ".1f"),
        _cell(100 * summary.sure, ".1f"),
        _cell(summary.worst_residual, ".1e"),
        _cell(summary.worst_kkt, ".1e"),
        _cell(summary.worst_error, ".3g"),
        _cell(summary.worst_sigmas, ".2f"),
        _cell(100 * summary.within, ".2f"),
        _cell(summary.median_sigmas, ".2f"),
        _cell(summary.median_stddev, ".3g"),
        _cell(1e3 * summary.step_p50, ".3g"),
        _cell(summary.step_ratio, ".1f"),
        _cell(summary.worst_condition, ".1e"),
        _cell(summary.worst_balance, ".1e"),
    )
    counts = (summary.nans, summary.refused, summary.crashed, summary.hung)
    return [summary.name, str(summary.n), *numbers, *map(str, counts)]


def _cell(value: float, form: str) -> str:
    return "" if np.isnan(value) else format(value, form)


def format_summaries(summaries: Sequence[Summary], first: str = "family") -> str:
    """Return the table as text with aligned columns."""
    rows = [[first, *HEAD[1:]], *(summary_cells(summary) for summary in summaries)]
    widths = [max(len(row[i]) for row in rows) for i in range(len(HEAD))]
    lines = [
        "  ".join([row[0].ljust(widths[0]), *(c.rjust(w) for c, w in zip(row[1:], widths[1:], strict=True))])
        for row in rows
    ]
    return "\n".join([lines[0], "-" * len(lines[0]), *lines[1:]])


def markdown_summaries(summaries: Sequence[Summary], first: str = "family") -> list[str]:
    """Return the lines of the table in Markdown."""
    return markdown_rows([first, *HEAD[1:]], [summary_cells(summary) for summary in summaries])
