"""The harness of every benchmark: parts that measure, their tables and JSON.

A part is a module of `lab.bench` with `measure(quick) -> Figures`. Its tables are data frames whose columns name their
units, so that one function prints them and one writes them.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from finforce_eval.errors import OptionError
from finforce_eval.machine import without_nan


@dataclass(frozen=True, kw_only=True)
class Figures:
    """The figures of one measurement.

    Attributes:
        tables: by name.
        notes: sentences below them.
        drawn: pictures, file names by what they show.
    """

    tables: Mapping[str, pd.DataFrame]
    notes: Sequence[str] = ()
    drawn: Mapping[str, str] = field(default_factory=dict)


# title of each part, a module of `lab.bench`
PARTS = {
    "solvers": "Run time against force error of the solver tiers",
    "chain": "Latency against force error of the whole chain",
}


def choose_names(option: str, names: str | None, known: Collection[str], between: str = ",") -> tuple[str, ...]:
    """Return the names in the text of an option, all known ones without it.

    Raises:
        OptionError: a name is not known.
    """
    chosen = [name.strip() for name in names.split(between) if name.strip()] if names else known
    for name in chosen:
        if name not in known:
            raise OptionError(f"{option} {name}: expected some of {f'{between} '.join(known)}")
    return tuple(dict.fromkeys(chosen))


def percentiles(seconds: Sequence[float] | NDArray, label: str = "") -> dict[str, float]:
    """Return the count and the percentiles of times [s] as columns of a table, in milliseconds; NaN without any."""
    times = 1e3 * np.asarray(seconds, dtype=float)
    values = np.percentile(times, [50, 95, 99, 100]) if times.size else np.full(4, np.nan)
    prefix = f"{label} " if label else ""
    columns = zip(("p50", "p95", "p99", "max"), values, strict=True)
    return {f"{prefix}n": times.size, **{f"{prefix}{name}/ms": float(value) for name, value in columns}}


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
    rule = "|---" * len(texts) + "|---:" * (len(head) - len(texts)) + "|"
    first, *rest = ("| " + " | ".join(row) + " |" for row in (head, *padded))
    return "\n".join([first, rule, *rest])


def _cell(value: Any) -> str:
    """Return a value as it stands in a table: numbers to four digits, nothing for what was not measured."""
    if isinstance(value, float | np.floating):
        return "" if np.isnan(value) else f"{value:.4g}"
    return str(value)


def figures_json(figures: Figures) -> dict[str, Any]:
    """Return the figures as plain values, with the tables in Markdown."""
    rows = {name: table.to_dict("records") for name, table in figures.tables.items()}
    text = {name: format_table(table) for name, table in figures.tables.items()}
    return without_nan({"rows": rows, "tables": text, "notes": list(figures.notes)})
