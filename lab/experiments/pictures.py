"""Pictures of the experiments."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from finforce_eval.figures.figures import BLACK, BLUE, GREEN, ORANGE, new_figure, style_axes

COLOURS = {"low": BLUE, "medium": GREEN, "high": ORANGE}


def draw_grasps(figures: Mapping[str, Mapping[str, Any]]) -> Any:
    """Return a figure with a panel for each object and place, measured and estimated force over time."""
    shapes = list(dict.fromkeys(row["object"] for row in figures.values()))
    places = list(dict.fromkeys(row["place"] for row in figures.values()))
    figure = new_figure(3.6 * len(places), 2.5 * len(shapes) + 0.4)
    panels = figure.subplots(len(shapes), len(places), squeeze=False, sharey=True)
    for row in figures.values():
        axes = panels[shapes.index(row["object"])][places.index(row["place"])]
        course = {name: np.array(values, dtype=float) for name, values in row["course"].items()}
        begin = course["seconds"][np.flatnonzero(course["truth"] > 0.02)[:1]].sum()
        axes.plot(course["seconds"] - begin, course["found"], color=COLOURS[row["level"]], linewidth=1.2)
        axes.plot(course["seconds"] - begin, course["truth"], color=BLACK, linewidth=0.9, dashes=(4, 2))
    for shape, line in zip(shapes, panels, strict=True):
        line[0].set_ylabel("grasp force [N]")
        for place, axes in zip(places, line, strict=True):
            style_axes(axes)
            axes.set_title(f"{shape}, {place}", loc="left", fontsize=10)
            axes.set_xlim(left=-1.0)
    for axes in panels[-1]:
        axes.set_xlabel("after first touch [s]")
    return figure


def draw_weights(figures: Mapping[str, Mapping[str, Any]]) -> Any:
    """Return a figure of the net force along gravity over gravity's direction in the gripper, a panel for each turn."""
    columns = min(len(figures), 4)
    rows = -(-len(figures) // columns)
    figure = new_figure(3.2 * columns, 3.4 * rows + 0.2)
    for number, (name, row) in enumerate(figures.items()):
        axes = figure.add_subplot(rows, columns, number + 1, projection="polar")
        course = row["course"]
        axes.plot(course["angle"], course["found"], color=BLUE, linewidth=0.9)
        axes.plot(course["angle"], course["truth"], color=BLACK, linewidth=1.0, dashes=(4, 2))
        axes.set_title(name, fontsize=10)
        axes.set_rlim(0.0, 1.3 * max([*course["truth"], 0.1]))
        axes.tick_params(labelsize=7)
    return figure


def draw_chips(figures: Mapping[str, Mapping[str, Any]], bears: float, breaks: float) -> Any:
    """Return a figure of the true forces [N] over time, a panel for each way of grasping."""
    ways = list(dict.fromkeys(row["way"] for row in figures.values()))
    figure = new_figure(4.2 * len(ways), 3.2)
    panels = figure.subplots(1, len(ways), squeeze=False, sharey=True)[0]
    for axes, way in zip(panels, ways, strict=True):
        style_axes(axes)
        members = [row for row in figures.values() if row["way"] == way]
        for row in members:
            colour = ORANGE if row["is_broken"] else BLUE
            axes.plot(row["seconds"], row["force"], color=colour, linewidth=0.9, alpha=0.7)
        axes.axhline(breaks, color=BLACK, linewidth=0.9, dashes=(4, 2))
        axes.axhline(bears, color=GREEN, linewidth=0.9, dashes=(4, 2))
        broken = sum(row["is_broken"] for row in members)
        axes.set_title(f"by {way}: {broken} of {len(members)} broken", loc="left", fontsize=10)
        axes.set(xlabel="after first touch [s]", xlim=(-0.5, 8.0))
    panels[0].set_ylabel("true force [N]")
    return figure


def draw_networks(figures: Mapping[str, Mapping[str, Any]]) -> Any:
    """Return a figure of the grasp force by both methods over time, a panel for each grasp."""
    columns = min(len(figures), 4)
    rows = -(-len(figures) // columns)
    figure = new_figure(3.6 * columns, 2.5 * rows + 0.4)
    panels = figure.subplots(rows, columns, squeeze=False, sharey=True)
    for axes in panels.flat[len(figures) :]:
        axes.set_visible(False)
    for axes, (name, row) in zip(panels.flat, figures.items(), strict=False):
        style_axes(axes)
        course = {key: np.array(values, dtype=float) for key, values in row["course"].items()}
        axes.plot(course["seconds"], course["network"], color=ORANGE, linewidth=1.0)
        axes.plot(course["seconds"], course["found"], color=BLUE, linewidth=1.2)
        axes.plot(course["seconds"], course["truth"], color=BLACK, linewidth=0.9, dashes=(4, 2))
        axes.set_title(f"{name} ({row.get('group', 'recording')})", loc="left", fontsize=9)
    for line in panels:
        line[0].set_ylabel("grasp force [N]")
    for axes in panels[-1]:
        axes.set_xlabel("time [s]")
    return figure
