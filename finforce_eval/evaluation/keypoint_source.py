"""Where the key points of a run come from, `--from images|keypoints|truth`."""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from finforce.errors import FinforceError
from finforce.stamps import NANOSECONDS
from finforce_eval.errors import OptionError, RecordingError
from finforce_eval.evaluation.changes import parse_changes
from finforce_eval.evaluation.detection import Detector, detect_keypoints
from finforce_eval.recordings.images import PAIRED
from finforce_eval.recordings.tracks import JawTrack, KeypointTrack, Recording

if TYPE_CHECKING:
    from finforce_keypoints.detectors.dots import DotSettings
    from finforce_keypoints.parameters import DetectorParameters
    from finforce_keypoints.settings import DetectorSettings

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
LIVE = ("max_age", "restart_gap", "diagnostics_period")  # without meaning where no clock runs


class DetectorRecords(NamedTuple):
    """What a detector is built with."""

    parameters: DetectorParameters
    settings: DetectorSettings
    dots: DotSettings


@dataclass(frozen=True, kw_only=True)
class KeypointSource:
    """What key points a run uses, and the detector that finds them where they come from images.

    Attributes:
        source: "images", "keypoints", "truth", or "" for key points where they were recorded, else images.
        jaw_file: of the jaws.
        parameters: parameters of the detector node that differ from its defaults, by their ROS names.
    """

    source: str = ""
    jaw_file: str = "bench"
    parameters: Mapping[str, Any] = field(default_factory=dict)

    def source_of(self, recording: Recording) -> str:
        """Return "images", "keypoints" or "truth" for a recording.

        Raises:
            RecordingError: it has no such thing.
        """
        has_keypoints = all(len(track.keypoints.stamps) for track in recording.jaws.values())
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
        own = {"camera_frame": recording.images.frame_id}
        pose = recording.case.get("T_gripper_camera")
        if isinstance(pose, list):
            own["T_gripper_camera"] = [float(number) for number in pose]
        step = recording.case.get("depth_scale")
        if isinstance(step, float):
            own |= {"depth_scale": step, "detector.quantum": step}
        sides = list(recording.jaws)
        jaws = "both" if len(sides) == 2 else sides[0]
        return {"jaws": jaws, "jaw_file": self.jaw_file, **own, **self.parameters}

    def build(self, recording: Recording) -> Detector:
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
        return build_detector(load_jaws(parameters), parameters, settings, dots).detector

    @property
    def pairing(self) -> int:
        """Greatest distance between the stamps of a colour and a depth image that belong together [ns]."""
        seconds = self.parameters.get("sync_tolerance")
        return PAIRED if seconds is None else round(seconds * NANOSECONDS)

    def _detect(self, recording: Recording) -> Recording:
        from tqdm import tqdm

        from finforce_keypoints.images import ImageWatch

        detector, parameters = self.build(recording), build_records(self.node_parameters(recording)).parameters
        watch = ImageWatch(parameters.frozen_after)
        recording = replace(recording, images=replace(recording.images, depth_scale=parameters.depth_scale))
        with tqdm(total=len(recording.images), unit="image", desc=recording.name, disable=None, leave=False) as bar:
            return detect_keypoints(recording, detector, watch=watch, progress=bar.update)


def build_records(given: Mapping[str, Any]) -> DetectorRecords:
    """Return the records of a detector with parameters by their ROS names; the others have their defaults.

    Raises:
        FinforceError: a value is not among its choices or out of its bounds.
    """
    return DetectorRecords(*(record(**_fields_of(prefix, given)) for prefix, record in _record_types().items()))


def _record_types() -> dict[str, type]:
    """Return the types of a detector's records by the prefix of their parameters."""
    from finforce_keypoints.detectors.dots import DotSettings
    from finforce_keypoints.parameters import DetectorParameters
    from finforce_keypoints.settings import DetectorSettings

    return {"": DetectorParameters, "detector": DetectorSettings, "dots": DotSettings}


def _fields_of(prefix: str, given: Mapping[str, Any]) -> dict[str, Any]:
    """Return the fields of the record that the names with a prefix, or without any, are of."""
    split = [(*name.rpartition(".")[::2], value) for name, value in given.items()]
    values = {name: value for own, name, value in split if own == prefix}
    return {name: tuple(value) if isinstance(value, list) else value for name, value in values.items()}


def _true_track(track: JawTrack) -> JawTrack:
    """Return the track of a jaw with its true key points and poses; what the camera did not see stays away."""
    sight = track.sight
    points = np.where(sight.visible[:, :, None], sight.points, np.nan)
    keypoints = KeypointTrack(stamps=sight.stamps, points=points, likelihood=sight.visible.astype(np.float64))
    return replace(track, keypoints=keypoints, pose=track.true_pose or track.pose)


def parse_source(options: argparse.Namespace) -> KeypointSource:
    """Return where the key points come from.

    Raises:
        OptionError: a parameter of the detector is not known, has another type, is out of its bounds, or is decided by
            something else; or no detector is needed.
    """
    parameters: dict[str, Any] = {}
    changes, extrinsics = getattr(options, "detector", []), getattr(options, "extrinsics", None)
    source = getattr(options, "source", None) or ""
    for name, given in (("--detector", changes), ("--extrinsics", extrinsics)):
        if given and source in (KEYPOINTS, TRUTH):
            raise OptionError(f"{name}: --from {source} needs no detector; leave it out, or give --from {IMAGES}")
    if changes:
        parameters = _parse_parameters(changes)
    if extrinsics:
        parameters["T_gripper_camera"] = _parse_extrinsics(extrinsics)
    return KeypointSource(source=source, jaw_file=options.jaw, parameters=parameters)


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
    from finforce.gripper_frames import BENCH_CAMERA, ROBOT_CAMERA
    from finforce.transforms import pose_numbers

    known = {"bench": BENCH_CAMERA, "robot": ROBOT_CAMERA}
    if text in known:
        return list(pose_numbers(known[text]))
    try:
        numbers = [float(part) for part in text.split(",")]
    except ValueError:
        numbers = []
    if len(numbers) != 7:
        raise OptionError(f"--extrinsics {text}: expected robot, bench, or x,y,z,qx,qy,qz,qw")
    return numbers
