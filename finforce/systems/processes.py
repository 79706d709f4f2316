"""The processes of a system, their parameters and remappings, described once, and what can be asked of a system."""

from __future__ import annotations

import json
import math
import os
import re
import sys
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, TypeVar

from finforce.errors import RigError
from finforce.gripper_frames import SIDES
from finforce.rig import read_rig
from finforce.settings import setting
from finforce.systems.parameter_file import check_sections

# small matrices: more threads per process cost time and make it vary
SINGLE_THREAD = {
    name: "1" for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")
}
POSE_TOPICS = ("object_pose", "object_detections")  # where a contact estimator listens for poses of other programs
PIPELINE = "finforce_pipeline"
STAGES = ("keypoint_detector", "contact_estimator", "ifea_solver")  # in the order in which an image passes them
RESPAWNED = (*STAGES, PIPELINE, "robot_state_publisher", "static_transform_publisher")  # none of them holds anything
RESPAWN_DELAY = 2.0  # [s]
UNUSABLE = 2  # exit status of a node whose settings cannot be used
NODES = (*STAGES[:2], *(f"{side}_ifea_solver" for side in SIDES), "gripper_driver", "twin_camera", "recording_player")


@dataclass(frozen=True, kw_only=True)
class Process:
    """One ROS process.

    Attributes:
        package: that holds the executable.
        executable: as `ros2 run` finds it.
        name: of the node; empty where a process has several, which would all be called so.
        namespace: of the node.
        parameters: ROS parameters that differ from the node's defaults.
        parameter_file: YAML file with more of them, overruled by `parameters`; empty for none.
        remappings: topic names as the node knows them -> as they are here.
        arguments: of the program, before those of ROS.
        ends_all: the whole system ends with this process.
        optional: the rest starts without it where its package is not installed.
        advice: alternative for users without the package.
    """

    package: str = "finforce"
    executable: str
    name: str
    namespace: str = ""
    parameters: Mapping[str, Any] = field(default_factory=dict)
    parameter_file: str = ""
    remappings: Mapping[str, str] = field(default_factory=dict)
    arguments: tuple[str, ...] = ()
    ends_all: bool = False
    optional: bool = False
    advice: str = ""

    def command(self) -> list[str]:
        """Return the command line that runs the process: a node of ours with this Python, without `ros2`."""
        if self.package != "finforce":
            return ["ros2", "run", self.package, self.executable, *self.arguments, "--ros-args", *self.words]
        return [sys.executable, "-m", "finforce.ros.start", self.executable, *self.arguments, "--ros-args", *self.words]

    @property
    def label(self) -> str:
        """The name of the process."""
        return self.name or self.executable

    @property
    def respawns(self) -> bool:
        """True if it is started again when it dies; a driver is not, whose gripper goes on holding."""
        return self.executable in RESPAWNED

    @property
    def words(self) -> list[str]:
        """The node's ROS arguments."""
        words = ["-r", f"__node:={self.name}"] if self.name else []
        if self.namespace:
            words += ["-r", f"__ns:=/{self.namespace.strip('/')}"]
        if self.parameter_file:
            words += ["--params-file", self.parameter_file]
        for name, value in self.parameters.items():
            # as YAML with its type beyond doubt, which JSON is, but for NaN
            words += ["-p", f"{name}:={'.nan' if value != value else json.dumps(value)}"]
        for name, other in self.remappings.items():
            words += ["-r", f"{name}:={other}"]
        return words


@dataclass(frozen=True, kw_only=True)
class Include:
    """A launch file of another package, which sees none of our arguments.

    Attributes:
        package: that holds the file.
        file: in the package's folder `launch`.
        arguments: of that file.
        environment: variables for its processes only.
        programs: that it calls, each named as the package it comes with.
        advice: alternative for users without the package.
    """

    package: str
    file: str
    arguments: Mapping[str, str] = field(default_factory=dict)
    environment: Mapping[str, str] = field(default_factory=dict)
    programs: tuple[str, ...] = ()
    advice: str = ""


def finish(parts: Sequence[Process | Include], options: SolverOptions) -> list[Process | Include]:
    """Return parts of a system in its namespace, with its prefix of frames, and composed where that is asked for.

    Raises:
        ValueError: ROS allows no such namespace, or the parameter file has a section for none of the nodes.
    """
    if not re.fullmatch(r"/?(?:[A-Za-z_]\w*/?)*", options.namespace, re.ASCII):
        hint = "letters, digits and underscores, such as robot_1 or lab/robot_1"
        raise ValueError(f"namespace '{options.namespace}': expected {hint}")
    if options.parameter_file:
        check_sections(options.parameter_file, options.namespace, NODES)
    parts = [_place(part, options) if isinstance(part, Process) else part for part in parts]
    return compose(parts) if options.composed else parts


def _place(part: Process, options: SolverOptions) -> Process:
    """Return a process in the namespace of a system, one of our nodes also with its prefix of frames."""
    own = {"frame_prefix": options.frame_prefix} if part.executable in (*STAGES, "gripper_driver") else {}
    return replace(part, namespace=options.namespace, parameters={**part.parameters, **given(own)})


def compose(parts: Sequence[Process | Include]) -> list[Process | Include]:
    """Return parts of a system with detector, contact estimator and solvers in one process, where there are several."""
    stages = [part for part in parts if isinstance(part, Process) and part.executable in STAGES]
    if len(stages) < 2:
        return list(parts)
    return [merge(stages), *(part for part in parts if part not in stages)]


def merge(nodes: Sequence[Process]) -> Process:
    """Return the process that has some nodes, in the order in which an image passes them, others behind these."""
    ordered = sorted(nodes, key=lambda node: (*STAGES, node.executable).index(node.executable))
    words = tuple(json.dumps([node.executable, *node.words]) for node in ordered)
    return Process(executable=PIPELINE, name="", arguments=words)


def executables_of(parts: Sequence[Process | Include]) -> list[str]:
    """Return the executables of the nodes that parts of a system have, composed or not."""
    found = []
    for part in parts:
        if isinstance(part, Process):
            found += (
                [json.loads(word)[0] for word in part.arguments] if part.executable == PIPELINE else [part.executable]
            )
    return found


def node_process(name: str, asked: Mapping[str, Any], options: SolverOptions) -> Process:
    """Return a node of ours that is called as its executable, with the parameters that were asked for."""
    parameters = {**given(asked), "use_sim_time": options.use_sim_time}
    return Process(executable=name, name=name, parameters=parameters, parameter_file=options.parameter_file)


def solver_process(side: str, options: SolverOptions, **parameters: Any) -> Process:
    """Return the solver of one jaw; `parameters` are added to those that the options name."""
    height, friction, friction_stddev = (
        None if math.isnan(number) else number
        for number in (options.contact_height, options.friction, options.friction_stddev)
    )
    asked = {
        "jaw_name": side,
        "jaw_file": options.jaw_file,
        "calibration_file": options.calibration_file,
        # NaN overrules a height in the parameter file
        "contact_height": math.nan if options.object_mesh else height,
        "estimator.solver": options.solver,
        "estimator.friction": friction,
        "estimator.friction_stddev": friction_stddev,
        **parameters,
    }
    return replace(node_process("ifea_solver", asked, options), name=f"{side}_ifea_solver")


def contact_processes(jaws: str, options: SolverOptions, *, waits: bool = False) -> list[Process]:
    """Return the contact estimator of "left", "right" or "both" jaws, if an object mesh is named.

    Where it `waits` for a mesh, which its services can bring, it is there unless the height of first touch is given.
    """
    if not options.object_mesh and not (waits and math.isnan(options.contact_height)):
        return []
    asked = {
        "jaws": jaws,
        "jaw_file": options.jaw_file,
        "calibration_file": options.calibration_file,
        "object_mesh": options.object_mesh,
        "object_mesh_unit": options.object_mesh_unit,
        "pose_source": options.pose_source,
        "contact.mesh": "coarse" if options.solver == "paper" else "",
    }
    topics = dict.fromkeys(POSE_TOPICS, options.pose_topic) if options.pose_topic else {}
    return [replace(node_process("contact_estimator", asked, options), remappings=topics)]


OptionsT = TypeVar("OptionsT", bound="SolverOptions")


def take_rig(options: OptionsT) -> OptionsT:
    """Return options with the jaw file of their rig, and its camera's pose unless another one is asked for.

    Raises:
        RigError: the rig file cannot be used, or is of other jaws.
    """
    if not options.rig:
        return options
    rig = read_rig(options.rig)
    if options.jaw_file not in ("", rig.jaw):
        name = Path(options.rig).name
        raise RigError(f"jaw_file:={options.jaw_file}: {name} is of the jaws '{rig.jaw}'; leave jaw_file out")
    pose = options.T_gripper_camera or " ".join(map(str, rig.T_gripper_camera))
    return replace(options, jaw_file=rig.jaw, T_gripper_camera=pose)


def detector_processes(jaws: str, options: SolverOptions) -> list[Process]:
    """Return the key point detector of "left", "right" or "both" jaws, if images are to be used.

    Raises:
        ValueError: the camera's pose is not seven numbers.
        RigError: the rig file cannot be used.
    """
    if not options.images:
        return []
    asked = {
        "jaws": jaws,
        "jaw_file": options.jaw_file,
        "detection_method": options.detection_method,
        "model": options.model,
        "depth": "" if options.depth == "auto" else options.depth,  # the node's default, unless its file says otherwise
        "T_gripper_camera": read_numbers("T_gripper_camera", options.T_gripper_camera, 7),
    }
    mounted = read_rig(options.rig).detector_parameters() if options.rig else {}
    return [node_process("keypoint_detector", {**mounted, **given(asked)}, options)]


def read_numbers(name: str, text: str, count: int) -> list[float] | None:
    """Return the numbers of an option, None for an empty text.

    Raises:
        ValueError: they are not so many, or none.
    """
    words = text.replace(",", " ").split()
    if not words:
        return None
    try:
        numbers = [float(word) for word in words]
    except ValueError:
        numbers = []
    if len(numbers) != count:
        raise ValueError(f"{name}:={text}: expected {count} numbers")
    return numbers


def given(asked: Mapping[str, Any]) -> dict[str, Any]:
    """Return what was asked for; the rest is the node's own."""
    return {name: value for name, value in asked.items() if value not in ("", None)}


def replay_processes(options: ReplayOptions, share: Path) -> list[Process]:
    """Return the solvers of the jaws in a recording, what feeds them, and the player where a recording is named.

    With two jaws the left one completes the forces on the gripper, with one jaw that one.
    """
    options = take_rig(options)
    if options.jaws == "both":
        solvers = [solver_process("left", options, peer="right"), solver_process("right", options, paired=True)]
    else:
        solvers = [solver_process(options.jaws, options, completes_grasp=True)]
    awaited = {"awaits_poses": True} if options.object_mesh else {}
    awaited |= {"awaits_images": True, "composed": options.composed} if options.images else {}
    player = Process(
        executable="finforce_recording_player",
        name="recording_player",
        parameters={"bag": options.bag, "rate": options.rate, **awaited},
        ends_all=True,
    )
    played = [player] if options.bag else []
    estimators = [*contact_processes(options.jaws, options), *detector_processes(options.jaws, options)]
    return finish([*solvers, *estimators, *played, *viewer(options, share)], options)


def viewer(options: SolverOptions, share: Path, config: str = "finforce.rviz") -> list[Process]:
    """Return RViz with a shipped configuration, if it was asked for."""
    if not options.rviz:
        return []
    return [
        Process(
            package="rviz2",
            executable="rviz2",
            name="rviz",
            parameters={"use_sim_time": options.use_sim_time},
            arguments=("-d", str(_own_view(share / "rviz" / config, options))),
            advice="or leave rviz:=true out",
        )
    ]


def _own_view(file: Path, options: SolverOptions) -> Path:
    """Return RViz's configuration; with the topics of a namespace and frames of a prefix, a file of its own."""
    space, prefix = options.namespace.strip("/"), options.frame_prefix
    if not (space or prefix):
        return file
    text = re.sub(r"(Value: /)(?=\w)", rf"\g<1>{space}/" if space else r"\1", file.read_text(encoding="utf-8"))
    text = re.sub(r"(Fixed Frame: )(?=\w)", rf"\g<1>{prefix}", text).replace('TF Prefix: ""', f'TF Prefix: "{prefix}"')
    own = Path(tempfile.mkdtemp(prefix="finforce_rviz_")) / file.name
    own.write_text(text, encoding="utf-8")
    return own


def emulated_port() -> str:
    """Return the path of an emulated gripper's port, another one for each process that asks."""
    return str(Path(tempfile.gettempdir()) / f"finforce_gripper_{os.getpid()}")


_PORT = "Serial port of the CAN adapter, or CAN channel"
_INTERFACE = "slcan for a serial CAN adapter, or an interface of python-can, such as socketcan"


@dataclass(frozen=True, kw_only=True)
class SolverOptions:
    """Options of every system with solvers; NaN and empty texts leave the node's own default.

    Each option is an argument of the launch files, where none stands for an empty text.
    """

    jaw_file: str = setting("", "Jaw file or name of an included jaw; none: bench")
    calibration_file: str = setting("", "Calibration file or name of an included one; none: material of the jaw file")
    contact_height: float = setting(
        math.nan, "Height of first touch above the clamped base; nan: contacts come by topic", "m", 0.0, 0.5
    )
    friction: float = setting(
        math.nan, "Coefficient of friction of the object on the finger; nan: unknown", "", 0.0, 2.0
    )
    friction_stddev: float = setting(
        math.nan, "Standard deviation of the coefficient of friction; nan: that of an unknown one", "", 1e-3, 2.0
    )
    object_mesh: str = setting("", "Mesh file of the object, from which contacts are estimated")
    object_mesh_unit: str = setting("", "Unit of the mesh file: m, cm, mm or inch")
    pose_source: str = setting("", "Source of object poses: topic, detections or tracker")
    pose_topic: str = setting("", "Topic of object poses from another program; none: object_pose, object_detections")
    images: bool = setting(False, "Detection of key points in camera images; false: key points come by topic")
    detection_method: str = setting("", "network, frame (DeepLabCut) or dots")
    model: str = setting("", "Folder of a network")
    depth: str = setting(
        "auto",
        "Depth images: aligned (every image needs one), auto (where there is one), none (colour alone)",
        choices=("aligned", "auto", "none"),
    )
    rig: str = setting("", "Rig file of `finforce camera`: jaws, mounts and the camera's pose")
    T_gripper_camera: str = setting("", "Pose of the camera in the gripper frame: x y z [m] qx qy qz qw")
    solver: str = setting("", "Mechanics: reduced, solid, frame, plane or paper (Eq. 1)")
    parameter_file: str = setting("", "YAML file with node parameters; none: that of the system")
    use_sim_time: bool = setting(False, "Time from /clock")
    composed: bool = setting(True, "Detector, contact estimator and solvers in one process; false: one process each")
    rviz: bool = setting(False, "RViz with the markers")
    namespace: str = setting("", "Namespace of all nodes, for several robots")
    frame_prefix: str = setting("", "Prefix of all frames, as robot_state_publisher has it")


@dataclass(frozen=True, kw_only=True)
class ReplayOptions(SolverOptions):
    """The jaws of a recording."""

    jaws: str = setting("left", "Jaws of the recording", choices=("left", "right", "both"))
    bag: str = setting("", "Recording to be played; none: somebody else plays it, with /clock")
    rate: float = setting(1.0, "Speed of playing")
    use_sim_time: bool = setting(True, "Time from /clock")


@dataclass(frozen=True, kw_only=True)
class GripperOptions(SolverOptions):
    """Options of a system with the gripper, in addition to those of the forces."""

    gripper_port: str = setting("", f"{_PORT}; none: from the parameter file, with sim a temporary one")
    gripper_interface: str = setting("", _INTERFACE)
    sim: bool = setting(False, "Simulation: an emulated gripper, with the synthetic twin as its camera")


@dataclass(frozen=True, kw_only=True)
class BenchOptions(GripperOptions):
    """One jaw, live; the gripper, if there is one, brings the object to it."""

    jaw: str = setting("left", "Jaw that is on the bench", choices=("left", "right"))


@dataclass(frozen=True, kw_only=True)
class RobotOptions(GripperOptions):
    """Both jaws on a robot's wrist, with the camera beside them."""

    images: bool = setting(True, "Detection of key points in camera images; false: key points come by topic")
    gripper: bool = setting(True, "Start of the gripper driver")
    camera: bool = setting(True, "Start of the wrist camera, a RealSense D405, by realsense2_camera; not with sim")
    camera_name: str = setting(
        "wrist_camera", "Topics /camera/NAME/..., frames NAME_...; none: topics and frame of the parameter file"
    )
    camera_config: str = setting("", "YAML file with parameters of realsense2_camera; none: the included d405.yaml")
    arm: bool = setting(False, "Start of the arm, a Kinova Gen3, by kortex_bringup; with sim one that is not there")
    arm_description: str = setting("", "xacro file of arm and gripper; none: the gripper on the flange of a Gen3")
    robot_ip: str = setting("192.168.1.10", "Address of the arm")
    dof: int = setting(7, "Joints of the arm", choices=(6, 7))
    gravity_frame: str = setting("", "Upright frame on /tf in which the gripper moves; none: world with arm")


@dataclass(frozen=True, kw_only=True)
class StackOptions:
    """Options of a gripper that a manipulation stack drives."""

    description: str = setting("", "xacro or URDF file of the robot; none: only the gripper")
    semantics: str = setting("", "SRDF file of the robot, for MoveIt; none: that of the gripper")
    controllers: str = setting("", "YAML file of the controllers; none: those of the gripper")
    gripper: bool = setting(True, "Start of the gripper driver")
    gripper_port: str = setting("", f"{_PORT}; none: that of the parameter file")
    gripper_interface: str = setting("", _INTERFACE)
    parameter_file: str = setting("", "YAML file with driver parameters; none: config/robot.yaml")
    sim: bool = setting(False, "Simulation: an emulated gripper in place of hardware")
