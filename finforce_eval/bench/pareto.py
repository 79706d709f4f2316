"""The picture of run time against force error; figures in, a matplotlib figure out."""

from __future__ import annotations

from typing import Any

from finforce_eval.bench.solvers import (
    PAPER,
    SOFA,
    SolverFigures,
    find_fronts,
    front_points,
    is_complete,
    mean_yardstick,
)
from finforce_eval.figures.figures import BLACK, BLUE, GREEN, GREY, ORANGE, new_figure, style_axes

_STYLES = {"exact": (BLUE, "o", "noise-free key points"), "noisy": (ORANGE, "s", "noisy key points")}


def draw_pareto(figures: SolverFigures) -> Any:
    """Returns the figure: milliseconds per step against RMSE, both logarithmic, p99 as a whisker."""
    figure = new_figure(10.5, 6.2)
    axes = figure.subplots()
    style_axes(axes)
    axes.set(xscale="log", yscale="log", xlabel="time per step, one thread [ms]", ylabel="RMSE of the force [N]")
    points, fronts = front_points(figures), find_fronts(figures)
    for kind, (colour, marker, label) in _STYLES.items():
        for tier, point in zip(figures.tiers, points[kind], strict=True):
            face = colour if is_complete(getattr(tier, kind)) else "white"
            axes.plot([point.time, point.slow], [point.error] * 2, color=colour, linewidth=0.8, alpha=0.6)
            axes.plot(point.time, point.error, marker, color=colour, markerfacecolor=face, markersize=6)
        axes.plot([], [], marker, color=colour, linestyle="none", label=label)
        steps = [(point.time, point.error) for point in fronts[kind]]
        if steps:
            axes.step(*zip(*steps, strict=True), where="post", color=colour, linewidth=4, alpha=0.25, zorder=0)
    for tier, exact, noisy in zip(figures.tiers, points["exact"], points["noisy"], strict=True):
        axes.plot([exact.time, noisy.time], [exact.error, noisy.error], color=GREY, linewidth=0.6, zorder=1)
        # the tiers with an outline lie beside those without: one kind is named above its points, the other below
        is_above = tier.tier.contact == "height"
        place = (max if is_above else min)((exact, noisy), key=lambda point: point.error)
        style = {"textcoords": "offset points", "fontsize": 8, "color": BLACK if is_above else GREY}
        axes.annotate(tier.tier.name, (place.time, place.error), (4, 6) if is_above else (4, -12), **style)
    _draw_quoted(axes, figures)
    axes.set_title("Run time against force error: nine presses of an independent program", loc="left", fontsize=11)
    axes.plot([], [], "D", color=GREY, markerfacecolor="white", linestyle="none",
              label="hollow: leaves more than 1 % of the frames unanswered, on no front")  # fmt: skip
    figure.legend(loc="outside lower center", ncols=2, frameon=False, fontsize=9)
    return figure


def _draw_quoted(axes: Any, figures: SolverFigures) -> None:
    """Marks what others state: SOFA as quoted and scaled to this machine, the paper's rate and range of errors."""
    error, step = SOFA["factor_per_height_N"], SOFA["step_ms"]
    here = step * mean_yardstick(figures) / SOFA["yardstick_ms"]
    axes.plot(step, error, "*", color=GREEN, markersize=13, linestyle="none",
              label=f"SOFA, quoted: {step:g} ms, {error:g} N after one factor per height")  # fmt: skip
    axes.plot(here, error, "*", markeredgecolor=GREEN, color="white", markersize=13, linestyle="none",
              label=f"SOFA, its time scaled by the yardstick: {here:.1f} ms")  # fmt: skip
    period = 1e3 / PAPER["rate_Hz"]
    low, high = PAPER["least_N"], PAPER["largest_N"]
    axes.plot([period, period], [low, high], color=BLACK, linewidth=2.5, solid_capstyle="butt",
              label=f"the paper, quoted: {PAPER['rate_Hz']:g} Hz, {low:g} to {high:g} N on its own finger")  # fmt: skip
