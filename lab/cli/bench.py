"""`finforce bench`: parts measured one after the other, each with a table, figures and a picture."""

from __future__ import annotations

import argparse
from importlib import import_module
from pathlib import Path
from time import perf_counter
from typing import Any

from finforce.errors import FinforceError
from finforce_eval.cli.parser import picture_file
from finforce_eval.errors import OptionError
from finforce_eval.machine import describe_machine, write_figures
from lab.bench.bench import BenchPart, select_parts


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the subcommand."""
    text = "recordings of the bench finger to be solved, too; without it shapes of an independent program alone"
    parser.add_argument("folder", nargs="?", metavar="FOLDER", help=text)
    text = "shipped jaw or jaw file whose solvers are measured, pressed by its own solid model (bench)"
    parser.add_argument("--jaw", default="bench", metavar="NAME", help=text)
    text = "solvers, peer, growth, localization, detection, chain, onset, skipping; without it those of `make bench`"
    parser.add_argument("--parts", metavar="A,B", help=text)
    parser.add_argument("--json", metavar="OUT", help="write the figures as JSON")
    text = "draw the first part, and every other beside it with its name added"
    parser.add_argument("--figure", type=picture_file, metavar="PNG", help=text)
    parser.add_argument("--quick", action="store_true", help="fewer cases and no slow tier, to try it out")


def run(options: argparse.Namespace) -> None:
    """Measure the parts, print each one's table, write the JSON and the pictures."""
    parts, machine = select_parts(options.parts, options.jaw), describe_machine()
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
    taken |= {"jaw": options.jaw} if part.takes_jaw else {}
    figures = module.measure(options.quick, **taken)
    table = module.format_table(figures)
    print(table)
    if picture is not None and hasattr(module, "draw"):
        picture.parent.mkdir(parents=True, exist_ok=True)
        module.draw(figures, picture)
        print(f"\nPicture: {picture}")
    return {**module.as_json(figures), "table": table}


def _picture_name(path: str | None, part: BenchPart, *, first: bool) -> Path | None:
    """Return the picture's name as given for the first part, with the part's name added for the others."""
    if not path:
        return None
    return Path(path) if first else Path(path).with_stem(f"{Path(path).stem}_{part.name}")
