"""The subcommand `experiment`: the paper's experiments on the twin or on recordings of one's own."""

from __future__ import annotations

import argparse
from importlib import import_module
from pathlib import Path

from finforce_eval.cli.parser import SOURCES, CommandResult, add_engine_options, read_engine
from finforce_eval.errors import OptionError
from lab.experiments.experiment import PAGE, Experiment, RunOptions, run_experiment
from lab.harness import figures_json, format_figures

TWIN = "twin"
QUICK_SIZE = "320x240"


# what each does, and the module in which it stands under its name in capitals
EXPERIMENTS = {
    "places": ("Table II: value of knowing the contact location", "paper_tables"),
    "grasp": ("27 grasps: three objects, places and forces, both jaws; nine also with slow and late poses", "grasp"),
    "manipulation": ("a held weight of 100 g that is turned, in two lights", "manipulation"),
    "friction": ("the 27 grasps with a friction of 0.5, and nine of them with a probe", "friction"),
    "network": ("nine grasps in two lights against the paper's baseline network", "network"),
    "drawn": ("24 scenes over all that the twin can vary, drawn from the seed", "drawn"),
    "chip": ("an object that breaks at 5.43 N, grasped to 5 N by force, position and current", "chip"),
}


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the subcommand."""
    names = "; ".join(f"{name}: {text}" for name, (text, _) in EXPERIMENTS.items())
    parser.add_argument("name", choices=tuple(EXPERIMENTS), metavar="NAME", help=names)
    text = "twin, or recordings with measured forces (twin)"
    parser.add_argument("--on", nargs="+", default=[TWIN], metavar="twin|BAG", help=text)
    text = "output folder; finished cases there are not repeated (report)"
    parser.add_argument("--report", default="report", metavar="DIR", help=text)
    parser.add_argument("--quick", action="store_true", help="run few, short and small cases, in about two minutes")
    parser.add_argument("--from", dest="source", default="", choices=SOURCES, help="key points (images for the twin)")
    parser.add_argument("--jaw", default="bench", metavar="FILE", help="jaw file, or name of an included jaw (bench)")
    text = "calibration file, or name of an included one; empty: material of the jaw file (twin; none for recordings)"
    parser.add_argument("--calibration", metavar="FILE", help=text)
    parser.add_argument("--seed", type=int, default=100, help="seed of the first scene (100)")
    parser.add_argument("--size", metavar="WxH", help="size of the rendered images (640x480; 320x240 with --quick)")
    text = "checkpoint that lab.training.baseline wrote, for network"
    parser.add_argument("--network", default="", metavar="FILE", help=text)
    add_engine_options(parser)


def read_options(options: argparse.Namespace) -> RunOptions:
    """Return what the options of a command line say.

    Raises:
        OptionError: they contradict each other, or a number is out of its bounds.
    """
    bags = [bag for bag in options.on if bag != TWIN]
    if bags and len(bags) < len(options.on):
        raise OptionError(f"--on {' '.join(options.on)}: expected twin or recordings, not both")
    if options.seed < 0:
        raise OptionError(f"--seed {options.seed}: expected a number from 0")
    calibration = options.calibration
    return RunOptions(
        bags=tuple(bags),
        jaw=options.jaw,
        calibration=("" if bags else "twin") if calibration is None else calibration,
        source=options.source,
        seed=options.seed,
        size=options.size or (QUICK_SIZE if options.quick else RunOptions.size),
        quick=options.quick,
        network=options.network,
    )


def run(options: argparse.Namespace) -> CommandResult:
    """Run an experiment, print its tables, name its page."""
    _, module = EXPERIMENTS[options.name]
    experiment: Experiment = getattr(import_module(f"lab.experiments.{module}"), options.name.upper())
    report, chosen = Path(options.report), read_options(options)
    figures = run_experiment(experiment, chosen, report, read_engine(options))
    print(format_figures(figures))
    print(f"Page: {report / experiment.name / PAGE}")
    return CommandResult({experiment.name: figures_json(figures)})
