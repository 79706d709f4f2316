"""Pictures of an evaluation: results in, matplotlib figures out."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from finforce.errors import MissingDependencyError
from finforce_eval.table import ForceSeries, Snapshot

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
    figure.supxlabel("measured force [N]", fontsize=10)
    figure.supylabel("estimated force [N]", fontsize=10)
    _phase_legend(figure, results)
    return figure


def _phase_legend(figure: Figure, results: Sequence[ForceSeries]) -> None:
    """Explain the colours of loading and unloading, if there are any."""
    if any((result.column("direction") != "").any() for result in results):
        patches = [Patch(color=colour, label=LABELS[key]) for key, colour in COLOURS.items()]
        figure.legend(handles=patches, loc="outside upper right", ncols=2, frameon=False, fontsize=9)


SIDE = (0, 2)  # seen along y: x to the right, z upwards


def outline_edges(vertices: NDArray[np.float64], triangles: NDArray[np.integer]) -> NDArray[np.integer]:
    """Return the edges at which a closed surface turns away from a viewer on the +y side.

    Args:
        vertices: (n, 3).
        triangles: (t, 3) vertex indices, outward normals.

    Returns:
        (e, 2) vertex indices.
    """
    corners = vertices[triangles]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    # one thousandth: faces seen edge-on count as turned away
    facing = normals[:, 1] > 1e-3 * np.linalg.norm(normals, axis=1)
    edges = triangles[facing][:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
    unique, counts = np.unique(np.sort(edges, axis=1), axis=0, return_counts=True)
    return unique[counts == 1]


def draw_jaw(snapshot: Snapshot, title: str) -> Any:
    """Draw the jaw from the side, in millimetres.

    Undeformed in grey, deformed in blue, the object in sand; key points used are filled, the others hollow; the arrow
    is the force that the object applies to the jaw.

    Args:
        snapshot: the jaw at one instant.
        title: what is shown.
    """
    bodies = [snapshot.surface0[:, SIDE], snapshot.surface[:, SIDE], *snapshot.outline]
    size = 1e3 * np.ptp(np.concatenate(bodies), axis=0)
    width, height = 6.0 * (size + 30) / (size + 30).max()
    figure = new_figure(max(width, 3.0) + 2.6, height + 1.0)
    axes = figure.subplots()
    _draw_object(axes, snapshot)
    _draw_body(axes, snapshot.surface0, snapshot.triangles, fill="#f1f1f1", line="#bbbbbb")
    _draw_body(axes, snapshot.surface, snapshot.triangles, fill="#cfe3f1", line=BLACK)
    _draw_keypoints(axes, snapshot)
    _draw_force(axes, snapshot)
    axes.set(aspect="equal", xlabel="x, closing direction [mm]", ylabel="z, from base to tip [mm]")
    axes.margins(0.08)
    axes.spines[["top", "right"]].set_visible(False)
    axes.set_title(title, loc="left", fontsize=10)
    figure.legend(loc="outside right center", frameon=False, fontsize=9)
    return figure


def _draw_object(axes: Any, snapshot: Snapshot) -> None:
    """Fill the object's outline, as far as it is known."""
    for number, polygon in enumerate(snapshot.outline):
        label = "" if number else "object"
        axes.fill(*(1e3 * polygon).T, facecolor="#efe6d5", edgecolor="#b5a27c", linewidth=0.9, label=label)


def _draw_body(axes: Any, vertices: NDArray, triangles: NDArray, *, fill: str, line: str) -> None:
    """Fill the projection of a surface and draw its outline."""
    from matplotlib.collections import LineCollection, PolyCollection

    flat = 1e3 * vertices[:, SIDE]
    axes.add_collection(PolyCollection(flat[triangles], facecolors=fill, edgecolors=fill, linewidths=0.6))
    edges = outline_edges(vertices, triangles)
    axes.add_collection(LineCollection(flat[edges], colors=line, linewidths=0.9))
    axes.update_datalim(flat)
    axes.autoscale_view()


def _draw_keypoints(axes: Any, snapshot: Snapshot) -> None:
    """Draw the key points as seen, used and unused."""
    axes.plot(*(1e3 * snapshot.keypoints0[:, SIDE]).T, "o", color="#bbbbbb", markersize=3)
    seen = 1e3 * snapshot.keypoints[:, SIDE]
    used = snapshot.used
    axes.plot(*seen[used].T, "o", color=BLUE, markersize=6, markeredgecolor="white", label="key point, used")
    rest = {"markerfacecolor": "none", "markeredgecolor": GREY, "markeredgewidth": 1.4}
    axes.plot(*seen[~used].T, "o", markersize=6, label="key point, not used", **rest)


def _draw_force(axes: Any, snapshot: Snapshot) -> None:
    """Draw the contact and the force arrow, its tip at the contact."""
    contact = 1e3 * snapshot.contact_point[list(SIDE)]
    force = snapshot.force[list(SIDE)]
    norm = np.linalg.norm(force)
    length = 0.2 * 1e3 * float(np.ptp(snapshot.surface0[:, 2]))
    tail = contact - length * force / max(norm, 1e-12)
    arrow = {"arrowstyle": "-|>", "color": ORANGE, "linewidth": 2.2, "mutation_scale": 16}
    axes.annotate("", xy=contact, xytext=tail, arrowprops=arrow | {"shrinkA": 0, "shrinkB": 0}, zorder=5)
    magnitude = np.linalg.norm(snapshot.force)
    axes.plot(*contact, "D", color=ORANGE, markersize=5, zorder=6, label="contact")
    axes.plot([], [], color=ORANGE, linewidth=2.2, label=f"force, {magnitude:.2f} N")
    axes.plot([], [], color="#bbbbbb", linewidth=5, label="undeformed")
    axes.update_datalim([tail])
    axes.autoscale_view()
