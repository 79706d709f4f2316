"""The `finforce` command: options in, one call out; heavy imports wait until a subcommand runs."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Sequence
from importlib import import_module
from typing import NoReturn

SOLVERS = ("default", "reduced", "solid", "frame", "linear", "paper")
MESHES = ("default", "coarse", "fine")
THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")
CONTACT_HELP = (
    "contact: estimate, closest or paper, from the object's mesh and pose; fixed:Z_MM, the height of first touch above "
    "the clamped base; fixed:case takes it from the case.json beside each recording; NAME=Z_MM gives it for one "
    "recording and may be repeated. Without it estimate for a recording with mesh and poses, else fixed:case"
)
SOURCES = ("images", "keypoints", "truth")
UNITS = ("m", "cm", "mm", "inch")


class Parser(argparse.ArgumentParser):
    """A parser whose complaints are one line."""

    def error(self, message: str) -> NoReturn:
        """Print one line and exit with 2."""
        self.exit(2, f"{self.prog}: {message} (see {self.prog} --help)\n")


def build_parser() -> Parser:
    """Return the parser with every subcommand."""
    parser = Parser(prog="finforce", description="Grasp force from the key points of fin-ray jaws.")
    commands = parser.add_subparsers(dest="command", metavar="COMMAND", required=True, parser_class=Parser)
    _add_evaluate(commands)
    _add_calibrate(commands)
    _add_weigh(commands)
    _add_extrinsics(commands)
    replay = "play a recording through the real nodes in real time and score it"
    commands.add_parser("replay", help=replay, add_help=False)
    _add_twin(commands)
    _add_demo(commands)
    _add_bench(commands)
    _add_stress(commands)
    _add_steel(commands)
    _add_reconstruct(commands)
    version = commands.add_parser("version", help="print the version")
    version.set_defaults(run="finforce_eval.cli.evaluate:run_version")
    return parser


def add_jaw_options(parser: argparse.ArgumentParser) -> None:
    """Add what names the jaw, the solver and the contact."""
    parser.add_argument("--jaw", default="bench", metavar="FILE", help="jaw file, or a shipped name (bench)")
    parser.add_argument("--solver", default="default", choices=SOLVERS, help="model and objective")
    parser.add_argument("--mesh", default="default", choices=MESHES, help="mesh density")
    parser.add_argument("--contact", action="append", default=[], metavar="CONTACT", help=CONTACT_HELP)
    mesh = "object mesh (STL, OBJ, PLY, GLB) in its own frame; without it the one that each case.json names"
    parser.add_argument("--object", metavar="MESH", help=mesh)
    parser.add_argument("--object-unit", default="m", choices=UNITS, help="unit of the mesh (m)")


def add_source_options(parser: argparse.ArgumentParser) -> None:
    """Add what names the key points and their detector."""
    text = "key points: images, by the detector; keypoints, as recorded; truth, of a synthetic recording. Without it "
    text += "keypoints where they were recorded, else images"
    parser.add_argument("--from", dest="source", choices=SOURCES, help=text)
    text = "change a parameter of the key point detector, as model=FOLDER or detector.gate=0.004; repeatable"
    parser.add_argument("--detector", action="append", default=[], metavar="NAME=VALUE", help=text)
    text = "the camera in the gripper: robot, bench, or x,y,z,qx,qy,qz,qw; without it that of the case.json, else robot"
    parser.add_argument("--extrinsics", metavar="POSE", help=text)


def _add_set(parser: argparse.ArgumentParser) -> None:
    """Add changes of single settings."""
    text = "change a setting of the estimator, may be repeated; an unknown NAME lists them"
    parser.add_argument("--set", action="append", default=[], metavar="NAME=VALUE", help=text)


def _add_evaluate(commands: argparse._SubParsersAction) -> None:
    text = "run the estimator over recordings offline and score it against the measured force"
    parser = commands.add_parser("evaluate", help=text, description=text)
    parser.add_argument("bags", nargs="+", metavar="BAG", help="rosbag2 folder, .mcap or .db3 file")
    add_jaw_options(parser)
    add_source_options(parser)
    calibration = "calibration file, or a shipped name; without it the jaw file's own material"
    parser.add_argument("--calibration", metavar="FILE", help=calibration)
    _add_set(parser)
    parser.add_argument("--json", metavar="OUT", help="write the scores as JSON")
    parser.add_argument("--report", metavar="DIR", help="write pictures and a page that shows them")
    parser.set_defaults(run="finforce_eval.cli.evaluate:run_evaluate")


def _add_calibrate(commands: argparse._SubParsersAction) -> None:
    text = "identify the material from recordings with ground truth"
    parser = commands.add_parser("calibrate", help=text, description=text)
    parser.add_argument("bags", nargs="+", metavar="BAG", help="rosbag2 folder, .mcap or .db3 file")
    add_jaw_options(parser)
    add_source_options(parser)
    _add_set(parser)
    parser.add_argument("-o", "--output", required=True, metavar="FILE", help="calibration to be written")
    parser.set_defaults(run="finforce_eval.cli.evaluate:run_calibrate")


def _add_weigh(commands: argparse._SubParsersAction) -> None:
    text = "scale the stiffness of a finger by the readings of a kitchen scale, one for each steady hold of a recording"
    parser = commands.add_parser("weigh", help=text, description=text)
    parser.add_argument("bags", nargs=1, metavar="BAG", help="rosbag2 folder, .mcap or .db3 file")
    add_jaw_options(parser)
    add_source_options(parser)
    parser.add_argument("--side", default="left", choices=("left", "right"), help="the jaw that pressed (left)")
    text = "what the scale showed at the end of each hold, in their order; without it the holds are listed"
    parser.add_argument("--grams", nargs="+", type=float, metavar="G", help=text)
    text = "calibration that is scaled, a file or a shipped name; without it the jaw file's own material"
    parser.add_argument("--calibration", metavar="FILE", help=text)
    _add_set(parser)
    parser.add_argument("-o", "--output", metavar="FILE", help="calibration to be written; needs --grams")
    parser.set_defaults(run="finforce_eval.cli.weigh:run_weigh")


def _add_extrinsics(commands: argparse._SubParsersAction) -> None:
    text = "find where the camera is in the gripper, from images of jaws that are open, still and unloaded"
    parser = commands.add_parser("extrinsics", help=text, description=text)
    parser.add_argument("bags", nargs=1, metavar="BAG", help="rosbag2 folder, .mcap or .db3 file with images")
    parser.add_argument("--jaw", default="bench", metavar="FILE", help="jaw file, or a shipped name (bench)")
    parser.add_argument("--jaws", default="both", choices=("left", "right", "both"), help="in the images (both)")
    text = "where the camera is about: robot, bench, or x,y,z,qx,qy,qz,qw; without it that of the case.json, else robot"
    parser.add_argument("--extrinsics", metavar="POSE", help=text)
    text = "change a parameter of the key point detector, as model=FOLDER; repeatable"
    parser.add_argument("--detector", action="append", default=[], metavar="NAME=VALUE", help=text)
    text = "how many images at the beginning show the jaws at rest (45)"
    parser.add_argument("--images", type=int, default=45, metavar="N", help=text)
    parser.set_defaults(run="finforce_eval.cli.extrinsics:run_extrinsics")


def _add_twin(commands: argparse._SubParsersAction) -> None:
    text = "make RGB-D recordings of a synthetic gripper, with the truth about everything in them"
    parser = commands.add_parser("twin", help=text, description=text)
    actions = parser.add_subparsers(dest="action", metavar="ACTION", required=True, parser_class=Parser)
    listing = actions.add_parser("list", help="name the scenes")
    listing.set_defaults(run="finforce_eval.cli.twin:run_list")
    record = actions.add_parser("record", help="render a scene and write it", description="render a scene and write it")
    record.add_argument("scene", metavar="SCENE", help="a name that `finforce twin list` prints")
    record.add_argument("-o", "--output", required=True, metavar="BAG", help="recording to be written, a new folder")
    record.add_argument("--seed", type=int, default=0, help="of textures, light and noise (0)")
    finger = "seed of the jaws' material; calibration twin is of finger 0 (0)"
    steps = "of the depth in mm: 1 as the ROS driver gives it, 0.1 as the camera itself does (1)"
    record.add_argument("--depth-step", type=float, default=1.0, choices=(1.0, 0.1), help=steps)
    record.add_argument("--finger", type=int, default=0, metavar="SEED", help=finger)
    record.add_argument("--light", metavar="WORD", help="bright, dim or any; without it that of the scene")
    record.add_argument("--object", metavar="NAME", help="shape by name, or mesh file; without it that of the scene")
    record.add_argument("--camera", choices=("robot", "bench"), help="two jaws on the wrist, or one on the bench")
    record.add_argument("--size", default="640x480", metavar="WxH", help="of the images (640x480)")
    text = "change a number of the scene, may be repeated; an unknown NAME lists them"
    record.add_argument("--set", action="append", default=[], metavar="NAME=VALUE", help=text)
    kind = record.add_mutually_exclusive_group()
    kind.add_argument("--compressed", action="store_true", help="jpeg colour and png depth (as it is without --raw)")
    kind.add_argument("--raw", action="store_true", help="plain images, 46 MB a second")
    record.add_argument("--quality", type=int, default=90, metavar="N", help="of the jpegs, 1 to 95 (90)")
    text = "leave depth beyond so many metres away, which makes a recording smaller"
    record.add_argument("--farthest", type=float, default=float("inf"), metavar="M", help=text)
    record.add_argument("--storage", default="mcap", choices=("mcap", "sqlite3"), help="format of the recording")
    record.set_defaults(run="finforce_eval.cli.twin:run_record")


def _add_demo(commands: argparse._SubParsersAction) -> None:
    text = "play a recording through the real nodes, from images to force, and write a report"
    parser = commands.add_parser("demo", help=text, description=text)
    text = "begin with images of a synthetic gripper, rendered into the report's folder at first use, or with the key "
    text += "points of a bench (images)"
    parser.add_argument("--from", dest="source", default="images", choices=("images", "keypoints"), help=text)
    parser.add_argument("--contact", action="append", default=[], metavar="CONTACT", help=CONTACT_HELP)
    parser.add_argument("--report", default="report", metavar="DIR", help="folder of the report (report)")
    parser.set_defaults(run="finforce_eval.cli.demo:run_demo")


def _add_bench(commands: argparse._SubParsersAction) -> None:
    text = "measure run time against error of every solver tier and of what comes before it, and how cost grows"
    parser = commands.add_parser("bench", help=text, description=text)
    text = "recordings of the bench finger to be solved, too; without it shapes of an independent program alone"
    parser.add_argument("folder", nargs="?", metavar="FOLDER", help=text)
    text = "solvers, growth, localization, detection, chain, nodes, live; without it those that take minutes together"
    parser.add_argument("--parts", metavar="A,B", help=text)
    parser.add_argument("--json", metavar="OUT", help="write the figures as JSON")
    text = "draw the first part, and every other beside it with its name added"
    parser.add_argument("--figure", metavar="PNG", help=text)
    parser.add_argument("--quick", action="store_true", help="fewer cases and no slow tier, to try it out")
    parser.set_defaults(run="finforce_eval.bench.bench:run_bench")


def _add_stress(commands: argparse._SubParsersAction) -> None:
    text = "put numbers that no bench gives to the estimators: an answer is right within what it states, or not sure"
    parser = commands.add_parser("stress", help=text, description=text)
    parser.add_argument("--families", metavar="A,B", help="families of trials, all without; a wrong one lists them")
    parser.add_argument("--count", type=int, metavar="N", help="trials per family; without, as many as each takes")
    parser.add_argument("--seed", type=int, default=0, help="of everything that is drawn (0)")
    parser.add_argument("--solver", default="default", choices=SOLVERS, help="model and objective")
    parser.add_argument("--mesh", default="default", choices=MESHES, help="mesh density")
    parser.add_argument("--json", metavar="OUT", help="write the figures as JSON")
    parser.add_argument("--report", metavar="DIR", help="write a page with every family by level")
    parser.set_defaults(run="finforce_eval.cli.stress:run_stress")


def _add_steel(commands: argparse._SubParsersAction) -> None:
    text = "convert the pictures of the measured steel finger into a recording"
    parser = commands.add_parser("convert-steel", help=text, description=text)
    parser.add_argument("output", metavar="FOLDER", help="recording to be written")
    parser.add_argument("--source", metavar="FILE", help="measurement; without it the shipped one")
    parser.add_argument("--storage", default="mcap", choices=("mcap", "sqlite3"), help="its format")
    parser.set_defaults(run="finforce_eval.recordings.steel:run_convert")


def _add_reconstruct(commands: argparse._SubParsersAction) -> None:
    text = "make an object's mesh in metres, and its pose, from a masked depth image"
    parser = commands.add_parser("reconstruct", help=text, description=text)
    parser.add_argument("--depth", required=True, metavar="FILE", help="16-bit PNG [mm], or .npy [m]")
    parser.add_argument("--mask", required=True, metavar="FILE", help="the object's pixels: picture or .npy")
    intrinsics = "fx fy cx cy [k1 k2 p1 p2 k3] in pixels, or a JSON or YAML file"
    parser.add_argument("--intrinsics", required=True, nargs="+", metavar="NUMBER", help=intrinsics)
    parser.add_argument("--color", metavar="FILE", help="colour picture, for the picture that is written")
    parser.add_argument("--mesh", metavar="FILE", help="generated mesh (STL, OBJ, PLY, GLB), in any unit")
    pose = "JSON of its place: rotation (w x y z), translation, scale as SAM-3D gives them, or a 4x4 matrix"
    parser.add_argument("--pose", metavar="FILE", help=pose)
    method = "default: robust with a generated mesh; without, a primitive where one fits, else a completion"
    parser.add_argument("--method", choices=("robust", "paper", "primitive", "completion"), help=method)
    parser.add_argument("-o", "--output", required=True, metavar="FILE", help="mesh: .stl, .ply or .glb, in metres")
    parser.add_argument("--picture", metavar="PNG", help="write a picture of the mesh over the depth")
    parser.set_defaults(run="finforce_eval.cli.reconstruct:run_reconstruct")


def main(argv: Sequence[str] | None = None) -> int:
    """Run the `finforce` command.

    Returns:
        0; 2 after one line on stderr when the input cannot be used; 130 after Ctrl-C.
    """
    arguments = list(sys.argv[1:] if argv is None else argv)
    # one thread: the times are of one thread, and sums come in the same order on every machine
    for name in THREADS:
        os.environ.setdefault(name, "1")
    from finforce.errors import FinforceError

    try:
        if arguments[:1] == ["replay"]:
            return import_module("finforce_eval.cli.replay").main(arguments[1:]) or 0
        options = build_parser().parse_args(arguments)
        module, function = options.run.split(":")
        return getattr(import_module(module), function)(options) or 0
    except (FinforceError, OSError) as error:
        print(f"finforce: {' '.join(str(error).split())}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        return 130


if __name__ == "__main__":
    sys.exit(main())
