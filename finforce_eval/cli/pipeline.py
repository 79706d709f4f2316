"""`finforce pipeline`: from a camera's images to the grasp force in one process, without a launch file."""

from __future__ import annotations

import argparse
from dataclasses import dataclass, fields, replace
from pathlib import Path

from finforce.optional import import_ros
from finforce.settings import setting
from finforce.systems.launch import options_from_words
from finforce.systems.processes import GripperOptions, Process, ReplayOptions, finish, merge, replay_processes
from finforce.systems.setups import gripper_process
from finforce_eval.cli.parser import CommandResult
from finforce_eval.errors import OptionError


@dataclass(frozen=True, kw_only=True)
class _PipelineOptions(ReplayOptions, GripperOptions):
    """Options of the command: those of the launch files that concern our nodes."""

    jaws: str = setting("both", "Jaws in the images", choices=("left", "right", "both"))
    images: bool = True
    use_sim_time: bool = False
    gripper: bool = False


OTHER = ("bag", "rate", "rviz", "sim", "composed")  # of launch files, which start other programs, too


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the subcommand."""
    names = ", ".join(entry.name for entry in fields(_PipelineOptions) if entry.name not in OTHER)
    text = f"argument as of the launch files, such as object_mesh:=can.stl: {names}. gripper:=true includes the driver"
    parser.add_argument("words", nargs="*", metavar="NAME:=VALUE", help=text)


def pipeline_process(words: list[str]) -> Process:
    """Return the process that words such as `object_mesh:=can.stl` ask for.

    Raises:
        OptionError: a word names no option, or its value is none.
    """
    try:
        options = options_from_words(_PipelineOptions, words, without=OTHER)
        processes = replay_processes(replace(options, composed=False), Path())
    except ValueError as error:
        raise OptionError(str(error)) from error
    driver = finish([gripper_process(options)], replace(options, composed=False)) if options.gripper else []
    return merge([*processes, *driver])


def run(options: argparse.Namespace) -> CommandResult:
    """Run the process until Ctrl-C; its exit status is that of the command."""
    process = pipeline_process(options.words)
    status = import_ros("finforce.ros.composition", "the pipeline").main([*process.arguments, "--ros-args"])
    return CommandResult({"processes": [process.executable]}, status=status)
