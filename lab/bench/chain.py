"""Latency against force error of the whole chain at 30, 60 and 90 Hz, through the real nodes.

A rendered grasp is played from images, and from its true key points, to all stages in one process and to each in its
own; once more while something else takes one processor, and with the skip rules on. Who listens hears the grasp force
alone, as a controller does, and without the rules every image is to be answered. Latency is from the image's leaving to
the arrival of the grasp force. The error is counted twice: at the image's own time, and "now": what is known at any
time, the newest force that has arrived, against the truth at that time. A force sets in where the true grasp force
crosses 0.02 N, and shows when a grasp force above 0.1 N has arrived.

Messages are decoded before they are played, so that the player takes no time from the nodes.
"""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from finforce.camera_topics import COLOR_TOPIC, DEPTH_TOPIC, INFO_TOPIC
from finforce.gripper_frames import SIDES
from finforce.health import IDLE
from finforce.messages import NANOSECONDS
from finforce.systems.processes import Process, ReplayOptions, compose, replay_processes
from finforce_eval.evaluation.keypoint_source import TRUTH, KeypointSource
from finforce_eval.evaluation.scoring import delay_stats, force_delays, match_truth, rms
from finforce_eval.recordings.objects import require_mesh
from finforce_eval.recordings.recording import read_recording
from finforce_eval.recordings.tracks import Recording
from finforce_eval.recordings.writer import write_recording
from finforce_eval.replay.answers import ReplayLog
from finforce_eval.replay.node_run import OBJECT_TOPIC, NodeRun, describe_load, run_nodes
from finforce_eval.replay.playback import Playback, RawMessage
from lab.harness import Figures, percentiles
from lab.scenes import GRASP, find_scene


@dataclass(frozen=True, kw_only=True, eq=False)
class SyntheticStream:
    """Messages that are played as a `Playback` is; every iteration gives the same.

    Attributes:
        messages: in the order of their times.
    """

    messages: Sequence[RawMessage]

    @property
    def begin(self) -> int:
        """Time of the first message [ns]."""
        return self.messages[0].time

    @property
    def types(self) -> dict[str, str]:
        """Type by topic."""
        return {message.topic: message.msgtype for message in self.messages}

    def __len__(self) -> int:
        return len(self.messages)

    def __iter__(self) -> Iterator[RawMessage]:
        yield from self.messages


def stream_images(source: Path) -> SyntheticStream:
    """Return what the camera of a scene sees, with the object's poses."""
    return choose_messages(Playback(source), {COLOR_TOPIC, DEPTH_TOPIC, INFO_TOPIC, OBJECT_TOPIC})


def stream_keypoints(source: Path) -> SyntheticStream:
    """Return the true key points and jaw poses of a scene, with the object's poses."""
    recording = KeypointSource(source=TRUTH).apply(read_recording(source))
    with TemporaryDirectory() as folder:
        plain = write_recording(replace(recording, images=None), Path(folder) / "truth")
        topics = {f"/{side}/{name}" for side in recording.jaws for name in ("keypoints", "jaw_pose")}
        return choose_messages(Playback(plain), topics | {OBJECT_TOPIC})


def choose_messages(messages: Playback, topics: set[str]) -> SyntheticStream:
    """Return the messages of some topics."""
    return SyntheticStream(messages=[message for message in messages if message.topic in topics])


RATES = (30, 60, 90)  # [Hz]
IMAGES, KEYPOINTS = "images", "key points"
TOGETHER, APART, BUSY, SKIPPING = "one process", "four processes", "one, a core taken", "one, skipping"
BURN = "while True: pass"
TARE = 3.8  # [s] from the first image, in which the solvers take their tare: on a slow machine that takes longer
STEP = 1e-3  # [s] between two times at which the error now is taken


@dataclass(frozen=True, kw_only=True, eq=False)
class TrueGrasp:
    """The true grasp force, the smaller of the jaws', (n,) [N] at stamps (n,) [ns]."""

    stamps_ns: NDArray[np.int64]
    force: NDArray

    def at(self, stamps: NDArray) -> NDArray:
        """Return the force between the stamps, linearly; NaN outside."""
        return np.interp(stamps, self.stamps_ns, self.force, left=np.nan, right=np.nan)


def measure(quick: bool) -> Figures:
    """Return latency and force error from images and from key points at every rate.

    Args:
        quick: at 30 Hz alone.

    Raises:
        MissingDependencyError: ROS 2 is not installed.
        FinforceError: the scene cannot be rendered, or a node ended early.
    """
    rows = []
    for rate in RATES[:1] if quick else RATES:
        scene = find_scene(replace(GRASP, changes={**GRASP.changes, "rate": rate, "tare": TARE - 0.3}))
        recording = read_recording(scene)
        truth = true_grasp(recording)
        for source, stream in ((IMAGES, stream_images(scene)), (KEYPOINTS, stream_keypoints(scene))):
            more = (BUSY, SKIPPING) if source == IMAGES and rate == RATES[0] else ()
            for setup in (TOGETHER, APART, *more):
                rows.append(describe_run(source, setup, rate, _run(source, setup, stream, recording), truth))
    table = pd.DataFrame(rows).sort_values(["chain from", "stages in", "Hz"])
    return Figures(
        tables={"chain": table},
        notes=[
            f"Largest true grasp force {np.nanmax(truth.force):.2f} N; now: the newest force that has arrived.",
            describe_load(table["other load/%"][table["stages in"] != BUSY]),
        ],
    )


def _run(source: str, setup: str, stream: SyntheticStream, recording: Recording) -> NodeRun:
    """Play a stream to the stages and return what came of it."""
    off = () if setup == SKIPPING else (IDLE,)
    processes = chain_processes(recording, images=source == IMAGES, off=off, composed=setup != APART)
    other = subprocess.Popen([sys.executable, "-c", BURN]) if setup == BUSY else None
    try:
        return run_nodes(processes, stream, SIDES, heard=())
    finally:
        if other is not None:
            other.kill()
            other.wait()


def chain_processes(recording: Recording, *, images: bool, off: Sequence[str] = (), **options: Any) -> list[Process]:
    """Return the nodes of both jaws with the contact estimator, from images with the detector.

    Args:
        recording: whose object and camera they are told.
        images: True if key points are found in images.
        off: skip rules that are off in all nodes.
        options: fields of `ReplayOptions` that differ.
    """
    asked = {
        "jaws": "both",
        "jaw_file": "bench",
        "calibration_file": "twin",
        "object_mesh": str(require_mesh(recording, None).resolve()),
        "use_sim_time": False,
        "images": images,
    }
    asked = ReplayOptions(**{**asked, **options})
    more = {"keypoint_detector": KeypointSource().node_parameters(recording)}
    rules = {"skip_off": list(off)} if off else {}
    processes = [
        replace(node, parameters={**node.parameters, **rules, **more.get(node.executable, {})})
        for node in replay_processes(replace(asked, composed=False), Path())
    ]
    return compose(processes) if asked.composed else processes


def true_grasp(recording: Recording) -> TrueGrasp:
    """Return the true grasp force of a recording with the truth of both jaws."""
    stamps = recording.truth(SIDES[0]).stamps_ns
    forces = [np.linalg.norm(match_truth(recording.truth(side), stamps), axis=1) for side in SIDES]
    return TrueGrasp(stamps_ns=stamps, force=np.min(forces, axis=0))


def describe_run(source: str, setup: str, rate: int, run: NodeRun, truth: TrueGrasp) -> dict[str, Any]:
    """Return the row of a run; counts are of images after the tare."""
    log = run.log
    sent = np.array(sorted(log.sent[SIDES[0]]))
    counted = {int(stamp) for stamp in sent if stamp >= sent[0] + TARE * NANOSECONDS}
    answered = np.array(sorted(counted & log.grasp.keys()))
    error = np.array([log.grasp[int(stamp)] for stamp in answered]) - truth.at(answered)
    return {
        "chain from": source,
        "stages in": setup,
        "Hz": rate,
        "images": len(counted),
        "answered/%": 100.0 * len(answered) / len(counted),
        **percentiles([log.grasp_latency[int(stamp)] for stamp in answered], "latency"),
        "error/N": rms(error),
        "error now/N": rms(error_now(log, truth, sent)),
        "shows after/ms": delay_stats([find_delays(log, truth)])["median_ms"] or np.nan,
        "nodes/% of a core": sum(run.cpu.values()),
        "memory/MB": sum(run.memory.values()) / 1e6,
        "other load/%": run.others,
    }


def find_delays(log: ReplayLog, truth: TrueGrasp) -> NDArray:
    """Return the delay after each onset in a run, see `force_delays`."""
    sent = np.array(sorted(log.sent[SIDES[0]]))
    stamps = sent[sent >= sent[0] + 0.5 * TARE * NANOSECONDS]
    estimate, lag = (
        np.array([told.get(int(stamp), np.nan) for stamp in stamps]) for told in (log.grasp, log.grasp_latency)
    )
    return force_delays(1e-9 * (stamps - stamps[0]), truth.at(stamps), estimate, lag)


def error_now(log: ReplayLog, truth: TrueGrasp, sent: NDArray[np.int64]) -> NDArray:
    """Return at every millisecond after the tare the newest grasp force that has arrived less the true one (m,) [N].

    Args:
        log: with grasp forces and their latencies.
        truth: of the grasp.
        sent: (n,) stamps of all images [ns], which leave at their own times.
    """
    arrivals = sorted((stamp + NANOSECONDS * late, stamp) for stamp, late in log.grasp_latency.items())
    arrived = np.array([time for time, _ in arrivals])
    # one that was overtaken changes nothing
    newest = np.maximum.accumulate(np.array([stamp for _, stamp in arrivals], dtype=np.int64))
    times = np.arange(sent[0] + TARE * NANOSECONDS, sent[-1], STEP * NANOSECONDS)
    row = np.searchsorted(arrived, times, side="right") - 1
    times, stamps = times[row >= 0], newest[row[row >= 0]]
    return np.array([log.grasp[int(stamp)] for stamp in stamps]) - truth.at(times)
