"""`finforce ablation`: the estimator's rules switched off one at a time, on scenes that reach them or on recordings."""

from __future__ import annotations

import argparse

from finforce_eval.cli.parser import CommandResult
from finforce_eval.machine import describe_machine
from lab.ablation.rules import RULES
from lab.ablation.run import ablate
from lab.harness import choose_names, figures_json, format_figures


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the subcommand."""
    text = "rules to switch off, separated by semicolons (all); an unknown one lists them"
    parser.add_argument("--rules", metavar="A;B", help=text)
    text = "recordings with measured forces instead of the scenes that reach each rule"
    parser.add_argument("--recordings", nargs="+", default=[], metavar="BAG", help=text)
    text = "calibration of their finger (bench)"
    parser.add_argument("--calibration", default="bench", metavar="FILE", help=text)


def run(options: argparse.Namespace) -> CommandResult:
    """Switch off the rules, print the table."""
    known, machine = {rule.name: rule for rule in RULES}, describe_machine()
    rules = [known[name] for name in choose_names("--rules", options.rules, known, ";")]
    print(f"{machine['processor']}, {machine['commit']}")
    figures = ablate(rules, options.recordings, options.calibration)
    print(format_figures(figures))
    return CommandResult({"ablation": figures_json(figures)})
