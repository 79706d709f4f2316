"""What the launch files share: the arguments of every system, and an action per process or included file."""

from __future__ import annotations

import os
import shutil
from collections.abc import Mapping
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
    from launch.actions import DeclareLaunchArgument as Argument

    own = "none: the node's own"
    return [
        Argument("jaw_file", default_value=NONE, description=f"jaw file, or the name of a shipped jaw; {own}, bench"),
        Argument("calibration_file", default_value=NONE, description="calibration file, or a shipped name"),
        Argument(
            "contact_height",
            default_value="nan",
            description="height of first touch above the clamped base [m]; nan: contacts come by topic",
        ),
        Argument("object_mesh", default_value=NONE, description="mesh file of the object; contacts are then estimated"),
        Argument("object_mesh_unit", default_value=NONE, description="unit of the mesh file: m, cm, mm or inch"),
        Argument("contact", default_value=NONE, description="contact by: estimate, paper (Algorithm 1) or closest"),
        Argument("pose_source", default_value=NONE, description="object poses: topic, detections or tracker"),
        Argument(
            "pose_topic",
            default_value=NONE,
            description="where other programs publish them, as /pose_estimation/output; "
            "none: object_pose, object_detections",
        ),
        Argument("pose_origin", default_value=NONE, description="what those are of: mesh, middle or added"),
        Argument(
            "images",
            default_value=images,
            choices=SWITCH,
            description="find the key points in images of a camera; else they come by topic",
        ),
        Argument("detection_method", default_value=NONE, description="network, frame (DeepLabCut) or dots"),
        Argument("model", default_value=NONE, description="folder of a network"),
        Argument(
            "depth",
            default_value=NONE,
            choices=(NONE, *DEPTHS),
            description="aligned: every colour image needs its depth; auto: where there is some; off: colour alone",
        ),
        Argument(
            "T_gripper_camera", default_value=NONE, description="camera in the gripper's frame: x y z [m] qx qy qz qw"
        ),
        Argument("solver", default_value=NONE, description="mechanics: reduced, solid, frame, linear or paper (Eq. 1)"),
        Argument("mesh", default_value=NONE, description="mesh density: default, coarse or fine"),
        Argument("parameter_file", default_value=parameter_file, description="YAML file with parameters of the nodes"),
        Argument("use_sim_time", default_value=use_sim_time, choices=SWITCH, description="take the time from /clock"),
        Argument(
            "composed",
            default_value="true",
            choices=SWITCH,
            description="detector, contact estimator and solvers in one process; false: each in its own",
        ),
        Argument("rviz", default_value="false", choices=SWITCH, description="show the markers in RViz"),
    ]


def gripper_arguments() -> list[Any]:
    """Return the launch arguments of every system with a gripper."""
    from launch.actions import DeclareLaunchArgument as Argument

    return [
        Argument(
            "gripper_port",
            default_value=NONE,
            description="port of the gripper's CAN adapter, or the CAN channel; none: that of the parameter file, "
            "or, with sim:=true, one in the temporary folder",
        ),
        Argument(
            "gripper_interface",
            default_value=NONE,
            description="slcan: a serial CAN adapter; else python-can's name of one, as socketcan",
        ),
        Argument(
            "sim",
            default_value="false",
            choices=SWITCH,
            description="no hardware: an emulated gripper bends the twin's jaws, and the twin is their camera",
        ),
    ]


def stack_arguments() -> list[Any]:
    """Return the launch arguments of the gripper in a manipulation stack."""
    from launch.actions import DeclareLaunchArgument as Argument

    return [
        Argument("description", default_value=NONE, description="xacro or URDF file of the robot; none: the gripper"),
        Argument("semantics", default_value=NONE, description="its SRDF file, for MoveIt; none: that of the gripper"),
        Argument("controllers", default_value=NONE, description="YAML file of controllers; none: the gripper's"),
        Argument("gripper", default_value="true", choices=SWITCH, description="drive the gripper"),
        Argument("gripper_port", default_value=NONE, description="port of the CAN adapter, or the CAN channel"),
        Argument("gripper_interface", default_value=NONE, description="slcan, or python-can's name, as socketcan"),
        Argument("parameter_file", default_value=NONE, description="YAML file with parameters of the driver"),
        Argument("sim", default_value="false", choices=SWITCH, description="an emulated gripper, no hardware"),
    ]


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
