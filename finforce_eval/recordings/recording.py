"""Bags into recordings: topics to tracks, checked."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from finforce.errors import ObservationError
from finforce.files import FileError, read_json
from finforce.gripper_frames import SIDES
from finforce.messages import Keypoints, decode_columns, decode_keypoints, stamp_of
from finforce_eval.errors import DamagedError, RecordingError
from finforce_eval.recordings.bags import bag_source, check_messages, check_types, is_buffer, is_frames, open_bag
from finforce_eval.recordings.dataset import is_dataset, read_episode
from finforce_eval.recordings.frames import read_frames
from finforce_eval.recordings.gravity import (
    FIXED,
    GRAVITY,
    MOVING,
    TRANSFORMS,
    VECTOR,
    read_gravity,
    read_transforms,
)
from finforce_eval.recordings.images import ImageChoice, ImageTrack, find_images
from finforce_eval.recordings.salvage import SalvagedCopy
from finforce_eval.recordings.tracks import (
    DetectionTruth,
    GravityTrack,
    JawTrack,
    KeypointTrack,
    PoseTrack,
    Recording,
    WrenchTrack,
    check_stamps,
    parse_phases,
    stack_vectors,
)
from finforce_eval.recordings.umi import read_buffer

CLOUD = "sensor_msgs/msg/PointCloud2"
WRENCH = "geometry_msgs/msg/WrenchStamped"
POSE = "geometry_msgs/msg/PoseStamped"
STRING = "std_msgs/msg/String"
TRUTH_COLUMNS = ("x", "y", "z", "u", "v", "visible")
TRUE_KEYPOINTS, TRUE_POSE = "ground_truth_keypoints", "ground_truth_jaw_pose"
PHASE = "/bench/phase"
TOPICS = {"/object_pose": POSE, PHASE: STRING, GRAVITY: VECTOR}
for _side in SIDES:
    TOPICS |= {
        f"/{_side}/keypoints": CLOUD,
        f"/{_side}/ground_truth_wrench": WRENCH,
        f"/{_side}/jaw_pose": POSE,
        f"/{_side}/{TRUE_KEYPOINTS}": CLOUD,
        f"/{_side}/{TRUE_POSE}": POSE,
    }

DEMO = Path(__file__).parents[1] / "data" / "bench_cyl25_middle"  # a loading cycle of the bench


SLOW = 110_000_000  # [ns] between readings of slow load cells; more is a reading per photograph
SPIKE, LEAST_SPIKE = 3.0, 1.0  # of what lasts [-], and beyond [N], from which on a force is none; impacts show twice it
_CHECKED = 10_000  # messages after which their number is looked at


class _Content(NamedTuple):
    """The content of a bag: messages by topic, phases by their time of receipt [ns], images, and notes."""

    samples: Mapping[str, list[Any]]
    phases: Sequence[tuple[int, str]]
    images: ImageTrack | None
    notes: list[str]


def read_recording(
    path: str | Path,
    choice: ImageChoice | None = None,
    sides: Sequence[str] = (),
    *,
    strict: bool = False,
    gravity_frame: str = "",
) -> Recording:
    """Read a bag with its `case.json`, an episode of a dataset or of a buffer of UMI, a video, or pictures.

    Unknown topics are not decoded; `notes` name those of unexpected type. Images are read later. A recording with
    images may lack key points; its tracks of them are then empty. A damaged recording is read as far as it is intact,
    and `notes` state how much was lost.

    Args:
        path: rosbag2 folder, .mcap, .db3, folder of a dataset or of pictures, .zarr, .zarr.zip, or video.
        choice: images to read.
        sides: jaws in the images, whether or not a topic names them; both if no topic names any.
        strict: True to reject a damaged recording.
        gravity_frame: upright frame on /tf for gravity and elevation; "" for the topic /gravity.

    Raises:
        RecordingError: the recording is missing, empty, malformed or out of bounds, or holds neither key points nor
            images.
    """
    choice = choice or ImageChoice()
    if read := _find_reader(Path(path)):
        if gravity_frame:
            raise RecordingError(f"{Path(path).name}: --gravity-frame {gravity_frame}: only bags have {MOVING}")
        return read(Path(path), choice, sides)
    source = bag_source(Path(path))
    folder = source if source.is_dir() else source.parent
    name = source.name if source.is_dir() else source.stem
    (samples, phases, images, notes), copy = _read_or_salvage(source, name, choice, gravity_frame, strict=strict)
    known = [side for side in SIDES if _has_jaw(samples, side, images is not None) or (images and side in sides)]
    if images and not known:
        known = SIDES
        notes.append("no topic states which jaws its images show: looking for both; --jaws left or right selects one")
    for topic in (f"/{side}/ground_truth_wrench" for side in known):
        samples[topic], said = _without_spikes(samples.get(topic, []), topic)
        notes += said
    jaws = {side: _jaw_track(samples, side, name) for side in known}
    if not jaws:
        what = "/left/keypoints and /right/keypoints have no messages; no colour images either"
        raise RecordingError(f"{name}: no key points: {what}")
    poses = samples.get("/object_pose")
    return Recording(
        name=name,
        path=Path(path),
        jaws=jaws,
        object_pose=_pose_track(poses, "/object_pose", name) if poses else None,
        gravity=_read_posture(samples, gravity_frame, name, notes),
        phases=parse_phases(*zip(*phases, strict=True), name) if phases else None,
        case=_read_case(folder / "case.json"),
        notes=tuple(notes),
        images=images,
        copy=copy,
    )


def _find_reader(path: Path) -> Callable[[Path, ImageChoice, Sequence[str]], Recording] | None:
    """Return what reads a recording that is no bag; None for bags."""
    kinds = ((is_dataset, read_episode), (is_buffer, read_buffer), (is_frames, read_frames))
    return next((read for is_such, read in kinds if is_such(path)), None)


def _read_posture(
    samples: Mapping[str, list[Any]], gravity_frame: str, name: str, notes: list[str]
) -> GravityTrack | None:
    """Return how the gripper was turned and lifted; None if nothing says, or what does is noted as malformed."""
    if gravity_frame:
        return read_transforms(samples, gravity_frame, name)
    try:
        return read_gravity(samples[GRAVITY], name) if GRAVITY in samples else None
    except RecordingError as error:
        notes.append(f"gravity is not known: {str(error).removeprefix(f'{name}: ')}")
        return None


def _has_jaw(samples: Mapping[str, list[Any]], side: str, has_images: bool) -> bool:
    """Say whether a recording tells of a jaw: by its key points, or with images by anything that is the jaw's own."""
    topics = [topic for topic in samples if topic.startswith(f"/{side}/")]
    return f"/{side}/keypoints" in topics or (has_images and bool(topics))


def _read_or_salvage(
    source: Path, name: str, choice: ImageChoice, gravity_frame: str, *, strict: bool
) -> tuple[_Content, SalvagedCopy | None]:
    """Return the content of a bag, or of the intact part of a damaged one beside its copy; `strict` raises instead."""
    try:
        return _read_samples(source, name, choice, gravity_frame), None
    except DamagedError as error:
        if strict:
            raise
        copy = SalvagedCopy(source, str(error))
    content = _read_samples(copy.path, name, choice, gravity_frame)
    content.notes.append(copy.note.removeprefix(f"{name}: "))
    return content, copy


def _read_samples(source: Path, name: str, choice: ImageChoice, gravity_frame: str) -> _Content:
    """Decode the messages of our topics, by topic, and find the images."""
    topics = TOPICS | (dict.fromkeys((MOVING, FIXED), TRANSFORMS) if gravity_frame else {})
    samples: dict[str, list[Any]] = {}
    phases: list[tuple[int, str]] = []
    with open_bag(source, name) as bag:
        check_types(bag.connections, {topic: (kind,) for topic, kind in topics.items()}, name)
        for number, raw in enumerate(bag.raw(topics)):
            if not number % _CHECKED:
                check_messages(number, source)
            message = bag.decode(raw)
            if raw.topic == PHASE:  # without a stamp of its own
                phases.append((raw.time, message.data))
            else:
                samples.setdefault(raw.topic, []).append(message)
        notes = bag.foreign_notes()
        try:
            images = find_images(bag, source, choice)
        except RecordingError as error:
            if not any(topic.endswith("/keypoints") for topic in samples):
                raise
            images, notes = None, [*notes, str(error)]
        notes += images.notes if images else []
        return _Content(samples, phases, images, notes)


def _jaw_track(samples: Mapping[str, list[Any]], side: str, name: str) -> JawTrack:
    """Gather what was recorded of one jaw."""
    truth = samples.get(f"/{side}/ground_truth_wrench")
    pose = samples.get(f"/{side}/jaw_pose")
    true_pose = samples.get(f"/{side}/{TRUE_POSE}")
    keypoints, sight = samples.get(f"/{side}/keypoints"), samples.get(f"/{side}/{TRUE_KEYPOINTS}")
    return JawTrack(
        keypoints=_keypoint_track(keypoints, side, name) if keypoints else KeypointTrack.empty(),
        truth=_wrench_track(truth, side, name) if truth else None,
        pose=_pose_track(pose, f"/{side}/jaw_pose", name) if pose else None,
        sight=_detection_truth(sight, side, name) if sight else None,
        true_pose=_pose_track(true_pose, f"/{side}/{TRUE_POSE}", name) if true_pose else None,
    )


def _check_frame(samples: Sequence[Any], topic: str, side: str, name: str) -> None:
    """Refuse messages of a jaw that are not in its frame."""
    for sample in samples:
        frame = sample.header.frame_id
        if frame.lstrip("/") != f"{side}_jaw":
            raise RecordingError(f"{name}: {topic} is in the frame '{frame}'; expected '{side}_jaw'")


def _keypoint_track(samples: Sequence[Any], side: str, name: str) -> KeypointTrack:
    """Stack the key point clouds of one jaw."""
    topic = f"/{side}/keypoints"
    _check_frame(samples, topic, side, name)
    stamps = check_stamps(map(stamp_of, samples), topic, name)
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
        raise RecordingError(f"{name}: {topic} message {first} has infinite coordinates; use NaN for 'no point'")
    likelihood, stated = np.stack([c.likelihood for c in clouds]), [c.stddev is not None for c in clouds]
    if any(stated) and not all(stated):
        first = stated.index(not stated[0])
        raise RecordingError(f"{name}: {topic} message {first} differs from the first in whether it states stddev_x")
    stddev = np.stack([c.stddev for c in clouds]) if stated[0] else None
    shared = np.array([c.shared for c in clouds]) if any(any(c.shared) for c in clouds) else None
    return KeypointTrack(stamps_ns=stamps, points=points, likelihood=likelihood, stddev=stddev, shared=shared)


def _detection_truth(samples: Sequence[Any], side: str, name: str) -> DetectionTruth:
    """Stack the true key points of one jaw."""
    topic = f"/{side}/{TRUE_KEYPOINTS}"
    _check_frame(samples, topic, side, name)
    stamps = check_stamps(map(stamp_of, samples), topic, name)
    try:
        clouds = [decode_columns(sample, TRUTH_COLUMNS) for sample in samples]
        columns = ([cloud[name] for cloud in clouds] for name in TRUTH_COLUMNS)
        x, y, z, u, v, visible = (np.array(column, dtype=np.float64) for column in columns)
    except (ObservationError, ValueError) as error:
        raise RecordingError(f"{name}: {topic}: {error}") from error
    points, pixels = np.stack([x, y, z], axis=-1), np.stack([u, v], axis=-1)
    return DetectionTruth(stamps_ns=stamps, points=points, pixels=pixels, visible=visible > 0)


def _cloud(sample: Any, index: int, topic: str, name: str) -> Keypoints:
    """Decode one key point cloud."""
    try:
        return decode_keypoints(sample)
    except ObservationError as error:
        raise RecordingError(f"{name}: {topic} message {index}: {error}") from error


def _wrench_track(samples: Sequence[Any], side: str, name: str) -> WrenchTrack:
    """Stack the ground truth of one jaw."""
    topic = f"/{side}/ground_truth_wrench"
    _check_frame(samples, topic, side, name)
    stamps = check_stamps(map(stamp_of, samples), topic, name, strict=False)
    wrenches = [sample.wrench for sample in samples]
    force, torque = (stack_vectors([getattr(each, name) for each in wrenches]) for name in ("force", "torque"))
    if not np.isfinite(force).all():
        raise RecordingError(f"{name}: {topic} holds forces that are not finite")
    return WrenchTrack(stamps_ns=stamps, force=force, torque=torque)


def _without_spikes(samples: list[Any], topic: str) -> tuple[list[Any], list[str]]:
    """Return readings of a force sensor without those of errors in their transmission, and a note of these.

    A spike, of one reading or two, is far beyond all medians of five in a row, if these follow each other closely.
    """
    forces, stamps = [sample.wrench.force for sample in samples], [stamp_of(sample) for sample in samples]
    if len(samples) < 5 or np.median(np.diff(stamps)) > SLOW:
        return samples, []
    size = np.array([np.linalg.norm((force.x, force.y, force.z)) for force in forces])
    lasting = float(np.median(np.lib.stride_tricks.sliding_window_view(size, 5), axis=1).max())
    spikes = np.isfinite(size) & (size > SPIKE * lasting + LEAST_SPIKE)
    spikes[-2:] = False  # a load may begin there
    if not spikes.any():
        return samples, []
    note = (
        f"{topic}: {spikes.sum()} of {len(size)} forces left out, up to {size[spikes].max():.3g} N where three of five "
        f"in a row show {lasting:.3g} N at most: errors of the sensor's transmission?"
    )
    return [sample for sample, is_spike in zip(samples, spikes, strict=True) if not is_spike], [note]


def _pose_track(samples: Sequence[Any], topic: str, name: str) -> PoseTrack:
    """Stack poses of one frame; the order of their stamps is not checked, trackers publish late results."""
    frames = [sample.header.frame_id for sample in samples]
    odd = next((index for index, frame in enumerate(frames) if frame != frames[0]), None)
    if odd is not None:
        what = f"message {odd} is in the frame '{frames[odd]}', the first in '{frames[0]}'"
        raise RecordingError(f"{name}: {topic} {what}; expected one frame")
    poses = [sample.pose for sample in samples]
    return PoseTrack(
        stamps_ns=np.array([stamp_of(sample) for sample in samples], dtype=np.int64),
        position=stack_vectors([pose.position for pose in poses]),
        quaternion=stack_vectors([pose.orientation for pose in poses], "xyzw"),
        frame_id=frames[0],
    )


def find_recordings(path: Path) -> list[Path]:
    """Return the recordings in a folder that is none itself, by their names; any other path as it is."""
    if not path.is_dir() or _is_recording(path):
        return [path]
    bags = (".mcap", ".db3")  # of which several in one folder are the parts of a bag without its metadata
    inside = [each for each in sorted(path.iterdir()) if each.suffix not in bags and _is_recording(each)]
    return inside or [path]


def _is_recording(path: Path) -> bool:
    """Say whether a path is what `read_recording` reads."""
    with suppress(RecordingError):
        return is_dataset(path) or is_frames(path) or bag_source(path).exists()
    return False


def stated_jaw(paths: Sequence[str | Path], default: str) -> str:
    """Return the jaw that the `case.json` of recordings names, a default where none does.

    Raises:
        RecordingError: they name several, or a `case.json` cannot be read.
    """
    folders = [path if path.is_dir() else path.parent for path in map(Path, paths)]
    named = {str(_read_case(folder / "case.json").get("jaw", default)) for folder in folders} or {default}
    if len(named) > 1:
        raise RecordingError(f"recordings of several jaws: {', '.join(sorted(named))}; give those of one at a time")
    return named.pop()


def _read_case(path: Path) -> dict[str, Any]:
    """Read `case.json`, empty when absent."""
    if not path.exists():
        return {}
    try:
        case = read_json(path)
    except FileError as error:
        raise RecordingError(f"{path.parent.name}/case.json: {error}") from error
    if not isinstance(case, dict):
        raise RecordingError(f"{path.parent.name}/case.json: expected an object, found {type(case).__name__}")
    return case
