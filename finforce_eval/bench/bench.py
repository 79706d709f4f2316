"""The `finforce bench` command: parts measured one after the other, each with a table, figures and a picture.

Knows of no part what it measures: each is a module with `measure(quick)`, `format_table`, `as_json` and `draw`.
"""

from __future__ import annotations

import argparse
import os
import platform
import subprocess
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from importlib import import_module
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np
from numpy.typing import NDArray

from finforce.errors import FinforceError
from finforce_eval.errors import OptionError

LIBRARIES = ("numpy", "scipy", "numba", "open3d", "manifold3d", "trimesh", "small_gicp", "coal")


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
    """

    name: str
    module: str
    title: str
    usual: bool = True
    takes_folder: bool = False


PARTS = (
    BenchPart(
        name="solvers",
        module="finforce_eval.bench.solvers",
        title="Run time against force error of the solver tiers",
        takes_folder=True,
    ),
    BenchPart(name="growth", module="finforce_eval.bench.growth", title="How cost grows"),
    BenchPart(
        name="localization",
        module="finforce_eval.bench.localization",
        title="Run time against place error of the contact",
    ),
    BenchPart(
        name="detection",
        module="finforce_eval.bench.detection",
        title="Run time against pixel error of the key points",
    ),
    BenchPart(name="chain", module="finforce_eval.bench.chain", title="Latency against force error of the whole chain"),
    BenchPart(
        name="nodes", module="finforce_eval.bench.nodes", title="Share of a core that each node takes", usual=False
    ),
    BenchPart(
        name="skipping",
        module="finforce_eval.bench.skipping",
        title="Share of a core that each node takes on three scenes, with what need not be done and without",
        usual=False,
    ),
    BenchPart(
        name="live",
        module="finforce_eval.bench.live",
        title="Key points out to wrench in, one solver node per jaw",
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


def describe_machine() -> dict[str, Any]:
    """Return processor, cores, versions of what is installed, and commit."""
    return {
        "processor": _processor(),
        "cores": os.cpu_count(),
        "system": platform.platform(),
        "python": platform.python_version(),
        **dict(_find_versions()),
        "commit": _commit(),
    }


def write_figures(path: Path | str, figures: Mapping[str, Any]) -> None:
    """Write figures as JSON with the machine, versions and commit that they are of; what is not finite becomes null."""
    from finforce_eval.cli.evaluate import write_json

    write_json(path, {"machine": describe_machine(), **_without_nan(figures)})


def _without_nan(content: Any) -> Any:
    """Return nested mappings and sequences with None for numbers that are not finite."""
    if isinstance(content, Mapping):
        return {name: _without_nan(value) for name, value in content.items()}
    if isinstance(content, list | tuple):
        return [_without_nan(value) for value in content]
    return None if isinstance(content, float) and not np.isfinite(content) else content


def _find_versions() -> Iterator[tuple[str, str]]:
    """Yield the installed libraries with their versions."""
    for name in LIBRARIES:
        with suppress(PackageNotFoundError):
            yield name, version(name)


def _processor() -> str:
    """Return the name of the processor."""
    info = Path("/proc/cpuinfo")
    lines = info.read_text(encoding="utf-8").splitlines() if info.exists() else []
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor()


def _commit() -> str:
    """Return the commit of the sources, with a mark when they were changed since."""
    command = ["git", "describe", "--always", "--dirty", "--abbrev=12"]
    folder = Path(__file__).parent
    try:
        return subprocess.run(command, cwd=folder, capture_output=True, text=True, check=True).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        return "unknown"


def format_rows(rows: Sequence[Row]) -> str:
    """Return the table of the times [ms]."""
    width = max(len(row.name) for row in rows)
    head = f"{'one thread, ms'.ljust(width)}  {'p50':>7}  {'p95':>7}  {'p99':>7}  {'max':>7}  {'n':>6}"
    lines = [
        f"{row.name.ljust(width)}  {row.p50:7.2f}  {row.p95:7.2f}  {row.p99:7.2f}  {row.max:7.2f}  {row.n:6d}"
        for row in rows
    ]
    return "\n".join([head, "-" * len(head), *lines])


def select_parts(names: str | None) -> tuple[BenchPart, ...]:
    """Return the parts of a comma-separated list; without one those that `make bench` measures.

    Raises:
        OptionError: a name is none of a part.
    """
    if not names:
        return tuple(part for part in PARTS if part.usual)
    known = {part.name: part for part in PARTS}
    wanted = [name.strip() for name in names.split(",") if name.strip()]
    for name in wanted:
        if name not in known:
            raise OptionError(f"--parts: there is no part {name!r}, expected some of {', '.join(known)}")
    return tuple(known[name] for name in dict.fromkeys(wanted))


def run_bench(options: argparse.Namespace) -> None:
    """Measure the parts, print each one's table, write the JSON and the pictures."""
    parts, machine = select_parts(options.parts), describe_machine()
    if options.folder and not any(part.takes_folder for part in parts):
        raise OptionError(f"{options.folder}: none of the parts {', '.join(p.name for p in parts)} takes recordings")
    content: dict[str, Any] = {}
    for number, part in enumerate(parts):
        begin = perf_counter()
        try:
            figures = _run_part(part, options, _picture_name(options.figure, part, first=number == 0))
        except OptionError:
            raise
        except FinforceError as error:
            print(f"not measured: {error}")
            figures = {"not_measured": str(error)}
        content[part.name] = {**figures, "took_s": round(perf_counter() - begin, 1)}
        if options.json:
            write_figures(options.json, content)
    print(f"\n{machine['processor']}, {machine['cores']} cores, Python {machine['python']}, {machine['commit']}")


def _run_part(part: BenchPart, options: argparse.Namespace, picture: Path | None) -> dict[str, Any]:
    """Measure one part, print and draw it, and return it as plain values."""
    module = import_module(part.module)
    print(f"\n{part.title}\n")
    taken = {"folder": options.folder} if part.takes_folder else {}
    figures = module.measure(options.quick, **taken)
    table = module.format_table(figures)
    print(table)
    if picture is not None:
        picture.parent.mkdir(parents=True, exist_ok=True)
        module.draw(figures, picture)
        print(f"\nPicture: {picture}")
    return {**module.as_json(figures), "table": table}


def _picture_name(path: str | None, part: BenchPart, *, first: bool) -> Path | None:
    """Return the picture's name as given for the first part, with the part's name added for the others."""
    if not path:
        return None
    return Path(path) if first else Path(path).with_stem(f"{Path(path).stem}_{part.name}")
