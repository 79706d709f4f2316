"""Synthetic scenes as recordings: images, poses, the truth, and a preview."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from shutil import rmtree
from typing import Any

import numpy as np
from numpy.typing import NDArray

from finforce.optional import import_trimesh
from finforce.transforms import pose_numbers, quaternion_from_pose
from finforce_contact.mesh.object_mesh import ObjectMesh
from finforce_eval.recordings.images import (
    CAMERA_INFO,
    COMPRESSED,
    DEPTH_FORMAT,
    IMAGE,
    QUALITY,
    compress_depth,
    encode_color,
)
from finforce_eval.recordings.recording import CLOUD, POSE, STRING, TRUE_KEYPOINTS, TRUE_POSE, WRENCH
from finforce_eval.recordings.writer import Entry, MessageFactory, write_entries
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
)
from finforce_sim.scenarios import Scenario

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
    form = form or RecordingForm()
    factory = MessageFactory()
    folder = Path(folder)
    folder.parent.mkdir(parents=True, exist_ok=True)
    entries = _footage_entries(footage, ImageFactory(factory, form), seen)
    is_new = not folder.exists()
    try:
        write_entries(entries, folder, factory, storage=form.storage)
    except BaseException:
        if is_new:  # half a recording would look like a whole one
            rmtree(folder, ignore_errors=True)
        raise
    content = dict(case or {})
    if footage.mesh is not None:
        write_mesh(footage.mesh, folder / MESH)
        content["mesh"] = f"{folder.name}/{MESH}"
    content["depth_scale"] = footage.depth_step
    content["T_gripper_camera"] = list(pose_numbers(footage.T_gripper_camera))
    (folder / "case.json").write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")
    return folder


def write_mesh(mesh: ObjectMesh, path: Path) -> None:
    """Write an object's mesh [m]."""
    import_trimesh().Trimesh(vertices=mesh.vertices, faces=mesh.triangles, process=False).export(path)


class ImageFactory:
    """Builds the messages of a camera.

    Args:
        factory: of the other messages.
        form: how images are written.
    """

    def __init__(self, factory: MessageFactory, form: RecordingForm) -> None:
        self.messages, self._form = factory, form
        self._types = factory.typestore.types

    def entries(self, frame: TwinFrame, footage: Footage) -> Iterator[Entry]:
        """Yield colour, depth and intrinsics of an image."""
        header = self.messages.header(frame.stamp, FRAME)
        region = self._types["sensor_msgs/msg/RegionOfInterest"](0, 0, 0, 0, False)
        info = info_fields(footage.camera) | {"binning_x": 0, "binning_y": 0, "roi": region}
        yield Entry(frame.stamp, INFO_TOPIC, CAMERA_INFO, self._types[CAMERA_INFO](header=header, **info))
        steps = encode_depth(np.where(frame.depth <= self._form.farthest, frame.depth, np.nan), footage.depth_step)
        if self._form.compressed:
            color = encode_color(frame.color, quality=self._form.quality)
            yield self._packed(f"{COLOR_TOPIC}/compressed", header, "rgb8; jpeg compressed bgr8", color)
            yield self._packed(f"{DEPTH_TOPIC}/compressedDepth", header, DEPTH_FORMAT, compress_depth(steps))
        else:
            yield self._plain(COLOR_TOPIC, header, "rgb8", frame.color)
            yield self._plain(DEPTH_TOPIC, header, "16UC1", steps)

    def _packed(self, topic: str, header: Any, form: str, data: bytes) -> Entry:
        message = self._types[COMPRESSED](header=header, format=form, data=np.frombuffer(data, dtype=np.uint8))
        return Entry(_stamp(header), topic, COMPRESSED, message)

    def _plain(self, topic: str, header: Any, encoding: str, pixels: np.ndarray) -> Entry:
        pixels = np.ascontiguousarray(pixels)
        message = self._types[IMAGE](
            header=header,
            height=pixels.shape[0],
            width=pixels.shape[1],
            encoding=encoding,
            is_bigendian=0,
            step=pixels.strides[0],
            data=pixels.reshape(-1).view(np.uint8),
        )
        return Entry(_stamp(header), topic, IMAGE, message)


def _stamp(header: Any) -> int:
    return header.stamp.sec * 1_000_000_000 + header.stamp.nanosec


def _footage_entries(footage: Footage, images: ImageFactory, seen: Callable[[TwinFrame], Any]) -> Iterator[Entry]:
    """Yield every message of the footage in the order of its stamps."""
    factory, phase = images.messages, None
    for frame in footage:
        if frame.phase != phase:
            phase = frame.phase
            yield Entry(frame.stamp, "/bench/phase", STRING, factory.string(phase))
        for side, jaw in frame.jaws.items():
            yield from _truth_entries(frame.stamp, side, jaw, factory)
        if frame.T_camera_object is not None:
            yield Entry(frame.stamp, "/object_pose", POSE, _pose(frame.stamp, frame.T_camera_object, factory))
        yield from images.entries(frame, footage)
        seen(frame)


def _truth_entries(stamp: int, side: str, jaw: TrueJaw, factory: MessageFactory) -> Iterator[Entry]:
    """Yield the truth about one jaw in one image."""
    wrench = factory.wrench(stamp, f"{side}_jaw", jaw.force, jaw.torque)
    yield Entry(stamp, f"/{side}/ground_truth_wrench", WRENCH, wrench)
    columns = detection_truth_columns(jaw)
    yield Entry(stamp, f"/{side}/{TRUE_KEYPOINTS}", CLOUD, factory.cloud(stamp, f"{side}_jaw", columns))
    yield Entry(stamp, f"/{side}/{TRUE_POSE}", POSE, _pose(stamp, jaw.T_camera_jaw, factory))


def _pose(stamp: int, pose: np.ndarray, factory: MessageFactory) -> Any:
    return factory.pose(stamp, FRAME, pose[:3, 3], quaternion_from_pose(pose))


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
    picture = np.array(frame.color[::step, ::step])
    for jaw in frame.jaws.values():
        for pixel, visible in zip(jaw.pixels, jaw.visible, strict=True):
            if np.isfinite(pixel).all():
                _draw_cross(picture, *np.round(pixel / step).astype(int).tolist(), VISIBLE if visible else HIDDEN)
    return picture


def _draw_cross(picture: NDArray[np.uint8], column: int, row: int, color: tuple[int, int, int]) -> None:
    height, width = picture.shape[:2]
    if 0 <= column < width and 0 <= row < height:
        picture[row, max(column - ARM, 0) : column + ARM + 1] = color
        picture[max(row - ARM, 0) : row + ARM + 1, column] = color


def draw_depth(depth: NDArray) -> NDArray[np.uint8]:
    """Return a depth image (h, w) [m] in grey (h, w, 3), bright where it is near, black where there is none."""
    share = (FAR - np.nan_to_num(depth, nan=FAR)) / (FAR - NEAR)
    grey = (40.0 + 215.0 * np.clip(share, 0.0, 1.0)) * np.isfinite(depth)
    return np.repeat(grey.astype(np.uint8)[:, :, None], 3, axis=2)
