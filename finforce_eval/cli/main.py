"""The `finforce` command: a file per subcommand, which is loaded when it is asked for."""

from __future__ import annotations

import argparse
import os
import signal
import sys
from collections.abc import Sequence
from contextlib import redirect_stdout
from importlib import import_module
from pathlib import Path
from types import ModuleType

from finforce.errors import one_line
from finforce.optional import import_library
from finforce_eval.cli.parser import Parser, add_output_options
from finforce_eval.errors import OptionError

THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")
COMMANDS = {
    "evaluate": "estimate forces in recordings and score them against measured forces",
    "annotate": "add forces to existing recordings and datasets",
    "live": "show the forces in the images of a webcam, without ROS",
    "compare": "compare two evaluations and report changes beyond chance",
    "view": "show a recording with images, key points, bending jaws, contact and forces in Rerun",
    "replay": "play a recording through the nodes in real time and score the result",
    "prepare": "compile code and build stored equilibria ahead of time",
    "launch": "start a whole system, such as the simulated robot, without `ros2`",
    "pipeline": "run all stages from camera images to grasp force in one process",
    "status": "show the state of every part of a running system as a table",
    "echo": "print the messages of a topic",
    "trace": "show how long the images of a recording take in each stage",
    "jaw": "make the jaw file of a finger from its STL, STEP, DXF or SVG file",
    "calibrate": "calibrate a finger from recordings with measured forces",
    "weigh": "calibrate the modulus of a finger with readings of a kitchen scale",
    "check": "check that camera, jaw file, extrinsics and images match",
    "camera": "make the rig file of a camera from a video or pictures of open, unloaded jaws",
    "extrinsics": "calibrate the camera pose from images of open, still, unloaded jaws",
    "twin": "make RGB-D recordings of a simulated gripper with ground truth",
    "demo": "run a simulated grasp through the nodes and write a report",
    "ablation": "switch off the estimator's rules one at a time",
    "bench": "measure run time and error of every stage",
    "bound": "compare the force error in recordings with the Cramér-Rao bound",
    "experiment": "repeat an experiment of the paper on the twin or on recordings",
    "stress": "test the estimators with difficult input",
    "report": "show forces over time on an HTML page",
    "reconstruct": "make an object mesh and its pose from a masked depth image",
}
LAB = ("ablation", "bench", "bound", "experiment", "stress")  # these judge the product, and are in its checkout alone
CHECKOUT = Path(__file__).parents[2]


def load_command(name: str) -> ModuleType:
    """Return the module of a subcommand, from the checkout for those of the lab.

    Raises:
        OptionError: The installed package comes without the lab.
    """
    if name not in LAB:
        return import_module(f"{__package__}.{name}")
    if not (CHECKOUT / "lab" / "cli").is_dir():
        raise OptionError(f"finforce {name} needs a checkout of the repository: clone it and run `make bench` there")
    if str(CHECKOUT) not in sys.path:
        sys.path.append(str(CHECKOUT))
    return import_module(f"lab.cli.{name}")


def build_commands() -> Parser:
    """Return the parser of the subcommand's name."""
    parser = Parser(prog="finforce", description="Estimate the grasp force of fin-ray fingers from camera images.")
    commands = parser.add_subparsers(dest="command", metavar="COMMAND", required=True, parser_class=Parser)
    for name, text in COMMANDS.items():
        commands.add_parser(name, help=text, add_help=False)
    parser.add_argument("--version", action="store_true", help="print the version")
    return parser


def build_parser(command: str) -> Parser:
    """Return the parser of a subcommand's options."""
    module = load_command(command)
    parser = Parser(prog=f"finforce {command}", description=COMMANDS[command], epilog=getattr(module, "EXAMPLES", None))
    parser.set_defaults(run=getattr(module, "run", None), json=None)
    add_output_options(parser)
    module.add_options(parser)
    return parser


def parse(words: Sequence[str]) -> argparse.Namespace:
    """Return the options of a command line, with `run`, the function that carries it out."""
    options = build_parser(build_commands().parse_args(words[:1]).command).parse_args(words[1:])
    recordings = getattr(options, "bags", None) or [bag for bag in [getattr(options, "bag", None)] if bag]
    if getattr(options, "jaw", "") is None and hasattr(options, "rig"):
        from finforce_eval.recordings.recording import stated_jaw

        options.jaw = stated_jaw(recordings, "bench")
    return options


def complete(words: Sequence[str]) -> None:
    """Print what may come next on a command line that a shell is about to complete, and exit.

    Raises:
        MissingDependencyError: argcomplete is not installed.
    """
    argcomplete = import_library("argcomplete", "shell completion", "'finforce[completion]'")
    typed = os.environ["COMP_LINE"][: int(os.environ.get("COMP_POINT", "999"))].split(" ")
    if len(typed) > 2 and typed[1] in COMMANDS:
        os.environ["_ARGCOMPLETE"] = str(int(os.environ["_ARGCOMPLETE"]) + 1)  # words before those to be completed
        argcomplete.autocomplete(build_parser(typed[1]))
    argcomplete.autocomplete(build_commands())


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
        words = list(sys.argv[1:] if argv is None else argv)
        if "_ARGCOMPLETE" in os.environ:
            complete(words)
        if quiet := not {"-q", "--quiet"}.isdisjoint(words):
            os.environ["TQDM_DISABLE"] = "1"
        if words[:1] in (["--version"], ["version"]):
            from finforce_eval.machine import version

            print(f"finforce {version()}")
            return 0
        options = parse([word for word in words if word not in ("-q", "--quiet")])
        with open(os.devnull, "w") as nowhere, redirect_stdout(nowhere if quiet else sys.stdout):
            outcome = options.run(options)
            if options.json:
                from finforce_eval.machine import write_figures

                write_figures(options.json, outcome.results)
            sys.stdout.flush()
            return outcome.status
    except BrokenPipeError:  # whoever reads has seen enough, as `head`
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 128 + signal.SIGPIPE
    except (FinforceError, OSError) as error:
        print(f"finforce: {one_line(error)}".encode("utf-8", "backslashreplace").decode(), file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        return 130


if __name__ == "__main__":
    sys.exit(main())
