"""The harness of every benchmark: parts that measure, their tables, JSON and pictures.

A part is a module of `lab.bench` with `measure(quick) -> Figures`. Its tables are data frames whose columns name their
units, so that one function prints them, one writes them and one draws them.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from importlib import import_module
from inspect import signature
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from finforce_eval.errors import OptionError
from finforce_eval.evaluation.tables import markdown_rows
from finforce_eval.machine import without_nan


@dataclass(frozen=True, kw_only=True)
class Tradeoff:
    """A picture of time against error, both columns of a table.

    Attributes:
        table: name of the table.
        method: columns whose values make a series.
        text: column of the text beside a point; empty for none.
        time: column of medians [ms].
        slow: column of the 99th percentiles [ms].
        error: column of errors.
        answered: column of the share of answers [%]; below `complete` a series is drawn hollow and is on no front.
        complete: least share of answers [%].
        title: above the picture.
        log_error: whether the axis of the errors is logarithmic.
    """

    table: str
    method: Sequence[str]
    time: str
    slow: str
    error: str
    answered: str
    title: str
    text: str = ""
    complete: float = 90.0
    log_error: bool = False


@dataclass(frozen=True, kw_only=True)
class Figures:
    """What was measured.

    Attributes:
        tables: by name.
        notes: sentences below them.
        picture: to be drawn of a table.
        drawn: pictures that are drawn already, file names by what they show.
        more: further plain values.
    """

    tables: Mapping[str, pd.DataFrame]
    notes: Sequence[str] = ()
    picture: Tradeoff | None = None
    drawn: Mapping[str, str] = field(default_factory=dict)
    more: Mapping[str, Any] = field(default_factory=dict)


# title of each part, a module of `lab.bench`
PARTS = {
    "solvers": "Run time against force error of the solver tiers",
    "chain": "Latency against force error of the whole chain",
    "start": "From a node's start until it is ready, and its memory",
    "images": "From images to forces on unseen scenes, beside true key points",
}
USUAL = ("solvers", "chain")  # measured when none is named


def measure_part(name: str, quick: bool, **options: Any) -> Figures:
    """Return the figures of a part.

    Raises:
        OptionError: the part does not take one of the options.
        FinforceError: it cannot be measured here.
    """
    taken = {part: signature(import_module(f"lab.bench.{part}").measure).parameters for part in PARTS}
    for option in options.keys() - taken[name].keys():
        able = ", ".join(part for part in PARTS if option in taken[part]) or "none"
        raise OptionError(f"the part {name} takes no {option}; {able} do")
    return import_module(f"lab.bench.{name}").measure(quick, **options)


def select_parts(names: str | None) -> tuple[str, ...]:
    """Return the parts of a comma-separated list, the usual ones without a list.

    Raises:
        OptionError: a name is none of a part.
    """
    wanted = [name.strip() for name in names.split(",") if name.strip()] if names else USUAL
    for name in wanted:
        if name not in PARTS:
            raise OptionError(f"--parts: there is no part {name!r}, expected some of {', '.join(PARTS)}")
    return tuple(dict.fromkeys(wanted))


def percentiles(seconds: Sequence[float] | NDArray, label: str = "") -> dict[str, float]:
    """Return the count and the percentiles of times [s] as columns of a table, in milliseconds; NaN without any."""
    times = 1e3 * np.asarray(seconds, dtype=float)
    values = np.percentile(times, [50, 95, 99, 100]) if times.size else np.full(4, np.nan)
    prefix = f"{label} " if label else ""
    columns = zip(("p50", "p95", "p99", "max"), values, strict=True)
    return {f"{prefix}n": times.size, **{f"{prefix}{name}/ms": float(value) for name, value in columns}}


def time_calls(call: Callable[[], Any], count: int, clock: Callable[[], float] = perf_counter) -> list[float]:
    """Return the durations of `count` calls [s] by a clock."""
    times = []
    for _ in range(count):
        begin = clock()
        call()
        times.append(clock() - begin)
    return times


def format_figures(figures: Figures) -> str:
    """Return the tables, each below its name, and the notes in Markdown."""
    tables = [f"**{name}**\n\n{format_table(table)}" for name, table in figures.tables.items()]
    return "\n\n".join([*tables, *figures.notes])


def format_table(table: pd.DataFrame) -> str:
    """Return one table in Markdown; its text columns come first."""
    texts = [name for name in table if not pd.api.types.is_numeric_dtype(table[name])]
    ordered = table[[*texts, *(name for name in table if name not in texts)]]
    rows = [[_cell(value) for value in row] for row in ordered.itertuples(index=False)]
    widths = [max(map(len, column)) for column in zip(list(ordered), *rows, strict=True)]
    head, *padded = (
        [cell.ljust(width) if number < len(texts) else cell.rjust(width)
         for number, (cell, width) in enumerate(zip(row, widths, strict=True))]
        for row in (list(ordered), *rows)
    )  # fmt: skip
    return "\n".join(markdown_rows(head, padded, len(texts)))


def _cell(value: Any) -> str:
    """Return a value as it stands in a table: numbers to four digits, nothing for what was not measured."""
    if isinstance(value, float | np.floating):
        return "" if np.isnan(value) else f"{value:.4g}"
    return str(value)


def figures_json(figures: Figures) -> dict[str, Any]:
    """Return the figures as plain values, with the tables in Markdown."""
    rows = {name: table.to_dict("records") for name, table in figures.tables.items()}
    text = {name: format_table(table) for name, table in figures.tables.items()}
    return without_nan({"rows": rows, "tables": text, "notes": list(figures.notes), **figures.more})


MARKS = (
    ("#0072B2", "o"), ("#D55E00", "s"), ("#009E73", "^"), ("#CC79A7", "D"), ("#E69F00", "v"), ("#56B4E9", "P"),
    ("#222222", "X"), ("#999999", "*"), ("#8B4513", "<"), ("#6A3D9A", ">"),
)  # fmt: skip


def find_front(points: pd.DataFrame, time: str, error: str) -> pd.DataFrame:
    """Return the rows than which no other is both as fast and better, or as good and faster; the fastest first."""
    known = points.dropna(subset=[time, error]).sort_values([time, error])
    best = known[error].cummin().shift(fill_value=np.inf)
    return known[known[error] < best]


def draw_tradeoff(figures: Figures, path: Path | str) -> None:
    """Draw time against error, from the median to the 99th percentile, with the front of methods that always answer."""
    from matplotlib.ticker import LogFormatter

    from finforce_eval.figures.figures import GREY, new_figure, style_axes

    plan = figures.picture
    table = figures.tables[plan.table]
    figure = new_figure(9.5, 5.2)
    axes = figure.subplots()
    style_axes(axes)
    complete = []
    for number, (key, rows) in enumerate(table.groupby(list(plan.method), sort=False)):
        colour, marker = MARKS[number % len(MARKS)]
        share = rows[plan.answered].min()
        face = colour if share >= plan.complete else "white"
        label = ", ".join(key) + ("" if share >= 99.95 else f"\n(answers {share:.0f} %)")
        style = {"color": colour, "marker": marker, "markerfacecolor": face, "markersize": 8, "linewidth": 1.0}
        axes.plot(rows[plan.time], rows[plan.error], label=label, linestyle=":", **style)
        axes.hlines(rows[plan.error], rows[plan.time], rows[plan.slow], color=colour, linewidth=1.6, alpha=0.6)
        for row in rows.to_dict("records") if plan.text else ():
            place, shift = (row[plan.time], row[plan.error]), {"xytext": (0, 8), "textcoords": "offset points"}
            axes.annotate(str(row[plan.text]), place, fontsize=8, color=colour, **shift)
        if share >= plan.complete:
            complete.append(rows)
    if complete:
        front = find_front(pd.concat(complete), plan.time, plan.error)
        axes.step(front[plan.time], front[plan.error], where="post", color=GREY, linewidth=5, alpha=0.35, zorder=0)
    axes.set(xscale="log", xlabel=f"{plan.time}: marker p50, line to p99", ylabel=plan.error)
    axes.xaxis.set(major_formatter="{x:g}", minor_formatter=LogFormatter(minor_thresholds=(2, 0.4)))
    axes.set(yscale="log") if plan.log_error else axes.set_ylim(bottom=0.0)
    axes.set_title(plan.title, loc="left", fontsize=11)
    figure.legend(loc="outside right upper", frameon=False, fontsize=9)
    figure.savefig(path)
