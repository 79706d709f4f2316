"""The subcommand `report`: forces over time as one HTML page."""

from __future__ import annotations

import argparse
from pathlib import Path

from finforce_eval.errors import OptionError
from finforce_eval.evaluate import read_evaluations
from finforce_eval.figures.recorded_forces import read_forces
from finforce_eval.figures.report import write_html, write_page
from finforce_eval.machine import version
from finforce_eval.tasks import is_manifest


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the subcommand."""
    text = "recordings or LeRobot datasets with forces, or output folders of finforce "
    text += "evaluate --out"
    parser.add_argument("sources", nargs="+", metavar="SOURCE", help=text)
    parser.add_argument("-o", "--output", default="report.html", metavar="FILE", help="page to write (report.html)")
    parser.add_argument("--title", default="Forces", help="heading of the page (Forces)")


def run(options: argparse.Namespace) -> None:
    """Write the page and name it.

    Raises:
        FinforceError: a source holds no forces, or the name of the page is none.
    """
    page = Path(options.output)
    if page.suffix not in (".html", ".htm"):
        raise OptionError(f"--output {page}: expected a name that ends in .html")
    tables, recorded = [], []
    sources = [Path(source) for source in options.sources if not is_manifest(Path(source))]
    for source in sources:
        files = sorted(source.glob("*.parquet")) if source.is_dir() else []
        tables += files
        recorded += [] if files else read_forces(source)
    if not tables and not recorded:
        raise OptionError(f"{' '.join(options.sources)}: only a manifest; expected the recordings next to it")
    if tables and recorded:
        raise OptionError("recordings and folders of evaluations: expected the one or the other")
    if tables:
        evaluation, about = read_evaluations(tables)
        write_page(evaluation, page, about=about, title=options.title)
    else:
        write_html(recorded, page, title=options.title, about={"version": version()})
    print(f"Page: {page}: {len(recorded) or len(evaluation.results)} plots")
