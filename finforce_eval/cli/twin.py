"""The subcommands `twin list` and `twin record`: a synthetic scene as a recording with its truth, and a preview."""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from shutil import rmtree
from typing import Any

import numpy as np
from numpy.typing import NDArray

from finforce.optional import import_cv2, import_trimesh
from finforce.transforms import pose_numbers, quaternion_from_pose
from finforce_eval.cli.parser import Parser, whole_number
from finforce_eval.errors import OptionError, RecordingError
from finforce_eval.evaluation.keypoint_source import parse_changes
from finforce_eval.recordings.images import (
    CAMERA_INFO,
    COMPRESSED,
    DEPTH_FORMAT,
    IMAGE,
    QUALITY,
    compress_depth,
    encode_color,
)
from finforce_eval.recordings.recording import STRING, TRUE_KEYPOINTS, TRUE_POSE
from finforce_eval.recordings.writer import (
    Entry,
    cloud_message,
    header,
    make_message,
    pose_message,
    wrench_message,
    write_entries,
)
from finforce_keypoints.parameters import COLOR_TOPIC, DEPTH_TOPIC, INFO_TOPIC
from finforce_sim.footage import (
    FINGER,
    Footage,
    TrueJaw,
    TwinFrame,
    build_footage,
    detection_truth_columns,
    encode_depth,
    info_fields,
    parse_size,
)
from finforce_sim.scenarios import SCENARIOS, Scenario, build_scenario, write_script


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the subcommand."""
    actions = parser.add_subparsers(dest="action", metavar="ACTION", required=True, parser_class=Parser)
    listing = actions.add_parser("list", help="name the scenes")
    listing.set_defaults(run=run_list)
    record = actions.add_parser("record", help="render a scene and write it", description="render a scene and write it")
    record.add_argument("scene", metavar="SCENE", help="a name that `finforce twin list` prints")
    record.add_argument("-o", "--output", required=True, metavar="BAG", help="recording to be written, a new folder")
    record.add_argument("--seed", type=whole_number(0, 2**32), default=0, help="of textures, light and noise (0)")
    finger = "seed of the jaws' material; calibration twin is of finger 0 (0)"
    steps = "of the depth in mm: 1 as the ROS driver gives it, 0.1 as the camera itself does (1)"
    record.add_argument("--depth-step", type=float, default=1.0, choices=(1.0, 0.1), help=steps)
    record.add_argument("--finger", type=whole_number(0, 2**32), default=0, metavar="SEED", help=finger)
    record.add_argument("--light", metavar="WORD", help="bright, dim or any; without it that of the scene")
    record.add_argument("--object", metavar="NAME", help="shape by name, or mesh file; without it that of the scene")
    record.add_argument("--jaw", metavar="NAME", help="shipped jaw or jaw file; without it that of the scene, bench")
    text = "two jaws on the wrist or from beyond the tips, or one jaw on the bench"
    record.add_argument("--camera", choices=("robot", "front", "bench"), help=text)
    record.add_argument("--lens", default="d405", choices=("d405", "webcam", "fisheye"), help="of the camera (d405)")
    record.add_argument("--size", default="640x480", metavar="WxH", help="of the images (640x480)")
    text = "change a number of the scene, may be repeated; an unknown NAME lists them"
    record.add_argument("--set", action="append", default=[], metavar="NAME=VALUE", help=text)
    kind = record.add_mutually_exclusive_group()
    kind.add_argument("--compressed", action="store_true", help="jpeg colour and png depth (as it is without --raw)")
    kind.add_argument("--raw", action="store_true", help="plain images, 46 MB a second")
    record.add_argument("--quality", type=int, default=90, metavar="N", help="of the jpegs, 1 to 95 (90)")
    text = "leave depth beyond so many metres away, which makes a recording smaller"
    record.add_argument("--farthest", type=float, default=float("inf"), metavar="M", help=text)
    record.add_argument("--storage", default="mcap", choices=("mcap", "sqlite3"), help="format of the recording")
    record.set_defaults(run=run_record)


def run_list(options: argparse.Namespace) -> None:
    """Print the scenes, with the numbers in which each differs from the default."""
    for name, scenario in SCENARIOS.items():
        duration = write_script(scenario).stamps[-1]
        print(f"{name:<22} {duration:5.1f} s  {', '.join(_deviations(scenario))}")


def _deviations(scenario: Scenario) -> list[str]:
    """Return what makes a scene, as NAME=VALUE."""
    plain = {entry.name: entry.default for entry in fields(Scenario)}
    values = {name: getattr(scenario, name) for name in plain if name != "name"}
    named = ("object", "camera", "light")
    changed = [name for name, value in values.items() if name in named or value != plain[name]]
    return [f"{name}={_short(values[name])}" for name in changed]


def _short(value: Any) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value) or "none"


def run_record(options: argparse.Namespace) -> None:
    """Render a scene and write the recording, its mesh, its `case.json` and a preview.

    Raises:
        FinforceError: an option or the scene cannot be used, or the folder exists.
    """
    folder = Path(options.output)
    check_new(folder)
    scenario = scenario_from_options(options)
    camera = parse_size(options.size, options.lens)
    if min(options.seed, options.finger) < 0:
        raise OptionError(f"--seed {options.seed} --finger {options.finger}: expected numbers from 0")
    if not 1 <= options.quality <= 95:
        raise OptionError(f"--quality {options.quality}: expected 1 to 95")
    if not options.farthest > 0.0:
        raise OptionError(f"--farthest {options.farthest:g}: expected a distance above 0 [m]")
    form = RecordingForm(
        compressed=not options.raw,
        quality=options.quality,
        farthest=options.farthest,
        storage=options.storage,
        depth_step=1e-3 * options.depth_step,
    )
    record_scene(scenario, options.seed, folder, camera=camera, form=form, finger=options.finger)
    size = sum(path.stat().st_size for path in folder.iterdir()) / 1e6
    print(f"Recording: {folder} ({size:.1f} MB), preview: {folder / PREVIEW}")
    print(f"Score it with: finforce evaluate {folder} --from images")


def check_new(folder: Path) -> None:
    """Refuse a folder that exists, or that cannot be made, before the work that would fill it.

    Raises:
        RecordingError: it is one of these.
    """
    try:
        folder.mkdir(parents=True)
        folder.rmdir()
    except FileExistsError as error:
        if folder.exists():
            raise RecordingError(f"{folder}: exists already; a recording is written to a new folder") from error
        raise _not_made(folder, error) from error
    except OSError as error:
        raise _not_made(folder, error) from error


def _not_made(folder: Path, error: OSError) -> RecordingError:
    return RecordingError(
        f"-o {folder}: cannot be made ({error.strerror}); expected a new folder where one may be written"
    )


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


FRAME = "camera_color_optical_frame"
MESH = "object.stl"


@dataclass(frozen=True, kw_only=True)
class RecordingForm:
    """How a recording is written.

    Attributes:
        compressed: jpeg colour and png depth; else plain images.
        quality: of a jpeg, 1 to 95.
        farthest: depth beyond it is left away, which makes a recording smaller [m].
        storage: "mcap" or "sqlite3".
        depth_step: of the depth image [m], that of the footage.
    """

    compressed: bool = True
    quality: int = QUALITY
    farthest: float = math.inf
    storage: str = "mcap"
    depth_step: float = 1e-3


def write_footage(
    footage: Footage,
    folder: str | Path,
    *,
    form: RecordingForm | None = None,
    case: Mapping[str, Any] | None = None,
    seen: Callable[[TwinFrame], Any] = lambda frame: None,
) -> Path:
    """Write footage as a rosbag2 folder with its `case.json` and the object's mesh.

    Args:
        footage: what is written; one image after the other, never all of them in memory.
        folder: the new folder, which must not exist.
        form: how it is written.
        case: further content of the `case.json`.
        seen: called with every image when it has been written.

    Returns:
        The folder.

    Raises:
        RecordingError: the folder exists.
        FinforceError: the footage cannot be made.
    """
    form, folder = form or RecordingForm(), Path(folder)
    folder.parent.mkdir(parents=True, exist_ok=True)
    is_new = not folder.exists()
    try:
        write_entries(footage_entries(footage, form, seen), folder, storage=form.storage)
    except BaseException:
        if is_new:  # half a recording would look like a whole one
            rmtree(folder, ignore_errors=True)
        raise
    content = dict(case or {})
    if footage.mesh is not None:
        mesh = import_trimesh().Trimesh(vertices=footage.mesh.vertices, faces=footage.mesh.triangles, process=False)
        mesh.export(folder / MESH)
        content["mesh"] = f"{folder.name}/{MESH}"
    content["depth_scale"] = footage.depth_step
    content["T_gripper_camera"] = list(pose_numbers(footage.T_gripper_camera))
    (folder / "case.json").write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")
    return folder


def footage_entries(
    footage: Footage, form: RecordingForm, seen: Callable[[TwinFrame], Any] = lambda frame: None
) -> Iterator[Entry]:
    """Yield every message of the footage in the order of its stamps."""
    phase = None
    for frame in footage:
        if frame.phase != phase:
            phase = frame.phase
            yield Entry(frame.stamp, "/bench/phase", make_message(STRING, data=phase))
        for side, jaw in frame.jaws.items():
            yield from _truth_entries(frame.stamp, side, jaw)
        if frame.T_camera_object is not None:
            yield Entry(frame.stamp, "/object_pose", _pose(frame.stamp, frame.T_camera_object))
        yield from _image_entries(frame, footage, form)
        seen(frame)


def _truth_entries(stamp: int, side: str, jaw: TrueJaw) -> Iterator[Entry]:
    """Yield the truth about one jaw in one image."""
    frame = f"{side}_jaw"
    yield Entry(stamp, f"/{side}/ground_truth_wrench", wrench_message(stamp, frame, jaw.force, jaw.torque))
    yield Entry(stamp, f"/{side}/{TRUE_KEYPOINTS}", cloud_message(stamp, frame, detection_truth_columns(jaw)))
    yield Entry(stamp, f"/{side}/{TRUE_POSE}", _pose(stamp, jaw.T_camera_jaw))


def _pose(stamp: int, pose: NDArray) -> Any:
    return pose_message(stamp, FRAME, pose[:3, 3], quaternion_from_pose(pose))


def _image_entries(frame: TwinFrame, footage: Footage, form: RecordingForm) -> Iterator[Entry]:
    """Yield colour, depth and intrinsics of an image."""
    stamp, told = frame.stamp, {"header": header(frame.stamp, FRAME)}
    yield Entry(stamp, INFO_TOPIC, make_message(CAMERA_INFO, **told, **info_fields(footage.camera)))
    steps = encode_depth(np.where(frame.depth <= form.farthest, frame.depth, np.nan), footage.depth_step)
    if form.compressed:
        color = encode_color(frame.color, quality=form.quality)
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


PREVIEW = "preview.jpg"


def record_scene(
    scenario: Scenario, seed: int, folder: Path, *, camera: Any, form: RecordingForm, finger: int = FINGER
) -> None:
    """Render a scene of a finger into a new folder, under a progress bar."""
    from tqdm import tqdm

    footage = build_footage(scenario, seed, camera, finger=finger, depth_step=form.depth_step)
    preview = Preview(len(footage))
    case = {
        "scene": scenario.name,
        "seed": seed,
        "finger": finger,
        "light": scenario.light,
        "object": {"kind": scenario.object},
    }
    with tqdm(total=len(footage), unit="image", desc=scenario.name, disable=None, leave=False) as bar:

        def seen(frame: Any) -> None:
            preview.take(frame)
            bar.update()

        write_footage(footage, folder, form=form, case=case, seen=seen)
    preview.save(folder / PREVIEW)


COUNT, COLUMNS = 6, 2
WIDEST = 320  # [px] of an image in the picture
VISIBLE, HIDDEN = (60, 230, 90), (235, 60, 60)
ARM = 3  # [px] of the cross at a key point
NEAR, FAR = 0.07, 0.25  # [m] of the depth that is drawn from bright to dark


class Preview:
    """Keeps a few images, evenly spread, and draws them with their depth.

    Args:
        frames: how many images there will be.
    """

    def __init__(self, frames: int) -> None:
        self._wanted = set(np.linspace(0, frames - 1, min(COUNT, frames)).round().astype(int).tolist())
        self._next, self._tiles = 0, []

    def take(self, frame: TwinFrame) -> None:
        """Take the next image."""
        if self._next in self._wanted:
            step = -(-frame.color.shape[1] // WIDEST)
            tile = np.hstack((draw_keypoints(frame, step), draw_depth(frame.depth[::step, ::step])))
            self._tiles.append(tile)
        self._next += 1

    def save(self, path: Path) -> None:
        """Write what was kept; nothing without images."""
        from PIL import Image

        if not self._tiles:
            return
        missing = -len(self._tiles) % COLUMNS if len(self._tiles) > COLUMNS else 0
        tiles = [*self._tiles, *[np.zeros_like(self._tiles[0])] * missing]
        columns = min(COLUMNS, len(tiles))
        rows = [np.hstack(tiles[begin : begin + columns]) for begin in range(0, len(tiles), columns)]
        Image.fromarray(np.vstack(rows)).save(path)


def draw_keypoints(frame: TwinFrame, step: int = 1) -> NDArray[np.uint8]:
    """Return the image with a cross at each true key point, green where it is visible, else red.

    Args:
        frame: with an image (h, w, 3).
        step: every how many of its pixels are drawn.
    """
    cv2, picture = import_cv2(), np.array(frame.color[::step, ::step])
    for jaw in frame.jaws.values():
        for pixel, visible in zip(jaw.pixels, jaw.visible, strict=True):
            if np.isfinite(pixel).all():
                place, color = np.round(pixel / step).astype(int).tolist(), VISIBLE if visible else HIDDEN
                cv2.drawMarker(picture, place, color, cv2.MARKER_CROSS, 2 * ARM + 1)
    return picture


def draw_depth(depth: NDArray) -> NDArray[np.uint8]:
    """Return a depth image (h, w) [m] in grey (h, w, 3), bright where it is near, black where there is none."""
    share = (FAR - np.nan_to_num(depth, nan=FAR)) / (FAR - NEAR)
    grey = (40.0 + 215.0 * np.clip(share, 0.0, 1.0)) * np.isfinite(depth)
    return np.repeat(grey.astype(np.uint8)[:, :, None], 3, axis=2)
