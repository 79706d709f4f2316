"""`finforce demo`: the shipped recording through the real nodes, a table and a report."""

from __future__ import annotations

import argparse
from pathlib import Path

from finforce_eval.commands import make_setup
from finforce_eval.recording import read_recording
from finforce_eval.replay import format_replay, replay
from finforce_eval.report import write_report

RECORDING = Path(__file__).parent / "data" / "bench_cyl25_middle"
CALIBRATION = "bench"


def run_demo(options: argparse.Namespace) -> None:
    """Replay one loading cycle, print the error of the force, write the report.

    Raises:
        MissingDependencyError: ROS 2 is not installed.
        ProcessError: a node cannot be started, or ended early.
    """
    recording = read_recording(RECORDING)
    begin, end = recording.jaw("left").keypoints.stamps[[0, -1]]
    print(f"Playing {recording.name}, {(end - begin) * 1e-9:.0f} s, through contact node and solver ...", flush=True)
    names = argparse.Namespace(
        jaw="bench", solver="default", mesh="default", contact=options.contact, calibration=CALIBRATION
    )
    setup = make_setup(names)
    result = replay(recording, setup, calibration_file=CALIBRATION)
    print(format_replay(result))
    page = write_report(
        result.evaluation,
        options.report,
        keypoint_names=setup.jaw.keypoint_names,
        about=setup.about,
        title="One loading cycle through the nodes",
    )
    print(f"Report: {page}")
