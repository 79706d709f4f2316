"""What the launch files share: the arguments of every system, and an action per process or included file."""

from __future__ import annotations

import os
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any, TypeVar

from finforce.errors import MissingDependencyError
from finforce.systems.processes import DEPTHS, SINGLE_THREAD, Include, Process

OptionsT = TypeVar("OptionsT")


NONE = "none"  # on a command line, where an empty text cannot be given
SWITCH = ("true", "false", "True", "False")


def solver_arguments(*, images: str = "false", parameter_file: str = NONE, use_sim_time: str = "false") -> list[Any]:
    """Return the launch arguments of every system with solvers; the defaults are those of its launch file."""
    from launch.substitutions import LaunchConfiguration

    return [
        _text("jaw_file", "Jaw file or name of a shipped jaw; none: bench"),
        _text("calibration_file", "Calibration file or name of a shipped calibration; none: material of the jaw file"),
        _text("contact_height", "Height of first touch above the clamped base [m]; nan: contacts come by topic", "nan"),
        _text("object_mesh", "Mesh file of the object, from which contacts are estimated"),
        _text("object_mesh_unit", "Unit of the mesh file: m, cm, mm or inch"),
        _text("contact", "Contact estimation: estimate, paper (Algorithm 1) or closest"),
        _text("pose_source", "Source of object poses: topic, detections or tracker"),
        _text("pose_topic", "Topic of object poses from another program; none: object_pose, object_detections"),
        _text("pose_origin", "Origin of these poses in the object: mesh, middle or added"),
        _switch("images", "Detection of key points in camera images; false: key points come by topic", images),
        _text("finder", "Former name of detection_method, for one release"),
        _text("detection_method", "network, frame (DeepLabCut) or dots", LaunchConfiguration("finder")),
        _text("model", "Folder of a network"),
        _choice(
            "depth", "Depth images: aligned (every image needs one), auto (where there is one), off", (NONE, *DEPTHS)
        ),
        _text("T_gripper_camera", "Pose of the camera in the gripper frame: x y z [m] qx qy qz qw"),
        _text("solver", "Mechanics: reduced, solid, frame, linear or paper (Eq. 1)"),
        _text("mesh", "Mesh density: default, coarse or fine"),
        _text("parameter_file", "YAML file with node parameters", parameter_file),
        _switch("use_sim_time", "Time from /clock", use_sim_time),
        _switch("composed", "Detector, contact estimator and solvers in one process; false: one process each", "true"),
        _switch("rviz", "RViz with the markers"),
    ]


def gripper_arguments() -> list[Any]:
    """Return the launch arguments of every system with a gripper."""
    port = "Serial port of the CAN adapter, or CAN channel; none: from the parameter file, with sim a temporary one"
    return [
        _text("gripper_port", port),
        _text("gripper_interface", "slcan for a serial CAN adapter, or an interface of python-can, such as socketcan"),
        _switch("sim", "Simulation: an emulated gripper, with the synthetic twin as its camera"),
    ]


def stack_arguments() -> list[Any]:
    """Return the launch arguments of the gripper in a manipulation stack."""
    return [
        _text("description", "xacro or URDF file of the robot; none: the gripper alone"),
        _text("semantics", "SRDF file of the robot, for MoveIt; none: that of the gripper"),
        _text("controllers", "YAML file of the controllers; none: those of the gripper"),
        _switch("gripper", "Start of the gripper driver", "true"),
        _text("gripper_port", "Serial port of the CAN adapter, or CAN channel"),
        _text("gripper_interface", "slcan for a serial CAN adapter, or an interface of python-can, such as socketcan"),
        _text("parameter_file", "YAML file with driver parameters"),
        _switch("sim", "Simulation: an emulated gripper in place of hardware"),
    ]


def _text(name: str, description: str, default: Any = NONE) -> Any:
    """Return a launch argument of any text."""
    from launch.actions import DeclareLaunchArgument

    return DeclareLaunchArgument(name, default_value=default, description=description)


def _choice(name: str, description: str, choices: Sequence[str]) -> Any:
    """Return a launch argument of one of several words, the first by default."""
    from launch.actions import DeclareLaunchArgument

    return DeclareLaunchArgument(name, default_value=choices[0], choices=choices, description=description)


def _switch(name: str, description: str, default: str = "false") -> Any:
    """Return a launch argument that is true or false."""
    from launch.actions import DeclareLaunchArgument

    return DeclareLaunchArgument(name, default_value=default, choices=SWITCH, description=description)


def options_from_texts(record: type[OptionsT], texts: Mapping[str, str]) -> OptionsT:
    """Return an options record from launch arguments, each turned into the type of its default.

    Raises:
        ValueError: a text is no such value.
    """
    return record(**{entry.name: _value(entry.name, texts[entry.name], entry.default) for entry in fields(record)})


def _value(name: str, text: str, default: Any) -> Any:
    """Turn one text into the type of a default; "none" is an empty text, and no number."""
    if isinstance(default, bool):
        if text not in SWITCH:
            raise ValueError(f"{name}:={text}: expected true or false")
        return text.lower() == "true"
    if text == NONE and isinstance(default, str | float):
        return type(default)("" if isinstance(default, str) else "nan")
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
        text = _missing(part.package, part.advice)
        if isinstance(part, Process) and part.optional:
            return LogInfo(msg=text)
        raise MissingDependencyError(text)
    return _node_action(part) if isinstance(part, Process) else _include_action(part, folder)


def find_share(package: str) -> Path | None:
    """Return the share folder of a ROS package, None where it is not installed."""
    from ament_index_python.packages import PackageNotFoundError, get_package_share_directory

    try:
        return Path(get_package_share_directory(package))
    except PackageNotFoundError:
        return None


def _missing(package: str, advice: str) -> str:
    """Say that a package is missing, and what would do."""
    archive = f"ros-{os.environ.get('ROS_DISTRO', 'jazzy')}-{package.replace('_', '-')}"
    return f"{package} is not installed: sudo apt install {archive}" + (f"; {advice}" if advice else "")


def _node_action(process: Process) -> Any:
    """Return the launch_ros action of a process."""
    from launch.actions import Shutdown
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
        output="screen",
        parameters=[*files, values] if values else files,
        remappings=list(process.remappings.items()),
        arguments=list(process.arguments),
        additional_env=SINGLE_THREAD,
        on_exit=Shutdown(reason=f"{process.name or process.executable} has ended") if process.ends_all else None,
    )


def _include_action(part: Include, folder: Path) -> Any:
    """Return the action that includes a launch file, with its own arguments and none of ours.

    Raises:
        MissingDependencyError: a program that it calls is not on the path.
    """
    from launch.actions import GroupAction, IncludeLaunchDescription, SetEnvironmentVariable
    from launch.launch_description_sources import PythonLaunchDescriptionSource

    for program in part.programs:
        if shutil.which(program) is None:
            raise MissingDependencyError(_missing(program, part.advice))
    source = PythonLaunchDescriptionSource(str(folder / "launch" / part.file))
    environment = [SetEnvironmentVariable(name, value) for name, value in part.environment.items()]
    included = IncludeLaunchDescription(source, launch_arguments=list(part.arguments.items()))
    return GroupAction([*environment, included], scoped=True, forwarding=False)
