"""The subcommand `evaluate`: the forces of recordings against what was measured."""

from __future__ import annotations

import argparse
import sys
from contextlib import ExitStack
from pathlib import Path
from tempfile import TemporaryDirectory

from finforce_eval.cli.parser import (
    add_calibration,
    add_engine_options,
    add_jaw_options,
    add_set,
    add_source_options,
    read_engine,
)
from finforce_eval.evaluation.setup import EvaluationSetup, make_setup
from finforce_eval.evaluation.tables import evaluation_json, format_table
from finforce_eval.machine import write_json
from finforce_eval.many import ManyEvaluated, evaluate_many


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the subcommand."""
    parser.add_argument("bags", nargs="+", metavar="BAG", help="rosbag2 folder, .mcap or .db3 file")
    add_jaw_options(parser)
    add_source_options(parser)
    add_calibration(parser)
    add_set(parser)
    parser.add_argument("--json", metavar="OUT", help="write the scores as JSON")
    parser.add_argument("--report", metavar="DIR", help="write pictures and a page that shows them")
    text = (
        "write a table of every recording there (Parquet: a row for each image and jaw), and manifest.jsonl, by which "
    )
    text += "a run that was killed goes on where it was; finforce report shows the tables"
    parser.add_argument("--out", metavar="DIR", help=text)
    add_engine_options(parser)


def run(options: argparse.Namespace) -> int:
    """Evaluate recordings: print the table, write JSON and report; 2 where one of them failed."""
    setup, engine = make_setup(options), read_engine(options)
    with ExitStack() as stack:
        folder = Path(options.out or stack.enter_context(TemporaryDirectory(prefix="finforce_")))
        found = evaluate_many(options, engine, folder)
    for name, error in found.failed.items():
        print(f"failed: {error if name in error else f'{name}: {error}'}", file=sys.stderr)
    print(format_table(found.evaluation))
    _write(found, setup, options)
    return 2 if found.failed else 0


def _write(found: ManyEvaluated, setup: EvaluationSetup, options: argparse.Namespace) -> None:
    """Write what was asked for."""
    if options.json:
        failed = {"failed": dict(found.failed)} if found.failed else {}
        write_json(options.json, evaluation_json(found.evaluation, **failed, **setup.about))
    if options.report:
        from finforce_eval.figures.report import write_overview

        print(f"Report: {write_overview(found.evaluation, options.report, about=setup.about)}")
