"""Force over time of grasps by force, with the bound that the controller showed; reads the benchmark's figures."""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from finforce_eval.figures.figures import BLACK, BLUE, GREY, ORANGE, new_figure, style_axes

BEFORE, AFTER = -0.4, 6.0  # [s] about first touch that are drawn


def draw_traces(traces: Sequence[dict[str, Any]]) -> Any:
    """Return a figure of forces and bounds, one course per set force."""
    figure = new_figure(8.0, 4.2)
    axes = figure.subplots()
    for number, one in enumerate(traces):
        draw_trace(axes, one, labelled=number == 0)
    axes.set(xlim=(BEFORE, AFTER), ylim=(0.0, None), xlabel="time since first touch [s]", ylabel="grasp force [N]")
    style_axes(axes)
    axes.legend(frameon=False, loc="lower right", ncols=2, fontsize=8)
    return figure


def draw_trace(axes: Any, one: dict[str, Any], *, labelled: bool) -> None:
    """Draw one course: set force, true force, measured forces, and how far it might have gone beyond."""

    def label(text: str) -> str | None:
        return text if labelled else None

    goal = one["goal_N"]
    times, bound = np.array(one["status_time_s"]), np.array(one["bound_N"], dtype=float)
    axes.axhline(goal, color=GREY, linewidth=0.8, linestyle="--", label=label("set force"))
    shown = times > 0.0
    axes.fill_between(
        times[shown], goal, goal + bound[shown], color=ORANGE, alpha=0.25, linewidth=0, label=label("bound shown")
    )
    axes.plot(times, one["measured_N"], ".", color=GREY, markersize=2, label=label("measured, when it arrived"))
    axes.plot(one["time_s"], one["force_N"], color=BLUE, linewidth=1.4, label=label("true force"))
    axes.annotate(f"{goal:g} N", (AFTER, goal), xytext=(4, 0), textcoords="offset points", va="center", color=BLACK)


def main() -> None:
    """Draw the picture from the JSON of the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("json", type=Path)
    parser.add_argument("figure", type=Path)
    options = parser.parse_args()
    draw_traces(json.loads(options.json.read_text(encoding="utf-8"))["traces"]).savefig(options.figure)


if __name__ == "__main__":
    main()
