"""The subcommand `live`: the forces in the images of a webcam, without ROS."""

from __future__ import annotations

import argparse
import re
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from finforce.camera import CameraIntrinsics, ImageError
from finforce.messages import NANOSECONDS
from finforce.optional import import_cv2
from finforce_eval.cli.parser import CommandResult, file_type, length_mm
from finforce_eval.errors import RecordingError
from finforce_eval.sensor import ForceSensor, GripperForces
from finforce_eval.table import ForceSeries, write_table
from finforce_keypoints.errors import KeypointError

_PRINT_PERIOD = 0.1  # [s] of the images between two lines
_COLUMNS = dict.fromkeys(("force", "torque", "force_stddev", "torque_stddev"), np.full(3, np.nan))
_COLUMNS["magnitude_stddev"] = np.nan


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the subcommand."""
    text = "number of a camera or its name (/dev/videoN), or a file or address that OpenCV can open (0)"
    parser.add_argument("--camera", default="0", metavar="N", help=text)
    parser.add_argument("--rig", required=True, metavar="FILE", help="rig file of finforce camera")
    text = "height of first touch above the clamped base [mm]"
    parser.add_argument("--contact-height", required=True, type=length_mm, metavar="MM", help=text)
    text = "calibration file, or name of an included one (material of the jaw file)"
    parser.add_argument("--calibration", metavar="FILE", help=text)
    text = "write a Parquet table, a row per image and jaw, at the end"
    parser.add_argument("-o", "--output", type=file_type(".parquet"), metavar="FILE.parquet", help=text)


def run(options: argparse.Namespace) -> CommandResult:
    """Print the forces in the images of a camera until it ends, or Ctrl-C."""
    sensor = ForceSensor(rig=options.rig, contact_height=options.contact_height, calibration=options.calibration)
    kept: list[GripperForces] = []
    shown = -np.inf
    try:
        for stamp, rgb in Webcam(options.camera, sensor.camera):
            try:
                kept.append(sensor.update(rgb, None, stamp))
            except (ImageError, KeypointError) as error:
                kept.append(GripperForces(stamp=stamp, jaws={}, status=str(error)))
            if stamp >= shown + _PRINT_PERIOD:
                shown = stamp
                print(describe(kept[-1]), flush=True)
    except KeyboardInterrupt:
        print("stopped", file=sys.stderr)
    finally:
        if options.output and any(each.jaws for each in kept):
            write_forces(kept, Path(options.output), options)
    answered = sum(each.status == "ok" for each in kept)
    print(f"a force in {answered} of {len(kept)} images")
    return CommandResult({"images": len(kept), "answered": answered})


class Webcam:
    """The images of a UVC camera, a file or a stream, by OpenCV.

    Args:
        source: number of the camera, its name in /dev, or path or address.
        camera: intrinsics, which the images have to agree with in size; a camera is asked for that.

    Raises:
        RecordingError: it cannot be opened.
    """

    def __init__(self, source: str, camera: CameraIntrinsics) -> None:
        cv2 = import_cv2()
        name = re.sub("//[^/]*@", "//", source)  # without a password
        self._name, self._camera = f"camera {name}", camera
        self._capture = cv2.VideoCapture(int(source) if source.isdigit() else source)
        if not self._capture.isOpened():
            there = ", ".join(sorted(each.name for each in Path("/dev").glob("video*"))) or "none"
            raise RecordingError(
                f"{self._name}: cannot be opened; expected a number of /dev/video* ({there}), a file, "
                "or the address of a stream that can be reached from here"
            )
        is_device = source.isdigit() or source.startswith("/dev/")
        is_stream = "://" in source and self._capture.get(cv2.CAP_PROP_FRAME_COUNT) <= 0  # its rate is but a guess
        self._is_live = is_device or is_stream
        if is_device:
            self._capture.set(cv2.CAP_PROP_FRAME_WIDTH, camera.width)
            self._capture.set(cv2.CAP_PROP_FRAME_HEIGHT, camera.height)
            self._capture.set(cv2.CAP_PROP_BUFFERSIZE, 1)  # the newest image, not the oldest that waits
        self._period = 1.0 / (self._capture.get(cv2.CAP_PROP_FPS) or 30.0)

    def __iter__(self) -> Iterator[tuple[float, NDArray[np.uint8]]]:
        """Yield time of receipt, or place in a file [s], and image (h, w, 3) RGB, until the file ends.

        Raises:
            RecordingError: the camera gives none, or images of another size.
        """
        size, number, begin = (self._camera.height, self._camera.width), 0, time.monotonic()
        try:
            while True:
                is_read, bgr = self._capture.read()
                now = time.monotonic()
                if not is_read and (self._is_live or not number):
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
                yield now if self._is_live else number * self._period, np.ascontiguousarray(bgr[..., ::-1])
                number, begin = number + 1, time.monotonic()
        finally:
            self._capture.release()


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
    """Write the forces in some images as Parquet; what is not trusted is NaN."""
    stamps = [round(each.stamp * NANOSECONDS) for each in kept]
    series = []
    for side in sorted({side for each in kept for side in each.jaws}):
        found = [each.jaws.get(side) for each in kept]
        columns = {
            name: [getattr(each, name) if each is not None and each.trusted else missing for each in found]
            for name, missing in _COLUMNS.items()
        }
        columns["status"] = ["not found" if each is None else each.status for each in found]
        columns["message"] = ["" if each.status == "ok" else each.status for each in kept]
        series.append(ForceSeries.build("live", side, stamps, **columns, scored=True))
    write_table(path, series, {"rig": options.rig, "camera": options.camera, "contact_height": options.contact_height})
