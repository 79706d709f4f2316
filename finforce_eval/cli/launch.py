"""The subcommand `launch`: the systems of the launch files, from wheels alone."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import fields
from pathlib import Path
from shutil import which

from finforce.errors import MissingDependencyError
from finforce.settings import describe
from finforce.signals import StopSignals
from finforce.systems.launch import default_text, find_share, missing, options_from_words
from finforce.systems.processes import (
    BenchOptions,
    Include,
    Process,
    ReplayOptions,
    RobotOptions,
    replay_processes,
)
from finforce.systems.setups import bench_processes, robot_processes
from finforce_eval.cli.parser import CommandResult
from finforce_eval.errors import OptionError
from finforce_eval.replay.process_group import ProcessGroup

SYSTEMS = {
    "robot": (RobotOptions, robot_processes),
    "bench": (BenchOptions, bench_processes),
    "replay": (ReplayOptions, replay_processes),
}
EXAMPLES = """examples:
  finforce launch robot sim:=true                            # no hardware
  finforce launch robot camera:=false gripper_port:=/dev/ttyACM0 object_mesh:=can.stl
  finforce launch replay bag:=BAG images:=true contact_height:=0.040"""
_POLL = 0.2  # [s] between two looks at the processes


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the subcommand."""
    parser.add_argument("system", choices=SYSTEMS, help="robot: both jaws; bench: one jaw; replay: a recording")
    text = "argument of the launch file, such as sim:=true or object_mesh:=can.stl; lengths in metres"
    parser.add_argument("words", nargs="*", metavar="NAME:=VALUE", help=text)
    parser.add_argument("-s", "--show-args", action="store_true", help="list the arguments and their defaults")


def run(options: argparse.Namespace) -> CommandResult:
    """Run the processes of a system until Ctrl-C, or until its recording ends."""
    record, _ = SYSTEMS[options.system]
    if options.show_args:
        for entry in fields(record):
            print(f"{entry.name}:={default_text(entry)}\n    {describe(entry)}")
        return CommandResult({"arguments": {entry.name: default_text(entry) for entry in fields(record)}})
    processes = startable(list_parts(options.system, options.words))
    with StopSignals() as stop, ProcessGroup(processes, {}, quiet=False) as group:
        while not stop.wait(_POLL) and not group.has_finished():
            pass
    return CommandResult({"system": options.system, "arguments": options.words})


def list_parts(system: str, words: Sequence[str]) -> list[Process | Include]:
    """Return what a system starts, by words such as `sim:=true`.

    Raises:
        OptionError: a word names no argument, or its value cannot be used.
    """
    record, describe_parts = SYSTEMS[system]
    checkout, installed = Path(__file__).parents[2], Path(sys.prefix, "share", "finforce")
    share = checkout if (checkout / "config").is_dir() else installed
    try:
        return describe_parts(options_from_words(record, words), share)
    except ValueError as error:
        raise OptionError(str(error)) from error


def startable(parts: Sequence[Process | Include]) -> list[Process]:
    """Return the processes that can be started without ROS 2's launch; what is optional and missing is left out.

    Raises:
        MissingDependencyError: one that is needed is missing, or a launch file of another package is needed.
    """
    processes = []
    for part in parts:
        if isinstance(part, Include):
            raise MissingDependencyError(f"{part.package} needs ROS 2 from apt and `ros2 launch`; {part.advice}")
        if part.package == "finforce" or (which("ros2") and find_share(part.package)):
            processes.append(part)
        elif part.optional:
            print(f"note: {missing(part.package, part.advice)}", file=sys.stderr)
        else:
            raise MissingDependencyError(missing(part.package, part.advice))
    return processes
