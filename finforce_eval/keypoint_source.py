"""Where the key points of a run come from, `--from images|keypoints|truth`; it finds none itself."""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from typing import Any

import numpy as np

from finforce_eval.cli import SOURCES
from finforce_eval.detection import Detector, detect_keypoints
from finforce_eval.errors import OptionError, RecordingError
from finforce_eval.tracks import JawTrack, KeypointTrack, Recording

IMAGES, KEYPOINTS, TRUTH = SOURCES
TRUTH_VALUES = {"true": True, "yes": True, "1": True, "false": False, "no": False, "0": False}


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
        sides = list(recording.jaws)
        jaws = "both" if len(sides) == 2 else sides[0]
        return {"jaws": jaws, "jaw_file": self.jaw_file, **own, **self.parameters}

    def build(self, recording: Recording) -> Detector:
        """Return a fresh detector for a recording.

        Raises:
            FinforceError: a parameter, the jaw or the network cannot be used.
        """
        from finforce_keypoints.dots import DotSettings
        from finforce_keypoints.finders import build_detector
        from finforce_keypoints.parameters import DetectorParameters, load_jaws
        from finforce_keypoints.settings import DetectorSettings

        given = self.node_parameters(recording)
        records = {"": DetectorParameters, "detector": DetectorSettings, "dots": DotSettings}
        parameters, settings, dots = (record(**_fields_of(prefix, given)) for prefix, record in records.items())
        return build_detector(load_jaws(parameters), parameters, settings, dots).detector

    def _detect(self, recording: Recording) -> Recording:
        from tqdm import tqdm

        from finforce_keypoints.images import ImageWatch

        detector = self.build(recording)
        count = len(recording.images)
        with tqdm(total=count, unit="image", desc=recording.name, disable=None, leave=False) as bar:
            return detect_keypoints(recording, detector, watch=ImageWatch(), progress=bar.update)


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
        OptionError: a parameter of the detector is not known or has another type.
    """
    parameters: dict[str, Any] = {}
    changes, extrinsics = getattr(options, "detector", []), getattr(options, "extrinsics", None)
    if changes:
        parameters = _parse_changes(changes)
    if extrinsics:
        parameters["T_gripper_camera"] = _parse_extrinsics(extrinsics)
    return KeypointSource(source=getattr(options, "source", None) or "", jaw_file=options.jaw, parameters=parameters)


def _parse_changes(changes: Sequence[str]) -> dict[str, Any]:
    """Return `NAME=VALUE` texts as values of the type of the parameter."""
    from finforce_keypoints.dots import DotSettings
    from finforce_keypoints.parameters import DetectorParameters
    from finforce_keypoints.settings import DetectorSettings

    defaults = dict(asdict(DetectorParameters()))
    for prefix, record in (("detector", DetectorSettings), ("dots", DotSettings)):
        defaults |= {f"{prefix}.{entry.name}": getattr(record(), entry.name) for entry in fields(record)}
    parsed = {}
    for change in changes:
        name, _, text = change.partition("=")
        if name not in defaults:
            raise OptionError(f"--detector {change}: unknown parameter; expected one of {', '.join(defaults)}")
        parsed[name] = _parse_value(change, text, defaults[name])
    return parsed


def _parse_value(change: str, text: str, default: Any) -> Any:
    """Return a text as a value of the type of a default; a list has commas."""
    if isinstance(default, tuple | list):
        kind = type(default[0]) if default else str
        return [_parse_value(change, part, kind()) for part in text.split(",")]
    try:
        return TRUTH_VALUES[text.lower()] if isinstance(default, bool) else type(default)(text)
    except (KeyError, ValueError):
        raise OptionError(f"--detector {change}: '{text}' is no {type(default).__name__}") from None


def _parse_extrinsics(text: str) -> list[float]:
    """Return x, y, z [m], qx, qy, qz, qw of a camera by its name or its numbers."""
    from finforce_keypoints.gripper_geometry import BENCH_CAMERA, ROBOT_CAMERA
    from finforce_keypoints.parameters import pose_numbers

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
