"""Two evaluations as a picture: the error of each recording before and after."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from finforce_eval.evaluation.comparison import BETTER, SIGMAS, WORSE, Change
from finforce_eval.figures.figures import BLACK, GREEN, GREY, ORANGE, Figure, new_figure, style_axes

_COLOURS = {BETTER: GREEN, WORSE: ORANGE}


def draw_comparison(changes: Sequence[Change], names: tuple[str, str]) -> Figure:
    """Draw an arrow per recording from its error before to that after, with the chance of the difference."""
    both = [change for change in changes if np.isfinite(change.difference)]
    figure = new_figure(8.0, 1.4 + 0.28 * max(len(both), 3))
    axes = figure.add_subplot()
    style_axes(axes)
    for row, change in enumerate(both):
        colour = _COLOURS.get(change.verdict, GREY)
        if np.isfinite(change.stddev):
            ends = change.before - SIGMAS * change.stddev, change.before + SIGMAS * change.stddev
            axes.plot(ends, [row, row], color="#cccccc", linewidth=7, solid_capstyle="butt")
        axes.plot([change.before, change.after], [row, row], color=colour, linewidth=1.5)
        axes.plot(change.before, row, "o", color="white", markeredgecolor=BLACK, markersize=5)
        axes.plot(change.after, row, "o", color=colour, markersize=6)
    axes.set_yticks(range(len(both)), [change.name for change in both], fontsize=8)
    axes.invert_yaxis()
    axes.set_xlim(left=0.0)
    axes.set_xlabel("root mean square error of the force [N]")
    title = f"○ {names[0]}   ● {names[1]}: green better, orange worse; grey band: within it chance alone"
    axes.set_title(title, fontsize=9, loc="left")
    return figure
