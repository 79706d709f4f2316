"""`finforce demo`: a recording through the real nodes, a table and a report; from images unless told otherwise."""

from __future__ import annotations

import argparse
import os
from pathlib import Path

from finforce_eval.commands import make_setup
from finforce_eval.keypoint_source import IMAGES, KeypointSource
from finforce_eval.recording import read_recording
from finforce_eval.replay import replay
from finforce_eval.replay_command import format_replay
from finforce_eval.report import write_report

DATA = Path(__file__).parent / "data"
RECORDING, CALIBRATION = DATA / "bench_cyl25_middle", "bench"
# the synthetic recording, where it is shipped; else its scene is rendered at first use
SHIPPED = DATA / "twin_demo"
SCENE, SEED = "grasp_cylinder", 4


def run_demo(options: argparse.Namespace) -> None:
    """Replay a recording, print the error of the force, write the report.

    Raises:
        MissingDependencyError: ROS 2 is not installed.
        ProcessError: a node cannot be started, or ended early.
    """
    from_images = options.source == IMAGES
    recording = read_recording(find_images() if from_images else RECORDING)
    stamps = recording.images.stamps if from_images else recording.jaw("left").keypoints.stamps
    way = "key point detector, contact node and solvers" if from_images else "contact node and solver"
    print(f"Playing {recording.name}, {(stamps[-1] - stamps[0]) * 1e-9:.0f} s, through {way} ...", flush=True)
    calibration = "" if from_images else CALIBRATION
    names = argparse.Namespace(
        jaw="bench",
        solver="default",
        mesh="default",
        contact=options.contact,
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
        title="From images to forces through the nodes" if from_images else "One loading cycle through the nodes",
    )
    print(f"Report: {page}")


def find_images() -> Path:
    """Return the synthetic recording: the shipped one, or one that is rendered now and kept in the user's cache."""
    if SHIPPED.is_dir():
        return SHIPPED
    from finforce_eval.twin_commands import record_scene
    from finforce_eval.twin_writer import RecordingForm
    from finforce_twin.record import parse_size
    from finforce_twin.scenarios import build_scenario

    cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "finforce"
    folder = cache / f"{SCENE}_{SEED}"
    if not folder.is_dir():
        print(f"Rendering the scene {SCENE} into {folder}, once; this takes about a minute ...", flush=True)
        record_scene(build_scenario(SCENE), SEED, folder, camera=parse_size("640x480"), form=RecordingForm())
    return folder
