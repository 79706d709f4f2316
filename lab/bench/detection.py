"""Time against pixel error of the ways to find key points, on rendered images with truth.

All ways get a second of images each, one way after the other, so that a busy machine slows all of them alike.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from itertools import islice
from time import perf_counter, process_time
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from finforce.camera import ImageError, project
from finforce.transforms import pose_from_quaternion
from finforce_eval.evaluation.keypoint_source import KeypointSource, build_records, with_detections
from finforce_eval.evaluation.scoring import compare_detection, detection_stats
from finforce_eval.recordings.recording import read_recording
from finforce_eval.recordings.tracks import JawTrack, Recording
from finforce_ifea.jaw.jaw import Jaw, load_jaw
from finforce_keypoints.build import build_detector
from finforce_keypoints.detector import KeypointDetector
from finforce_keypoints.errors import KeypointError
from finforce_keypoints.geometry.jaw_localizer import JawKeypoints
from finforce_keypoints.images import RgbdImage
from finforce_keypoints.parameters import load_jaws
from lab.harness import Figures, Tradeoff, percentiles
from lab.scenes import DIM, GRASP, TwinScene, find_scene

QUICK_IMAGES = 45
BLOCK = 30  # images that one way sees in a row


@dataclass(frozen=True, kw_only=True)
class Way:
    """One way to find key points.

    Attributes:
        name: for tables.
        parameters: of the detector node, where they differ from the defaults.
        searches: whether the jaws are searched in every image, not tracked.
        rests: whether it leaves out pixels and depth where nothing has moved.
        dots: whether it looks at images with printed dots.
    """

    name: str
    parameters: Mapping[str, Any] = field(default_factory=dict)
    searches: bool = False
    rests: bool = False
    dots: bool = False


WAYS = (
    Way(name="network"),
    Way(name="network, 1 thread", parameters={"threads": 1}),
    Way(name="network, searching", searches=True),
    Way(name="network, resting", rests=True),
    Way(name="dots", parameters={"detection_method": "dots"}, dots=True),
)


@dataclass(kw_only=True)
class _DetectionRun:
    """A way on one recording: its detector, and what it found of each jaw."""

    way: Way
    detector: KeypointDetector
    found: dict[str, dict[int, JawKeypoints]]
    step_ms: dict[int, float] = field(default_factory=dict)
    seconds: list[float] = field(default_factory=list)
    cpu: list[float] = field(default_factory=list)

    def detect(self, stamp: int, image: RgbdImage) -> None:
        """Detect the key points in an image, and keep the time and the answer."""
        begin, used = perf_counter(), process_time()
        if self.way.searches:
            self.detector.reset()
        seen: Mapping[str, JawKeypoints] = {}
        with suppress(KeypointError, ImageError):
            seen = self.detector.detect(image)
        self.seconds.append(perf_counter() - begin)
        self.cpu.append(process_time() - used)
        self.step_ms[stamp] = 1e3 * self.seconds[-1]
        for side in self.found.keys() & seen.keys():
            self.found[side][stamp] = seen[side]


def measure(quick: bool) -> Figures:
    """Return times and pixel errors of every way.

    Args:
        quick: look at the first images of one scene only.

    Raises:
        FinforceError: a scene cannot be rendered.
    """
    return measure_ways(WAYS, [GRASP] if quick else [GRASP, DIM], QUICK_IMAGES if quick else None)


def measure_ways(ways: Sequence[Way], scenes: Sequence[TwinScene], count: int | None = None) -> Figures:
    """Return times and pixel errors of some ways on scenes.

    Args:
        ways: to be compared.
        scenes: whose images they look at.
        count: images of each scene at most; all without.
    """
    seconds: dict[str, list[float]] = {way.name: [] for way in ways}
    cpu: dict[str, list[float]] = {way.name: [] for way in ways}
    series: dict[str, list[pd.DataFrame]] = {way.name: [] for way in ways}
    yardstick: list[float] = []
    for scene in scenes:
        recording = read_recording(find_scene(scene))
        recording = replace(recording, images=recording.images.at(recording.images.stamps[:count]))
        for run in _look_at(recording, ways, yardstick):
            # the first image compiles, and finds the jaws
            seconds[run.way.name] += run.seconds[1:]
            cpu[run.way.name] += run.cpu[1:]
            detected = with_detections(recording, run.found, dict.fromkeys(run.found, run.step_ms))
            series[run.way.name] += [
                compare_detection(track.detection, track.sight) for track in detected.jaws.values()
            ]
    rows = [
        {
            "key points of both jaws": name,
            **percentiles(spent),
            "CPU p50/ms": 1e3 * float(np.median(cpu[name])),
            "CPU mean/ms": 1e3 * float(np.mean(cpu[name])),
            **sight_columns(detection_stats(series[name])),
        }
        for name, spent in seconds.items()
    ]
    return Figures(
        tables={"detection": pd.DataFrame(rows)},
        notes=[f"Product of two matrices of 512 x 512 in the same run: p50 {1e3 * np.median(yardstick):.2f} ms."],
        picture=Tradeoff(
            table="detection",
            method=("key points of both jaws",),
            time="p50/ms",
            slow="p99/ms",
            error="pixel error p95/px",
            answered="visible accepted/%",
            log_error=True,
            title="Key points of both jaws in one image: time against error",
        ),
    )


def sight_columns(stats: Mapping[str, float | None]) -> dict[str, float]:
    """Return the numbers of `detection_stats`, how well key points were seen, as columns of a table."""
    found = {name: np.nan if value is None else value for name, value in stats.items()}
    return {
        "pixel error median/px": found["pixel_median_px"],
        "pixel error p95/px": found["pixel_p95_px"],
        "point error median/mm": found["point_median_mm"],
        "point error p95/mm": found["point_p95_mm"],
        "hidden accepted/%": found["hidden_accepted_pct"],
        "visible accepted/%": 100.0 - found["visible_lost_pct"],
    }


def _look_at(recording: Recording, ways: Sequence[Way], yardstick: list[float]) -> list[_DetectionRun]:
    """Return what each way found in the images of a recording; times of the yardstick [s] go to a list."""
    from tqdm import tqdm

    jaws = {side: load_jaw("bench", side) for side in recording.jaws}
    runs = [_begin(way, recording) for way in ways]
    images = iter(tqdm(recording.images, unit="image", desc="key points", disable=None, leave=False))
    while block := list(islice(images, BLOCK)):
        dotted = [(stamp, paint_dots(image, stamp, jaws, recording.jaws)) for stamp, image in block]
        for run in runs:
            for stamp, image in dotted if run.way.dots else block:
                run.detect(stamp, image)
            yardstick.append(time_product())
    return runs


def _begin(way: Way, recording: Recording) -> _DetectionRun:
    """Return a way that is ready to look at a recording."""
    records = build_records(KeypointSource(parameters=way.parameters).node_parameters(recording))
    detector = build_detector(load_jaws(records.parameters), *records, rests=way.rests)
    detector.warm_up()
    return _DetectionRun(way=way, detector=detector, found={side: {} for side in recording.jaws})


def time_product(size: int = 512) -> float:
    """Return the time [s] of a product of two square matrices in single precision."""
    matrix = np.random.default_rng(0).standard_normal((size, size)).astype(np.float32)
    begin = perf_counter()
    matrix @ matrix
    return perf_counter() - begin


DIAMETER = 0.003  # [m]
COLOUR = np.array([40.0, 200.0, 60.0])  # of 255, where the image is of medium brightness
_MEDIUM = 120.0
_REACH = 20  # [px] around a dot that are painted at most
_STEP = 1e-4  # [m], of the differences that give a dot's shape in the image


@dataclass(frozen=True, kw_only=True, eq=False)
class _Disc:
    """A dot in the image: its centre [px], and what maps pixels from it onto the jaw's side (2, 2) [m/px]."""

    centre: NDArray
    onto_side: NDArray


def paint_dots(image: RgbdImage, stamp: int, jaws: Mapping[str, Jaw], tracks: Mapping[str, JawTrack]) -> RgbdImage:
    """Return an image with a dot on every visible key point and on the reference points.

    A dot is as bright as what it is printed on, with the image's own noise.

    Args:
        image: rendered.
        stamp: of it [ns].
        jaws: by side.
        tracks: the truth by side.
    """
    color = image.color.astype(np.float32)
    for side, track in tracks.items():
        row = int(np.searchsorted(track.sight.stamps, stamp))
        pose = pose_from_quaternion(track.true_pose.position[row], track.true_pose.quaternion[row])
        points = track.sight.points[row][track.sight.visible[row]]
        for point in (*points, jaws[side].reference_point):
            _paint(color, _place(point, pose, image))
    return replace(image, color=np.round(np.clip(color, 0.0, 255.0)).astype(np.uint8))


def _place(point: NDArray, pose: NDArray, image: RgbdImage) -> _Disc:
    """Return the disc about a point (3,) [m] of the jaw's side, y = const."""
    places = point + np.array([[0.0, 0.0, 0.0], [_STEP, 0.0, 0.0], [0.0, 0.0, _STEP]])
    pixels = project(places @ pose[:3, :3].T + pose[:3, 3], image.camera)
    return _Disc(centre=pixels[0], onto_side=np.linalg.inv((pixels[1:] - pixels[0]).T / _STEP))


def _paint(color: NDArray, disc: _Disc) -> None:
    """Paint a disc into an image (h, w, 3), its rim's pixels by the part that is covered."""
    column, row = (int(value) for value in np.round(disc.centre))
    rows = slice(max(row - _REACH, 0), max(row + _REACH + 1, 0))
    columns = slice(max(column - _REACH, 0), max(column + _REACH + 1, 0))
    part = color[rows, columns]
    if not part.size:
        return
    grid = np.stack(np.meshgrid(np.arange(part.shape[1]), np.arange(part.shape[0])), axis=-1)
    away = (grid + (columns.start, rows.start) - disc.centre) @ disc.onto_side.T
    pitch = np.sqrt(abs(np.linalg.det(disc.onto_side)))
    cover = np.clip(0.5 + (0.5 * DIAMETER - np.linalg.norm(away, axis=-1)) / pitch, 0.0, 1.0)[..., None]
    brightness = part.mean(axis=2, keepdims=True) / _MEDIUM
    part += cover * (COLOUR * brightness - part)
