"""How the cost of solving and of finding the contact grows with its size: curves, slopes, and their pictures.

Costs are processor times, to which other processes on the machine add nothing.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from finforce_eval.evaluation.markdown import align_rows

# The slope at the end is that of the sizes within this factor of the largest.
_END = 12.0


@dataclass(frozen=True, kw_only=True)
class Curve:
    """Median processor times of one kind of work over its size.

    Attributes:
        name: of the work.
        sizes: rising.
        seconds: median time [s] at each size.
        detail: whether it is a share of another curve, drawn thin.
    """

    name: str
    sizes: Sequence[float]
    seconds: Sequence[float]
    detail: bool = False

    @property
    def slope(self) -> float:
        """Exponent of the power law through all sizes."""
        return fit_slope(self.sizes, self.seconds)

    @property
    def end_slope(self) -> float:
        """Exponent through the largest sizes, where constant costs no longer show."""
        sizes = np.asarray(self.sizes, float)
        last = sizes >= sizes.max() / _END
        return fit_slope(sizes[last], np.asarray(self.seconds)[last])


@dataclass(frozen=True, kw_only=True)
class Growth:
    """Curves over one kind of size."""

    name: str
    unit: str
    curves: Sequence[Curve]


@dataclass(frozen=True, kw_only=True)
class GrowthFigures:
    """Everything of one run."""

    growths: Sequence[Growth]


def fit_slope(sizes: Sequence[float], seconds: Sequence[float]) -> float:
    """Returns the exponent p of seconds ~ sizes^p by least squares of the logarithms; NaN below two sizes."""
    if len(sizes) < 2:
        return float("nan")
    return float(np.polyfit(np.log(sizes), np.log(seconds), 1)[0])


def measure(quick: bool) -> GrowthFigures:
    """Measures all curves, under a progress bar.

    Args:
        quick: fewer and smaller sizes.
    """
    from tqdm import tqdm

    jobs = list(_list_jobs(quick))
    growths = []
    with tqdm(jobs, unit="growth", disable=None, leave=False) as bar:
        for job in bar:
            growths.append(job())
    return GrowthFigures(growths=growths)


def _list_jobs(quick: bool) -> Iterator[Callable[[], Growth]]:
    """Yields what measures each growth."""
    from finforce_eval.bench.growth_object import grow_triangles
    from finforce_eval.bench.growth_solver import grow_candidates, grow_keypoints, grow_vertices

    yield lambda: grow_vertices(quick)
    yield lambda: grow_vertices(quick, solid=True)
    yield lambda: grow_keypoints(quick)
    yield lambda: grow_candidates(quick)
    yield lambda: grow_triangles(quick)


def format_table(figures: GrowthFigures) -> str:
    """Returns the times and slopes in Markdown, one table per kind of size."""
    return "\n\n".join(_format_growth(growth) for growth in figures.growths)


def _format_growth(growth: Growth) -> str:
    sizes = sorted({size for curve in growth.curves for size in curve.sizes})
    rows = []
    for curve in growth.curves:
        known = dict(zip(curve.sizes, curve.seconds, strict=True))
        cells = [f"{1e3 * known[size]:.3g}" if size in known else "" for size in sizes]
        rows.append([curve.name, *cells, f"{curve.slope:.2f}", f"{curve.end_slope:.2f}"])
    return align_rows([f"{growth.name}, ms", *(f"{size:,.0f}" for size in sizes), "slope", "at the end"], rows)


def as_json(figures: GrowthFigures) -> dict[str, Any]:
    """Returns the figures as plain values."""
    return {
        "growths": [
            {
                "name": growth.name,
                "unit": growth.unit,
                "table": _format_growth(growth),
                "curves": [
                    {**asdict(curve), "slope": curve.slope, "end_slope": curve.end_slope} for curve in growth.curves
                ],
            }
            for growth in figures.growths
        ]
    }


def draw(figures: GrowthFigures, path: Path | str) -> None:
    """Draws a log-log panel per kind of size and writes the picture."""
    from finforce_eval.figures.figures import new_figure, style_axes

    columns = 2
    rows = -(-len(figures.growths) // columns)
    figure = new_figure(6.2 * columns, 4.2 * rows)
    panels = figure.subplots(rows, columns, squeeze=False).ravel()
    for axes, growth in zip(panels, figures.growths, strict=False):
        style_axes(axes)
        for curve in growth.curves:
            width, line = (1.0, "--") if curve.detail else (1.8, "-")
            label = f"{curve.name}: slope {curve.slope:.2f}, at the end {curve.end_slope:.2f}"
            axes.plot(curve.sizes, 1e3 * np.array(curve.seconds), line, marker="o", linewidth=width, markersize=3.5,
                      label=label)  # fmt: skip
        axes.set(xscale="log", yscale="log", xlabel=growth.unit, ylabel="processor time, median [ms]")
        axes.set_title(growth.name, loc="left", fontsize=10)
        axes.legend(frameon=False, fontsize=7)
    for axes in panels[len(figures.growths) :]:
        axes.set_visible(False)
    figure.savefig(path)
