"""The live setups: a bench with one jaw, a robot with two."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar

from finforce.gripper_frames import ROBOT_CAMERA
from finforce.ros.transport import CHOICES, PROFILES, TRANSPORT
from finforce.systems.parameter_file import parameters_of
from finforce.systems.processes import (
    BenchOptions,
    GripperOptions,
    Include,
    Process,
    RobotOptions,
    SolverOptions,
    contact_processes,
    detector_processes,
    emulated_port,
    finish,
    given,
    node_process,
    read_numbers,
    solver_process,
    take_rig,
    viewer,
)
from finforce.transforms import pose_numbers

SIM_OBJECT = Path(__file__).parents[2] / "finforce_eval" / "data" / "objects" / "cylinder_25.stl"  # in metres
SIM_CALIBRATION, SIM_JAWS = "twin", ("", "bench")
# of a camera, behind its name; a D405 had the other colour topic before realsense2_camera 4.57.4
COLOR, OLD_COLOR = "color/image_raw", "color/image_rect_raw"
DEPTH, INFO = "aligned_depth_to_color/image_raw", "color/camera_info"
WORLD = "world"  # upright root of an arm's description
POSE_AXES = ("x", "y", "z", "qx", "qy", "qz", "qw")


OptionsT = TypeVar("OptionsT", bound=GripperOptions)


def bench_processes(options: BenchOptions, share: Path) -> list[Process | Include]:
    """Return the processes of one jaw on a bench; its force is the grasp force; `images` start the detector.

    Raises:
        ValueError: the simulated bench is asked for what it has not got.
    """
    if options.sim and options.jaw != "left":
        raise ValueError(f"jaw:={options.jaw}: the simulated bench has the left jaw only")
    options = complete(options, share, "bench")
    driven = options.sim or options.gripper_port
    parts = [
        *twin_processes("bench_cylinder", options),
        solver_process(options.jaw, options, completes_grasp=True),
        *contact_processes(options.jaw, options),
        *detector_processes(options.jaw, options),
        *([gripper_process(options)] if driven else []),
        *viewer(options, share),
    ]
    return finish(parts, options)


def robot_processes(options: RobotOptions, share: Path) -> list[Process | Include]:
    """Return the processes of two jaws on a robot: camera, detector, contacts, solvers, gripper, frames, arm.

    Raises:
        ValueError: the simulated robot is asked for what it has not got, or a camera that is to be started has no name.
    """
    options = complete(options, share, "robot")
    upright = options.gravity_frame or (WORLD if options.arm else "")
    parts = [
        *[see_camera(process, options) for process in twin_processes("grasp_cylinder", options)],
        *camera_includes(options, share),
        *arm_includes(options, share),
        solver_process("left", options, peer="right", gravity_frame=upright),
        solver_process("right", options, paired=True, gravity_frame=upright),
        *[see_camera(process, options) for process in contact_processes("both", options, waits=True)],
        *[see_camera(process, options) for process in detector_processes("both", options)],
        *([gripper_process(options)] if options.gripper else []),
        *frame_processes(options, share),
        *viewer(options, share, "robot.rviz"),
    ]
    return finish(parts, options)


def complete(options: OptionsT, share: Path, setup: str) -> OptionsT:
    """Return options with the setup's configuration, unless another is named, and with the twin if they ask for it.

    Raises:
        ValueError: the twin has not got what they ask for.
        RigError: the rig file cannot be used, or is of other jaws.
    """
    file = options.parameter_file or str(share / "config" / (f"{setup}_sim.yaml" if options.sim else f"{setup}.yaml"))
    options = take_rig(replace(options, parameter_file=file))
    return simulated(options) if options.sim else options


def simulated(options: OptionsT) -> OptionsT:
    """Return options for the twin in place of hardware: its images, its object, its material.

    Raises:
        ValueError: the object is not in metres.
    """
    if options.object_mesh_unit not in ("", "m"):
        raise ValueError(f"object_mesh_unit:={options.object_mesh_unit}: sim:=true takes meshes in m only")
    return replace(
        options,
        images=True,
        object_mesh=options.object_mesh or str(SIM_OBJECT),
        calibration_file=options.calibration_file or (SIM_CALIBRATION if options.jaw_file in SIM_JAWS else ""),
        gripper_port=options.gripper_port or emulated_port(),
        gripper_interface="slcan",
    )


def twin_processes(scene: str, options: GripperOptions) -> list[Process]:
    """Return the camera of the twin in a scene, with the emulated gripper, if they stand in for hardware."""
    if not options.sim:
        return []
    asked = {
        "scene": scene,
        "object": options.object_mesh,
        "jaw_file": options.jaw_file,
        "gripper_link": options.gripper_port,
    }
    return [node_process("twin_camera", asked, options)]


def gripper_process(options: GripperOptions) -> Process:
    """Return the driver of the gripper."""
    asked = {"port": options.gripper_port, "interface": options.gripper_interface}
    return node_process("gripper_driver", asked, options)


def see_camera(process: Process, options: RobotOptions) -> Process:
    """Return a process with the topics of the camera by its name; the twin films under them, in the camera's frame."""
    if not options.camera_name:
        return process
    base = f"camera/{options.camera_name}"
    if process.executable == "twin_camera":
        topics = {f"camera/camera/{stream}": f"{base}/{stream}" for stream in (COLOR, DEPTH, INFO)}
        frame = {"camera_frame": _camera_frame(options)}
        return replace(process, parameters={**process.parameters, **frame}, remappings=topics)
    topics = {"depth_topic": f"{base}/{DEPTH}", "info_topic": f"{base}/{INFO}"}
    if process.executable == "keypoint_detector":
        topics["color_topics"] = [f"{base}/{stream}" for stream in (COLOR, OLD_COLOR)]
    return replace(process, parameters={**process.parameters, **topics})


def _camera_frame(options: RobotOptions) -> str:
    """Return the frame of the camera's colour images."""
    return f"{options.frame_prefix}{options.camera_name}_color_optical_frame"


def camera_includes(options: RobotOptions, share: Path) -> list[Include]:
    """Return the launch file of the real camera, if it is to be started.

    Its frames stay unpublished: what the detector is told of its place is what /tf shows.

    Raises:
        ValueError: it has no name.
    """
    if options.sim or not options.camera:
        return []
    if not options.camera_name:
        raise ValueError("camera_name:=none: camera:=true needs a name, as wrist_camera")
    arguments = {
        "camera_namespace": "/".join(filter(None, (options.namespace.strip("/"), "camera"))),
        "camera_name": options.camera_name,
        "config_file": options.camera_config or str(share / "config" / "d405.yaml"),
        **given({"tf_prefix": options.frame_prefix}),
    }
    chosen = any(os.environ.get(name) for name in CHOICES)
    return [
        Include(
            package="realsense2_camera",
            file="rs_launch.py",
            arguments=arguments,
            environment={} if chosen else {PROFILES: str(TRANSPORT)},
            advice="or say camera:=false and start a camera yourself",
        )
    ]


def arm_includes(options: RobotOptions, share: Path) -> list[Include]:
    """Return the launch file of the arm, if it is to be started, with our description of arm and gripper.

    The controllers stay those of kortex_description: an absolute path of the description is taken as it is.
    """
    if not options.arm:
        return []
    description = options.arm_description or str(share / "urdf" / "gen3_finray.urdf.xacro")
    arguments = {
        "robot_type": "gen3",
        "robot_ip": options.robot_ip,
        "dof": str(options.dof),
        "description_file": str(Path(description).resolve()),
        "gripper": "",
        "use_fake_hardware": str(options.sim).lower(),
        "launch_rviz": "false",
    }
    return [
        Include(
            package="kortex_bringup",
            file="kortex_control.launch.py",
            arguments=arguments,
            programs=("xacro",),
            advice="or leave arm:=true out",
        )
    ]


def frame_processes(options: RobotOptions, share: Path) -> list[Process]:
    """Return what publishes the frames of gripper and camera on /tf, as far as nobody else does."""
    publishers = []
    if not options.arm:  # whose description holds the gripper, too
        model = (share / "urdf" / "finray_gripper.urdf").read_text(encoding="utf-8")
        told = {"robot_description": model, **given({"frame_prefix": options.frame_prefix})}
        publishers.append(_frames("robot_state_publisher", "robot_state_publisher", told))
    if options.camera_name and (options.sim or options.camera):
        pose = zip(POSE_AXES, camera_pose(options), strict=True)
        words = [word for axis, number in pose for word in (f"--{axis}", str(number))]
        words += ["--frame-id", f"{options.frame_prefix}gripper_base", "--child-frame-id", _camera_frame(options)]
        publishers.append(_frames("tf2_ros", "static_transform_publisher", {}, tuple(words)))
    return publishers


def _frames(package: str, executable: str, parameters: Mapping[str, Any], arguments: tuple[str, ...] = ()) -> Process:
    """Return a publisher of frames, without which forces are estimated all the same."""
    return Process(
        package=package,
        executable=executable,
        name=executable,
        parameters=parameters,
        arguments=arguments,
        optional=True,
        advice="without it /tf lacks frames, all else works",
    )


def camera_pose(options: SolverOptions) -> Sequence[float]:
    """Return x, y, z [m], qx, qy, qz, qw of the camera in the gripper's frame, as the detector will know it.

    Raises:
        ValueError: the option, or what the parameter file says, is not seven numbers.
    """
    asked = read_numbers("T_gripper_camera", options.T_gripper_camera, 7)
    node = "/".join(("", *filter(None, (options.namespace.strip("/"), "keypoint_detector"))))
    told = parameters_of(options.parameter_file, node).get("T_gripper_camera")
    return asked or told or pose_numbers(ROBOT_CAMERA)
