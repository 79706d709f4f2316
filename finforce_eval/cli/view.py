"""The subcommand `view`: a recording with its forces in Rerun."""

from __future__ import annotations

import argparse
from pathlib import Path

from finforce_eval.cli.parser import BAG_HELP, add_run_options
from finforce_eval.errors import OptionError
from finforce_eval.evaluation.forces import estimate_forces
from finforce_eval.evaluation.gripper import combine_jaws
from finforce_eval.evaluation.setup import make_setup, read_keypoints
from finforce_eval.tasks import progress_bar


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the subcommand."""
    parser.add_argument("bags", nargs=1, metavar="BAG", help=BAG_HELP)
    text = "write a Rerun file instead of opening the viewer"
    parser.add_argument("--save", metavar="FILE.rrd", help=text)
    add_run_options(parser)


def run(options: argparse.Namespace) -> None:
    """Find the forces of a recording and show them with its pictures."""
    from finforce_eval.figures.rerun_view import RerunView

    if options.save and not options.save.endswith(".rrd"):
        raise OptionError(f"--save {options.save}: expected a name that ends in .rrd")
    setup = make_setup(options)
    (recording,) = read_keypoints(options)
    view = RerunView(recording.name, Path(options.save) if options.save else None)
    frames = sum(len(track.keypoints.stamps) for track in recording.jaws.values())
    with progress_bar(frames, "image", recording.name) as bar:
        jaws = estimate_forces(recording, setup, progress=bar.update, watch=view.show_shape)
    view.show_images(recording)
    view.show_poses(recording)
    view.show_forces(jaws, combine_jaws(jaws), recording)
    view.close()
    if options.save:
        print(f"{options.save}: {frames} images of {', '.join(jaws)}; open it with: rerun {options.save}")
