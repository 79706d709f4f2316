"""rosbag2 files (mcap, sqlite3) into recordings; the only place that reads bags."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from finforce_eval.errors import RecordingError
from finforce_eval.tracks import (
    JAWS,
    NANOSECONDS,
    JawTrack,
    KeypointTrack,
    PoseTrack,
    Recording,
    WrenchTrack,
    parse_phases,
)
from finforce_ifea.errors import MissingDependencyError, ObservationError
from finforce_ifea.pointcloud import Keypoints, decode_keypoints

CLOUD = "sensor_msgs/msg/PointCloud2"
WRENCH = "geometry_msgs/msg/WrenchStamped"
POSE = "geometry_msgs/msg/PoseStamped"
STRING = "std_msgs/msg/String"
TOPICS = {"/object_pose": POSE, "/bench/phase": STRING}
for _side in JAWS:
    TOPICS |= {
        f"/{_side}/keypoints": CLOUD,
        f"/{_side}/ground_truth_wrench": WRENCH,
        f"/{_side}/jaw_pose": POSE,
    }


class Sample(NamedTuple):
    """A message and the time [ns] at which the bag received it."""

    time: int
    message: Any


def read_recording(path: str | Path) -> Recording:
    """Read a rosbag2 folder or a single .mcap / .db3 file, with the `case.json` beside it.

    Topics that are not ours are not decoded; those of unknown type are named in `notes`.

    Args:
        path: the folder or the file.

    Raises:
        RecordingError: nothing there, damaged, empty, without key points, or with malformed content.
        MissingDependencyError: rosbags is not installed.
    """
    source = bag_source(Path(path))
    folder = source if source.is_dir() else source.parent
    name = source.name if source.is_dir() else source.stem
    samples, notes = _read_samples(source, name)
    jaws = {side: _jaw_track(samples, side, name) for side in JAWS if samples.get(f"/{side}/keypoints")}
    if not jaws:
        raise RecordingError(f"{name}: no key points: /left/keypoints and /right/keypoints have no messages")
    phases = samples.get("/bench/phase")
    poses = samples.get("/object_pose")
    return Recording(
        name=name,
        path=Path(path),
        jaws=jaws,
        object_pose=_pose_track(poses, "/object_pose", name) if poses else None,
        phases=_phases(phases, name) if phases else None,
        case=_read_case(folder / "case.json"),
        notes=tuple(notes),
    )


def bag_source(path: Path) -> Path:
    """Return what rosbags can open: a folder with metadata.yaml, or the one bag file in a folder without."""
    if not path.exists():
        raise RecordingError(f"{path}: no such recording")
    path = path.resolve()
    if path.is_file() and path.suffix not in (".mcap", ".db3"):
        raise RecordingError(f"{path.name}: not a recording; expected a rosbag2 folder, .mcap or .db3")
    if path.is_file() or (path / "metadata.yaml").exists():
        return path
    files = sorted([*path.glob("*.mcap"), *path.glob("*.db3")])
    if len(files) != 1:
        found = f"no metadata.yaml and {len(files)} bag files" if files else "no metadata.yaml, .mcap or .db3"
        raise RecordingError(f"{path.name}: the folder is no recording: {found} in it")
    return files[0]


@contextmanager
def damage_reported(name: str) -> Iterator[None]:
    """Turn whatever a bag reader raises on damaged bytes into one RecordingError."""
    try:
        yield
    except (RecordingError, MissingDependencyError):
        raise
    except Exception as error:  # struct, sqlite3, zstd, lz4, yaml, ... each has its own classes
        reason = " ".join(str(error).split()) or type(error).__name__
        raise RecordingError(f"{name}: truncated or damaged: {reason}") from error


def _read_samples(source: Path, name: str) -> tuple[dict[str, list[Sample]], list[str]]:
    """Decode the messages of our topics, by topic, and note the topics of unknown type."""
    try:
        from rosbags.rosbag2 import Reader
        from rosbags.typesys import Stores, get_typestore
    except ImportError as error:
        raise MissingDependencyError("reading a recording needs rosbags: pip install rosbags") from error
    # not AnyReader: it registers every definition in the bag and ends at a foreign one it cannot parse
    types = get_typestore(Stores.ROS2_JAZZY)
    samples: dict[str, list[Sample]] = {}
    with damage_reported(name), Reader(source) as reader:
        if reader.message_count == 0:
            raise RecordingError(f"{name}: the recording is empty: it holds no messages")
        ours = [connection for connection in reader.connections if connection.topic in TOPICS]
        _check_types(ours, name)
        notes = _foreign_notes(reader.connections, types.fielddefs)
        for connection, time, data in reader.messages(connections=ours) if ours else ():
            message = types.deserialize_cdr(data, connection.msgtype)
            samples.setdefault(connection.topic, []).append(Sample(time, message))
    return samples, notes


def _check_types(connections: Iterable[Any], name: str) -> None:
    """Refuse one of our topics with another type."""
    for connection in connections:
        expected = TOPICS[connection.topic]
        if connection.msgtype != expected:
            raise RecordingError(f"{name}: {connection.topic} is {connection.msgtype}; expected {expected}")


def _foreign_notes(connections: Iterable[Any], known: Mapping[str, Any]) -> list[str]:
    """Name the topics whose type is unknown."""
    return [
        f"{connection.topic} skipped: unknown type {connection.msgtype}"
        for connection in connections
        if connection.msgtype not in known
    ]


def _stamp(sample: Sample) -> int:
    """Return the header stamp [ns]."""
    stamp = sample.message.header.stamp
    return stamp.sec * NANOSECONDS + stamp.nanosec


def _stamps(samples: Sequence[Sample], topic: str, name: str, *, strict: bool) -> np.ndarray:
    """Return the header stamps (n,) [ns] and check their order."""
    stamps = np.array([_stamp(sample) for sample in samples], dtype=np.int64)
    steps = np.diff(stamps)
    wrong = np.flatnonzero(steps <= 0 if strict else steps < 0)
    if wrong.size:
        what = "go back" if steps[wrong[0]] < 0 else "stand still"
        seconds = stamps[wrong[0] + 1] / NANOSECONDS
        where = f"message {wrong[0] + 1}, {seconds:.3f} s"
        raise RecordingError(f"{name}: the stamps of {topic} {what} at {where}")
    return stamps


def _jaw_track(samples: Mapping[str, list[Sample]], side: str, name: str) -> JawTrack:
    """Gather what was recorded of one jaw."""
    truth = samples.get(f"/{side}/ground_truth_wrench")
    pose = samples.get(f"/{side}/jaw_pose")
    return JawTrack(
        keypoints=_keypoint_track(samples[f"/{side}/keypoints"], side, name),
        truth=_wrench_track(truth, side, name) if truth else None,
        pose=_pose_track(pose, f"/{side}/jaw_pose", name) if pose else None,
    )


def _check_frame(samples: Sequence[Sample], topic: str, side: str, name: str) -> None:
    """Refuse messages of a jaw that are not in its frame."""
    for sample in samples:
        frame = sample.message.header.frame_id
        if frame.lstrip("/") != f"{side}_jaw":
            raise RecordingError(f"{name}: {topic} is in the frame '{frame}'; expected '{side}_jaw'")


def _keypoint_track(samples: Sequence[Sample], side: str, name: str) -> KeypointTrack:
    """Stack the key point clouds of one jaw."""
    topic = f"/{side}/keypoints"
    _check_frame(samples, topic, side, name)
    stamps = _stamps(samples, topic, name, strict=True)
    clouds = [_cloud(sample, index, topic, name) for index, sample in enumerate(samples)]
    counts = [len(cloud.points) for cloud in clouds]
    odd = next((index for index, count in enumerate(counts) if count != counts[0] or count == 0), None)
    if odd is not None:
        what = f"message {odd} has {counts[odd]} key points, the first {counts[0]}"
        raise RecordingError(f"{name}: {topic} {what}; expected the same number above zero in all")
    points = np.stack([cloud.points for cloud in clouds])
    infinite = np.isinf(points).any(axis=(1, 2))
    if infinite.any():
        first = int(np.argmax(infinite))
        raise RecordingError(f"{name}: {topic} message {first} has infinite coordinates; NaN says 'no point'")
    return KeypointTrack(stamps=stamps, points=points, likelihood=np.stack([c.likelihood for c in clouds]))


def _cloud(sample: Sample, index: int, topic: str, name: str) -> Keypoints:
    """Decode one key point cloud."""
    try:
        return decode_keypoints(sample.message)
    except ObservationError as error:
        raise RecordingError(f"{name}: {topic} message {index}: {error}") from error


def _wrench_track(samples: Sequence[Sample], side: str, name: str) -> WrenchTrack:
    """Stack the ground truth of one jaw."""
    topic = f"/{side}/ground_truth_wrench"
    _check_frame(samples, topic, side, name)
    stamps = _stamps(samples, topic, name, strict=False)
    wrenches = [sample.message.wrench for sample in samples]
    force = np.array([[w.force.x, w.force.y, w.force.z] for w in wrenches])
    torque = np.array([[w.torque.x, w.torque.y, w.torque.z] for w in wrenches])
    if not np.isfinite(force).all():
        raise RecordingError(f"{name}: {topic} holds forces that are not finite")
    return WrenchTrack(stamps=stamps, force=force, torque=torque)


def _pose_track(samples: Sequence[Sample], topic: str, name: str) -> PoseTrack:
    """Stack poses of one frame; the order of their stamps is not checked, trackers publish late results."""
    frames = [sample.message.header.frame_id for sample in samples]
    odd = next((index for index, frame in enumerate(frames) if frame != frames[0]), None)
    if odd is not None:
        what = f"message {odd} is in the frame '{frames[odd]}', the first in '{frames[0]}'"
        raise RecordingError(f"{name}: {topic} {what}; expected one frame")
    poses = [sample.message.pose for sample in samples]
    return PoseTrack(
        stamps=np.array([_stamp(sample) for sample in samples], dtype=np.int64),
        position=np.array([[p.position.x, p.position.y, p.position.z] for p in poses]),
        quaternion=np.array([[getattr(p.orientation, axis) for axis in "xyzw"] for p in poses]),
        frame_id=frames[0],
    )


def _phases(samples: Sequence[Sample], name: str) -> Any:
    """Read the phases; strings carry no stamp, the time of receipt stands for it."""
    return parse_phases([s.time for s in samples], [s.message.data for s in samples], name)


def _read_case(path: Path) -> dict[str, Any]:
    """Read `case.json`, empty when absent."""
    if not path.exists():
        return {}
    try:
        case = json.loads(path.read_text(encoding="utf-8"))
    except (ValueError, OSError) as error:
        raise RecordingError(f"{path.parent.name}/case.json: not JSON: {error}") from error
    if not isinstance(case, dict):
        raise RecordingError(f"{path.parent.name}/case.json: expected an object, found {type(case).__name__}")
    return case
