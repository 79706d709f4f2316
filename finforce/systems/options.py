"""What can be asked of a system when it is launched, one record per system."""

from __future__ import annotations

import math
from dataclasses import dataclass

from finforce.settings import setting


@dataclass(frozen=True, kw_only=True)
class SolverOptions:
    """What every graph with solvers is asked for; NaN and empty texts leave the node's own default."""

    jaw_file: str = setting("", "jaw file, or the name of a shipped jaw")
    calibration_file: str = setting("", "calibration file, or a shipped name")
    contact_height: float = setting(
        math.nan,
        "height of first touch above the clamped base [m]; nan: contacts come by topic, as with an object mesh",
    )
    object_mesh: str = setting("", "mesh file of the object, whose contacts are then estimated; empty: none is known")
    object_mesh_unit: str = setting("", "unit of the mesh file: m, cm, mm or inch")
    contact: str = setting("", "how the contact is estimated: estimate, paper or closest")
    pose_source: str = setting("", "object poses: topic, detections or tracker")
    images: bool = setting(False, "find the key points in images of a camera; else they come by topic")
    finder: str = setting("", "what finds key points in images: network, frame (any DeepLabCut network) or dots")
    model: str = setting("", "folder of a network and its pytorch_config.yaml; empty: the shipped network")
    T_gripper_camera: str = setting("", "camera in the gripper's frame: x y z [m] qx qy qz qw")
    solver: str = setting("", "mechanics: default (reduced), reduced, solid, frame, linear or paper")
    mesh: str = setting("", "mesh density: default, coarse or fine")
    parameter_file: str = setting("", "YAML file with ROS parameters of the nodes")
    use_sim_time: bool = setting(False, "take the time from /clock")
    rviz: bool = setting(False, "show the markers in RViz")


@dataclass(frozen=True, kw_only=True)
class ReplayOptions(SolverOptions):
    """The jaws of a recording."""

    jaws: str = setting("left", "the jaws of the recording", choices=("left", "right", "both"))
    bag: str = setting("", "recording to be played; empty: somebody else plays it, with /clock")
    rate: float = setting(1.0, "speed of playing")
    use_sim_time: bool = setting(True, "take the time from /clock")


@dataclass(frozen=True, kw_only=True)
class GripperOptions(SolverOptions):
    """What a setup with the gripper is asked for beside the forces."""

    gripper_port: str = setting(
        "",
        "serial port of the gripper's CAN adapter, or the CAN channel; with sim: where the emulated gripper's port is "
        "made; empty: that of the parameter file, with sim one in the temporary folder",
    )
    gripper_interface: str = setting("", "slcan: a serial CAN adapter; else python-can's name of one, as socketcan")
    sim: bool = setting(False, "no hardware: an emulated gripper bends the twin's jaws, and the twin films them")


@dataclass(frozen=True, kw_only=True)
class BenchOptions(GripperOptions):
    """One jaw, live; the gripper, if there is one, brings the object to it."""

    jaw: str = setting("left", "the jaw that is on the bench", choices=("left", "right"))


@dataclass(frozen=True, kw_only=True)
class RobotOptions(GripperOptions):
    """Both jaws on a robot's wrist, with the camera beside them."""

    images: bool = setting(True, "find the key points in images of a camera; else they come by topic")
    gripper: bool = setting(True, "drive the gripper")
    camera: bool = setting(True, "start the wrist camera, a RealSense D405, by realsense2_camera; not with sim")
    camera_name: str = setting(
        "wrist_camera",
        "name of the camera: topics /camera/NAME/..., frames NAME_...; empty: topics and frame of the parameter file",
    )
    camera_config: str = setting("", "YAML file with parameters of realsense2_camera; empty: the shipped d405.yaml")
    camera_serial: str = setting("", "serial number of the camera; empty: the only one")
    arm: bool = setting(False, "start the arm, a Kinova Gen3, by kortex_bringup; with sim one that is not there")
    arm_description: str = setting(
        "", "xacro file of arm and gripper; empty: the shipped one, with the gripper on the flange of a Gen3"
    )
    robot_ip: str = setting("192.168.1.10", "address of the arm")
    dof: int = setting(7, "joints of the arm", choices=("6", "7"))
    use_fake_hardware: bool = setting(False, "an arm that is not there: it mirrors its commands")
