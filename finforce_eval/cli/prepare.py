"""`finforce prepare`: do ahead of time what a first start would have to wait for."""

from __future__ import annotations

import argparse

from tqdm import tqdm

from finforce.caches import note_prepared
from finforce_eval.preparation import list_tasks, run_tasks

WORDS = {
    "compile_solver": "solver compiled",
    "build_equilibria": "equilibria stored",
    "compile_contact": "contact estimator compiled",
    "compile_detector": "detector compiled",
}


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the subcommand."""
    text = "jaw files, or shipped names, whose equilibria are built (bench)"
    parser.add_argument("jaws", nargs="*", default=["bench"], metavar="JAW", help=text)
    text = "calibration of the fingers, a file or a shipped name; without it the jaw files' own materials"
    parser.add_argument("--calibration", default="", metavar="FILE", help=text)


def run(options: argparse.Namespace) -> None:
    """Compile and build under a progress bar."""
    tasks = list_tasks(options.jaws, options.calibration)
    with tqdm(total=len(tasks), desc="preparing", unit="part", disable=None, leave=False) as bar:
        for name in run_tasks(tasks):
            bar.update()
            bar.write(WORDS[name])
    note_prepared()
