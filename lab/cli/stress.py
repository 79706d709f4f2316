"""The subcommand `stress`: families in, table, JSON, page and exit status out."""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from tqdm import tqdm

from finforce_eval.cli.parser import MESHES, SOLVERS, whole_number
from finforce_eval.errors import OptionError
from finforce_eval.machine import describe_machine, write_figures
from lab.stress.stress import (
    Family,
    Plan,
    Trial,
    find_families,
    format_summaries,
    run_family,
    summarise_family,
    summarise_levels,
)

WORST = 5


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the subcommand."""
    parser.add_argument("--families", metavar="A,B", help="families of trials, all without; a wrong one lists them")
    parser.add_argument(
        "--count",
        type=whole_number(1, 10_000_000),
        metavar="N",
        help="trials per family; without, as many as each takes",
    )
    parser.add_argument("--seed", type=whole_number(0, 2**32), default=0, help="of everything that is drawn (0)")
    parser.add_argument("--solver", default="default", choices=SOLVERS, help="model and objective")
    parser.add_argument("--mesh", default="default", choices=MESHES, help="mesh density")
    text = "shipped jaw or jaw file of the families about key points and places (bench)"
    parser.add_argument("--jaw", default="bench", metavar="FILE", help=text)
    parser.add_argument("--json", metavar="OUT", help="write the figures as JSON")
    parser.add_argument("--report", metavar="DIR", help="write a page with every family by level")


def choose_families(names: str | None, known: Mapping[str, Family]) -> list[Family]:
    """Return the families of a comma-separated list, all without one.

    Raises:
        OptionError: A name is not known.
    """
    chosen = list(known) if not names else [name.strip() for name in names.split(",")]
    for name in chosen:
        if name not in known:
            raise OptionError(f"--families {name}: expected one of {', '.join(known)}")
    return [known[name] for name in chosen]


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


def write_page(
    folder: Path, summaries: Sequence[Mapping[str, Any]], trials: Mapping[str, Sequence[Trial]], what: Mapping[str, str]
) -> None:
    """Write `stress.md`: the table, then each family by level with its worst trials."""
    folder.mkdir(parents=True, exist_ok=True)
    lines = ["# Numerical stress", "", format_summaries(summaries), ""]
    for summary in summaries:
        name = summary["name"]
        lines += [f"## {name}", "", f"{what[name]}.", ""]
        lines += [f"- **broken:** {words}" for words in summary["broken"]] + [""] * bool(summary["broken"])
        lines += [format_summaries(summarise_levels(trials[name]), "level"), ""]
        lines += [f"- {describe_trial(trial)}" for trial in worst_trials(trials[name])] + [""]
    (folder / "stress.md").write_text("\n".join(lines), encoding="utf-8")


def describe_trial(trial: Trial) -> str:
    """Return a trial in one line."""
    error = f"error {trial.force_error:.3g} N, stated {trial.stddev:.3g} N, {trial.sigmas:.1f} sigma"
    return f"seed {trial.seed}, {trial.level}: {trial.outcome}, {error}{'; ' + trial.note if trial.note else ''}"


def run(options: argparse.Namespace) -> int:
    """Run the families, print the table, write what was asked for.

    Returns:
        0; 1 when a rule is broken by a family that it is asked of.
    """
    families = choose_families(options.families, find_families())
    plan = Plan(seed=options.seed, solver=options.solver, mesh=options.mesh, count=options.count, jaw=options.jaw)
    trials = run_families(families, plan)
    summaries = [summarise_family(family, trials[family.name]) for family in families]
    print(format_summaries(summaries))
    for summary in summaries:
        for words in summary["broken"]:
            print(f"broken: {summary['name']}: {words}")
            print("\n".join(f"  {describe_trial(trial)}" for trial in worst_trials(trials[summary["name"]])))
    if options.json:
        write_figures(options.json, {"plan": asdict(plan), "families": collect_figures(summaries, trials)})
    if options.report:
        write_page(Path(options.report), summaries, trials, {family.name: family.what for family in families})
    machine = describe_machine()
    print(f"seed {plan.seed}, solver {plan.solver}, {machine['processor']}, {machine['commit']}")
    ruled = {family.name for family in families if family.ruled}
    return int(any(summary["broken"] for summary in summaries if summary["name"] in ruled))


def collect_figures(summaries: Sequence[Mapping[str, Any]], trials: Mapping[str, Sequence[Trial]]) -> dict[str, Any]:
    """Return families, their levels and worst trials as JSON has them."""
    return {
        summary["name"]: {
            **summary,
            "levels": summarise_levels(trials[summary["name"]]),
            "worst": [asdict(trial) for trial in worst_trials(trials[summary["name"]])],
        }
        for summary in summaries
    }
