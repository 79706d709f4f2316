"""The `finforce` command: a file per subcommand, which is loaded when it is asked for."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Sequence
from importlib import import_module
from pathlib import Path
from types import ModuleType

from finforce.errors import one_line
from finforce_eval.cli.parser import Parser
from finforce_eval.errors import OptionError

THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")
COMMANDS = {
    "evaluate": "run the estimator over recordings offline and score it against the measured force",
    "annotate": "write the forces into recordings that exist: the same messages, and wrenches between them",
    "compare": "say which recordings got better or worse from one evaluation to another, beyond chance",
    "view": "show a recording with its forces in Rerun: pictures, key points, bending jaws, contact, forces over time",
    "replay": "play a recording through the real nodes in real time and score it",
    "prepare": "compile and build ahead of time what a first start would have to wait for",
    "launch": "start a whole system, such as the simulated robot, without `ros2`",
    "pipeline": "find the grasp force in a camera's images, all stages in one process",
    "trace": "show the way of a recording's images through the stages: who waits for whom, and where time goes",
    "jaw": "make the jaw file of a printed finger from its STL, STEP, DXF or SVG file",
    "calibrate": "identify the material from recordings with ground truth",
    "weigh": "scale the stiffness of a finger by the readings of a kitchen scale, one for each steady hold",
    "check": "say whether camera, jaw file, extrinsics and picture fit each other, before any force",
    "extrinsics": "find where the camera is in the gripper, from images of jaws that are open, still and unloaded",
    "twin": "make RGB-D recordings of a synthetic gripper, with the truth about everything in them",
    "demo": "play a recording through the real nodes, from images to force, and write a report",
    "bench": "measure run time against error of every solver tier and of what comes before it, and how cost grows",
    "experiment": "run one of the paper's experiments on the twin or on recordings, with a page of its figures",
    "stress": "give the estimators what no bench does: every answer is right within what it states, or not sure",
    "report": "put forces over time on one HTML page with plots that zoom",
    "convert-steel": "convert the pictures of the measured steel finger into a recording",
    "reconstruct": "make an object's mesh in metres, and its pose, from a masked depth image",
    "version": "print the version",
}
LAB = ("bench", "experiment", "stress")  # these judge the product, and are in its checkout alone
CHECKOUT = Path(__file__).parents[2]


def load_command(name: str) -> ModuleType:
    """Return the module of a subcommand, from the checkout for those of the lab.

    Raises:
        OptionError: The installed package comes without the lab.
    """
    if name not in LAB:
        return import_module(f"{__package__}.{name.replace('-', '_')}")
    if not (CHECKOUT / "lab" / "cli").is_dir():
        raise OptionError(f"finforce {name} needs a checkout of the repository: clone it and run `make bench` there")
    if str(CHECKOUT) not in sys.path:
        sys.path.append(str(CHECKOUT))
    return import_module(f"lab.cli.{name}")


def read_command(words: Sequence[str]) -> str:
    """Return the subcommand that the words of a command line begin with; without one, print what there is and exit."""
    parser = Parser(prog="finforce", description="Grasp force from the key points of fin-ray jaws.")
    commands = parser.add_subparsers(dest="command", metavar="COMMAND", required=True, parser_class=Parser)
    for name, text in COMMANDS.items():
        commands.add_parser(name, help=text, add_help=False)
    return parser.parse_args(words[:1]).command


def parse(words: Sequence[str]) -> argparse.Namespace:
    """Return the options of a command line, with `run`, the function that carries it out."""
    command = read_command(words)
    module = load_command(command)
    parser = Parser(prog=f"finforce {command}", description=COMMANDS[command])
    parser.set_defaults(run=getattr(module, "run", None))
    module.add_options(parser)
    return parser.parse_args(words[1:])


def main(argv: Sequence[str] | None = None) -> int:
    """Run the `finforce` command.

    Returns:
        0; 1 where `check` found a fault; 2 after one line on stderr when the input cannot be used; 130 after Ctrl-C.
    """
    # one thread: the times are of one thread, and sums come in the same order on every machine
    for name in THREADS:
        os.environ.setdefault(name, "1")
    from finforce.errors import FinforceError

    try:
        options = parse(sys.argv[1:] if argv is None else argv)
        return options.run(options) or 0
    except (FinforceError, OSError) as error:
        print(f"finforce: {one_line(error)}".encode("utf-8", "backslashreplace").decode(), file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        return 130


if __name__ == "__main__":
    sys.exit(main())
