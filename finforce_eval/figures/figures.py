"""Pictures of an evaluation: results in, matplotlib figures out."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

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


def draw_errors(results: Sequence[ForceSeries]) -> Figure:
    """Draw error against true force, all cases in one panel, loading and unloading apart."""
    figure = new_figure(8.0, 3.6)
    axes = figure.subplots()
    style_axes(axes)
    axes.axhline(0.0, color=BLACK, linewidth=0.9)
    for result in results:
        for direction, colour in [*COLOURS.items(), ("", BLUE)]:
            chosen = result.counted & (result.column("direction") == direction)
            style = {"color": colour, "alpha": 0.35, "markersize": 3, "markeredgewidth": 0}
            axes.plot(result.true_magnitude[chosen], result.error[chosen], "o", **style)
    axes.set(xlabel="true force [N]", ylabel="error of the force [N]")
    if any((result.column("direction") != "").any() for result in results):
        patches = [Patch(color=colour, label=LABELS[key]) for key, colour in COLOURS.items()]
        figure.legend(handles=patches, loc="outside upper right", ncols=2, frameon=False, fontsize=9)
    return figure
