"""The processes of a system, their parameters and remappings, described once; starts nothing itself."""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

# small matrices: more threads per process cost time and make it vary
SINGLE_THREAD = {
    name: "1" for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")
}


@dataclass(frozen=True, kw_only=True)
class Process:
    """One ROS process.

    Attributes:
        package: that holds the executable.
        executable: as `ros2 run` finds it.
        name: of the node.
        parameters: ROS parameters that differ from the node's defaults.
        parameter_file: YAML file with more of them, overruled by `parameters`; empty for none.
        remappings: topic names as the node knows them -> as they are here.
        arguments: of the program, before those of ROS.
        ends_all: the whole system ends with this process.
    """

    package: str = "finforce"
    executable: str
    name: str
    parameters: Mapping[str, Any] = field(default_factory=dict)
    parameter_file: str = ""
    remappings: Mapping[str, str] = field(default_factory=dict)
    arguments: tuple[str, ...] = ()
    ends_all: bool = False

    def command(self) -> list[str]:
        """Return the command line that runs one of our nodes with this Python, without `ros2`."""
        words = [sys.executable, "-m", "finforce_start", self.executable, *self.arguments]
        words += ["--ros-args", "-r", f"__node:={self.name}"]
        if self.parameter_file:
            words += ["--params-file", self.parameter_file]
        for name, value in self.parameters.items():
            words += ["-p", f"{name}:={_yaml(value)}"]
        for name, other in self.remappings.items():
            words += ["-r", f"{name}:={other}"]
        return words


def _yaml(value: Any) -> str:
    """Return a value as YAML with its type beyond doubt, which JSON is, but for NaN."""
    return ".nan" if value != value else json.dumps(value)


def _option(default: Any, description: str, **metadata: Any) -> Any:
    """Return a dataclass field that becomes a launch argument."""
    return field(default=default, metadata={"description": description, **metadata})


@dataclass(frozen=True, kw_only=True)
class SolverOptions:
    """What every graph with solvers is asked for; NaN and empty texts leave the node's own default."""

    jaw_file: str = _option("", "jaw file, or the name of a shipped jaw")
    calibration_file: str = _option("", "calibration file, or a shipped name")
    contact_height: float = _option(
        math.nan,
        "height of first touch above the clamped base [m]; nan: contacts come by topic, as with an object mesh",
    )
    object_mesh: str = _option("", "mesh file of the object, whose contacts are then estimated; empty: none is known")
    object_mesh_unit: str = _option("", "unit of the mesh file: m, cm, mm or inch")
    contact: str = _option("", "how the contact is estimated: estimate, paper or closest")
    pose_source: str = _option("", "object poses: topic, detections or tracker")
    images: bool = _option(False, "find the key points in images of a camera; else they come by topic")
    finder: str = _option("", "what finds key points in images: network, frame (any DeepLabCut network) or dots")
    model: str = _option("", "folder of a network and its pytorch_config.yaml; empty: the shipped network")
    T_gripper_camera: str = _option("", "camera in the gripper's frame: x y z [m] qx qy qz qw")
    solver: str = _option("", "model and objective: default, solid, frame or paper")
    mesh: str = _option("", "mesh density: default, coarse or fine")
    parameter_file: str = _option("", "YAML file with ROS parameters of the nodes")
    use_sim_time: bool = _option(False, "take the time from /clock")
    rviz: bool = _option(False, "show the markers in RViz")


@dataclass(frozen=True, kw_only=True)
class BenchOptions(SolverOptions):
    """One jaw, live."""

    jaw: str = _option("left", "the jaw that is on the bench: left or right")


@dataclass(frozen=True, kw_only=True)
class ReplayOptions(SolverOptions):
    """The jaws of a recording."""

    jaws: str = _option("left", "the jaws of the recording: left, right or both")
    bag: str = _option("", "recording to be played; empty: somebody else plays it, with /clock")
    rate: float = _option(1.0, "speed of playing")
    use_sim_time: bool = _option(True, "take the time from /clock")


def solver_process(side: str, options: SolverOptions, **parameters: Any) -> Process:
    """Return the solver of one jaw; `parameters` are added to those that the options name."""
    height = None if math.isnan(options.contact_height) else options.contact_height
    asked = {
        "jaw_file": options.jaw_file,
        "calibration_file": options.calibration_file,
        # NaN overrules a height in the parameter file
        "contact_height": math.nan if options.object_mesh else height,
        "estimator.solver": options.solver,
        "estimator.mesh": options.mesh,
    }
    return Process(
        executable="ifea_solver",
        name=f"{side}_ifea_solver",
        parameters={"jaw_name": side, **_given(asked), **parameters, "use_sim_time": options.use_sim_time},
        parameter_file=options.parameter_file,
    )


def _jaws_process(name: str, jaws: str, asked: Mapping[str, Any], options: SolverOptions) -> Process:
    """Return a node that serves "left", "right" or "both" jaws, called as its executable."""
    return Process(
        executable=name,
        name=name,
        parameters={"jaws": jaws, **_given(asked), "use_sim_time": options.use_sim_time},
        parameter_file=options.parameter_file,
    )


def contact_processes(jaws: str, options: SolverOptions) -> list[Process]:
    """Return the contact estimator of "left", "right" or "both" jaws, if an object mesh is named."""
    if not options.object_mesh:
        return []
    asked = {
        "jaw_file": options.jaw_file,
        "calibration_file": options.calibration_file,
        "object_mesh": options.object_mesh,
        "object_mesh_unit": options.object_mesh_unit,
        "pose_source": options.pose_source,
        "contact.mode": options.contact,
        "contact.mesh": "coarse" if options.solver == "paper" else options.mesh,
    }
    return [_jaws_process("contact_estimator", jaws, asked, options)]


def detector_processes(jaws: str, options: SolverOptions) -> list[Process]:
    """Return the key point detector of "left", "right" or "both" jaws, if images are to be used.

    Raises:
        ValueError: the camera's pose is not seven numbers.
    """
    if not options.images:
        return []
    asked = {
        "jaw_file": options.jaw_file,
        "finder": options.finder,
        "model": options.model,
        "T_gripper_camera": _numbers("T_gripper_camera", options.T_gripper_camera, 7),
    }
    return [_jaws_process("keypoint_detector", jaws, asked, options)]


def _numbers(name: str, text: str, count: int) -> list[float] | None:
    """Return the numbers of an option, None for an empty text."""
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


def _given(asked: Mapping[str, Any]) -> dict[str, Any]:
    """Return what was asked for; the rest is the node's own."""
    return {name: value for name, value in asked.items() if value not in ("", None)}


def bench_processes(options: BenchOptions, share: Path) -> list[Process]:
    """Return the processes of one jaw on a bench; its force is the grasp force; `images` start the detector."""
    solver = solver_process(options.jaw, options, completes_grasp=True)
    return [
        solver,
        *contact_processes(options.jaw, options),
        *detector_processes(options.jaw, options),
        *_viewer(options, share),
    ]


def replay_processes(options: ReplayOptions, share: Path) -> list[Process]:
    """Return the solvers of the jaws in a recording, what feeds them, and the player where a recording is named.

    With two jaws the left one completes the forces on the gripper, with one jaw that one.
    """
    if options.jaws == "both":
        solvers = [solver_process("left", options, peer="right"), solver_process("right", options)]
    else:
        solvers = [solver_process(options.jaws, options, completes_grasp=True)]
    awaited = {"awaits_poses": True} if options.object_mesh else {}
    awaited |= {"awaits_images": True} if options.images else {}
    player = Process(
        executable="recording_player",
        name="recording_player",
        parameters={"bag": options.bag, "rate": options.rate, **awaited},
        ends_all=True,
    )
    played = [player] if options.bag else []
    estimators = [*contact_processes(options.jaws, options), *detector_processes(options.jaws, options)]
    return [*solvers, *estimators, *played, *_viewer(options, share)]


def _viewer(options: SolverOptions, share: Path) -> list[Process]:
    """Return RViz with the shipped configuration, if it was asked for."""
    if not options.rviz:
        return []
    config = str(share / "rviz" / "finforce.rviz")
    return [
        Process(
            package="rviz2",
            executable="rviz2",
            name="rviz",
            parameters={"use_sim_time": options.use_sim_time},
            arguments=("-d", config),
        )
    ]
