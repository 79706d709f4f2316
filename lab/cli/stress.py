"""The subcommand `stress`: families in, table, JSON and exit status out."""

from __future__ import annotations

import argparse
import secrets
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

from tqdm import tqdm

from finforce_eval.cli.parser import MESHES, SOLVERS, CommandResult, whole_number
from finforce_eval.machine import describe_machine
from lab.harness import choose_names
from lab.stress import friction, inputs, objects, regrasp
from lab.stress.stress import (
    AXES,
    Family,
    Plan,
    Trial,
    format_summaries,
    run_family,
    summarise_family,
    summarise_levels,
)

WORST, WORST_OF_LEVEL = 5, 2
LARGEST_SEED, NEW = 2**32, "new"
FAMILIES = {
    family.name: family for family in (*inputs.FAMILIES, *friction.FAMILIES, *objects.FAMILIES, *regrasp.FAMILIES)
}


def read_seed(text: str) -> int:
    """Return an option as a seed; one that is drawn for `new`."""
    return secrets.randbelow(LARGEST_SEED) if text == NEW else whole_number(0, LARGEST_SEED)(text)


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the subcommand."""
    parser.add_argument("--families", metavar="A,B", help="families of trials (all); an unknown one lists them")
    parser.add_argument(
        "--count",
        type=whole_number(1, 10_000_000),
        metavar="N",
        help="trials per family (the default of each)",
    )
    text = "seed of the trials (0); new: a random one, which is printed"
    parser.add_argument("--seed", type=read_seed, default=0, metavar="N|new", help=text)
    parser.add_argument("--solver", default="default", choices=SOLVERS, help="mechanics of the solver")
    parser.add_argument("--mesh", default="default", choices=MESHES, help="mesh density")
    parser.add_argument("--jaw", default="bench", metavar="FILE", help="jaw file, or name of an included jaw (bench)")


def run_families(families: Sequence[Family], plan: Plan) -> dict[str, list[Trial]]:
    """Return the trials by family, under a progress bar."""
    trials = {}
    with tqdm(families, disable=None, leave=False) as bar:
        for family in bar:
            bar.set_description(family.name)
            trials[family.name] = run_family(family, plan)
    return trials


def worst_trials(trials: Sequence[Trial]) -> list[Trial]:
    """Return the trials that a reader wants to run again: crashed, hung, not finite, and the farthest sure ones."""
    defects = [t for t in trials if t.nan or t.outcome in ("crashed", "hung")]
    sure = sorted((t for t in trials if t.sure and t.sigmas > 0), key=lambda t: -t.sigmas)
    return (defects + [t for t in sure if t not in defects])[:WORST]


def list_broken(summary: Mapping[str, Any], trials: Sequence[Trial]) -> list[str]:
    """Return a line for every rule that a family breaks, or one of its levels by itself, with the worst trials."""
    lines = []
    for number, part in enumerate((summary, *summarise_levels(trials))):
        name, own, most = summary["name"], trials, WORST
        if number:
            own = [trial for trial in trials if trial.level == part["name"]]
            name, most = f"{name}, {part['name']}", WORST_OF_LEVEL
        lines += [f"broken: {name}: {words}" for words in part["broken"]]
        lines += [f"  {describe_trial(trial)}" for trial in worst_trials(own)[:most] if part["broken"]]
    return lines


def describe_trial(trial: Trial) -> str:
    """Return a trial in one line."""
    errors = zip(AXES, trial.errors, trial.stated, strict=False)
    words = ", ".join(f"{axis} {error:.3g} ± {stated:.2g}" for axis, error, stated in errors)
    notes = "; ".join(filter(None, (f"{trial.sigmas:.1f} sigma", words, trial.note)))
    return f"seed {trial.seed}, {trial.level}: {trial.outcome}, {notes}"


def run(options: argparse.Namespace) -> CommandResult:
    """Run the families, print the table.

    Returns:
        The figures, and status 0; 1 when a rule is broken by a family that it is asked of, or by one of its levels.
    """
    families = [FAMILIES[name] for name in choose_names("--families", options.families, FAMILIES)]
    plan = Plan(seed=options.seed, solver=options.solver, mesh=options.mesh, count=options.count, jaw=options.jaw)
    machine = describe_machine()
    print(f"seed {plan.seed}, jaw {plan.jaw}, solver {plan.solver}, {machine['processor']}, {machine['commit']}")
    trials = run_families(families, plan)
    summaries = [summarise_family(family, trials[family.name]) for family in families]
    print(format_summaries(summaries))
    broken = {summary["name"]: list_broken(summary, trials[summary["name"]]) for summary in summaries}
    print("\n".join(line for lines in broken.values() for line in lines))
    content = {"plan": asdict(plan), "tables": {"families": format_summaries(summaries)}}
    content["families"] = {
        summary["name"]: {
            **summary,
            "levels": summarise_levels(trials[summary["name"]]),
            "worst": [asdict(trial) for trial in worst_trials(trials[summary["name"]])],
        }
        for summary in summaries
    }
    status = int(any(broken[family.name] for family in families if family.ruled))
    return CommandResult(content, status=status)
