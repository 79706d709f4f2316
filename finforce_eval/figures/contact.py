"""The stated contact location over time, against the pressure centre of the measured force."""

from __future__ import annotations

from typing import Any

import numpy as np

from finforce_eval.evaluation.scoring import LEAST_FORCE, ONSET_FORCE
from finforce_eval.figures.figures import (
    BLACK,
    BLUE,
    GREEN,
    GREY,
    ORANGE,
    Figure,
    find_runs,
    new_figure,
    shade_phases,
    style_axes,
)
from finforce_eval.table import ForceSeries


def draw_contact(result: ForceSeries) -> Figure:
    """Draw the heights of given and found contact with the true one, their errors, and when they touch.

    Args:
        result: with a contact series.
    """
    figure = new_figure(11, 6.4)
    height, error, touch = figure.subplots(3, 1, sharex=True, height_ratios=[3, 1.6, 0.7])
    time = result.seconds
    for axes in (height, error):
        style_axes(axes)
        shade_phases(axes, result, labelled=axes is height)
    _draw_heights(height, error, result)
    _draw_touching(touch, result)
    figure.legend(loc="outside upper right", ncols=6, frameon=False, fontsize=9)
    height.set(ylabel="height on the\nundeformed surface [mm]")
    height.set_title(f"{result.name}, contact: {result.column('contact_source')[0]}", loc="left", fontsize=11)
    error.set(ylabel="off the pressure\ncentre [mm]")
    touch.set(xlabel="time [s]", xlim=(time[0], max(time[-1], 1e-3)))
    return figure


def _draw_heights(height: Any, error: Any, result: ForceSeries) -> None:
    """Draw the heights, and their distance from the truth where the truth presses."""
    time, given, solved = result.seconds, result.column("contact_height"), result.column("contact_location")[:, 2]
    pressed = result.true_magnitude > LEAST_FORCE
    truth = np.where(pressed, result.column("true_height"), np.nan)
    height.plot(time, 1e3 * given, color=ORANGE, linewidth=0.9, label="contact given to the solver")
    height.plot(time, 1e3 * solved, color=GREEN, linewidth=0.9, label="found by the solver")
    height.plot(time, 1e3 * truth, color=BLACK, linewidth=1.3, dashes=(4, 1.5), label="pressure centre of the truth")
    error.axhline(0.0, color=BLACK, linewidth=0.8)
    for heights, colour in ((given, ORANGE), (solved, GREEN)):
        error.plot(time, 1e3 * (heights - truth), color=colour, linewidth=0.8)


def _draw_touching(axes: Any, result: ForceSeries) -> None:
    """Draw bars for the true contact and for the one reported."""
    rows = [("measured", np.nan_to_num(result.true_magnitude) > ONSET_FORCE, BLACK)]
    if result.has("touching"):
        rows.append(("touching", result.column("touching").astype(bool), BLUE))
    for line, (_, mask, colour) in enumerate(rows):
        time = np.r_[result.seconds, 2 * result.seconds[-1] - result.seconds[-2 if len(mask) > 1 else -1]]
        bars = [(time[run[0]], time[run[-1] + 1] - time[run[0]]) for run in find_runs(mask)]
        axes.broken_barh(bars, (line - 0.35, 0.7), color=colour, linewidth=0)
    axes.set_yticks(range(len(rows)), [name for name, *_ in rows], fontsize=9)
    axes.set_ylim(len(rows) - 0.5, -0.5)
    axes.tick_params(axis="y", colors=GREY, labelcolor=BLACK)
    axes.spines[["top", "right"]].set_visible(False)
