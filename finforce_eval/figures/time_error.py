"""Time against error as a picture: methods with their times and errors, and those that no other beats.

Knows nothing of what is measured.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, kw_only=True)
class TimeStats:
    """Times of one kind of work [ms]."""

    n: int
    p50: float
    p95: float
    p99: float
    max: float


@dataclass(frozen=True, kw_only=True)
class ErrorPoint:
    """One measured point.

    Attributes:
        text: beside the point; empty for none.
        time: p50 [ms].
        slow: p99 [ms].
        error: in the unit of the picture.
    """

    text: str
    time: float
    slow: float
    error: float


@dataclass(frozen=True, kw_only=True)
class ErrorSeries:
    """The points of one method, and whether it answers always; one that does not is drawn hollow."""

    name: str
    points: Sequence[ErrorPoint]
    complete: bool = True


def time_stats(seconds: Sequence[float] | NDArray) -> TimeStats:
    """Return the percentiles of times (n,) [s] in milliseconds; NaN without any."""
    times = 1e3 * np.asarray(seconds, dtype=float)
    if not times.size:
        return TimeStats(n=0, p50=np.nan, p95=np.nan, p99=np.nan, max=np.nan)
    p50, p95, p99, longest = (float(value) for value in np.percentile(times, [50, 95, 99, 100]))
    return TimeStats(n=times.size, p50=p50, p95=p95, p99=p99, max=longest)


def find_front(points: Sequence[ErrorPoint]) -> list[ErrorPoint]:
    """Return the points than which no other is both as fast (p50) and better, or as good and faster; fastest first."""
    front: list[ErrorPoint] = []
    for point in sorted(points, key=lambda point: (point.time, point.error)):
        if np.isfinite(point.time) and np.isfinite(point.error) and (not front or point.error < front[-1].error):
            front.append(point)
    return front


def draw_time_error(
    series: Sequence[ErrorSeries],
    path: Path | str,
    *,
    title: str,
    error: str,
    time: str = "time [ms]",
    log_error: bool = False,
) -> None:
    """Draw points from p50 to p99 against their errors, with the front of those that always answer, as a picture file.

    Args:
        series: what is drawn, a colour each.
        path: of the picture; its ending names the format.
        title: above it.
        error: label of the errors' axis, with unit.
        time: label of the times' axis, which is logarithmic.
        log_error: whether that of the errors is, too.

    Raises:
        MissingDependencyError: matplotlib is not installed.
    """
    from finforce_eval.figures.figures import GREY, new_figure, style_axes

    figure = new_figure(9.5, 5.2)
    axes = figure.subplots()
    style_axes(axes)
    for number, entry in enumerate(series):
        _draw_series(axes, entry, number)
    front = find_front([point for entry in series if entry.complete for point in entry.points])
    steps = [(point.time, point.error) for point in front]
    if steps:
        axes.step(*zip(*steps, strict=True), where="post", color=GREY, linewidth=5, alpha=0.35, zorder=0)
    axes.set(xscale="log", xlabel=f"{time}: marker p50, line to p99", ylabel=error)
    _label_ticks(axes.xaxis)
    if log_error:
        axes.set(yscale="log")
        _label_ticks(axes.yaxis)
    else:
        axes.set_ylim(bottom=0.0)
    axes.set_title(title, loc="left", fontsize=11)
    figure.legend(loc="outside right upper", frameon=False, fontsize=9)
    figure.savefig(path)


NEAR_TIME, NEAR_ERROR = 0.35, 0.05  # of a logarithm, and of a share: texts of points closer than this overlap
MARKS = ("#0072B2", "o"), ("#D55E00", "s"), ("#009E73", "^"), ("#CC79A7", "D"), ("#E69F00", "v"), ("#56B4E9", "P")
MORE = ("#222222", "X"), ("#999999", "*"), ("#8B4513", "<"), ("#6A3D9A", ">")


def _draw_series(axes: Any, entry: ErrorSeries, number: int) -> None:
    """Draw the points of one method, a line through their p50, one to the p99 of each."""
    marks = MARKS + MORE
    colour, marker = marks[number % len(marks)]
    times, errors = [point.time for point in entry.points], [point.error for point in entry.points]
    face = colour if entry.complete else "white"
    style = {"color": colour, "marker": marker, "markerfacecolor": face, "markersize": 8, "linewidth": 1.0}
    axes.plot(times, errors, label=entry.name, linestyle=":", **style)
    for point in entry.points:
        axes.plot([point.time, point.slow], [point.error] * 2, color=colour, linewidth=1.6, alpha=0.6)
    for point in join_near(entry.points):
        axes.annotate(
            point.text, (point.time, point.error), (0, 8), textcoords="offset points", fontsize=8, color=colour
        )


def _label_ticks(axis: Any) -> None:
    """Label 1, 2 and 5 of every decade as plain numbers."""
    from matplotlib.ticker import LogLocator, NullFormatter

    axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axis.set_major_formatter("{x:g}")
    axis.set_minor_formatter(NullFormatter())


def join_near(points: Sequence[ErrorPoint]) -> list[ErrorPoint]:
    """Return the points that have a text; of neighbours that would cover each other the first, with all their texts."""
    joined: list[ErrorPoint] = []
    for point in points:
        last = joined[-1] if joined else None
        if last and abs(np.log(point.time / last.time)) < NEAR_TIME and abs(point.error / last.error - 1) < NEAR_ERROR:
            joined[-1] = replace(last, text=f"{last.text} · {point.text}")
        elif point.text:
            joined.append(point)
    return joined
