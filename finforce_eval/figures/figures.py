"""Pictures of an evaluation: results in, matplotlib figures out."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from finforce.errors import MissingDependencyError
from finforce_eval.table import ForceSeries

try:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.patches import Patch
except ImportError as error:
    raise MissingDependencyError("a report needs matplotlib: pip install matplotlib") from error

# Okabe and Ito's palette, safe for colour-blind readers
BLUE, ORANGE, GREEN, GREY, BLACK = "#0072B2", "#D55E00", "#009E73", "#999999", "#222222"
COLOURS = {"load": BLUE, "unload": ORANGE}
LABELS = {"load": "loading", "unload": "unloading"}


def new_figure(width: float, height: float) -> Figure:
    """Return a figure that pyplot knows nothing of; sizes in inches."""
    figure = Figure(figsize=(width, height), dpi=120, layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def style_axes(axes: Any) -> None:
    """Take away the frame and set a quiet grid."""
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(color="#dddddd", linewidth=0.6)
    axes.set_axisbelow(True)


def draw_unity(results: Sequence[ForceSeries]) -> Figure:
    """Draw estimate against truth, one panel per case, loading and unloading apart."""
    columns = min(len(results), 3)
    rows = -(-len(results) // columns)
    figure = new_figure(3.4 * columns + 0.8, 3.4 * rows + 0.6)
    panels = figure.subplots(rows, columns, squeeze=False).ravel()
    for axes, result in zip(panels, results, strict=False):
        style_axes(axes)
        counted = np.r_[result.true_magnitude[result.counted], result.magnitude[result.counted]]
        limit = 1.06 * float(counted.max(initial=0.1))
        axes.plot([0, limit], [0, limit], color=GREY, linewidth=1.0, dashes=(4, 2))
        for direction, colour in [*COLOURS.items(), ("", BLUE)]:
            chosen = result.counted & (result.column("direction") == direction)
            style = {"color": colour, "alpha": 0.35, "markersize": 3, "markeredgewidth": 0}
            axes.plot(result.true_magnitude[chosen], result.magnitude[chosen], "o", **style)
        axes.set(xlim=(0, limit), ylim=(0, limit), aspect="equal")
        axes.locator_params(nbins=6)
        axes.set_title(result.name, fontsize=10)
    for axes in panels[len(results) :]:
        axes.set_visible(False)
    figure.supxlabel("true force [N]", fontsize=10)
    figure.supylabel("estimated force [N]", fontsize=10)
    if any((result.column("direction") != "").any() for result in results):
        patches = [Patch(color=colour, label=LABELS[key]) for key, colour in COLOURS.items()]
        figure.legend(handles=patches, loc="outside upper right", ncols=2, frameon=False, fontsize=9)
    return figure
