"""The key point detector over the images of a recording, offline.

The detector is the one that its node runs: what it says of an image here, it says there.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from time import perf_counter
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from finforce.camera import ImageError
from finforce.transforms import quaternion_from_pose
from finforce_eval.errors import RecordingError
from finforce_eval.recordings.tracks import DetectionTrack, JawTrack, KeypointTrack, PoseTrack, Recording
from finforce_keypoints.errors import KeypointError
from finforce_keypoints.images import ImageWatch, RgbdImage


class FoundKeypoints(Protocol):
    """What is read of the key points that a detector found of one jaw; `finforce_keypoints.JawKeypoints` has it."""

    points: NDArray
    likelihood: NDArray
    pixels: NDArray
    valid: NDArray
    stddev: NDArray
    T_camera_jaw: NDArray
    reasons: NDArray


class Detector(Protocol):
    """Finds the key points of all jaws in one image after the other.

    Attributes:
        warnings: what is suspicious about a jaw, by side.
    """

    warnings: Mapping[str, str]

    def detect(self, image: RgbdImage) -> Mapping[str, FoundKeypoints]:
        """Return what was found, by side; a jaw that was not found is absent."""


@dataclass(kw_only=True)
class SideLog:
    """What a detector said of one jaw, image by image [ns].

    Attributes:
        found: the key points, where the jaw was found.
        step_ms: wall time [ms] of every image.
    """

    found: dict[int, FoundKeypoints] = field(default_factory=dict)
    step_ms: dict[int, float] = field(default_factory=dict)


class Reasons:
    """Why images were refused: texts that differ in their numbers only are one reason."""

    def __init__(self) -> None:
        """Begin without any."""
        self._counts: Counter[str] = Counter()
        self._texts: dict[str, str] = {}

    def count(self, text: str) -> None:
        """Take a reason; of a kind, the first text is kept."""
        kind = re.sub(r"[0-9.]+", "#", text)
        self._counts[kind] += 1
        self._texts.setdefault(kind, text)

    def commonest(self) -> str:
        """Return the text of the most frequent reason, "" without any."""
        return self._texts[self._counts.most_common(1)[0][0]] if self._counts else ""

    def notes(self) -> list[str]:
        """Return a line for each reason."""
        return [f"{count} images refused: {self._texts[kind]}" for kind, count in self._counts.items()]


def detect_keypoints(
    recording: Recording, detector: Detector, *, watch: ImageWatch, progress: Callable[[int], Any] = lambda images: None
) -> Recording:
    """Return a recording with the key points and jaw poses that a detector finds in its images.

    An image that is refused, or in which a jaw is not found, has no key points of it.

    Args:
        recording: with images.
        detector: a fresh one, of the recording's jaws.
        watch: notices a camera that fails, as in the node.
        progress: called with the number of images done since its last call.

    Raises:
        RecordingError: an image is damaged, or not one jaw was found in any.
    """
    images = recording.images
    logs = {side: SideLog() for side in recording.jaws}
    reasons = Reasons()
    for stamp, image in images:
        begin = perf_counter()
        try:
            watch.check(image)
            found = detector.detect(image)
        except (KeypointError, ImageError) as error:
            found = {}
            reasons.count(str(error))
        spent = 1e3 * (perf_counter() - begin)
        for side, log in logs.items():
            log.step_ms[stamp] = spent
            if side in found:
                log.found[stamp] = found[side]
        progress(1)
    warnings = [f"{side} jaw: {warning}" for side, warning in detector.warnings.items()]
    if not any(log.found for log in logs.values()):
        why = reasons.commonest() or "; ".join(warnings) or "no jaw stands where it could be; another --extrinsics?"
        raise RecordingError(f"{recording.name}: no key points in {len(images)} images: {why}")
    notes = reasons.notes() + warnings
    return with_detections(replace(recording, notes=(*recording.notes, *notes)), logs)


def awaiting_keypoints(recording: Recording) -> Recording:
    """Return a recording without the key points and jaw poses that were recorded: images will give them."""
    jaws = {side: replace(track, keypoints=KeypointTrack.empty(), pose=None) for side, track in recording.jaws.items()}
    return replace(recording, jaws=jaws)


def with_detections(recording: Recording, logs: Mapping[str, SideLog]) -> Recording:
    """Return a recording whose key points and jaw poses are those that a detector found.

    Args:
        recording: with images.
        logs: by side; a jaw that was never found has no key points in any image.
    """
    jaws = {
        side: _with_detection(track, logs[side], recording.images.stamps, recording.images.frame_id)
        for side, track in recording.jaws.items()
        if side in logs
    }
    return replace(recording, jaws=jaws)


def _with_detection(track: JawTrack, log: SideLog, stamps: NDArray[np.int64], frame_id: str) -> JawTrack:
    """Return the track of a jaw with its detections at all images (n,) [ns]."""
    count = next((len(found.points) for found in log.found.values()), track.sight.points.shape[1] if track.sight else 0)
    seen = [log.found.get(int(stamp)) for stamp in stamps]
    points, stddev = _rows(seen, "points", (count, 3)), _rows(seen, "stddev", (count, 3))
    accepted = np.nan_to_num(_rows(seen, "valid", (count,))).astype(bool)
    # what is not valid has no coordinates for the solver, as when the cloud comes by topic in single precision
    passed = np.where(accepted[:, :, None], points, np.nan).astype(np.float32).astype(np.float64)
    keypoints = KeypointTrack(
        stamps=stamps,
        points=passed,
        likelihood=np.nan_to_num(_rows(seen, "likelihood", (count,))),
        stddev=np.where(np.isfinite(passed), stddev, np.nan),
    )
    detection = DetectionTrack(
        stamps=stamps,
        pixels=_rows(seen, "pixels", (count, 2)),
        points=points,
        accepted=accepted,
        reasons=np.array([_reasons(found, count) for found in seen]).reshape(-1, count),
        found=np.array([found is not None for found in seen]),
        step_ms=np.array([log.step_ms.get(int(stamp), np.nan) for stamp in stamps]),
    )
    return replace(track, keypoints=keypoints, pose=_pose_track(log, frame_id), detection=detection)


def _rows(seen: Sequence[FoundKeypoints | None], name: str, shape: tuple[int, ...]) -> NDArray[np.float64]:
    """Return one attribute of every image (n, *shape), NaN where the jaw was not found."""
    missing = np.full(shape, np.nan)
    rows = [missing if found is None else np.asarray(getattr(found, name), dtype=np.float64) for found in seen]
    return np.array(rows).reshape(-1, *shape)


def _reasons(found: FoundKeypoints | None, count: int) -> NDArray[np.str_]:
    """Return why each key point (count,) was refused, "" where the jaw was not found."""
    return np.full(count, "", dtype="U16") if found is None else np.asarray(found.reasons, dtype="U16")


def _pose_track(log: SideLog, frame_id: str) -> PoseTrack | None:
    """Return the poses of a jaw where it was found; None without any."""
    if not log.found:
        return None
    stamps = sorted(log.found)
    poses = [log.found[stamp].T_camera_jaw for stamp in stamps]
    return PoseTrack(
        stamps=np.array(stamps, dtype=np.int64),
        position=np.array([pose[:3, 3] for pose in poses]),
        quaternion=np.array([quaternion_from_pose(pose) for pose in poses]),
        frame_id=frame_id,
    )
