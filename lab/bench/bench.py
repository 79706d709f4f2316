"""The `finforce bench` command: parts measured one after the other, each with a table, figures and a picture.

Knows of no part what it measures: each is a module with `measure(quick)`, `format_table`, `as_json` and, if it has a
picture, `draw`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from time import perf_counter
from typing import Any

import numpy as np
from numpy.typing import NDArray

from finforce_eval.errors import OptionError


@dataclass(frozen=True, kw_only=True)
class Row:
    """Times of one kind of work [ms]."""

    name: str
    n: int
    p50: float
    p95: float
    p99: float
    max: float


@dataclass(frozen=True, kw_only=True)
class BenchPart:
    """One part of the benchmark.

    Attributes:
        name: on the command line and in the JSON.
        module: that measures it.
        title: above its table.
        usual: whether it is measured when no parts are named.
        takes_folder: whether it measures recordings, too.
        takes_jaw: whether it measures other fingers than that of the bench.
    """

    name: str
    module: str
    title: str
    usual: bool = True
    takes_folder: bool = False
    takes_jaw: bool = False


PARTS = (
    BenchPart(
        name="solvers",
        module="lab.bench.solvers",
        title="Run time against force error of the solver tiers",
        takes_folder=True,
        takes_jaw=True,
    ),
    BenchPart(name="peer", module="lab.bench.peer", title="Noise, and targets that no force reaches"),
    BenchPart(name="growth", module="lab.bench.growth", title="How cost grows"),
    BenchPart(
        name="localization",
        module="lab.bench.localization",
        title="Run time against place error of the contact",
    ),
    BenchPart(
        name="detection",
        module="lab.bench.detection",
        title="Run time against pixel error of the key points",
    ),
    BenchPart(name="chain", module="lab.bench.chain", title="Latency against force error of the whole chain"),
    BenchPart(
        name="start",
        module="lab.bench.first_start",
        title="From a node's start to its being ready, and its memory",
        usual=False,
    ),
    BenchPart(
        name="onset",
        module="lab.bench.onset",
        title="From a force's onset to its showing",
        usual=False,
    ),
    BenchPart(
        name="endurance",
        module="lab.bench.endurance",
        title="An hour of grasps: growth of memory, drift of the force, lost images",
        usual=False,
    ),
    BenchPart(
        name="skipping",
        module="lab.bench.skipping",
        title="Share of a core that each node takes on three scenes, with what need not be done and without",
        usual=False,
    ),
)


def row_from_times(name: str, times: Sequence[float] | NDArray[np.float64]) -> Row:
    """Return the percentiles of times [s] in milliseconds."""
    p50, p95, p99, longest = (1e3 * float(value) for value in np.percentile(times, [50, 95, 99, 100]))
    return Row(name=name, n=len(times), p50=p50, p95=p95, p99=p99, max=longest)


def time_calls(call: Callable[[], Any], count: int, clock: Callable[[], float] = perf_counter) -> list[float]:
    """Return the durations of `count` calls [s] by a clock."""
    times = []
    for _ in range(count):
        begin = clock()
        call()
        times.append(clock() - begin)
    return times


def format_rows(rows: Sequence[Row]) -> str:
    """Return the table of the times [ms]."""
    width = max(len(row.name) for row in rows)
    head = f"{'one thread, ms'.ljust(width)}  {'p50':>7}  {'p95':>7}  {'p99':>7}  {'max':>7}  {'n':>6}"
    lines = [
        f"{row.name.ljust(width)}  {row.p50:7.2f}  {row.p95:7.2f}  {row.p99:7.2f}  {row.max:7.2f}  {row.n:6d}"
        for row in rows
    ]
    return "\n".join([head, "-" * len(head), *lines])


def select_parts(names: str | None, jaw: str = "bench") -> tuple[BenchPart, ...]:
    """Return the parts of a comma-separated list; without one those that `make bench` measures, of another finger too.

    Raises:
        OptionError: a name is none of a part, or of one that measures the finger of the bench alone.
    """
    other = jaw != "bench"
    if not names:
        return tuple(part for part in PARTS if part.usual and (part.takes_jaw or not other))
    known = {part.name: part for part in PARTS}
    wanted = [name.strip() for name in names.split(",") if name.strip()]
    for name in wanted:
        if name not in known:
            raise OptionError(f"--parts: there is no part {name!r}, expected some of {', '.join(known)}")
        if other and not known[name].takes_jaw:
            able = ", ".join(part.name for part in PARTS if part.takes_jaw)
            raise OptionError(f"--jaw {jaw}: the part {name} measures the bench finger alone, expected --parts {able}")
    return tuple(known[name] for name in dict.fromkeys(wanted))
