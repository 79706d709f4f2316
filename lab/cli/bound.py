"""`finforce bound`: the force error in recordings over the Cramér-Rao bound."""

from __future__ import annotations

import argparse

from finforce_eval.cli.parser import BAG_HELP, CommandResult, add_run_options
from finforce_eval.evaluation.keypoint_source import parse_source
from finforce_eval.evaluation.setup import make_setup, read_recordings
from lab.bound import compare
from lab.harness import figures_json, format_figures


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the subcommand."""
    parser.add_argument("bags", nargs="+", metavar="BAG", help=BAG_HELP)
    add_run_options(parser)


def run(options: argparse.Namespace) -> CommandResult:
    """Evaluate the recordings, print error and bound."""
    setup, source = make_setup(options), parse_source(options)
    read = [source.apply(each) for each in read_recordings(options.bags, source)]
    figures = compare(read, setup)
    print(format_figures(figures))
    return CommandResult({"bound": figures_json(figures)})
