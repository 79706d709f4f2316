"""Options that several subcommands share, and a parser whose complaints are one line."""

from __future__ import annotations

import argparse
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from difflib import get_close_matches
from typing import TYPE_CHECKING, Any, NoReturn

from finforce.errors import suggest
from finforce_ifea.settings import MESHES, SOLVERS

if TYPE_CHECKING:
    from finforce_eval.tasks import EngineOptions

UNITS = ("m", "cm", "mm", "inch")
SOURCES = ("images", "keypoints", "truth")
JAWS_CHOICES = ("left", "right", "both")
PLAYED_HELP = "rosbag2 folder, .mcap or .db3 file"
BAG_HELP = f"{PLAYED_HELP}, the folder of a LeRobot dataset, UMI's or UMI-FT's .zarr or "
BAG_HELP += ".zarr.zip, a video, or a folder of pictures"
JAW_HELP = "jaw file, or name of an included jaw (that of the case.json, else bench)"
CONTACT_HELP = (
    "contact: estimate, closest or paper, from the object's mesh and pose; fixed:Z_MM, the height of first touch above "
    "the clamped base [mm]; fixed:case, from the case.json next to each recording; NAME=Z_MM, for one "
    "recording, repeatable (estimate with mesh and poses, else fixed:case)"
)
FORCE_HELP = "accept a modulus more than a factor of 3 off the jaw file's, or outside 5 to 200 MPa for TPU"
PICTURES = (".png", ".jpg", ".svg", ".pdf")


@dataclass(frozen=True)
class CommandResult:
    """The results of a command, as `--json` writes them, and its exit status."""

    results: Mapping[str, Any] = field(default_factory=dict)
    status: int = 0


def file_type(*endings: str) -> Callable[[str], str]:
    """Return what reads the name of a file to be written, for `type=` of an option; another ending is refused."""

    def read(text: str) -> str:
        if not text.lower().endswith(endings):
            raise argparse.ArgumentTypeError(f"{text}: expected a name that ends in {', '.join(endings)}")
        return text

    return read


picture_file = file_type(*PICTURES)


class Parser(argparse.ArgumentParser):
    """A parser whose complaints are one line, with the word that was likely meant."""

    def __init__(self, **given: Any) -> None:
        super().__init__(formatter_class=argparse.RawDescriptionHelpFormatter, **given)
        self._negative_number_matcher = re.compile(r"-\.?\d")  # a pose that begins with a minus is not an option

    def error(self, message: str) -> NoReturn:
        """Print one line and exit with 2."""
        choice = re.search(r"invalid choice: '?(.*?)'? \(choose from (.*)\)", message)
        unknown = re.match(r"unrecognized arguments: (-[\w-]+)", message)
        if choice:
            known = re.findall(r"[^\s',]+", choice[2])
            message = f"{message[: choice.start()]}got {choice[1]!r}, {suggest(choice[1], known)}"
        elif unknown and get_close_matches(unknown[1], self._option_string_actions):
            message = f"no option {unknown[1]}, {suggest(unknown[1], self._option_string_actions)}"
        self.exit(2, f"{self.prog}: {message} (see {self.prog} --help)\n")


def add_run_options(parser: argparse.ArgumentParser, *, calibration: bool = True, settings: bool = True) -> None:
    """Add what names jaw, solver, contact and key points and, where they count, calibration and single settings."""
    finger = parser.add_argument_group("finger and mechanics")
    finger.add_argument("--jaw", metavar="FILE", help=JAW_HELP)
    if calibration:
        text = "calibration file, or name of an included one (material of the jaw file)"
        finger.add_argument("--calibration", metavar="FILE", help=text)
    finger.add_argument("--solver", default="default", choices=SOLVERS, help="mechanics of the solver")
    finger.add_argument("--mesh", default="default", choices=MESHES, help="mesh density")
    if settings:
        text = "set an estimator setting, lengths in metres, repeatable; an unknown NAME lists all"
        finger.add_argument("--set", action="append", default=[], metavar="NAME=VALUE", help=text)
    contact = parser.add_argument_group("object and contact")
    contact.add_argument("--contact", action="append", default=[], metavar="CONTACT", help=CONTACT_HELP)
    contact.add_argument("--object", metavar="MESH", help="mesh file of the object (that of the case.json)")
    contact.add_argument("--object-unit", default="m", choices=UNITS, help="unit of the mesh (m)")
    text = "compare the mesh with the depth images (compared); off for objects that depth cameras see through"
    contact.add_argument("--compare-mesh", action=argparse.BooleanOptionalAction, default=True, help=text)
    if settings:
        text = "upright frame on the bag's /tf, such as base_link, for gravity and elevation (the topic /gravity)"
        contact.add_argument("--gravity-frame", default="", metavar="FRAME", help=text)
    images = parser.add_argument_group("key points and camera")
    text = "key points: from images, keypoints as recorded, or truth of a simulated recording "
    text += "(keypoints if recorded, else images)"
    images.add_argument("--from", dest="source", choices=SOURCES, help=text)
    text = "treat every image as a separate photograph: no tare, no memory"
    images.add_argument("--stills", action="store_true", help=text)
    images.add_argument("--jaws", choices=JAWS_CHOICES, help="jaws in the images, if no topic tells (both)")
    add_detector_options(images)
    text = "reject truncated or damaged recordings instead of reading them up to the damage"
    images.add_argument("--strict", action="store_true", help=text)


def add_output_options(parser: argparse.ArgumentParser) -> None:
    """Add what every command has; `main` takes `--quiet`, wherever it stands, and writes the JSON."""
    parser.add_argument("-q", "--quiet", action="store_true", help="print nothing but notes and errors")
    text = "write the results as JSON"
    parser.add_argument("--json", default=argparse.SUPPRESS, metavar="OUT", help=text)  # of an action, or before it


def add_detector_options(parser: argparse._ActionsContainer) -> None:
    """Add what changes the key point detector."""
    text = "set a detector parameter such as model=FOLDER or detector.readout=0.02, repeatable"
    parser.add_argument("--detector", action="append", default=[], metavar="NAME=VALUE", help=text)
    text = "camera pose in the gripper frame: robot, bench, x,y,z,qx,qy,qz,qw in metres, or a file of "
    text += "easy_handeye or a (4, 4) matrix (case.json, else robot)"
    parser.add_argument("--extrinsics", metavar="POSE", help=text)
    text = "rig file of finforce camera, instead of --jaw, --extrinsics and --intrinsics; a --jaw after it has priority"
    parser.add_argument("--rig", action=_UseRig, metavar="FILE", help=text)
    text = "topic of the colour images, feature of a LeRobot dataset, or array of a .zarr (the only one)"
    parser.add_argument("--color", metavar="TOPIC", help=text)
    text = "topic of the depth images (the only one in the frame of the colour images)"
    parser.add_argument("--depth", metavar="TOPIC", help=text)
    text = "topic of the camera_info (the one next to the colour images)"
    parser.add_argument("--camera-info", metavar="TOPIC", help=text)
    text = "intrinsics instead of camera_info: fx fy cx cy [k1 k2 p1 p2 k3] in pixels, or a file of "
    text += "ROS, OpenCV, kalibr, BOP, OpenICC (UMI), ORB-SLAM or COLMAP, with the name of the camera if it has several"
    parser.add_argument("--intrinsics", nargs="+", metavar="NUMBER", help=text)
    episode = whole_number(0, 10**9)
    parser.add_argument("--episode", type=episode, default=0, metavar="N", help="episode of a dataset or .zarr (0)")


class _UseRig(argparse.Action):
    """Take the jaw of a rig file."""

    def __call__(self, parser: Any, namespace: argparse.Namespace, value: Any, option: str | None = None) -> None:
        from finforce.rig import read_rig

        namespace.rig, namespace.jaw = value, read_rig(value).jaw


def add_rest_options(parser: argparse.ArgumentParser, images: int) -> None:
    """Add what names jaws at rest in the first images of a recording, so many unless told otherwise."""
    parser.add_argument("--jaw", metavar="FILE", help=JAW_HELP)
    parser.add_argument("--jaws", default="both", choices=JAWS_CHOICES, help="jaws in the images (both)")
    add_detector_options(parser)
    text = f"number of initial images with open, still, unloaded jaws ({images})"
    parser.add_argument("--images", type=whole_number(1, 100_000), default=images, metavar="N", help=text)


def whole_number(least: int, most: int) -> Callable[[str], int]:
    """Return what reads an option as a whole number within bounds."""

    def read(text: str) -> int:
        digits = text.strip()
        if not re.fullmatch(r"-?\d{1,30}", digits) or not least <= int(digits) <= most:
            raise argparse.ArgumentTypeError(f"{text[:40]!r}: expected a whole number from {least} to {most}")
        return int(digits)

    return read


def length_mm(text: str) -> float:
    """Return an option that is given in millimetres in metres; what looks like metres is refused."""
    value = float(text)
    if value and not 0.1 <= abs(value) <= 500.0:
        likely = f", such as {1e3 * value:g}" if abs(value) < 0.1 else ""
        raise argparse.ArgumentTypeError(f"{text}: expected millimetres{likely}")
    return 1e-3 * value


def add_engine_options(command: argparse.ArgumentParser) -> None:
    """Add what says where recordings are worked at."""
    parser = command.add_argument_group("many recordings")
    text = "recordings processed in parallel, by Dask workers on this machine; 0: one per core (1: without Dask)"
    parser.add_argument("--workers", type=int, default=1, metavar="N", help=text)
    text = "memory limit of each of these workers [GB]; 0: none (4)"
    parser.add_argument("--memory", type=float, default=4.0, metavar="GB", help=text)
    text = "process the recordings on the workers of a Dask scheduler, such as tcp://host:8786"
    parser.add_argument("--scheduler", default="", metavar="ADDRESS", help=text)


def read_engine(options: argparse.Namespace) -> EngineOptions:
    """Return what `add_engine_options` added.

    Raises:
        OptionError: a number is out of its bounds, or two contradict each other.
    """
    from finforce_eval.tasks import EngineOptions

    return EngineOptions(workers=options.workers, memory=options.memory, scheduler=options.scheduler)
