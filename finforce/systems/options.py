"""What can be asked of a system when it is launched, one record per system."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any


def option(default: Any, description: str, **metadata: Any) -> Any:
    """Return a dataclass field that becomes a launch argument."""
    return field(default=default, metadata={"description": description, **metadata})


@dataclass(frozen=True, kw_only=True)
class SolverOptions:
    """What every graph with solvers is asked for; NaN and empty texts leave the node's own default."""

    jaw_file: str = option("", "jaw file, or the name of a shipped jaw")
    calibration_file: str = option("", "calibration file, or a shipped name")
    contact_height: float = option(
        math.nan,
        "height of first touch above the clamped base [m]; nan: contacts come by topic, as with an object mesh",
    )
    object_mesh: str = option("", "mesh file of the object, whose contacts are then estimated; empty: none is known")
    object_mesh_unit: str = option("", "unit of the mesh file: m, cm, mm or inch")
    contact: str = option("", "how the contact is estimated: estimate, paper or closest")
    pose_source: str = option("", "object poses: topic, detections or tracker")
    images: bool = option(False, "find the key points in images of a camera; else they come by topic")
    finder: str = option("", "what finds key points in images: network, frame (any DeepLabCut network) or dots")
    model: str = option("", "folder of a network and its pytorch_config.yaml; empty: the shipped network")
    T_gripper_camera: str = option("", "camera in the gripper's frame: x y z [m] qx qy qz qw")
    solver: str = option("", "mechanics: default (reduced), reduced, solid, frame, linear or paper")
    mesh: str = option("", "mesh density: default, coarse or fine")
    parameter_file: str = option("", "YAML file with ROS parameters of the nodes")
    use_sim_time: bool = option(False, "take the time from /clock")
    rviz: bool = option(False, "show the markers in RViz")


@dataclass(frozen=True, kw_only=True)
class ReplayOptions(SolverOptions):
    """The jaws of a recording."""

    jaws: str = option("left", "the jaws of the recording", choices=("left", "right", "both"))
    bag: str = option("", "recording to be played; empty: somebody else plays it, with /clock")
    rate: float = option(1.0, "speed of playing")
    use_sim_time: bool = option(True, "take the time from /clock")


@dataclass(frozen=True, kw_only=True)
class GripperOptions(SolverOptions):
    """What a setup with the gripper is asked for beside the forces."""

    gripper_port: str = option(
        "",
        "serial port of the gripper's CAN adapter, or the CAN channel; with sim: where the emulated gripper's port is "
        "made; empty: that of the parameter file, with sim one in the temporary folder",
    )
    gripper_interface: str = option("", "slcan: a serial CAN adapter; else python-can's name of one, as socketcan")
    sim: bool = option(False, "no hardware: an emulated gripper bends the twin's jaws, and the twin films them")


@dataclass(frozen=True, kw_only=True)
class BenchOptions(GripperOptions):
    """One jaw, live; the gripper, if there is one, brings the object to it."""

    jaw: str = option("left", "the jaw that is on the bench", choices=("left", "right"))


@dataclass(frozen=True, kw_only=True)
class RobotOptions(GripperOptions):
    """Both jaws on a robot's wrist, with the camera beside them."""

    images: bool = option(True, "find the key points in images of a camera; else they come by topic")
    gripper: bool = option(True, "drive the gripper")
    camera: bool = option(True, "start the wrist camera, a RealSense D405, by realsense2_camera; not with sim")
    camera_name: str = option(
        "wrist_camera",
        "name of the camera: topics /camera/NAME/..., frames NAME_...; empty: topics and frame of the parameter file",
    )
    camera_config: str = option("", "YAML file with parameters of realsense2_camera; empty: the shipped d405.yaml")
    camera_serial: str = option("", "serial number of the camera; empty: the only one")
    arm: bool = option(False, "start the arm, a Kinova Gen3, by kortex_bringup; with sim one that is not there")
    arm_description: str = option(
        "", "xacro file of arm and gripper; empty: the shipped one, with the gripper on the flange of a Gen3"
    )
    robot_ip: str = option("192.168.1.10", "address of the arm")
    dof: int = option(7, "joints of the arm", choices=("6", "7"))
    use_fake_hardware: bool = option(False, "an arm that is not there: it mirrors its commands")
