"""`finforce bench`: parts measured one after the other, each with tables and JSON."""

from __future__ import annotations

import argparse
from importlib import import_module
from pathlib import Path
from time import perf_counter
from typing import Any

from finforce.errors import FinforceError
from finforce_eval.cli.parser import CommandResult, picture_file
from finforce_eval.machine import describe_machine, write_figures
from lab.harness import PARTS, choose_names, figures_json, format_figures


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the subcommand."""
    text = f"parts to measure: {', '.join(PARTS)} (those of `make bench`)"
    parser.add_argument("--parts", metavar="A,B", help=text)
    text = "picture of time against error, of the part solvers"
    parser.add_argument("--figure", type=picture_file, metavar="PNG", help=text)
    parser.add_argument("--quick", action="store_true", help="measure fewer cases")


def run(options: argparse.Namespace) -> CommandResult:
    """Measure the parts and print each one's tables."""
    machine, content = describe_machine(), {}
    for part in choose_names("--parts", options.parts, PARTS):
        content[part] = _run_part(part, options.quick, options.figure)
        if options.json:  # what comes next may fail
            write_figures(options.json, content)
    print(f"\n{machine['processor']}, {machine['cores']} cores, Python {machine['python']}, {machine['commit']}")
    return CommandResult(content)


def _run_part(part: str, quick: bool, picture: str | None) -> dict[str, Any]:
    """Measure one part, print it and draw the solvers; return it as plain values."""
    print(f"\n{PARTS[part]}\n")
    begin = perf_counter()
    try:
        figures = import_module(f"lab.bench.{part}").measure(quick)
    except FinforceError as error:
        print(f"not measured: {error}")
        return {"not_measured": str(error)}
    print(format_figures(figures))
    if picture and part == "solvers":
        from lab.bench.solvers import draw_tiers

        draw_tiers(figures.tables["tiers"], Path(picture))
    return {**figures_json(figures), "took_s": round(perf_counter() - begin, 1)}
