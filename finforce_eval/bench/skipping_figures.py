"""What the benchmark of skipped work found: its records, tables and picture."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from matplotlib.figure import Figure

SCENES = ("idle", "approach", "grasp")
ON, OFF = "rules on", "rules off"
MOST_IDLE = 2.0  # [% of a core] that a node may take while idle
MOST_STEADY = 0.5  # of the cost without rules that a steady grasp may take


@dataclass(frozen=True, kw_only=True)
class SceneCost:
    """What a node took in one scene.

    Attributes:
        setting: of the rules.
        scene: its name.
        node: its name.
        cpu: CPU time per second of scene [% of a core].
        others: CPU use of everything that is no node of ours meanwhile [% of a core].
        images: of which the grasp force came, per second.
    """

    setting: str
    scene: str
    node: str
    cpu: float
    others: float
    images: float


@dataclass(frozen=True, kw_only=True)
class SkippingFigures:
    """What was measured: costs, memory [MB] by setting and node, and what the rules skipped by node and rule."""

    costs: Sequence[SceneCost]
    memory: Mapping[str, Mapping[str, float]]
    skipped: Mapping[str, Mapping[str, str]]


def find_cost(figures: SkippingFigures, setting: str, scene: str, node: str) -> float:
    """Return the CPU use of a node in a scene [% of a core], NaN where it was not measured."""
    found = (cost.cpu for cost in figures.costs if (cost.setting, cost.scene, cost.node) == (setting, scene, node))
    return next(found, float("nan"))


def _nodes_of(figures: SkippingFigures) -> list[str]:
    return list(dict.fromkeys(cost.node for cost in figures.costs))


def format_table(figures: SkippingFigures) -> str:
    """Return the CPU use of each node in each scene [% of a core] and the memory [MB] as text."""
    head = f"{'CPU, % of a core':<22}" + "".join(f"{f'{scene} on':>13}{'off':>7}{'ratio':>7}" for scene in SCENES)
    lines = [head + f"{'MB':>7}", "-" * (len(head) + 7)]
    for node in _nodes_of(figures):
        line = f"{node:<22}"
        for scene in SCENES:
            on, off = (find_cost(figures, setting, scene, node) for setting in (ON, OFF))
            line += f"{on:>13.1f}{off:>7.1f}{on / off if off else np.nan:>7.2f}"
        lines.append(line + f"{figures.memory.get(ON, {}).get(node, np.nan):>7.0f}")
    load = ", ".join(f"{cost.setting}, {cost.scene}: {cost.others:.0f} %" for cost in _one_per_scene(figures))
    images = ", ".join(f"{cost.setting}, {cost.scene}: {cost.images:.1f}" for cost in _one_per_scene(figures))
    return "\n".join([*lines, f"Grasp forces per second: {images}.", f"Everything else on the machine: {load}."])


def format_each(figures: SkippingFigures) -> str:
    """Return what all nodes together take in each scene [% of a core], by setting, and beside that with all rules."""
    width = max(len(name) for name in figures.memory)
    totals = {
        name: [sum(find_cost(figures, name, scene, node) for node in _nodes_of(figures)) for scene in SCENES]
        for name in figures.memory
    }
    head = "CPU of all nodes, % of a core".ljust(width) + "".join(f"{scene:>12}{'more':>7}" for scene in SCENES)
    lines = [head, "-" * len(head)]
    for name, costs in totals.items():
        pairs = zip(costs, totals.get(ON, [np.nan] * len(SCENES)), strict=True)
        lines.append(name.ljust(len(head) - 19 * len(SCENES)) + "".join(f"{c:>12.1f}{c - on:>7.1f}" for c, on in pairs))
    return "\n".join(lines)


def _one_per_scene(figures: SkippingFigures) -> list[SceneCost]:
    """Return one cost of each setting and scene."""
    return list({(cost.setting, cost.scene): cost for cost in figures.costs}.values())


def as_json(figures: SkippingFigures) -> dict[str, Any]:
    """Return the figures as they are written."""
    return {
        "costs": [asdict(cost) for cost in figures.costs],
        "memory_MB": figures.memory,
        "skipped": figures.skipped,
        "aims": {"idle_pct": MOST_IDLE, "steady_share": MOST_STEADY},
    }


def draw(figures: SkippingFigures, path: Path | str) -> None:
    """Draw the CPU use of each node, one panel per scene, with the rules and without, and write it to a file.

    Raises:
        MissingDependencyError: matplotlib is not installed.
    """
    draw_costs(figures).savefig(path)


def draw_costs(figures: SkippingFigures) -> Figure:
    """Return the picture of `draw`."""
    from finforce_eval.figures.figures import BLACK, BLUE, GREY, new_figure, style_axes

    figure, nodes = new_figure(11, 3.6), _nodes_of(figures)
    panels = figure.subplots(1, len(SCENES), sharey=True)
    places = np.arange(len(nodes))
    for axes, scene in zip(panels, SCENES, strict=True):
        style_axes(axes)
        for shift, setting, color in ((-0.2, OFF, GREY), (0.2, ON, BLUE)):
            costs = [find_cost(figures, setting, scene, node) for node in nodes]
            bars = axes.bar(places + shift, costs, width=0.38, color=color, label=setting)
            axes.bar_label(bars, fmt="%.1f", fontsize=7)
        axes.set_title(scene, loc="left", fontsize=10)
        axes.set_xticks(places, [node.replace("_", "\n") for node in nodes], fontsize=7)
    panels[0].axhline(MOST_IDLE, color=BLACK, linewidth=0.8, linestyle=":")
    panels[0].set(ylabel="CPU time per second [% of a core]", yscale="symlog")
    panels[-1].legend(frameon=False, fontsize=8)
    return figure
