"""Launch descriptions of systems: one argument per option, one action per process; knows no system."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import MISSING, fields
from pathlib import Path
from typing import Any, TypeVar

from finforce_graph import SINGLE_THREAD, Process

OptionsT = TypeVar("OptionsT")


def options_from_texts(record: type[OptionsT], texts: Mapping[str, str]) -> OptionsT:
    """Return an options record from launch arguments, each turned into the type of its default.

    Raises:
        ValueError: a text is no such value.
    """
    values = {entry.name: _value(entry.name, texts[entry.name], entry.default) for entry in fields(record)}
    return record(**values)


def _value(name: str, text: str, default: Any) -> Any:
    """Turn one text into the type of a default."""
    if isinstance(default, bool):
        if text.lower() not in ("true", "false"):
            raise ValueError(f"{name}:={text}: expected true or false")
        return text.lower() == "true"
    try:
        return type(default)(text)
    except ValueError:
        raise ValueError(f"{name}:={text}: expected a {type(default).__name__}") from None


def describe_launch(
    record: type[OptionsT], build: Callable[[OptionsT, Path], Sequence[Process]], share: Path, **defaults: str
) -> Any:
    """Return a launch description: one argument per field of the record, one action per process.

    Args:
        record: the options dataclass.
        build: options and share folder to processes.
        share: folder that holds `config` and `rviz`.
        defaults: of arguments, in place of the record's.
    """
    from launch import LaunchDescription
    from launch.actions import DeclareLaunchArgument, OpaqueFunction

    arguments = [
        DeclareLaunchArgument(
            entry.name,
            default_value=defaults.get(entry.name, str(entry.default)),
            description=entry.metadata["description"],
        )
        for entry in fields(record)
        if entry.default is not MISSING
    ]

    def start(context: Any) -> list[Any]:
        options = options_from_texts(record, context.launch_configurations)
        return [_launch_action(process) for process in build(options, share)]

    return LaunchDescription([*arguments, OpaqueFunction(function=start)])


def _launch_action(process: Process) -> Any:
    """Return the launch_ros action of a process."""
    from launch.actions import Shutdown
    from launch_ros.actions import Node

    files = [process.parameter_file] if process.parameter_file else []
    return Node(
        package=process.package,
        executable=process.executable,
        name=process.name,
        output="screen",
        parameters=[*files, dict(process.parameters)],
        remappings=list(process.remappings.items()),
        arguments=list(process.arguments),
        additional_env=SINGLE_THREAD,
        on_exit=Shutdown(reason=f"{process.name} has ended") if process.ends_all else None,
    )
