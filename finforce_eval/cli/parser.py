"""Options that several subcommands share, and a parser whose complaints are one line."""

from __future__ import annotations

import argparse
import re
from collections.abc import Callable
from typing import TYPE_CHECKING, NoReturn

if TYPE_CHECKING:
    from finforce_eval.tasks import EngineOptions

SOLVERS = ("default", "reduced", "solid", "frame", "plane", "linear", "paper")
MESHES = ("default", "coarse", "fine")
UNITS = ("m", "cm", "mm", "inch")
SOURCES = ("images", "keypoints", "truth")
JAWS_CHOICES = ("left", "right", "both")
BAG_HELP = "rosbag2 folder, .mcap or .db3 file, or the folder of a LeRobot dataset"
CONTACT_HELP = (
    "contact: estimate, closest or paper, from the object's mesh and pose; fixed:Z_MM, the height of first touch above "
    "the clamped base; fixed:case takes it from the case.json next to each recording; NAME=Z_MM gives it for one "
    "recording and may be repeated. Without it estimate for a recording with mesh and poses, else fixed:case"
)
PICTURES = (".png", ".jpg", ".svg", ".pdf")


def picture_file(text: str) -> str:
    """Return the name of a picture to be drawn, for `type=` of an option; another ending is refused."""
    if not text.lower().endswith(PICTURES):
        raise argparse.ArgumentTypeError(f"{text}: expected a name that ends in {', '.join(PICTURES)}")
    return text


class Parser(argparse.ArgumentParser):
    """A parser whose complaints are one line."""

    def error(self, message: str) -> NoReturn:
        """Print one line and exit with 2."""
        self.exit(2, f"{self.prog}: {message} (see {self.prog} --help)\n")


def add_run_options(parser: argparse.ArgumentParser, *, calibration: bool = True, settings: bool = True) -> None:
    """Add what names jaw, solver, contact and key points and, where they count, calibration and single settings."""
    parser.add_argument("--jaw", default="bench", metavar="FILE", help="jaw file, or a shipped name (bench)")
    parser.add_argument("--solver", default="default", choices=SOLVERS, help="model and objective")
    parser.add_argument("--mesh", default="default", choices=MESHES, help="mesh density")
    parser.add_argument("--contact", action="append", default=[], metavar="CONTACT", help=CONTACT_HELP)
    mesh = "object mesh (STL, OBJ, PLY, GLB) in its own frame; without it the one that each case.json names"
    parser.add_argument("--object", metavar="MESH", help=mesh)
    parser.add_argument("--object-unit", default="m", choices=UNITS, help="unit of the mesh (m)")
    text = "key points: images, by the detector; keypoints, as recorded; truth, of a synthetic recording. Without it "
    text += "keypoints where they were recorded, else images"
    parser.add_argument("--from", dest="source", choices=SOURCES, help=text)
    text = "jaws that are in the images, where no topic tells (both)"
    parser.add_argument("--jaws", choices=JAWS_CHOICES, help=text)
    add_detector_options(parser)
    text = "refuse a recording that is cut off or damaged; without it, it is read as far as it is good"
    parser.add_argument("--strict", action="store_true", help=text)
    if calibration:
        text = "calibration file, or a shipped name; without it the jaw file's own material"
        parser.add_argument("--calibration", metavar="FILE", help=text)
    if settings:
        text = "change a setting of the estimator, may be repeated; an unknown NAME lists them"
        parser.add_argument("--set", action="append", default=[], metavar="NAME=VALUE", help=text)


def add_detector_options(parser: argparse.ArgumentParser) -> None:
    """Add what changes the key point detector."""
    text = "change a parameter of the key point detector, as model=FOLDER or detector.gate=0.004; repeatable"
    parser.add_argument("--detector", action="append", default=[], metavar="NAME=VALUE", help=text)
    text = "the camera in the gripper: robot, bench, or x,y,z,qx,qy,qz,qw; without it that of the case.json, else robot"
    parser.add_argument("--extrinsics", metavar="POSE", help=text)
    text = "topic of the colour images, of a LeRobot dataset the feature; without it the only one there is"
    parser.add_argument("--color", metavar="TOPIC", help=text)
    text = "topic of the depth images; without it the only one in the frame of the colour images"
    parser.add_argument("--depth", metavar="TOPIC", help=text)
    text = "topic of the camera_info; without it that next to the colour images"
    parser.add_argument("--camera-info", metavar="TOPIC", help=text)
    text = "the camera, instead of camera_info and for LeRobot datasets: fx fy cx cy [k1 k2 p1 p2 k3] in pixels, or a "
    text += "file of ROS, OpenCV, kalibr, BOP or OpenICC (UMI), and which of its cameras where it has several"
    parser.add_argument("--intrinsics", nargs="+", metavar="NUMBER", help=text)
    episode = whole_number(0, 10**9)
    parser.add_argument("--episode", type=episode, default=0, metavar="N", help="of a LeRobot dataset (0)")


def add_rest_options(parser: argparse.ArgumentParser, images: int) -> None:
    """Add what names jaws at rest in the first images of a recording, so many unless told otherwise."""
    parser.add_argument("--jaw", default="bench", metavar="FILE", help="jaw file, or a shipped name (bench)")
    parser.add_argument("--jaws", default="both", choices=JAWS_CHOICES, help="in the images (both)")
    add_detector_options(parser)
    text = f"how many images at the beginning show the jaws open, still and unloaded ({images})"
    parser.add_argument("--images", type=whole_number(1, 100_000), default=images, metavar="N", help=text)


def whole_number(least: int, most: int) -> Callable[[str], int]:
    """Return what reads an option as a whole number within bounds."""

    def read(text: str) -> int:
        digits = text.strip()
        if not re.fullmatch(r"-?\d{1,30}", digits) or not least <= int(digits) <= most:
            raise argparse.ArgumentTypeError(f"{text[:40]!r}: expected a whole number from {least} to {most}")
        return int(digits)

    return read


def add_engine_options(parser: argparse.ArgumentParser) -> None:
    """Add what says how many recordings are worked at, and where."""
    from finforce_eval.tasks import ENGINES

    parser.add_argument("--engine", default=ENGINES[0], choices=ENGINES, help="how recordings are worked at")
    text = "recordings at once; without it one for each processor"
    parser.add_argument("--workers", type=int, default=0, metavar="N", help=text)
    text = "of a task in processes or on Ray [GB]; 0: any (4)"
    parser.add_argument("--memory", type=float, default=4.0, metavar="GB", help=text)
    parser.add_argument("--address", default="", help="of a Ray cluster; without it one of this machine")
    text = "i/n: do the i-th of n parts of the recordings, as a job of a batch system"
    parser.add_argument("--shard", default="", metavar="I/N", help=text)


def read_engine(options: argparse.Namespace) -> EngineOptions:
    """Return what `add_engine_options` added.

    Raises:
        OptionError: a number is out of its bounds.
    """
    from finforce_eval.tasks import EngineOptions

    return EngineOptions(engine=options.engine, workers=options.workers, memory=options.memory, address=options.address)
