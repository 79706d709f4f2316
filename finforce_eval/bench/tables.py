"""The solver tiers' figures as tables in Markdown, aligned for a terminal."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from finforce_eval.bench.recordings import RecordedFigures
from finforce_eval.bench.solvers import SOFA, SolverFigures, TierFigures, compare_with_sofa
from finforce_eval.evaluation.markdown import align_rows


def format_tables(figures: SolverFigures) -> Mapping[str, str]:
    """Returns the tables by name: "tiers", "cases", "peer" and, where there are recordings, "recorded"."""
    tables = {"tiers": _tiers(figures.tiers), "cases": _cases(figures.tiers), "peer": _peer(figures.tiers)}
    return {**tables, "recorded": _recorded(figures.recorded)} if figures.recorded else tables


def _tiers(tiers: Sequence[TierFigures]) -> str:
    head = ("tier", "p50/ms", "p99", "CPU p50", "CPU p99", "SuperLU/ms", "noise-free/N", "unanswered", "noisy/N",
            "unanswered", "memory/MB", "set-up/s", "anew/s")  # fmt: skip
    rows = []
    for tier in tiers:
        times = (tier.step.p50, tier.step.p99, tier.cpu.p50, tier.cpu.p99)
        row = [tier.tier.name, *(f"{time:.3f}" for time in times), f"{tier.yardstick.p50:.1f}"]
        for accuracy in (tier.exact, tier.noisy):
            row += [f"{accuracy.rmse:.3f}", f"{accuracy.lost:.1%}"]
        rows.append(row + _start_cells(tier))
    return align_rows(head, rows)


def _start_cells(tier: TierFigures) -> list[str]:
    """Returns memory and set-up of a process; empty cells where another tier has the same."""
    start = tier.start
    if start is None:
        return [""] * 3
    anew = "" if start.build_uncached is None else f"{start.build_uncached:.1f}"
    return [f"{start.memory:.0f}", f"{start.imports + start.build:.2f}", anew]


def _cases(tiers: Sequence[TierFigures]) -> str:
    """Returns the RMSE of every case, noise-free and noisy."""
    names = list(tiers[0].exact.by_case) if tiers else []
    rows = [
        [tier.tier.name, *(f"{tier.exact.by_case[name]:.2f} / {tier.noisy.by_case[name]:.2f}" for name in names)]
        for tier in tiers
    ]
    return align_rows(("noise-free / noisy, N", *names), rows)


def _peer(tiers: Sequence[TierFigures]) -> str:
    """Returns the errors at the held shapes beside those that are quoted of the peer."""
    heights = ("lower", "middle", "upper")
    head = ("noise-free shapes", "shapes", "solved", "nothing fitted/N", *heights, "one factor/N",
            "a factor per height/N", "rate, times SOFA's", "by the yardstick", "share of SOFA's error")  # fmt: skip
    rows = []
    for tier in tiers:
        shapes, compared = tier.shapes, compare_with_sofa(tier)
        row = [tier.tier.name, str(shapes.n), str(shapes.solved), f"{shapes.rmse:.3f}"]
        row += [f"{shapes.by_height[name]:.3f}" if name in shapes.by_height else "" for name in heights]
        row += [f"{shapes.one_factor:.3f}", f"{shapes.factor_per_height:.3f}"]
        rates = (compared["rate"], compared["rate_by_yardstick"])
        rows.append(row + [*(f"{rate:.1f}" for rate in rates), f"{compared['error_share']:.0%}"])
    quoted = [f"{SOFA['rmse_N']:g}", "", "", "", f"{SOFA['one_factor_N']:g}", f"{SOFA['factor_per_height_N']:g}"]
    return align_rows(head, [*rows, ["SOFA, quoted", "45", "45", *quoted, "1", "1", "100%"]])


def _recorded(recorded: Sequence[RecordedFigures]) -> str:
    head = ("recordings", "p50/ms", "p99", "RMSE/N", "bias/N", "unanswered", "not solved at all")
    rows = [
        [row.tier, f"{row.p50:.3f}", f"{row.p99:.3f}", f"{row.rmse:.3f}", f"{row.bias:+.3f}", f"{row.lost:.1%}",
         str(len(row.unsolved))]
        for row in recorded
    ]  # fmt: skip
    return align_rows(head, rows)
