"""The subcommand `check`: do camera, jaw file, extrinsics and picture fit each other, before any force."""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

from tqdm import tqdm

from finforce_eval.cli.extrinsics import read_at_rest
from finforce_eval.cli.parser import whole_number
from finforce_eval.errors import OptionError
from finforce_eval.evaluation.at_rest import ROUNDS
from finforce_eval.evaluation.check import FAULT, check_recording
from finforce_eval.recordings.listening import CameraTopics, record_camera

PICTURE = "check.png"


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the subcommand."""
    parser.add_argument("bags", nargs="*", metavar="BAG", help="rosbag2 folder, .mcap or .db3 file with images")
    text = (
        "listen to a running camera instead: to the usual topics, or to those of colour images, camera_info and, "
        "if there is any, aligned depth"
    )
    parser.add_argument("--topics", nargs="*", metavar="TOPIC", help=text)
    parser.add_argument("--jaw", default="bench", metavar="FILE", help="jaw file, or a shipped name (bench)")
    parser.add_argument("--jaws", default="both", choices=("left", "right", "both"), help="in the images (both)")
    text = "the camera in the gripper: robot, bench, or x,y,z,qx,qy,qz,qw; without it that of the case.json, else robot"
    parser.add_argument("--extrinsics", metavar="POSE", help=text)
    text = "change a parameter of the key point detector, as depth=none; repeatable"
    parser.add_argument("--detector", action="append", default=[], metavar="NAME=VALUE", help=text)
    text = "how many images at the beginning show the jaws open, still and unloaded (30)"
    parser.add_argument("--images", type=whole_number(1, 100_000), default=30, metavar="N", help=text)
    parser.add_argument("--report", default=".", metavar="DIR", help=f"where {PICTURE} is written (here)")


def run(options: argparse.Namespace) -> int:
    """Check the first images of a recording, print what fits and what does not, and draw it.

    Returns:
        0 if everything fits, 1 if something has to be changed.
    """
    with TemporaryDirectory() as scratch:
        if options.topics is not None:
            options.bags += [str(_listen(options, Path(scratch) / "camera"))]
        if len(options.bags) != 1:
            raise OptionError(f"got {' '.join(options.bags) or 'nothing'}; expected one BAG, or --topics")
        return _check(options)


def _listen(options: argparse.Namespace, folder: Path) -> Path:
    """Record what a running camera publishes."""
    if options.bags or len(options.topics) not in (0, 2, 3):
        raise OptionError(
            f"--topics {' '.join(options.topics)}: expected none, or those of colour, camera_info and perhaps depth; "
            "and no BAG"
        )
    topics = CameraTopics(*options.topics, *([""] if len(options.topics) == 2 else []))
    return record_camera(topics, options.images, folder)


def _check(options: argparse.Namespace) -> int:
    from finforce.optional import import_cv2

    source, recording = read_at_rest(options)
    if not recording.images.has_depth and "depth" not in source.parameters:
        source = replace(source, parameters={**source.parameters, "depth": "none"})
    with tqdm(total=ROUNDS * len(recording.images), unit="image", disable=None, leave=False) as bar:
        check = check_recording(recording, source, bar.update)
    for line in check.said:
        print(f"{line.level:<8}{line.text}")
    folder = Path(options.report)
    folder.mkdir(parents=True, exist_ok=True)
    import_cv2().imwrite(str(folder / PICTURE), check.picture[..., ::-1])
    verdict = "everything fits" if check.is_good else f"{sum(line.level == FAULT for line in check.said)} to be changed"
    print(f"{verdict}; {folder / PICTURE}: grey as given, orange as fitted, green key points")
    return 0 if check.is_good else 1
