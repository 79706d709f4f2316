"""The subcommand `evaluate`: the forces of recordings against what was measured."""

from __future__ import annotations

import argparse
import sys
from contextlib import ExitStack
from pathlib import Path
from tempfile import TemporaryDirectory

from finforce_eval.cli.parser import BAG_HELP, CommandResult, add_engine_options, add_run_options, read_engine
from finforce_eval.errors import OptionError
from finforce_eval.evaluation.batch import evaluate_many
from finforce_eval.evaluation.score_tables import evaluation_json, format_tables
from finforce_eval.evaluation.setup import make_setup

EXAMPLES = """examples:
  finforce evaluate BAG --calibration twin                             # as recorded, scored
  finforce evaluate BAG --from images --jaw my_finger.yaml --contact fixed:40
  finforce evaluate BAG... --contact estimate --object can.stl --json scores.json --report scores
  finforce evaluate BAG... --out kept --workers 0                      # resumes when run again"""


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the subcommand."""
    parser.add_argument("bags", nargs="+", metavar="BAG", help=BAG_HELP)
    add_run_options(parser)
    results = parser.add_argument_group("results")
    text = "skip the images that the nodes skip: nothing moved, or the object is out of reach"
    results.add_argument("--as-live", action="store_true", help=text)
    results.add_argument("--report", metavar="DIR", help="write a page with figures to this folder")
    text = "write a Parquet table of every recording (one row per image and jaw) and _manifest.jsonl, with which "
    text += "a killed run resumes; finforce report shows the tables, finforce compare compares two folders"
    results.add_argument("--out", metavar="DIR", help=text)
    add_engine_options(parser)


def run(options: argparse.Namespace) -> CommandResult:
    """Evaluate recordings: print the table, write the report; status 2 where one of them failed."""
    setup, engine = make_setup(options), read_engine(options)
    if engine.scheduler and not options.out:
        raise OptionError(f"--scheduler {engine.scheduler}: expected --out DIR, too, which all workers see")
    with ExitStack() as stack:
        folder = Path(options.out or stack.enter_context(TemporaryDirectory(prefix="finforce_")))
        evaluation, failed = evaluate_many(options, engine, folder)
    for name, error in failed.items():
        print(f"failed: {error if name in error else f'{name}: {error}'}", file=sys.stderr)
    print(format_tables(evaluation))
    if options.report:
        from finforce_eval.figures.report import write_overview

        print(f"Report: {write_overview(evaluation, options.report, about=setup.about)}")
    more = {"failed": failed} if failed else {}
    return CommandResult(evaluation_json(evaluation, **more, **setup.about), status=2 if failed else 0)
