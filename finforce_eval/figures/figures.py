"""Pictures of an evaluation: results in, matplotlib figures out."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from finforce.errors import MissingDependencyError
from finforce_eval.table import ForceSeries

try:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.colors import ListedColormap
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


def find_runs(mask: NDArray[np.bool_]) -> list[NDArray[np.integer]]:
    """Return the runs of frames in which the mask is true."""
    rows = np.flatnonzero(mask)
    if rows.size == 0:
        return []
    return np.split(rows, np.flatnonzero(np.diff(rows) > 1) + 1)


def shade_phases(axes: Any, result: ForceSeries, *, labelled: bool) -> None:
    """Shade the record phases of loading and unloading, with entries for the legend if `labelled`."""
    time = result.seconds
    for direction, colour in COLOURS.items():
        for count, run in enumerate(find_runs(result.scored & (result.column("direction") == direction))):
            label = f"record, {LABELS[direction]}" if labelled and count == 0 else None
            axes.axvspan(time[run[0]], time[run[-1]], color=colour, alpha=0.13, linewidth=0, label=label)


def draw_force(result: ForceSeries) -> Figure:
    """Draw estimate and truth over time, with twice the standard deviation and the error below."""
    figure = new_figure(11, 5.4)
    force, error = figure.subplots(2, 1, sharex=True, height_ratios=[3, 1])
    time = result.seconds
    for axes in (force, error):
        style_axes(axes)
        shade_phases(axes, result, labelled=axes is force)
    stddev = result.column("magnitude_stddev")
    low, high = result.magnitude - 2 * stddev, result.magnitude + 2 * stddev
    force.fill_between(
        time, np.maximum(low, 0), high, color=GREEN, alpha=0.3, linewidth=0, label="± 2 standard deviations"
    )
    force.plot(time, result.magnitude, color=GREEN, linewidth=1.1, label="estimate")
    force.plot(time, result.true_magnitude, color=BLACK, linewidth=1.1, dashes=(4, 1.5), label="measured")
    _draw_error(error, result)
    figure.legend(loc="outside upper right", ncols=6, frameon=False, fontsize=9)
    highest = np.nanmax(np.r_[result.magnitude, result.true_magnitude, 0.1])
    force.set(ylabel="force on the jaw [N]", ylim=(0, 1.08 * highest))
    error.set(xlabel="time [s]", ylabel="error [N]", xlim=(time[0], max(time[-1], 1e-3)))
    force.set_title(result.name, loc="left", fontsize=11)
    return figure


def _draw_error(axes: Any, result: ForceSeries) -> None:
    """Draw the error of the scored frames, and a mark for each frame without an estimate."""
    time = result.seconds
    axes.axhline(0.0, color=BLACK, linewidth=0.8)
    for direction, colour in [*COLOURS.items(), ("", GREY)]:
        chosen = result.counted & (result.column("direction") == direction)
        axes.plot(time[chosen], result.error[chosen], ".", markersize=2, color=colour)
    lost = time[~result.solved]
    if lost.size:
        style = {"transform": axes.get_xaxis_transform(), "clip_on": False}
        axes.plot(lost, np.zeros(lost.size), "|", color=GREY, markersize=7, label="no estimate", **style)


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
    figure.supxlabel("measured force [N]", fontsize=10)
    figure.supylabel("estimated force [N]", fontsize=10)
    _phase_legend(figure, results)
    return figure


def _phase_legend(figure: Figure, results: Sequence[ForceSeries]) -> None:
    """Explain the colours of loading and unloading, if there are any."""
    if any((result.column("direction") != "").any() for result in results):
        patches = [Patch(color=colour, label=LABELS[key]) for key, colour in COLOURS.items()]
        figure.legend(handles=patches, loc="outside upper right", ncols=2, frameon=False, fontsize=9)


def draw_keypoints(result: ForceSeries, names: Sequence[str]) -> Figure:
    """Draw which key points entered the estimate, over time.

    Args:
        result: the time series.
        names: K names of the key points.
    """
    figure = new_figure(11, 0.6 + 0.24 * len(names) + 0.8)
    axes = figure.subplots()
    time = result.seconds
    used = result.column("used")
    picture = np.where(used, 1, 0).T
    extent = (time[0], max(time[-1], 1e-3), len(names) - 0.5, -0.5)
    colours = ListedColormap(["#e9e9e9", BLUE])
    axes.imshow(picture, aspect="auto", extent=extent, cmap=colours, vmin=0, vmax=1, interpolation="nearest")
    for line in range(1, len(names)):
        axes.axhline(line - 0.5, color="white", linewidth=1.5)
    shares = 100 * used.mean(axis=0)
    labels = [f"{name}  {share:3.0f} %" for name, share in zip(names, shares, strict=True)]
    axes.set_yticks(range(len(names)), labels, fontsize=8)
    axes.spines[:].set_visible(False)
    axes.set_xlabel("time [s]")
    title = f"{result.name}: key points used (blue), with their share of the frames"
    axes.set_title(title, loc="left", fontsize=11)
    return figure
