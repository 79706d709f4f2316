"""`finforce replay`: options in, a recording through the real nodes, scores out as text and files."""

from __future__ import annotations

import argparse
from dataclasses import asdict
from pathlib import Path

import numpy as np

from finforce.optional import import_cv2
from finforce.ros.transport import LAST_DOMAIN
from finforce_eval.annotation.video import ForceOverlay
from finforce_eval.cli.parser import PLAYED_HELP, CommandResult, add_run_options
from finforce_eval.errors import OptionError
from finforce_eval.evaluation.keypoint_source import parse_source
from finforce_eval.evaluation.score_tables import evaluation_json
from finforce_eval.evaluation.setup import make_setup, read_recordings
from finforce_eval.recordings.images import ALONE
from finforce_eval.replay.node_run import Playing
from finforce_eval.replay.replay import Replay, replay

GRASP = "grasp.png"  # picture on top of the report


ENOUGH = 0.5  # of the images in the record phases that have to be answered for a score
SOME = 0.2  # of the images without depth, as where depth comes at a lower rate


def format_summary(result: Replay) -> list[str]:
    """Return the few figures that matter, one a line: error of the grasp force, pixel error, delay."""
    score, sight = result.grasp_score, result.evaluation.total.sight
    error, delay, lines = score.error, score.delay, []
    answered = f"{error.n} of {score.frames} images in the record phases answered"
    if error.n < ENOUGH * score.frames:
        images, advice = result.recording.images, "if the machine was busy, --rate 0.5 plays at half the speed"
        if images is not None and images.has_depth and (alone := (images.depth_stamps == ALONE).mean()) > SOME:
            advice = f"{100 * alone:.0f} % of the images have no depth: --detector depth=none waits for none"
        return [f"Grasp force: no score, {answered}; {advice}"]
    if error.rmse_N is not None:
        errors = f"{error.rmse_N:.3f} N RMSE, {error.max_error_N:.3f} N largest error, of {score.largest:.2f} N at most"
        lines.append(f"Grasp force: {errors}; {answered}")
    if sight["pixel_median_px"] is not None:
        median, p95 = sight["pixel_median_px"], sight["pixel_p95_px"]
        lines.append(f"Key points: {median:.2f} px off in the median, {p95:.2f} px at the 95th percentile")
    if delay["n"]:
        lines.append(f"Delay: the grasp force shows {delay['median_ms']:.0f} ms after its true onset")
    elif delay["missed"]:
        lines.append("Delay: the grasp force did not show within a second of its true onset")
    return lines


def draw_grasp(result: Replay, path: Path) -> bool:
    """Write the image with the largest force, key points and forces drawn into it; False without images."""
    jaws = {series.side: series for series in result.evaluation.results.values()}
    images = result.recording.images
    if images is None or not result.grasp or any(track.detection is None for track in result.recording.jaws.values()):
        return False
    overlay = ForceOverlay(result.recording, jaws)
    largest = max(result.grasp, key=lambda stamp: result.grasp[stamp])
    for stamp, image in images.at(np.array([largest])):
        return bool(import_cv2().imwrite(str(path), overlay.draw(stamp, image.color)[..., ::-1]))
    return False


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add what names the recording and how it is played."""
    parser.add_argument("bag", metavar="BAG", help=f"{PLAYED_HELP}, with key points, or images and camera_info")
    add_run_options(parser, settings=False)
    parser.add_argument("--rate", type=float, default=1.0, help="playback speed; other than 1 uses /clock (1)")
    parser.add_argument("--domain", type=int, metavar="ID", help="ROS_DOMAIN_ID, for example to watch in RViz (random)")
    parser.add_argument("--report", metavar="DIR", help="write a page with figures to this folder")


def run(options: argparse.Namespace) -> CommandResult:
    """Play a recording and score it.

    Raises:
        FinforceError: an option, the recording or a node fails.
    """
    if not 0.01 <= options.rate <= 100.0:
        raise OptionError(f"--rate {options.rate:g}: expected 0.01 to 100")
    if options.domain is not None and not 0 <= options.domain <= LAST_DOMAIN:
        raise OptionError(f"--domain {options.domain}: expected 0 to {LAST_DOMAIN}")
    setup = make_setup(options)
    playing = Playing(rate=options.rate, domain=options.domain)
    keypoints, calibration = parse_source(options), options.calibration or ""
    (recording,) = read_recordings([options.bag], keypoints)
    result = replay(recording, setup, calibration_file=calibration, playing=playing, keypoints=keypoints)
    summary = format_summary(result)
    print("\n".join(summary))
    if options.report:
        from finforce_eval.figures.report import write_overview

        Path(options.report).mkdir(parents=True, exist_ok=True)
        picture = GRASP if draw_grasp(result, Path(options.report, GRASP)) else ""
        words = {"about": setup.about, "headline": summary[0] if summary else "", "picture": picture}
        print(f"Report: {write_overview(result.evaluation, options.report, **words)}")
    score = result.grasp_score
    grasp = {"grasp": asdict(score.error), "grasp_frames": score.frames, "grasp_delay": score.delay}
    return CommandResult(evaluation_json(result.evaluation, **grasp, **setup.about))
