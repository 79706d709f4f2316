"""Recordings into rosbag2 files, as a bench would have recorded them."""

from __future__ import annotations

import json
import os
import shutil
import sqlite3
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from functools import lru_cache
from glob import escape
from pathlib import Path
from tempfile import mkdtemp
from typing import Any, NamedTuple

import numpy as np

from finforce.errors import one_line
from finforce.messages import NANOSECONDS, STDDEV_COLUMNS, SharedStddev, encode_cloud, shared_columns
from finforce.settings import GripperParameters
from finforce_eval.errors import RecordingError
from finforce_eval.recordings.gravity import GRAVITY, VECTOR
from finforce_eval.recordings.recording import CLOUD, POSE, STRING, WRENCH
from finforce_eval.recordings.tracks import KeypointTrack, PhaseTrack, PoseTrack, Recording
from finforce_ifea.messages import ARROW, CONTACT, CONTACT_DIAMETER, FORCE, NEWTONS_PER_METRE

MARKERS = "visualization_msgs/msg/MarkerArray"
STATUS = "diagnostic_msgs/msg/DiagnosticArray"


class Entry(NamedTuple):
    """One message to be written."""

    stamp: int
    topic: str
    message: Any


@lru_cache(maxsize=1)
def typestore() -> Any:
    """Return the message types of ROS 2 Jazzy, of rosbags."""
    from rosbags.typesys import Stores, get_typestore

    return get_typestore(Stores.ROS2_JAZZY)


def make_message(kind: str, **values: Any) -> Any:
    """Return a message of a type; mappings become messages, what is not given is zero or empty."""
    fields = typestore().fielddefs[kind][1]
    return typestore().types[kind](**{name: _make_value(values.get(name), *what) for name, what in fields})


def _make_value(value: Any, node: Any, what: Any) -> Any:
    """Return the value of a field that rosbags describes by its node and what that is of; zero for None."""
    if node.name == "BASE":
        return {"string": "", "bool": False}.get(what[0], 0) if value is None else value
    if node.name == "NAME":
        return make_message(what, **(value or {})) if value is None or isinstance(value, Mapping) else value
    (node, what), count = what
    if node.name == "BASE" and what[0] not in ("string", "bool"):
        return np.zeros(count, what[0]) if value is None else np.asarray(value, what[0])
    return [_make_value(each, node, what) for each in value or ()]


def header(stamp: int, frame_id: str) -> dict[str, Any]:
    """Return a header; stamp [ns]."""
    seconds, nanoseconds = divmod(int(stamp), NANOSECONDS)
    return {"stamp": {"sec": seconds, "nanosec": nanoseconds}, "frame_id": frame_id}


def _named(values: Iterable[float], names: str = "xyz") -> dict[str, float]:
    """Return the numbers of a vector, a point, a quaternion or a colour by their names."""
    return {name: float(value) for name, value in zip(names, values, strict=True)}


def cloud_message(stamp: int, frame_id: str, columns: Mapping[str, np.ndarray]) -> Any:
    """Return a PointCloud2 of height 1."""
    encoded = encode_cloud(columns)
    width = len(next(iter(columns.values())))
    return make_message(
        CLOUD,
        header=header(stamp, frame_id),
        height=1,
        width=width,
        fields=[vars(entry) for entry in encoded.fields],
        point_step=encoded.point_step,
        row_step=encoded.point_step * width,
        data=np.frombuffer(encoded.data, dtype=np.uint8),
    )


def wrench_message(stamp: int, frame_id: str, force: np.ndarray, torque: np.ndarray) -> Any:
    """Return a WrenchStamped."""
    return make_message(
        WRENCH, header=header(stamp, frame_id), wrench={"force": _named(force), "torque": _named(torque)}
    )


def pose_message(stamp: int, frame_id: str, position: Iterable[float], quaternion: Iterable[float]) -> Any:
    """Return a PoseStamped."""
    pose = {"position": _named(position), "orientation": _named(quaternion, "xyzw")}
    return make_message(POSE, header=header(stamp, frame_id), pose=pose)


def status_message(stamp: int, level: int, name: str, text: str, values: Mapping[str, str]) -> Any:
    """Return a DiagnosticArray of one status."""
    pairs = [{"key": key, "value": value} for key, value in values.items()]
    status = {"level": level, "name": name, "message": text, "values": pairs}
    return make_message(STATUS, header=header(stamp, ""), status=[status])


def force_markers(stamp: int, frame_id: str, point: np.ndarray, force: np.ndarray) -> Any:
    """Return a MarkerArray of a contact point (3,) [m] and an arrow that ends there, for a force (3,) [N]."""
    kind = typestore().types["visualization_msgs/msg/Marker"]
    known = bool(np.isfinite(point).all() and np.isfinite(force).all() and np.any(force))
    ends = [_named(point - force / NEWTONS_PER_METRE), _named(point)] if known else []
    shapes = (
        ("contact", kind.SPHERE_LIST, ends[1:], (CONTACT_DIAMETER,) * 3, CONTACT),
        ("force", kind.ARROW, ends, ARROW, FORCE),
    )
    markers = [
        {
            "header": header(stamp, frame_id),
            "ns": name,
            "type": shape,
            "action": kind.ADD if known else kind.DELETE,
            "pose": {"orientation": {"w": 1.0}},
            "scale": _named(scale),
            "color": _named(color, "rgba"),
            "points": points,
        }
        for name, shape, points, scale, color in shapes
    ]
    return make_message(MARKERS, markers=markers)


@contextmanager
def new_folder(target: Path) -> Iterator[Path]:
    """Yield the path of a folder to be made, which takes its place under its own name once it is whole.

    Raises:
        RecordingError: the target exists, or cannot be made.
        OSError: it cannot be written.
    """
    try:
        if target.exists():
            raise RecordingError(f"{target}: exists already; a recording is written to a new folder")
        target.parent.mkdir(parents=True, exist_ok=True)
        part = Path(mkdtemp(prefix=f".{target.name}.", suffix=".part", dir=target.parent))
    except OSError as error:
        what = f"cannot be made ({error.strerror}); expected a new folder where one may be written"
        raise RecordingError(f"{target}: {what}") from error
    try:
        yield part / target.name
        os.replace(part / target.name, target)
        for left in target.parent.glob(f".{escape(target.name)}.{'?' * 8}.part"):  # of attempts that were killed
            shutil.rmtree(left, ignore_errors=True)
    except sqlite3.Error as error:  # of a full disk
        raise OSError(f"{target}: cannot be written: {one_line(error)}") from error
    finally:
        with suppress(OSError):
            shutil.rmtree(part)


def write_recording(
    recording: Recording, folder: str | Path, *, storage: str = "mcap", compressed: bool = False
) -> Path:
    """Write a recording as a rosbag2 folder with its `case.json`.

    Args:
        recording: tracks to write, interleaved by stamp.
        folder: the new folder, which must not exist.
        storage: "mcap" or "sqlite3".
        compressed: compress the chunks (mcap only).

    Returns:
        The folder.

    Raises:
        RecordingError: the folder exists.
    """
    entries = sorted(recording_entries(recording), key=lambda entry: entry.stamp)
    folder = write_entries(entries, folder, storage=storage, compressed=compressed)
    if recording.case:
        (folder / "case.json").write_text(json.dumps(recording.case, indent=2) + "\n", encoding="utf-8")
    return folder


def write_entries(
    entries: Iterable[Entry], folder: str | Path, *, storage: str = "mcap", compressed: bool = False
) -> Path:
    """Write messages in the order given as a rosbag2 folder, and return the folder.

    Raises:
        RecordingError: the folder exists.
    """
    from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer

    folder = Path(folder)
    if folder.exists():
        raise RecordingError(f"{folder}: exists already; a recording is written to a new folder")
    writer = Writer(folder, version=9, storage_plugin=StoragePlugin[storage.upper()])
    if compressed:
        writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
    connections: dict[str, Any] = {}
    types = typestore()
    with writer:
        for entry in entries:
            kind = entry.message.__msgtype__
            if entry.topic not in connections:
                connections[entry.topic] = writer.add_connection(entry.topic, kind, typestore=types)
            data = types.serialize_cdr(entry.message, kind)
            writer.write(connections[entry.topic], entry.stamp, data)
    return folder


def recording_entries(recording: Recording) -> Iterator[Entry]:
    """Yield every message of a recording, track by track."""
    for side, track in recording.jaws.items():
        if not track.is_awaited:
            yield from _keypoint_entries(track.keypoints, side)
        if track.truth is not None:
            for stamp, force, torque in zip(track.truth.stamps_ns, track.truth.force, track.truth.torque, strict=True):
                wrench = wrench_message(stamp, f"{side}_jaw", force, torque)
                yield Entry(int(stamp), f"/{side}/ground_truth_wrench", wrench)
        if track.pose is not None:
            yield from _pose_entries(track.pose, f"/{side}/jaw_pose")
    if recording.object_pose is not None:
        yield from _pose_entries(recording.object_pose, "/object_pose")
    if recording.gravity is not None:
        for stamp, direction in zip(recording.gravity.stamps_ns, recording.gravity.direction, strict=True):
            told = make_message(VECTOR, header=header(stamp, GripperParameters.gripper_frame), vector=_named(direction))
            yield Entry(int(stamp), GRAVITY, told)
    if recording.phases is not None:
        yield from _phase_entries(recording.phases)


def _keypoint_entries(track: KeypointTrack, side: str) -> Iterator[Entry]:
    for index, stamp in enumerate(track.stamps_ns):
        columns = {axis: track.points[index, :, i] for i, axis in enumerate("xyz")}
        columns["likelihood"] = track.likelihood[index]
        if track.stddev is not None:
            columns |= {name: track.stddev[index, :, i] for i, name in enumerate(STDDEV_COLUMNS)}
        if track.shared is not None:
            columns |= shared_columns(SharedStddev(*track.shared[index]), track.count)
        cloud = cloud_message(stamp, f"{side}_jaw", {name: value.astype(np.float32) for name, value in columns.items()})
        yield Entry(int(stamp), f"/{side}/keypoints", cloud)


def _pose_entries(track: PoseTrack, topic: str) -> Iterator[Entry]:
    for stamp, position, quaternion in zip(track.stamps_ns, track.position, track.quaternion, strict=True):
        yield Entry(int(stamp), topic, pose_message(stamp, track.frame_id, position, quaternion))


def _phase_entries(track: PhaseTrack) -> Iterator[Entry]:
    columns = (track.stamps_ns, track.cycle, track.direction, track.displacement_mm, track.stage)
    for stamp, cycle, direction, displacement, stage in zip(*columns, strict=True):
        text = f"{cycle}:{direction}:{displacement:g}:{stage}"
        yield Entry(int(stamp), "/bench/phase", make_message(STRING, data=text))
