"""The subcommand `live`: the forces in the images of a webcam, without ROS."""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from finforce.camera import CameraIntrinsics, ImageError
from finforce.messages import NANOSECONDS
from finforce.optional import import_cv2
from finforce_eval.cli.parser import CommandResult, length_mm
from finforce_eval.errors import RecordingError
from finforce_eval.sensor import ForceSensor, GripperForces
from finforce_eval.table import ForceSeries, write_table
from finforce_ifea.observation import Solution
from finforce_keypoints.errors import KeypointError

_PRINT_PERIOD = 0.1  # [s] of the images between two lines
_VECTORS = ("force", "torque", "force_stddev", "torque_stddev")


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the subcommand."""
    text = "number of a camera (/dev/videoN), or a file or address that OpenCV can open (0)"
    parser.add_argument("--camera", default="0", metavar="N", help=text)
    parser.add_argument("--rig", required=True, metavar="FILE", help="rig file of finforce camera")
    text = "height of first touch above the clamped base [mm]"
    parser.add_argument("--contact-height", required=True, type=length_mm, metavar="MM", help=text)
    text = "calibration file, or name of an included one (material of the jaw file)"
    parser.add_argument("--calibration", metavar="FILE", help=text)
    text = "write a Parquet table, a row per image and jaw, at the end"
    parser.add_argument("-o", "--output", metavar="FILE", help=text)


def run(options: argparse.Namespace) -> CommandResult:
    """Print the forces in the images of a camera until it ends, or Ctrl-C."""
    sensor = ForceSensor(rig=options.rig, contact_height=options.contact_height, calibration=options.calibration)
    kept: list[GripperForces] = []
    shown = -np.inf
    try:
        for stamp, rgb in Webcam(options.camera, sensor.camera):
            kept.append(find_forces(sensor, rgb, stamp))
            if stamp >= shown + _PRINT_PERIOD:
                shown = stamp
                print(describe(kept[-1]), flush=True)
    except KeyboardInterrupt:
        print("stopped", file=sys.stderr)
    finally:
        if options.output and kept:
            write_forces(kept, Path(options.output), options)
    answered = sum(each.status == "ok" for each in kept)
    print(f"a force in {answered} of {len(kept)} images{f': {options.output}' if options.output and kept else ''}")
    return CommandResult({"images": len(kept), "answered": answered})


class WebcamImage(NamedTuple):
    """An image (h, w, 3) uint8 RGB and its time of receipt, or its place in a file [s]."""

    stamp: float
    rgb: NDArray[np.uint8]


class Webcam:
    """The images of a UVC camera, a file or a stream, by OpenCV.

    Args:
        source: number of the camera, or path or address.
        camera: intrinsics, which the images have to agree with in size; a camera is asked for that.

    Raises:
        RecordingError: it cannot be opened.
    """

    def __init__(self, source: str, camera: CameraIntrinsics) -> None:
        cv2 = import_cv2()
        self._name, self._camera, self._is_device = f"camera {source}", camera, source.isdigit()
        self._capture = cv2.VideoCapture(int(source) if self._is_device else source)
        if not self._capture.isOpened():
            there = ", ".join(sorted(each.name for each in Path("/dev").glob("video*"))) or "none"
            raise RecordingError(
                f"{self._name}: cannot be opened; expected a number of /dev/video* ({there}), or a file"
            )
        if self._is_device:
            self._capture.set(cv2.CAP_PROP_FRAME_WIDTH, camera.width)
            self._capture.set(cv2.CAP_PROP_FRAME_HEIGHT, camera.height)
            self._capture.set(cv2.CAP_PROP_BUFFERSIZE, 1)  # the newest image, not the oldest that waits
        self._period = 1.0 / (self._capture.get(cv2.CAP_PROP_FPS) or 30.0)

    def __iter__(self) -> Iterator[WebcamImage]:
        """Yield images until the file ends.

        Raises:
            RecordingError: the camera gives none, or images of another size.
        """
        size, number, begin = (self._camera.height, self._camera.width), 0, time.monotonic()
        try:
            while True:
                is_read, bgr = self._capture.read()
                now = time.monotonic()
                if not is_read and (self._is_device or not number):
                    raise RecordingError(
                        f"{self._name}: no image for {now - begin:.1f} s, after {number}: unplugged, stalled, or used "
                        "by another program?"
                    )
                if not is_read:
                    return
                if bgr.shape[:2] != size:
                    raise RecordingError(
                        f"{self._name}: image {number} is {bgr.shape[1]} x {bgr.shape[0]}; expected {size[1]} x "
                        f"{size[0]} as the rig has: make a rig of these by finforce camera"
                    )
                yield WebcamImage(
                    now if self._is_device else number * self._period, np.ascontiguousarray(bgr[..., ::-1])
                )
                number, begin = number + 1, time.monotonic()
        finally:
            self._capture.release()


def find_forces(sensor: ForceSensor, rgb: NDArray, stamp: float) -> GripperForces:
    """Return the forces in an image; of one that cannot be used, why."""
    try:
        return sensor.update(rgb, None, stamp)
    except (ImageError, KeypointError) as error:
        return GripperForces(stamp=stamp, jaws={}, status=str(error))


def describe(forces: GripperForces) -> str:
    """Return a line about one image."""
    jaws = [
        f"{side} {np.linalg.norm(each.force):.2f} ± {each.magnitude_stddev:.2f} N"
        for side, each in forces.jaws.items()
        if each.trusted
    ]
    grasp = f"grasp {forces.grasp:.2f} N" if forces.status == "ok" else forces.status
    return f"{forces.stamp:.2f} s  {'  '.join([*jaws, grasp])}"


def write_forces(kept: list[GripperForces], path: Path, options: argparse.Namespace) -> None:
    """Write the forces in some images as Parquet."""
    stamps = [round(each.stamp * NANOSECONDS) for each in kept]
    sides = sorted({side for each in kept for side in each.jaws})
    series = [
        ForceSeries.build("live", side, stamps, **_columns([(each.jaws.get(side), each.status) for each in kept]))
        for side in sides
    ]
    write_table(path, series, {"rig": options.rig, "camera": options.camera, "contact_height": options.contact_height})


def _columns(rows: list[tuple[Solution | None, str]]) -> dict[str, Any]:
    """Return the columns of one jaw; what is not trusted is NaN."""
    trusted = [each if each is not None and each.trusted else None for each, _ in rows]
    columns: dict[str, Any] = {
        name: [np.full(3, np.nan) if each is None else getattr(each, name) for each in trusted] for name in _VECTORS
    }
    columns["magnitude_stddev"] = [np.nan if each is None else each.magnitude_stddev for each in trusted]
    columns["status"] = ["not found" if each is None else each.status for each, _ in rows]
    columns["message"] = ["" if each is not None and each.trusted else words for each, words in rows]
    return columns | {"scored": True}
