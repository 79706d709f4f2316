"""Launch arguments of every system, and an action per process or included file."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import Field, fields
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

from finforce.errors import MissingDependencyError, suggest
from finforce.settings import check_bounds, describe
from finforce.systems.processes import RESPAWN_DELAY, SINGLE_THREAD, UNUSABLE, Include, Process

OptionsT = TypeVar("OptionsT")


NONE = "none"  # on a command line, where an empty text cannot be given; not of an option that has it as a value
SWITCH = ("true", "false", "True", "False")


def describe_system(
    record: type[OptionsT], processes: Callable[[OptionsT, Path], Sequence[Process | Include]], share: Path, **own: str
) -> Any:
    """Return the launch description of a system: an argument for every option, and an action for every process.

    Args:
        record: the options.
        processes: makes of options, and of the share folder, what is to be started.
        share: folder with the configuration.
        own: defaults of the launch file in place of the record's.
    """
    from launch import LaunchDescription
    from launch.actions import OpaqueFunction

    def start(context: Any) -> list[Any]:
        options = options_from_texts(record, context.launch_configurations)
        return [launch_action(part) for part in processes(options, share)]

    arguments = [_argument_of(entry, own.get(entry.name)) for entry in fields(record)]
    return LaunchDescription([*arguments, OpaqueFunction(function=start)])


def _argument_of(entry: Field, default: str | None) -> Any:
    """Return the launch argument of an option."""
    from launch.actions import DeclareLaunchArgument

    choices = SWITCH if isinstance(entry.default, bool) else entry.metadata.get("choices")
    some = {"choices": [str(word) or NONE for word in choices]} if choices else {}
    default = default or default_text(entry)
    return DeclareLaunchArgument(entry.name, default_value=default, description=describe(entry), **some)


def default_text(entry: Field) -> str:
    """Return the default of an option as an argument has it."""
    return (str(entry.default).lower() if isinstance(entry.default, bool) else str(entry.default)) or NONE


def options_from_words(record: type[OptionsT], words: Sequence[str], without: Sequence[str] = ()) -> OptionsT:
    """Return an options record from words such as `object_mesh:=can.stl`.

    Args:
        record: the options.
        words: of a command line.
        without: names of options that cannot be given.

    Raises:
        ValueError: a word names no option, or its value is none.
    """
    known = {entry.name: entry for entry in fields(record) if entry.name not in without}
    texts = {entry.name: default_text(entry) for entry in fields(record)}
    for word in words:
        name, given, text = word.partition(":=")
        if name not in known:
            raise ValueError(f"{name!r} is not an option: {suggest(name, known)}")
        if not given:
            raise ValueError(f"{word!r}: expected {name}:=VALUE")
        texts[name] = text
    return options_from_texts(record, texts)


def options_from_texts(record: type[OptionsT], texts: Mapping[str, str]) -> OptionsT:
    """Return an options record from launch arguments, each turned into the type of its default.

    Raises:
        ValueError: a text is no such value.
    """
    options = record(**{entry.name: _value(entry, texts[entry.name]) for entry in fields(record)})
    check_bounds(options, ValueError)
    return options


def _value(entry: Field, text: str) -> Any:
    """Turn one text into the type of a default; "none" is an empty text, and no number, unless it is a choice."""
    name, default = entry.name, entry.default
    if isinstance(default, bool):
        if text not in SWITCH:
            raise ValueError(f"{name}:={text}: expected true or false")
        return text.lower() == "true"
    if text == NONE and NONE not in entry.metadata.get("choices", ()) and isinstance(default, str | float):
        return type(default)("" if isinstance(default, str) else "nan")
    if text.startswith("~/") and not name.endswith("_topic"):  # of a topic it is the node's own name
        text = os.path.expanduser(text)  # shells leave it as it is after :=
    try:
        return type(default)(text)
    except ValueError:
        raise ValueError(f"{name}:={text}: expected a {type(default).__name__}") from None


def launch_action(part: Process | Include) -> Any:
    """Return the action that starts a process or includes a file, a line where an optional one cannot be started.

    Raises:
        MissingDependencyError: a package that is needed is not installed.
    """
    from launch.actions import LogInfo

    folder = find_share(part.package)
    if folder is None:
        text = missing(part.package, part.advice)
        if isinstance(part, Process) and part.optional:
            return LogInfo(msg=text)
        raise MissingDependencyError(text)
    return _node_action(part) if isinstance(part, Process) else _include_action(part, folder)


def find_share(package: str) -> Path | None:
    """Return the share folder of a ROS package, None where it is not installed."""
    try:
        from ament_index_python.packages import get_package_share_directory

        return Path(get_package_share_directory(package))
    except (ImportError, LookupError, OSError):  # no ROS, no such package, no ROS that is sourced
        return None


def missing(package: str, advice: str) -> str:
    """Say that a package is missing, and what would do."""
    archive = f"ros-{os.environ.get('ROS_DISTRO', 'jazzy')}-{package.replace('_', '-')}"
    return f"{package} is not installed: sudo apt install {archive}" + (f"; {advice}" if advice else "")


def _node_action(process: Process) -> Any:
    """Return the launch_ros action of a process."""
    from launch_ros.actions import Node
    from launch_ros.parameter_descriptions import ParameterValue

    files = [process.parameter_file] if process.parameter_file else []
    # else a text that reads as a number, or as YAML, would no longer be a text
    values = {
        name: ParameterValue(value, value_type=str) if isinstance(value, str) else value
        for name, value in process.parameters.items()
    }
    return Node(
        package=process.package,
        executable=process.executable,
        name=process.name or None,
        namespace=process.namespace or None,
        output="screen",
        parameters=[*files, values] if values else files,
        remappings=list(process.remappings.items()),
        arguments=list(process.arguments),
        additional_env=SINGLE_THREAD,
        respawn=process.respawns,
        respawn_delay=RESPAWN_DELAY,
        on_exit=partial(_on_exit, process),
    )


def _on_exit(process: Process, event: Any, _: Any) -> Any:
    """Return the action that ends all after a process that does so, or whose settings cannot be used; else nothing."""
    from launch.actions import Shutdown

    is_end = process.ends_all or event.returncode == UNUSABLE
    return Shutdown(reason=f"{process.label} ended with status {event.returncode}") if is_end else None


def _include_action(part: Include, folder: Path) -> Any:
    """Return the action that includes a launch file, with its own arguments and none of ours.

    Raises:
        MissingDependencyError: a program that it calls is not on the path.
    """
    from launch.actions import GroupAction, IncludeLaunchDescription, SetEnvironmentVariable
    from launch.launch_description_sources import PythonLaunchDescriptionSource

    for program in part.programs:
        if shutil.which(program) is None:
            raise MissingDependencyError(missing(program, part.advice))
    source = PythonLaunchDescriptionSource(str(folder / "launch" / part.file))
    environment = [SetEnvironmentVariable(name, value) for name, value in part.environment.items()]
    included = IncludeLaunchDescription(source, launch_arguments=list(part.arguments.items()))
    return GroupAction([*environment, included], scoped=True, forwarding=False)
