"""`finforce demo`: a recording through the real nodes, a table and a report; from images unless told otherwise."""

from __future__ import annotations

import argparse
import json
import os
import sys
from contextlib import suppress
from pathlib import Path
from shutil import rmtree, which
from typing import Any

from finforce.systems.launch import find_share
from finforce_eval.cli.main import parse
from finforce_eval.cli.parser import CONTACT_HELP, CommandResult
from finforce_eval.cli.replay import ENOUGH
from finforce_eval.cli.twin import record_simulation
from finforce_eval.errors import RecordingError, SilentReplayError
from finforce_eval.evaluation.keypoint_source import IMAGES
from finforce_eval.recordings.recording import DEMO, read_recording
from finforce_sim.scenarios import build_scenario
from finforce_sim.simulated_recording import FINGER, build_simulated_recording, parse_size

CALIBRATION = "bench"
# the synthetic scene of a run from images, and the calibration of its finger
SCENE, SEED, SCENE_CALIBRATION = "grasp_cylinder", 4, "twin"
SIZE = "640x480"
SLOWER = 0.25  # than the speed at which too few forces came
REPEATS = 2  # so often: 16 times slower, any machine keeps up


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the subcommand."""
    text = "start from rendered images, made in the report's folder at first use, or from the key "
    text += "points of a bench recording (images)"
    parser.add_argument("--from", dest="source", default="images", choices=("images", "keypoints"), help=text)
    parser.add_argument("--contact", action="append", default=[], metavar="CONTACT", help=CONTACT_HELP)
    parser.add_argument("--rate", default="1", help="playback speed (1)")
    parser.add_argument("--report", default="report", metavar="DIR", help="folder of the report (report)")


def run(options: argparse.Namespace) -> CommandResult:
    """Replay a recording, print the error of the force, write the report.

    Raises:
        FinforceError: the scene cannot be rendered, or ROS 2 or another library is not installed.
        ProcessError: a node cannot be started, or ended early.
    """
    bag, calibration, contacts = DEMO, CALIBRATION, options.contact
    if options.source == IMAGES:
        bag, calibration = prepare_recording(Path(options.report) / SCENE), SCENE_CALIBRATION
        contacts = contacts or ["estimate"]
    words = ["replay", str(bag), "--from", options.source, "--calibration", calibration, "--report", options.report]
    words += ["--rate", options.rate]
    replay = parse([*words, *(word for contact in contacts for word in ("--contact", contact))])
    print(f"Playing {bag.name} through the nodes at {options.rate} x real time ...", flush=True)
    outcome = _play(replay)
    print(f"Next, the simulated robot: {next_command()}")
    return outcome


def _play(replay: argparse.Namespace) -> CommandResult:
    """Return the outcome of a replay, which is repeated more slowly where others keep the processor busy."""
    for _ in range(REPEATS):
        with suppress(SilentReplayError):
            outcome = replay.run(replay)
            if outcome.results["grasp"]["n"] >= ENOUGH * outcome.results["grasp_frames"]:
                return outcome
        replay.rate *= SLOWER
        print(f"Too few images were answered. Once more at {replay.rate:g} x real time ...", flush=True)
    return replay.run(replay)


def next_command() -> str:
    """Return the command that starts the simulated robot, as this environment can run it."""
    if which("ros2") and find_share("finforce"):
        return "ros2 launch finforce robot.launch.py sim:=true"
    program = "finforce" if which("finforce") else os.path.relpath(Path(sys.executable).with_name("finforce"))
    return f"{program} launch robot sim:=true"


def prepare_recording(folder: Path) -> Path:
    """Return the folder of the recording of the demo's scene, rendered unless it is there already.

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
            return read_recording(folder, strict=True).path
    if folder.exists():
        rmtree(folder)
    print(f"Rendering the scene {SCENE} into {folder}, once ...", flush=True)
    scenario = build_scenario(SCENE)
    record_simulation(build_simulated_recording(scenario, SEED, parse_size(SIZE)), scenario, SEED, folder)
    return folder
