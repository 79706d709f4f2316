"""`finforce demo`: a recording through the real nodes, a table and a report; from images unless told otherwise."""

from __future__ import annotations

import argparse
import json
import os
import sys
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from shutil import rmtree, which
from typing import Any

from finforce.systems.launch import find_share
from finforce_eval.annotation.bag import new_folder
from finforce_eval.cli.parser import CONTACT_HELP
from finforce_eval.cli.replay import format_replay
from finforce_eval.cli.twin import RecordingForm, record_scene
from finforce_eval.errors import RecordingError
from finforce_eval.evaluation.keypoint_source import IMAGES, KeypointSource
from finforce_eval.evaluation.setup import make_setup
from finforce_eval.figures.report import write_report
from finforce_eval.recordings.recording import DEMO, read_recording
from finforce_eval.recordings.tracks import Recording
from finforce_eval.replay.replay import Replay, replay
from finforce_sim.footage import parse_size
from finforce_sim.scenarios import build_scenario

CALIBRATION = "bench"
# the synthetic scene of a run from images, and the calibration of its finger
SCENE, SEED, FINGER, SCENE_CALIBRATION = "grasp_cylinder", 4, 0, "twin"
SIZE = "640x480"
FOLDER = "recording"  # in the folder of the report


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the subcommand."""
    text = "begin with images of a synthetic gripper, rendered into the report's folder at first use, or with the key "
    text += "points of a bench (images)"
    parser.add_argument("--from", dest="source", default="images", choices=("images", "keypoints"), help=text)
    parser.add_argument("--contact", action="append", default=[], metavar="CONTACT", help=CONTACT_HELP)
    parser.add_argument("--report", default="report", metavar="DIR", help="folder of the report (report)")
    parser.add_argument(
        "--movie", metavar="FILE", help="also make a moving picture, FILE.webp or FILE.gif, of the images"
    )


def run(options: argparse.Namespace) -> None:
    """Replay a recording, print the error of the force, write the report.

    Raises:
        FinforceError: the scene cannot be rendered, or ROS 2 or another library is not installed.
        ProcessError: a node cannot be started, or ended early.
    """
    from_images = options.source == IMAGES
    recording = prepare_recording(Path(options.report) / FOLDER) if from_images else read_recording(DEMO)
    calibration = SCENE_CALIBRATION if from_images else CALIBRATION
    stamps = recording.images.stamps if from_images else recording.jaw("left").keypoints.stamps
    way = "key point detector, contact estimator and solvers" if from_images else "contact estimator and solver"
    print(f"Playing {recording.name}, {(stamps[-1] - stamps[0]) * 1e-9:.0f} s, through {way} ...", flush=True)
    names = argparse.Namespace(
        jaw="bench",
        solver="default",
        mesh="default",
        contact=options.contact or (["estimate"] if from_images else []),
        source=options.source,
        calibration=calibration,
    )
    setup = make_setup(names)
    keypoints = KeypointSource(source=options.source, jaw_file=names.jaw)
    result = replay(recording, setup, calibration_file=calibration, keypoints=keypoints)
    print(format_replay(result))
    page = write_report(
        result.evaluation,
        options.report,
        keypoint_names=setup.jaw.keypoint_names,
        about=setup.about,
        recordings=[result.recording],
        title="From images to forces through the nodes" if from_images else "One loading cycle through the nodes",
    )
    if options.movie:
        from finforce_eval.figures.movie import write_movie
        from finforce_keypoints.diagnostics import build_skeleton

        skeleton = build_skeleton(setup.jaw.keypoint_names)
        write_movie(result.recording, list(result.evaluation.results.values()), options.movie, skeleton)
    print(f"\n{format_summary(result)}\nReport: {page}\nNext, the simulated robot: {next_command()}")


def next_command() -> str:
    """Return the command that starts the simulated robot, as this environment can run it."""
    if which("ros2") and find_share("finforce"):
        return "ros2 launch finforce robot.launch.py sim:=true"
    program = "finforce" if which("finforce") else os.path.relpath(Path(sys.executable).with_name("finforce"))
    return f"{program} launch robot sim:=true"


def format_summary(result: Replay) -> str:
    """Return the few figures that matter, one a line: error of the grasp force, pixel error, delay."""
    score, sight = result.grasp_score, result.evaluation.total.sight
    error, delay, lines = score.error, score.delay, []
    if error.rmse_N is not None:
        where = f"of {score.largest:.2f} N at most; {error.n} of {score.frames} images in the record phases answered"
        lines.append(f"Grasp force: {error.rmse_N:.3f} N RMSE, {error.max_error_N:.3f} N largest error, {where}")
    if sight["pixel_median_px"] is not None:
        median, p95 = sight["pixel_median_px"], sight["pixel_p95_px"]
        lines.append(f"Key points: {median:.2f} px off in the median, {p95:.2f} px at the 95th percentile")
    if delay["n"]:
        lines.append(f"Delay: the grasp force shows {delay['median_ms']:.0f} ms after its true onset")
    elif delay["missed"]:
        lines.append("Delay: the grasp force did not show within a second of its true onset")
    return "\n".join(lines)


def prepare_recording(folder: Path) -> Recording:
    """Return the recording of the demo's scene in a folder, rendered unless it is there already.

    Raises:
        RecordingError: the folder holds something else than a recording of a synthetic scene.
        FinforceError: the scene cannot be rendered.
    """
    case: dict[str, Any] = {}
    with suppress(OSError, ValueError, TypeError):
        case = dict(json.loads((folder / "case.json").read_text(encoding="utf-8")))
    if folder.exists() and "scene" not in case:
        raise RecordingError(
            f"{folder}: holds something else than a recording of a synthetic scene, expected one or no such folder; "
            "move it away, or give another --report"
        )
    if (case.get("scene"), case.get("seed"), case.get("finger")) == (SCENE, SEED, FINGER):
        with suppress(RecordingError):
            return replace(read_recording(folder, strict=True), name=SCENE)
    if folder.exists():
        rmtree(folder)
    print(f"Rendering the scene {SCENE} into {folder}, once ...", flush=True)
    with new_folder(folder) as new:
        record_scene(build_scenario(SCENE), SEED, new, camera=parse_size(SIZE), form=RecordingForm(), finger=FINGER)
    return replace(read_recording(folder), name=SCENE)
