"""`finforce ablation`: the estimator's rules switched off one at a time, on scenes that reach them or on recordings."""

from __future__ import annotations

import argparse
from collections.abc import Sequence

from finforce_eval.cli.parser import CommandResult
from finforce_eval.errors import OptionError
from finforce_eval.machine import describe_machine
from lab.ablation.rules import RULES, Rule
from lab.ablation.run import ablate
from lab.harness import figures_json, format_figures


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the subcommand."""
    text = "rules to switch off, separated by semicolons (all); an unknown one lists them"
    parser.add_argument("--rules", metavar="A;B", help=text)
    text = "recordings with measured forces instead of the scenes that reach each rule"
    parser.add_argument("--recordings", nargs="+", default=[], metavar="BAG", help=text)
    text = "calibration of their finger (bench)"
    parser.add_argument("--calibration", default="bench", metavar="FILE", help=text)


def choose_rules(names: str | None) -> Sequence[Rule]:
    """Return the rules of a list, all without one.

    Raises:
        OptionError: a name is not known.
    """
    known = {rule.name: rule for rule in RULES}
    chosen = [name.strip() for name in names.split(";")] if names else list(known)
    for name in chosen:
        if name not in known:
            raise OptionError(f"--rules {name}: expected some of {'; '.join(known)}")
    return [known[name] for name in chosen]


def run(options: argparse.Namespace) -> CommandResult:
    """Switch off the rules, print the table."""
    rules, machine = choose_rules(options.rules), describe_machine()
    print(f"{machine['processor']}, {machine['commit']}")
    figures = ablate(rules, options.recordings, options.calibration)
    print(format_figures(figures))
    return CommandResult({"ablation": figures_json(figures)})
