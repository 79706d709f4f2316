"""The subcommand `view`: a recording with its forces in Rerun."""

from __future__ import annotations

import argparse
from pathlib import Path

from finforce_eval.annotation.forces import estimate_forces
from finforce_eval.cli.parser import add_calibration, add_jaw_options, add_set, add_source_options
from finforce_eval.errors import OptionError
from finforce_eval.evaluation.manipulation import combine_jaws
from finforce_eval.evaluation.setup import make_setup, read_keypoints
from finforce_eval.recordings.tracks import JAWS


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the subcommand."""
    parser.add_argument("bags", nargs=1, metavar="BAG", help="rosbag2 folder, .mcap or .db3 file")
    text = "write a Rerun file instead of opening the viewer"
    parser.add_argument("--save", metavar="FILE.rrd", help=text)
    text = "jaws that are in the images, where no topic tells"
    parser.add_argument("--jaws", choices=(*JAWS, "both"), help=text)
    add_jaw_options(parser)
    add_source_options(parser)
    add_calibration(parser)
    add_set(parser)


def run(options: argparse.Namespace) -> None:
    """Find the forces of a recording and show them with its pictures."""
    from tqdm import tqdm

    from finforce_eval.engine.settings import sides_of
    from finforce_eval.figures.rerun_view import RerunView

    if options.save and not options.save.endswith(".rrd"):
        raise OptionError(f"--save {options.save}: expected a name that ends in .rrd")
    setup = make_setup(options)
    (recording,) = read_keypoints(options, sides_of(options))
    view = RerunView(recording.name, Path(options.save) if options.save else None)
    frames = sum(len(track.keypoints.stamps) for track in recording.jaws.values())
    with tqdm(total=frames, unit="image", desc=recording.name, disable=None, leave=False) as bar:
        jaws = estimate_forces(recording, setup, bar.update, view.show_shape)
    view.show_images(recording)
    view.show_poses(recording)
    view.show_forces(jaws, combine_jaws(jaws), recording)
    view.close()
    if options.save:
        print(f"{options.save}: {frames} images of {', '.join(jaws)}; open it with: rerun {options.save}")
