"""Sources of a recording's key points: recorded, true, or found in its images by the detector of the node."""

from __future__ import annotations

import argparse
import math
import re
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from finforce.camera import ImageError
from finforce.errors import FinforceError, PoseError, suggest
from finforce.gripper_frames import SIDES, read_extrinsics
from finforce.health import Idling
from finforce.messages import NANOSECONDS, NOTHING_SHARED
from finforce.rig import read_rig
from finforce.transforms import pose_from_quaternion, pose_numbers, quaternion_from_pose
from finforce_eval.errors import OptionError, RecordingError, UnseenError
from finforce_eval.recordings.images import DEPTH_ENDS, ImageChoice, ImageTrack
from finforce_eval.recordings.recording import read_recording
from finforce_eval.recordings.tracks import DetectionTrack, JawTrack, KeypointTrack, PoseTrack, Recording
from finforce_eval.tasks import progress_bar
from finforce_keypoints.errors import KeypointError

if TYPE_CHECKING:
    from finforce_keypoints.detector import KeypointDetector
    from finforce_keypoints.detectors.dots import DotSettings
    from finforce_keypoints.geometry.jaw_localizer import JawKeypoints
    from finforce_keypoints.parameters import DetectorParameters, DetectorSettings

SOURCES = IMAGES, KEYPOINTS, TRUTH = ("images", "keypoints", "truth")
_BY_ENDS = "images of a recording are found by the ends of their topics"
# parameters of the node that something else decides here
DECIDED = {
    "jaws": "the jaws are those of the recording",
    "jaw_file": "give --jaw",
    "camera_frame": "the frame is that of the recorded images",
    "color_topics": _BY_ENDS,
    "depth_topic": _BY_ENDS,
    "info_topic": _BY_ENDS,
}
_CHOICES = {"color": "color", "depth": "depth", "info": "camera_info", "episode": "episode"}  # of images, by options
_SWITCHES = {"true": True, "yes": True, "1": True, "false": False, "no": False, "0": False}
LIVE = ("max_age", "diagnostics_period")  # without meaning where no clock runs


class DetectorRecords(NamedTuple):
    """The parameters that a detector is built with."""

    parameters: DetectorParameters
    settings: DetectorSettings
    dots: DotSettings


@dataclass(frozen=True, kw_only=True)
class KeypointSource:
    """The key points of a run, and the detector that finds them where they come from images.

    Attributes:
        source: "images", "keypoints", "truth", or "" for key points where they were recorded, else images.
        jaw_file: of the jaws.
        parameters: parameters of the detector node that differ from its defaults, by their ROS names.
        strict: refuse recordings that are damaged.
        as_live: leave out the images that the detector's node leaves out.
        stills: True if nothing of one image is known in the next.
        choice: images to read.
        sides: jaws that are in the images, whether or not a topic tells of them.
        gravity_frame: see `read_recording`.
    """

    source: str = ""
    jaw_file: str = "bench"
    parameters: Mapping[str, Any] = field(default_factory=dict)
    strict: bool = False
    as_live: bool = False
    stills: bool = False
    choice: ImageChoice = field(default_factory=ImageChoice)
    sides: tuple[str, ...] = ()
    gravity_frame: str = ""

    def read(self, path: str | Path) -> Recording:
        """Return a recording as it lies there; see `read_recording`."""
        return read_recording(path, self.choice, self.sides, strict=self.strict, gravity_frame=self.gravity_frame)

    def source_of(self, recording: Recording) -> str:
        """Return "images", "keypoints" or "truth" for a recording.

        Raises:
            RecordingError: it has no such thing.
        """
        has_keypoints = all(len(track.keypoints.stamps_ns) for track in recording.jaws.values())
        source = self.source or (KEYPOINTS if has_keypoints or recording.images is None else IMAGES)
        has = {
            IMAGES: recording.images is not None,
            KEYPOINTS: has_keypoints,
            TRUTH: all(track.sight is not None for track in recording.jaws.values()),
        }
        if not has[source]:
            there = ", ".join(name for name in SOURCES if has[name]) or "nothing of all that"
            raise RecordingError(f"{recording.name}: --from {source}: not in this recording, which has {there}")
        return source

    def apply(self, recording: Recording) -> Recording:
        """Return a recording whose key points and jaw poses come from where they were asked for.

        Raises:
            FinforceError: the recording has none there, or the detector cannot be used or finds nothing.
        """
        source = self.source_of(recording)
        if source == KEYPOINTS:
            return recording
        if source == TRUTH:
            return replace(recording, jaws={side: _true_track(track) for side, track in recording.jaws.items()})
        return self._detect(recording)

    def node_parameters(self, recording: Recording) -> dict[str, Any]:
        """Return the parameters of the detector node for a recording, those of its own camera included."""
        from finforce_keypoints.parameters import NO_DEPTH

        own = {"camera_frame": recording.images.frame_id}
        if not recording.images.has_depth:
            own["depth"] = NO_DEPTH
        pose = recording.case.get("T_gripper_camera")
        if isinstance(pose, list):
            own["T_gripper_camera"] = [float(number) for number in pose]
        step = recording.case.get("depth_scale")
        if isinstance(step, float):
            own |= {"depth_scale": step, "detector.quantum": step}
        sides = list(recording.jaws)
        jaws = "both" if len(sides) == 2 else sides[0]
        return {"jaws": jaws, "jaw_file": self.jaw_file, **own, **self.parameters}

    def build(self, recording: Recording) -> KeypointDetector:
        """Return a fresh detector for a recording.

        Raises:
            FinforceError: a parameter, the jaw or the network cannot be used.
        """
        from finforce_keypoints.build import build_detector
        from finforce_keypoints.parameters import load_jaws

        live = next((name for name in LIVE if name in self.parameters), None)
        if live is not None:
            raise OptionError(f"--detector {live}: means nothing offline; leave it out, or use finforce replay")
        parameters, settings, dots = build_records(self.node_parameters(recording))
        return build_detector(load_jaws(parameters), parameters, settings, dots, self.as_live)

    def _detect(self, recording: Recording) -> Recording:
        given = self.node_parameters(recording)
        detector, parameters = self.build(recording), build_records(given).parameters
        if "T_gripper_camera" not in given:
            note = "the camera is taken to be on the mount 'robot'; elsewhere give --extrinsics, or --rig"
            recording = replace(recording, notes=(*recording.notes, note))
        images = choose_images(recording, parameters.depth)
        recording = replace(recording, images=replace(images, depth_scale=parameters.depth_scale))
        with progress_bar(len(recording.images), "image", recording.name) as bar:
            return detect_keypoints(recording, detector, as_live=self.as_live, stills=self.stills, progress=bar.update)


def choose_images(recording: Recording, depth: str) -> ImageTrack:
    """Return the images that a detector is to see, with depth, without, or where there is some.

    Raises:
        RecordingError: there is no depth, and it is needed.
    """
    from finforce_keypoints.parameters import ALIGNED, NO_DEPTH

    images = recording.images
    if depth == NO_DEPTH:
        return images.colors_alone()
    if depth != ALIGNED:
        return images.all_colors()
    if not images.has_depth:
        raise RecordingError(
            f"{recording.name}: there are images on {images.topics[0]}, but no depth on {DEPTH_ENDS[0]}; give "
            "--detector depth=none"
        )
    return images


def spread(stamps: NDArray[np.int64], count: int) -> NDArray[np.int64]:
    """Return at most `count` of stamps (n,) [ns], evenly chosen."""
    return stamps[np.unique(np.linspace(0, len(stamps) - 1, count).round().astype(int))]


def build_records(given: Mapping[str, Any]) -> DetectorRecords:
    """Return the records of a detector with parameters by their ROS names; the others have their defaults.

    Raises:
        FinforceError: a value is not among its choices or out of its bounds.
    """
    return DetectorRecords(*(record(**_fields_of(prefix, given)) for prefix, record in _record_types().items()))


def _record_types() -> dict[str, type]:
    """Return the types of a detector's records by the prefix of their parameters."""
    from finforce_keypoints.detectors.dots import DotSettings
    from finforce_keypoints.parameters import DetectorParameters, DetectorSettings

    return {"": DetectorParameters, "detector": DetectorSettings, "dots": DotSettings}


def _fields_of(prefix: str, given: Mapping[str, Any]) -> dict[str, Any]:
    """Return the fields of the record that the names with a prefix, or without any, are of."""
    split = [(*name.rpartition(".")[::2], value) for name, value in given.items()]
    values = {name: value for own, name, value in split if own == prefix}
    return {name: tuple(value) if isinstance(value, list) else value for name, value in values.items()}


def _true_track(track: JawTrack) -> JawTrack:
    """Return the track of a jaw with its true key points and poses; what the camera did not see is left out."""
    sight = track.sight
    points = np.where(sight.visible[:, :, None], sight.points, np.nan)
    keypoints = KeypointTrack(stamps_ns=sight.stamps_ns, points=points, likelihood=sight.visible.astype(np.float64))
    return replace(track, keypoints=keypoints, pose=track.true_pose or track.pose)


def sides_of(options: argparse.Namespace) -> tuple[str, ...]:
    """Return the jaws that images show, none where the option does not say."""
    jaws = getattr(options, "jaws", None)
    return {None: (), "both": SIDES}.get(jaws, (jaws,))


def parse_source(options: argparse.Namespace) -> KeypointSource:
    """Return where the key points come from.

    Raises:
        OptionError: a parameter of the detector is not known, has another type, is out of its bounds, or is decided by
            something else; or no detector is needed.
    """
    parameters: dict[str, Any] = {}
    changes, extrinsics = getattr(options, "detector", []), getattr(options, "extrinsics", None)
    rig = read_rig(options.rig) if getattr(options, "rig", None) else None
    source = getattr(options, "source", None) or ""
    for name, given in (("--detector", changes), ("--extrinsics", extrinsics)):
        if given and source in (KEYPOINTS, TRUTH):
            raise OptionError(f"{name}: --from {source} needs no detector; leave it out, or give --from {IMAGES}")
    if rig is not None:
        parameters |= rig.detector_parameters()
    if changes:
        parameters |= _parse_parameters(changes)
    if extrinsics:
        parameters["T_gripper_camera"] = _parse_extrinsics(extrinsics)
    switches = {name: bool(getattr(options, name, False)) for name in ("strict", "as_live", "stills")}
    seconds = parameters.get("sync_tolerance")
    given = {name: getattr(options, option, None) for name, option in _CHOICES.items()}
    choice = ImageChoice(
        **{name: value for name, value in given.items() if value},
        intrinsics=tuple(getattr(options, "intrinsics", None) or ()),
        camera=rig.intrinsics if rig is not None else None,
        T_gripper_camera=pose_of(parameters),
        pairing=None if seconds is None or math.isnan(seconds) else round(seconds * NANOSECONDS),
    )
    return KeypointSource(
        source=source,
        jaw_file=options.jaw,
        parameters=parameters,
        choice=choice,
        sides=sides_of(options),
        gravity_frame=getattr(options, "gravity_frame", ""),
        **switches,
    )


def pose_of(parameters: Mapping[str, Any]) -> NDArray[np.float64] | None:
    """Return the camera's pose (4, 4) [m] in the gripper's frame among a detector's parameters; None without."""
    pose = parameters.get("T_gripper_camera")
    return None if pose is None else pose_from_quaternion(pose[:3], pose[3:])


def _parse_parameters(texts: Sequence[str]) -> dict[str, Any]:
    """Return `NAME=VALUE` texts as values of the type of the parameter, checked."""
    defaults = {
        f"{prefix}.{entry.name}" if prefix else entry.name: entry.default
        for prefix, record in _record_types().items()
        for entry in fields(record)
    }
    parameters = parse_changes("--detector", "parameter", texts, defaults)
    for name, reason in DECIDED.items():
        if name in parameters:
            raise OptionError(f"--detector {name}: cannot be set here: {reason}")
    try:
        build_records(parameters)
    except FinforceError as error:
        raise OptionError(f"--detector {error}") from error
    return parameters


def _parse_extrinsics(text: str) -> list[float]:
    """Return x, y, z [m], qx, qy, qz, qw of a camera by its name or its numbers."""
    try:
        return list(pose_numbers(read_extrinsics(text)))
    except PoseError as error:
        raise OptionError(f"--extrinsics: {str(error).removeprefix('extrinsics').lstrip(' :')}") from error


def parse_changes(option: str, kind: str, texts: Sequence[str], defaults: Mapping[str, Any]) -> dict[str, Any]:
    """Return `NAME=VALUE` texts as values by name, each of the type of the default that it changes.

    Args:
        option: of the command line, for messages.
        kind: noun for the names, for messages.
        texts: as they were given.
        defaults: by name; a list takes its values with commas between.

    Raises:
        OptionError: a name is not known, or a value is not of its type.
    """
    changes = {}
    for text in texts:
        name, _, value = text.partition("=")
        if name not in defaults:
            raise OptionError(f"{option} {text}: unknown {kind}; {suggest(name, defaults)}")
        changes[name] = _parse_value(f"{option} {text}", value, defaults[name])
    return changes


def _parse_value(given: str, text: str, default: Any) -> Any:
    """Return a text as a value of the type of a default."""
    if isinstance(default, tuple | list):
        kind = type(default[0]) if default else str
        return [_parse_value(given, part, kind()) for part in text.split(",")]
    try:
        return _SWITCHES[text.lower()] if isinstance(default, bool) else type(default)(text)
    except (KeyError, ValueError):
        raise OptionError(f"{given}: '{text}' is not of type {type(default).__name__}") from None


def detect_keypoints(
    recording: Recording,
    detector: KeypointDetector,
    *,
    as_live: bool = False,
    stills: bool = False,
    progress: Callable[[int], Any] = lambda images: None,
) -> Recording:
    """Return a recording with the key points and jaw poses that a detector finds in its images.

    An image that is refused, or in which a jaw is not found, has no key points of it.

    Args:
        recording: with images.
        detector: a fresh one, of the recording's jaws.
        as_live: True if the images that the detector's node leaves out have no row.
        stills: True if nothing of one image is known in the next.
        progress: called with the number of images done since its last call.

    Raises:
        RecordingError: an image is damaged.
        UnseenError: not one jaw was found in any.
    """
    images, refused = recording.images, []
    found: dict[str, dict[int, JawKeypoints]] = {side: {} for side in recording.jaws}
    step_ms: dict[int, float] = {}
    idling, passed = Idling(), set()
    for stamp, image in images:
        begin = perf_counter()
        if stills:
            detector.reset()
        try:
            seen = detector.detect(image)
        except (KeypointError, ImageError) as error:
            seen = {}
            refused.append(str(error))
        else:
            is_still = as_live and detector.was_still
            if is_still and idling.passes(stamp):
                passed.add(stamp)
            else:
                idling.note(stamp, is_still)
        step_ms[stamp] = 1e3 * (perf_counter() - begin)
        for side in found.keys() & seen.keys():
            found[side][stamp] = seen[side]
        progress(1)
    reasons = count_reasons(refused)
    warnings = [f"{side} jaw: {warning}" for side, warning in detector.warnings.items()]
    if not any(found.values()):
        commonest = max(reasons, key=reasons.get, default="")
        why = commonest or "; ".join(warnings) or "no jaw stands where it could be; another camera pose or rig?"
        raise UnseenError(f"{recording.name}: no key points in {len(images)} images: {why}")
    notes = [f"{count} images rejected: {text}" for text, count in reasons.items()] + warnings
    notes += [f"the {side} jaw is in none of the images" for side, seen in found.items() if not seen]
    if missing := len(images) - len(step_ms):
        notes.append(
            f"{missing} of {len(images)} images are damaged, or follow a damaged or missing one, and are left out"
        )
    recording = replace(recording, notes=(*recording.notes, *notes))
    return with_detections(recording, found, dict.fromkeys(found, step_ms), passed)


def count_reasons(texts: Iterable[str]) -> dict[str, int]:
    """Return how often images were refused by reason; of texts that differ in their numbers only, the first counts."""
    firsts: dict[str, str] = {}
    counts: dict[str, int] = {}
    for text in texts:
        first = firsts.setdefault(re.sub(r"[0-9.]+", "#", text), text)
        counts[first] = counts.get(first, 0) + 1
    return counts


def awaiting_keypoints(recording: Recording) -> Recording:
    """Return a recording without the key points and jaw poses that were recorded: images will give them."""
    jaws = {side: replace(track, keypoints=KeypointTrack.empty(), pose=None) for side, track in recording.jaws.items()}
    return replace(recording, jaws=jaws)


def with_detections(
    recording: Recording,
    found: Mapping[str, Mapping[int, JawKeypoints]],
    step_ms: Mapping[str, Mapping[int, float]],
    passed: Collection[int] = (),
) -> Recording:
    """Return a recording whose key points and jaw poses are those that a detector found.

    Args:
        recording: with images.
        found: by side and stamp [ns]; a jaw that was never found has no key points in any image.
        step_ms: wall time [ms] of every image, likewise.
        passed: stamps [ns] of images that are left out.
    """
    images = recording.images
    stamps = images.stamps_ns[~np.isin(images.stamps_ns, list(passed))]
    # a jaw that was never found has as many key points as the other
    counts = [len(jaw.points) for jaws in found.values() for jaw in jaws.values()]
    counts += [track.sight.points.shape[1] for track in recording.jaws.values() if track.sight]
    jaws = {
        side: _with_detection(recording.jaw(side), found[side], step_ms[side], stamps, images.frame_id, counts[0])
        for side in found
    }
    return replace(recording, jaws=jaws)


def _with_detection(
    track: JawTrack,
    found: Mapping[int, JawKeypoints],
    step_ms: Mapping[int, float],
    stamps: NDArray[np.int64],
    frame_id: str,
    count: int,
) -> JawTrack:
    """Return the track of a jaw with its detections at some images (n,) [ns], of so many key points."""
    seen = [found.get(stamp) for stamp in stamps.tolist()]
    points, stddev = _rows(seen, "points", (count, 3)), _rows(seen, "stddev", (count, 3))
    accepted = np.nan_to_num(_rows(seen, "valid", (count,))).astype(bool)
    # what is not valid has no coordinates for the solver, as when the cloud comes by topic in single precision
    passed = np.where(accepted[:, :, None], points, np.nan).astype(np.float32).astype(np.float64)
    keypoints = KeypointTrack(
        stamps_ns=stamps,
        points=passed,
        likelihood=np.nan_to_num(_rows(seen, "likelihood", (count,))),
        stddev=np.where(np.isfinite(passed), stddev, np.nan),
        shared=np.nan_to_num(_rows(seen, "shared", (len(NOTHING_SHARED),))),
    )
    unfound = np.full(count, "")
    reasons = [unfound if each is None else each.reasons for each in seen]
    detection = DetectionTrack(
        stamps_ns=stamps,
        pixels=_rows(seen, "pixels", (count, 2)),
        points=points,
        accepted=accepted,
        reasons=np.array(reasons, dtype="U16").reshape(len(stamps), count),
        step_ms=np.array([step_ms.get(stamp, np.nan) for stamp in stamps.tolist()]),
    )
    return replace(track, keypoints=keypoints, pose=_pose_track(found, stamps, frame_id), detection=detection)


def _rows(seen: Sequence[JawKeypoints | None], name: str, shape: tuple[int, ...]) -> NDArray[np.float64]:
    """Return one attribute of every image (n, *shape), NaN where the jaw was not found."""
    missing = np.full(shape, np.nan)
    rows = [missing if found is None else np.asarray(getattr(found, name), dtype=np.float64) for found in seen]
    return np.array(rows).reshape(len(seen), *shape)


def _pose_track(found: Mapping[int, JawKeypoints], images: NDArray[np.int64], frame_id: str) -> PoseTrack | None:
    """Return the poses of a jaw where it was found; None without any."""
    stamps = [stamp for stamp in images.tolist() if stamp in found]
    if not stamps:
        return None
    poses = [found[stamp].T_camera_jaw for stamp in stamps]
    return PoseTrack(
        stamps_ns=np.array(stamps, dtype=np.int64),
        position=np.array([pose[:3, 3] for pose in poses]),
        quaternion=np.array([quaternion_from_pose(pose) for pose in poses]),
        frame_id=frame_id,
    )
