"""Recordings into rosbag2 files, as a bench would have recorded them."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from finforce.errors import MissingDependencyError
from finforce.messages import STDDEV_COLUMNS, encode_cloud
from finforce.stamps import NANOSECONDS
from finforce_eval.errors import RecordingError
from finforce_eval.recordings.recording import CLOUD, POSE, STRING, WRENCH
from finforce_eval.recordings.tracks import KeypointTrack, PhaseTrack, PoseTrack, Recording, WrenchTrack
from finforce_ifea.messages import ARROW, CONTACT, CONTACT_DIAMETER, FORCE, NEWTONS_PER_METRE

MARKERS = "visualization_msgs/msg/MarkerArray"


class Entry(NamedTuple):
    """One message to be written."""

    stamp: int
    topic: str
    msgtype: str
    message: Any


class MessageFactory:
    """Builds messages of the standard types from arrays."""

    def __init__(self) -> None:
        """Load the message types."""
        try:
            from rosbags.typesys import Stores, get_typestore
        except ImportError as error:
            raise MissingDependencyError("writing a recording needs rosbags: pip install rosbags") from error
        self.typestore = get_typestore(Stores.ROS2_JAZZY)
        self._types = self.typestore.types

    def header(self, stamp: int, frame_id: str) -> Any:
        """Return a header; stamp [ns]."""
        seconds, nanoseconds = divmod(int(stamp), NANOSECONDS)
        time = self._types["builtin_interfaces/msg/Time"](sec=seconds, nanosec=nanoseconds)
        return self._types["std_msgs/msg/Header"](stamp=time, frame_id=frame_id)

    def vector(self, values: np.ndarray) -> Any:
        """Return a Vector3."""
        return self._types["geometry_msgs/msg/Vector3"](*(float(value) for value in values))

    def cloud(self, stamp: int, frame_id: str, columns: dict[str, np.ndarray]) -> Any:
        """Return a PointCloud2 of height 1."""
        encoded = encode_cloud(columns)
        width = len(next(iter(columns.values())))
        field_type = self._types["sensor_msgs/msg/PointField"]
        return self._types[CLOUD](
            header=self.header(stamp, frame_id),
            height=1,
            width=width,
            fields=[field_type(f.name, f.offset, f.datatype, f.count) for f in encoded.fields],
            is_bigendian=False,
            point_step=encoded.point_step,
            row_step=encoded.point_step * width,
            data=np.frombuffer(encoded.data, dtype=np.uint8),
            is_dense=False,
        )

    def wrench(self, stamp: int, frame_id: str, force: np.ndarray, torque: np.ndarray) -> Any:
        """Return a WrenchStamped."""
        wrench = self._types["geometry_msgs/msg/Wrench"](self.vector(force), self.vector(torque))
        return self._types[WRENCH](self.header(stamp, frame_id), wrench)

    def pose(self, stamp: int, frame_id: str, position: np.ndarray, quaternion: np.ndarray) -> Any:
        """Return a PoseStamped."""
        point = self._types["geometry_msgs/msg/Point"](*(float(value) for value in position))
        turn = self._types["geometry_msgs/msg/Quaternion"](*(float(value) for value in quaternion))
        pose = self._types["geometry_msgs/msg/Pose"](point, turn)
        return self._types[POSE](self.header(stamp, frame_id), pose)

    def status(self, stamp: int, level: int, name: str, text: str, values: Mapping[str, str]) -> Any:
        """Return a DiagnosticArray of one status."""
        pairs = [self._types["diagnostic_msgs/msg/KeyValue"](key=key, value=value) for key, value in values.items()]
        status = self._types["diagnostic_msgs/msg/DiagnosticStatus"](
            level=level, name=name, message=text, hardware_id="", values=pairs
        )
        return self._types["diagnostic_msgs/msg/DiagnosticArray"](header=self.header(stamp, ""), status=[status])

    def force_markers(self, stamp: int, frame_id: str, point: np.ndarray, force: np.ndarray) -> Any:
        """Return a MarkerArray of a contact point (3,) [m] and an arrow that ends there, for a force (3,) [N]."""
        types = self._types
        known = bool(np.isfinite(point).all() and np.isfinite(force).all() and np.any(force))
        ends = [point - force / NEWTONS_PER_METRE, point] if known else []
        kind = types["visualization_msgs/msg/Marker"]
        points = [types["geometry_msgs/msg/Point"](*(float(value) for value in end)) for end in ends]
        zero = types["geometry_msgs/msg/Pose"](
            types["geometry_msgs/msg/Point"](0.0, 0.0, 0.0), types["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0)
        )
        shapes = (
            ("contact", kind.SPHERE_LIST, points[1:], (CONTACT_DIAMETER,) * 3, CONTACT),
            ("force", kind.ARROW, points, ARROW, FORCE),
        )
        markers = [
            kind(
                header=self.header(stamp, frame_id),
                ns=name,
                id=0,
                type=shape,
                action=kind.ADD if known else kind.DELETE,
                pose=zero,
                scale=self.vector(np.array(scale)),
                color=types["std_msgs/msg/ColorRGBA"](*color),
                lifetime=types["builtin_interfaces/msg/Duration"](sec=0, nanosec=0),
                frame_locked=False,
                points=ends_of,
                colors=[],
                texture_resource="",
                texture=types["sensor_msgs/msg/CompressedImage"](self.header(0, ""), "", np.zeros(0, np.uint8)),
                uv_coordinates=[],
                text="",
                mesh_resource="",
                mesh_file=types["visualization_msgs/msg/MeshFile"]("", np.zeros(0, np.uint8)),
                mesh_use_embedded_materials=False,
            )
            for name, shape, ends_of, scale, color in shapes
        ]
        return types[MARKERS](markers=markers)

    def string(self, text: str) -> Any:
        """Return a String."""
        return self._types[STRING](data=text)


def write_recording(
    recording: Recording, folder: str | Path, *, storage: str = "mcap", compressed: bool = False
) -> Path:
    """Write a recording as a rosbag2 folder with its `case.json`.

    Args:
        recording: what to write; its tracks are interleaved by stamp.
        folder: the new folder, which must not exist.
        storage: "mcap" or "sqlite3".
        compressed: compress the chunks (mcap only).

    Returns:
        The folder.

    Raises:
        RecordingError: the folder exists.
        MissingDependencyError: rosbags is not installed.
    """
    factory = MessageFactory()
    entries = sorted(recording_entries(recording, factory), key=lambda entry: entry.stamp)
    folder = write_entries(entries, folder, factory, storage=storage, compressed=compressed)
    if recording.case:
        (folder / "case.json").write_text(json.dumps(recording.case, indent=2) + "\n", encoding="utf-8")
    return folder


def write_entries(
    entries: Iterable[Entry],
    folder: str | Path,
    factory: MessageFactory,
    *,
    storage: str = "mcap",
    compressed: bool = False,
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
    types = factory.typestore
    with writer:
        for entry in entries:
            if entry.topic not in connections:
                connections[entry.topic] = writer.add_connection(entry.topic, entry.msgtype, typestore=types)
            data = types.serialize_cdr(entry.message, entry.msgtype)
            writer.write(connections[entry.topic], entry.stamp, data)
    return folder


def recording_entries(recording: Recording, factory: MessageFactory) -> Iterator[Entry]:
    """Yield every message of a recording, track by track."""
    for side, track in recording.jaws.items():
        if not track.is_awaited:
            yield from _keypoint_entries(track.keypoints, side, factory)
        if track.truth is not None:
            yield from _wrench_entries(track.truth, side, factory)
        if track.pose is not None:
            yield from _pose_entries(track.pose, f"/{side}/jaw_pose", factory)
    if recording.object_pose is not None:
        yield from _pose_entries(recording.object_pose, "/object_pose", factory)
    if recording.phases is not None:
        yield from _phase_entries(recording.phases, factory)


def _keypoint_entries(track: KeypointTrack, side: str, factory: MessageFactory) -> Iterator[Entry]:
    for index, stamp in enumerate(track.stamps):
        columns = {axis: track.points[index, :, i] for i, axis in enumerate("xyz")}
        columns["likelihood"] = track.likelihood[index]
        if track.stddev is not None:
            columns |= {name: track.stddev[index, :, i] for i, name in enumerate(STDDEV_COLUMNS)}
        cloud = factory.cloud(stamp, f"{side}_jaw", {name: value.astype(np.float32) for name, value in columns.items()})
        yield Entry(int(stamp), f"/{side}/keypoints", CLOUD, cloud)


def _wrench_entries(track: WrenchTrack, side: str, factory: MessageFactory) -> Iterator[Entry]:
    for stamp, force, torque in zip(track.stamps, track.force, track.torque, strict=True):
        wrench = factory.wrench(stamp, f"{side}_jaw", force, torque)
        yield Entry(int(stamp), f"/{side}/ground_truth_wrench", WRENCH, wrench)


def _pose_entries(track: PoseTrack, topic: str, factory: MessageFactory) -> Iterator[Entry]:
    for stamp, position, quaternion in zip(track.stamps, track.position, track.quaternion, strict=True):
        yield Entry(int(stamp), topic, POSE, factory.pose(stamp, track.frame_id, position, quaternion))


def _phase_entries(track: PhaseTrack, factory: MessageFactory) -> Iterator[Entry]:
    columns = (track.stamps, track.cycle, track.direction, track.displacement_mm, track.stage)
    for stamp, cycle, direction, displacement, stage in zip(*columns, strict=True):
        text = f"{cycle}:{direction}:{displacement:g}:{stage}"
        yield Entry(int(stamp), "/bench/phase", STRING, factory.string(text))
