"""The subcommands `twin list` and `twin record`: a synthetic scene as a recording with its truth."""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Iterator, Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from finforce.camera_topics import COLOR_TOPIC, DEPTH_TOPIC, INFO_TOPIC
from finforce.messages import DEPTH_FORMAT
from finforce.optional import import_trimesh
from finforce.transforms import pose_numbers, quaternion_from_pose
from finforce_eval.cli.parser import CommandResult, Parser, add_output_options, whole_number
from finforce_eval.evaluation.keypoint_source import parse_changes
from finforce_eval.recordings.images import (
    CAMERA_INFO,
    COMPRESSED,
    IMAGE,
    compress_depth,
    encode_color,
)
from finforce_eval.recordings.recording import STRING, TRUE_KEYPOINTS, TRUE_POSE
from finforce_eval.recordings.writer import (
    Entry,
    cloud_message,
    header,
    make_message,
    new_folder,
    pose_message,
    wrench_message,
    write_entries,
)
from finforce_eval.tasks import progress_bar
from finforce_sim.scenarios import SCENARIOS, Scenario, build_scenario, write_script
from finforce_sim.simulated_camera import TrueJaw
from finforce_sim.simulated_recording import (
    FINGER,
    SimulatedRecording,
    TwinFrame,
    build_simulated_recording,
    detection_truth_columns,
    encode_depth,
    info_fields,
    parse_size,
)


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the subcommand."""
    actions = parser.add_subparsers(dest="action", metavar="ACTION", required=True, parser_class=Parser)
    listing = actions.add_parser("list", help="list the scenes")
    listing.set_defaults(run=run_list)
    add_output_options(listing)
    record = actions.add_parser("record", help="render a scene and write it", description="render a scene and write it")
    add_output_options(record)
    record.add_argument("scene", metavar="SCENE", help="name from `finforce twin list`")
    record.add_argument("-o", "--output", required=True, metavar="BAG", help="recording to write, a new folder")
    record.add_argument("--seed", type=whole_number(0, 2**32), default=0, help="seed of textures, light and noise (0)")
    finger = "seed of the jaw material; the calibration twin belongs to 0 (0)"
    steps = "depth step [mm]: 1 as from the ROS driver, 0.1 as from the camera itself (1)"
    record.add_argument("--depth-step", type=float, default=1.0, choices=(1.0, 0.1), help=steps)
    record.add_argument("--finger", type=whole_number(0, 2**32), default=0, metavar="SEED", help=finger)
    record.add_argument("--light", metavar="WORD", help="bright, dim or any (that of the scene)")
    record.add_argument("--object", metavar="NAME", help="name of a shape, or mesh file (that of the scene)")
    record.add_argument("--jaw", metavar="NAME", help="jaw file, or name of an included jaw (that of the scene, bench)")
    text = "camera: robot on the wrist, front beyond the tips, or bench with one jaw"
    record.add_argument("--camera", choices=("robot", "front", "bench"), help=text)
    record.add_argument("--lens", default="d405", choices=("d405", "webcam", "fisheye"), help="camera lens (d405)")
    record.add_argument("--size", default="640x480", metavar="WxH", help="size of the images (640x480)")
    text = "set a number of the scene, repeatable; an unknown NAME lists all"
    record.add_argument("--set", action="append", default=[], metavar="NAME=VALUE", help=text)
    text = "write uncompressed images, 46 MB per second, instead of jpeg colour and png depth"
    record.add_argument("--raw", action="store_true", help=text)
    record.set_defaults(run=run_record)


def run_list(options: argparse.Namespace) -> CommandResult:
    """Print the scenes, with the numbers in which each differs from the default."""
    lengths = {name: float(write_script(scenario).stamps[-1]) for name, scenario in SCENARIOS.items()}
    for name, scenario in SCENARIOS.items():
        print(f"{name:<22} {lengths[name]:5.1f} s  {', '.join(_deviations(scenario))}")
    return CommandResult({"scenes": {name: {"seconds": length} for name, length in lengths.items()}})


def _deviations(scenario: Scenario) -> list[str]:
    """Return what makes a scene, as NAME=VALUE."""
    plain = {entry.name: entry.default for entry in fields(Scenario)}
    values = {name: getattr(scenario, name) for name in plain if name != "name"}
    named = ("object", "camera", "light")
    changed = [name for name, value in values.items() if name in named or value != plain[name]]
    return [f"{name}={_short(values[name])}" for name in changed]


def _short(value: Any) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value) or "none"


def run_record(options: argparse.Namespace) -> CommandResult:
    """Render a scene and write the recording, its mesh and its `case.json`.

    Raises:
        FinforceError: an option or the scene cannot be used, or the folder exists.
    """
    folder = Path(options.output)
    with new_folder(folder) as new:
        scenario = scenario_from_options(options)
        camera, step = parse_size(options.size, options.lens), 1e-3 * options.depth_step
        simulated = build_simulated_recording(scenario, options.seed, camera, finger=options.finger, depth_step=step)
        record_simulation(simulated, scenario, options.seed, new, compressed=not options.raw, finger=options.finger)
    size = sum(path.stat().st_size for path in folder.iterdir()) / 1e6
    print(f"Recording: {folder} ({size:.1f} MB)")
    print(f"Score it with: finforce evaluate {folder} --from images")
    return CommandResult({"recording": str(folder), "megabytes": size})


def scenario_from_options(options: argparse.Namespace) -> Scenario:
    """Return the scene that options name, with what they change in it.

    Raises:
        OptionError: a change is no NAME=VALUE, or its value has another type.
        ScenarioError: there is no such scene, or a number is out of its bounds.
    """
    defaults = {entry.name: entry.default for entry in fields(Scenario) if entry.name != "name"}
    changes = parse_changes("--set", "number", options.set, defaults)
    for name in ("light", "object", "camera", "jaw"):
        if getattr(options, name) is not None:
            changes[name] = getattr(options, name)
    return build_scenario(options.scene, **changes)


# What a `case.json` says of objects that a hand or the bench guides: the simulator presses them in without friction.
FRICTIONLESS = {"mean": 0.0, "stddev": 0.03}
FRAME = "camera_color_optical_frame"
MESH = "object.stl"


def write_simulated_recording(
    simulated: SimulatedRecording,
    folder: str | Path,
    *,
    compressed: bool = True,
    case: Mapping[str, Any] | None = None,
    seen: Callable[[TwinFrame], Any] = lambda frame: None,
) -> Path:
    """Write a simulated recording as a rosbag2 folder with its `case.json` and the object's mesh.

    Args:
        simulated: images and truth; one image after the other, never all of them in memory.
        folder: the new folder, which must not exist.
        compressed: jpeg colour and png depth; else plain images.
        case: further content of the `case.json`.
        seen: called with every image when it has been written.

    Returns:
        The folder.

    Raises:
        RecordingError: the folder exists.
        FinforceError: the recording cannot be made.
    """
    folder, content = Path(folder), dict(case or {})
    with new_folder(folder) as new:
        write_entries(simulated_entries(simulated, compressed, seen), new)
        if simulated.mesh is not None:
            mesh = import_trimesh().Trimesh(
                vertices=simulated.mesh.vertices, faces=simulated.mesh.triangles, process=False
            )
            mesh.export(new / MESH)
            content["mesh"] = f"{folder.name}/{MESH}"
        content["depth_scale"] = simulated.depth_step
        content["T_gripper_camera"] = list(pose_numbers(simulated.T_gripper_camera))
        (new / "case.json").write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")
    return folder


def simulated_entries(
    simulated: SimulatedRecording, compressed: bool, seen: Callable[[TwinFrame], Any] = lambda frame: None
) -> Iterator[Entry]:
    """Yield every message of a simulated recording in the order of its stamps."""
    phase = None
    for frame in simulated:
        if frame.phase != phase:
            phase = frame.phase
            yield Entry(frame.stamp, "/bench/phase", make_message(STRING, data=phase))
        for side, jaw in frame.jaws.items():
            yield from _truth_entries(frame.stamp, side, jaw)
        if frame.T_camera_object is not None:
            yield Entry(frame.stamp, "/object_pose", _pose(frame.stamp, frame.T_camera_object))
        yield from _image_entries(frame, simulated, compressed)
        seen(frame)


def _truth_entries(stamp: int, side: str, jaw: TrueJaw) -> Iterator[Entry]:
    """Yield the truth about one jaw in one image."""
    frame = f"{side}_jaw"
    yield Entry(stamp, f"/{side}/ground_truth_wrench", wrench_message(stamp, frame, jaw.force, jaw.torque))
    yield Entry(stamp, f"/{side}/{TRUE_KEYPOINTS}", cloud_message(stamp, frame, detection_truth_columns(jaw)))
    yield Entry(stamp, f"/{side}/{TRUE_POSE}", _pose(stamp, jaw.T_camera_jaw))


def _pose(stamp: int, pose: NDArray) -> Any:
    return pose_message(stamp, FRAME, pose[:3, 3], quaternion_from_pose(pose))


def _image_entries(frame: TwinFrame, simulated: SimulatedRecording, compressed: bool) -> Iterator[Entry]:
    """Yield colour, depth and intrinsics of an image."""
    stamp, told = frame.stamp, {"header": header(frame.stamp, FRAME)}
    yield Entry(stamp, INFO_TOPIC, make_message(CAMERA_INFO, **told, **info_fields(simulated.camera)))
    steps = encode_depth(frame.depth, simulated.depth_step)
    if compressed:
        color = encode_color(frame.color)
        yield Entry(stamp, f"{COLOR_TOPIC}/compressed", _packed(told, "rgb8; jpeg compressed bgr8", color))
        yield Entry(stamp, f"{DEPTH_TOPIC}/compressedDepth", _packed(told, DEPTH_FORMAT, compress_depth(steps)))
    else:
        yield Entry(stamp, COLOR_TOPIC, _plain(told, "rgb8", frame.color))
        yield Entry(stamp, DEPTH_TOPIC, _plain(told, "16UC1", steps))


def _packed(told: Mapping[str, Any], form: str, data: bytes) -> Any:
    return make_message(COMPRESSED, **told, format=form, data=np.frombuffer(data, dtype=np.uint8))


def _plain(told: Mapping[str, Any], encoding: str, pixels: NDArray) -> Any:
    pixels = np.ascontiguousarray(pixels)
    height, width = pixels.shape[:2]
    size = {"height": height, "width": width, "step": pixels.strides[0]}
    return make_message(IMAGE, **told, **size, encoding=encoding, data=pixels.reshape(-1).view(np.uint8))


def record_simulation(
    simulated: SimulatedRecording,
    scenario: Scenario,
    seed: int,
    folder: Path,
    *,
    compressed: bool = True,
    finger: int = FINGER,
) -> None:
    """Render the recording of a scene into a new folder, under a progress bar."""
    case = {
        "scene": scenario.name,
        "seed": seed,
        "finger": finger,
        "light": scenario.light,
        "jaw": str(Path(scenario.jaw).resolve()) if Path(scenario.jaw).is_file() else scenario.jaw,
        "object": {"kind": scenario.object},
    }
    if scenario.is_guided and not scenario.roughness:
        case["friction"] = FRICTIONLESS
    with progress_bar(len(simulated), "image", scenario.name) as bar:
        write_simulated_recording(simulated, folder, compressed=compressed, case=case, seen=lambda _: bar.update())
