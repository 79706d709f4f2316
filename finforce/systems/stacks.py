"""The gripper under ros2_control, and under MoveIt."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from finforce.files import read_yaml
from finforce.optional import import_library
from finforce.systems.parameter_file import check_sections
from finforce.systems.processes import NODES, Process, StackOptions, emulated_port, given

STATES = "gripper_driver/joint_states"  # of the driver, where joint_states are those of the whole robot
CONTROLLERS = ("joint_state_broadcaster", "finray_gripper_controller")


def control_processes(options: StackOptions, share: Path) -> list[Process]:
    """Return driver, ros2_control and its controllers, which start one after the other.

    Raises:
        MissingDependencyError: the description is a xacro file, and xacro is not installed.
    """
    model = describe(options.description or share / "urdf" / "finray_gripper_control.urdf.xacro")
    controllers = options.controllers or str(share / "config" / "ros2_control" / "controllers.yaml")
    return [
        *gripper_processes(options, share, {"joint_states": STATES}),
        _publisher(model),
        Process(
            package="controller_manager",
            executable="ros2_control_node",
            name="",
            parameter_file=controllers,
            remappings={"~/robot_description": "/robot_description"},
        ),
        Process(
            package="controller_manager",
            executable="spawner",
            name="",
            arguments=(*CONTROLLERS, "--param-file", controllers),
        ),
    ]


def moveit_processes(options: StackOptions, share: Path) -> list[Process]:
    """Return driver and move_group, which moves the jaws by the driver's own action.

    Raises:
        MissingDependencyError: the description is a xacro file, and xacro is not installed.
        FileError: the file of controllers cannot be read.
    """
    folder = share / "config" / "moveit"
    model = describe(options.description or share / "urdf" / "finray_gripper.urdf")
    semantics = describe(options.semantics or folder / "finray_gripper.srdf")
    controllers = read_yaml(options.controllers or folder / "controllers.yaml")
    limits = read_yaml(folder / "joint_limits.yaml")
    parameters = {
        "robot_description": model,
        "robot_description_semantic": semantics,
        **flatten(controllers),
        **flatten({"robot_description_planning": limits}),
    }
    return [
        *gripper_processes(options, share, {}),
        _publisher(model),
        Process(package="moveit_ros_move_group", executable="move_group", name="", parameters=parameters),
    ]


def gripper_processes(options: StackOptions, share: Path, remappings: dict[str, str]) -> list[Process]:
    """Return the driver with remapped topics, and with `sim` the emulated gripper.

    Raises:
        ValueError: the parameter file has a section for none of the nodes.
    """
    port, interface = options.gripper_port, options.gripper_interface
    processes = []
    if options.sim:
        port = port or emulated_port()
        interface = "slcan"
        processes.append(Process(executable="emulated_gripper", name="emulated_gripper", arguments=("--link", port)))
    if options.gripper:
        file = options.parameter_file or str(share / "config" / "robot.yaml")
        check_sections(file, "", NODES)
        driver = Process(
            executable="gripper_driver",
            name="gripper_driver",
            parameters=given({"port": port, "interface": interface}),
            parameter_file=file,
            remappings=remappings,
        )
        processes.append(driver)
    return processes


def describe(path: str | Path) -> str:
    """Return the XML of a file, which xacro makes of one with that ending.

    Raises:
        MissingDependencyError: it is not installed.
    """
    if str(path).endswith(".xacro"):
        return import_library("xacro", "a description with xacro").process_file(str(path)).toxml()
    return Path(path).read_text(encoding="utf-8")


def flatten(tree: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    """Return nested parameters by their names with dots."""
    flat = {}
    for name, value in tree.items():
        flat |= flatten(value, f"{prefix}{name}.") if isinstance(value, dict) else {f"{prefix}{name}": value}
    return flat


def _publisher(model: str) -> Process:
    return Process(
        package="robot_state_publisher",
        executable="robot_state_publisher",
        name="robot_state_publisher",
        parameters={"robot_description": model},
    )
