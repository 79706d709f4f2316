"""`finforce trace`: the way of a recording's images through the stages, in a table and a picture."""

from __future__ import annotations

import argparse
from pathlib import Path
from tempfile import TemporaryDirectory

from finforce_eval.cli.parser import BAG_HELP, add_run_options, picture_file
from finforce_eval.evaluation.keypoint_source import parse_source
from finforce_eval.evaluation.setup import make_setup, sides_of
from finforce_eval.machine import write_figures
from finforce_eval.recordings.recording import read_recording
from finforce_eval.replay.replay import Playing, play_to_nodes
from finforce_eval.replay.trace import Trace, draw_way, format_trace, read_spans, stage_figures


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add what names the recording, and how the stages run."""
    parser.add_argument("bag", metavar="BAG", help=BAG_HELP)
    add_run_options(parser, settings=False)
    parser.add_argument("--apart", action="store_true", help="run every stage in its own process")
    parser.add_argument("--json", metavar="OUT", help="write the figures as JSON")
    parser.add_argument(
        "--figure", type=picture_file, metavar="PNG", help="draw the stages of one image and the durations of all"
    )


def run(options: argparse.Namespace) -> None:
    """Play a recording in real time and print where the time went.

    Raises:
        FinforceError: an option, the recording or a node fails.
    """
    keypoints = parse_source(options)
    recording = read_recording(options.bag, keypoints.choice, sides_of(options), strict=keypoints.strict)
    with TemporaryDirectory() as folder:
        playing = Playing(composed=not options.apart, trace=folder)
        log = play_to_nodes(
            recording,
            make_setup(options),
            calibration_file=options.calibration or "",
            playing=playing,
            source=keypoints,
        ).log
        sent = {stamp: time for times in log.sent.values() for stamp, time in times.items()}
        trace = Trace(
            spans=read_spans(Path(folder), log.offset, sent),
            late={stamp: 1e3 * late for stamp, late in log.grasp_latency.items()},
            images=sorted(sent),
            lost={name: state["refused"] for name, state in log.health.items() if "refused" in state},
        )
    print(format_trace(trace))
    if options.json:
        write_figures(options.json, {"stages": stage_figures(trace), "images": len(trace.images), "lost": trace.lost})
    if options.figure:
        Path(options.figure).parent.mkdir(parents=True, exist_ok=True)
        draw_way(trace, options.figure)
        print(f"Picture: {options.figure}")
