"""The subcommands `evaluate`, `calibrate` and `version`: options to records, calls, and print."""

from __future__ import annotations

import argparse

from finforce_eval.cli.parser import add_calibration, add_jaw_options, add_set, add_source_options
from finforce_eval.evaluation.machine import write_json
from finforce_eval.evaluation.setup import evaluate_all, make_setup, read_keypoints
from finforce_eval.evaluation.tables import evaluation_json, format_table


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the subcommand."""
    parser.add_argument("bags", nargs="+", metavar="BAG", help="rosbag2 folder, .mcap or .db3 file")
    add_jaw_options(parser)
    add_source_options(parser)
    add_calibration(parser)
    add_set(parser)
    parser.add_argument("--json", metavar="OUT", help="write the scores as JSON")
    parser.add_argument("--report", metavar="DIR", help="write pictures and a page that shows them")


def run(options: argparse.Namespace) -> None:
    """Evaluate recordings: print the table, write JSON and report."""
    setup = make_setup(options)
    recordings = read_keypoints(options)
    evaluation = evaluate_all(recordings, setup)
    print(format_table(evaluation))
    if options.json:
        write_json(options.json, evaluation_json(evaluation, **setup.about))
    if options.report:
        from finforce_eval.figures.report import write_report

        page = write_report(
            evaluation,
            options.report,
            keypoint_names=setup.jaw.keypoint_names,
            about=setup.about,
            recordings=recordings,
        )
        print(f"Report: {page}")
