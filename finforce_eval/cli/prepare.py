"""`finforce prepare`: do ahead of time what a first start would have to wait for."""

from __future__ import annotations

import argparse

from finforce_eval.preparation import COMPILED, prepare
from finforce_eval.tasks import progress_bar


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the subcommand."""
    text = "jaw files or names of included jaws (bench)"
    parser.add_argument("jaws", nargs="*", default=["bench"], metavar="JAW", help=text)
    text = "calibration file, or name of an included one (materials of the jaw files)"
    parser.add_argument("--calibration", default="", metavar="FILE", help=text)


def run(options: argparse.Namespace) -> None:
    """Compile and build under a progress bar."""
    count = len(COMPILED) + len(options.jaws)
    with progress_bar(count, "part", "preparing") as bar:
        for done in prepare(options.jaws, options.calibration):
            bar.update()
            bar.write(done)
