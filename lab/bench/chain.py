"""Latency against force error of the whole chain at 30, 60 and 90 Hz, through the real nodes.

A rendered grasp is played from images, and from its true key points, to all stages in one process and to each in its
own; once more while something else takes one processor. Who listens hears the grasp force alone, as a controller does,
and every image is to be answered. Latency is from the image's leaving to the arrival of the grasp force. The error is
counted twice: at the image's own time, and "now": what is known at any time, the newest force that has arrived, against
the truth at that time.
"""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from finforce.skipping import IDLE
from finforce.stamps import NANOSECONDS
from finforce.systems.processes import Process, ReplayOptions, compose, replay_processes
from finforce_eval.evaluation.keypoint_source import KeypointSource
from finforce_eval.evaluation.scoring import match_truth, rms
from finforce_eval.figures.time_error import ErrorPoint, ErrorSeries, TimeStats, draw_time_error, time_stats
from finforce_eval.recordings.objects import require_mesh
from finforce_eval.recordings.recording import read_recording
from finforce_eval.recordings.tracks import Recording
from finforce_eval.replay.live import ReplayLog
from finforce_eval.replay.node_run import QUIET, NodeRun, describe_load, run_nodes
from finforce_eval.replay.synthetic_stream import SyntheticStream, stream_images, stream_keypoints
from lab.bench.scenes import GRASP, GRASP_FAST, find_scene

RATES = (30, 60, 90)  # [Hz]
IMAGES, KEYPOINTS = "images", "key points"
TOGETHER, APART, BUSY = "one process", "four processes", "one, a core taken"
BURN = "while True: pass"
TARE = 1.8  # [s] from the first image, in which the solvers take their tare and give no force
STEP = 1e-3  # [s] between two times at which the error now is taken
SIDES = ("left", "right")


@dataclass(frozen=True, kw_only=True)
class ChainRow:
    """One source of key points at one rate; counts are of images after the tare.

    Attributes:
        source: "images" or "key points".
        setup: how the stages run.
        rate: of the images [Hz].
        images: that were sent.
        answered: of which a grasp force came.
        latency: from the image to the grasp force [ms].
        error_N: root mean square over the answered images, at their own times [N].
        error_now_N: the same over all time, of what had arrived by then [N].
        largest_N: true grasp force [N].
        cpu: of each process [% of a core].
        memory_MB: of all processes together, resident.
        others: CPU use of everything else but nodes and player [% of a core]; it should be small.
        refused: what each node says that it refused, and how often.
    """

    source: str
    setup: str
    rate: int
    images: int
    answered: int
    latency: TimeStats
    error_N: float
    error_now_N: float
    largest_N: float
    cpu: Mapping[str, float]
    memory_MB: float
    others: float
    refused: Mapping[str, str]


@dataclass(frozen=True, kw_only=True)
class ChainFigures:
    """What was measured."""

    rows: Sequence[ChainRow]


@dataclass(frozen=True, kw_only=True, eq=False)
class TrueGrasp:
    """The true grasp force, the smaller of the jaws', (n,) [N] at stamps (n,) [ns]."""

    stamps: NDArray[np.int64]
    force: NDArray

    def at(self, stamps: NDArray) -> NDArray:
        """Return the force between the stamps, linearly; NaN outside."""
        return np.interp(stamps, self.stamps, self.force, left=np.nan, right=np.nan)


def measure(quick: bool) -> ChainFigures:
    """Return latency and force error from images and from key points at every rate.

    Args:
        quick: at 30 Hz only.

    Raises:
        MissingDependencyError: ROS 2 is not installed.
        FinforceError: the scene cannot be rendered, or a node ended early.
    """
    scene = find_scene(GRASP if quick else GRASP_FAST)
    recording, truth = read_recording(scene), true_grasp(read_recording(scene))
    rows = []
    for rate in RATES[:1] if quick else RATES:
        for source, stream in ((IMAGES, stream_images(scene, rate)), (KEYPOINTS, stream_keypoints(scene, rate))):
            busy = (BUSY,) if source == IMAGES and rate == RATES[0] else ()
            for setup in (TOGETHER, APART, *busy):
                run = _run(source, setup, stream, recording)
                rows.append(make_row(source, setup, rate, run, truth))
    return ChainFigures(rows=sorted(rows, key=lambda row: (row.source, row.setup)))


def _run(source: str, setup: str, stream: SyntheticStream, recording: Recording) -> NodeRun:
    """Play a stream to the stages and return what came of it."""
    processes = chain_processes(recording, images=source == IMAGES, off=(IDLE,), composed=setup != APART)
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
        images: whether key points are found in images.
        off: rules of all nodes that are not applied.
        options: fields of `ReplayOptions` that differ.
    """
    rules = {"skip_off": list(off)} if off else {}
    asked = {
        "jaws": "both",
        "jaw_file": "bench",
        "calibration_file": "twin",
        "object_mesh": str(require_mesh(recording, None).resolve()),
        "use_sim_time": False,
        "images": images,
    }
    asked = ReplayOptions(**{**asked, **options})
    camera = KeypointSource().node_parameters(recording)
    processes = [
        replace(
            process,
            parameters={
                **process.parameters,
                **rules,
                **(camera if process.executable == "keypoint_detector" else {}),
            },
        )
        for process in replay_processes(replace(asked, composed=False), Path())
    ]
    return compose(processes) if asked.composed else processes


def true_grasp(recording: Recording) -> TrueGrasp:
    """Return the true grasp force of a recording with the truth of both jaws."""
    stamps = recording.truth(SIDES[0]).stamps
    forces = [np.linalg.norm(match_truth(recording.truth(side), stamps), axis=1) for side in SIDES]
    return TrueGrasp(stamps=stamps, force=np.min(forces, axis=0))


def make_row(source: str, setup: str, rate: int, run: NodeRun, truth: TrueGrasp) -> ChainRow:
    """Return the figures of a run."""
    log = run.log
    sent = np.array(sorted(log.jaws[SIDES[0]].sent))
    counted = {int(stamp) for stamp in sent if stamp >= sent[0] + TARE * NANOSECONDS}
    answered = np.array(sorted(counted & log.grasp.keys()))
    error = np.array([log.grasp[int(stamp)] for stamp in answered]) - truth.at(answered)
    return ChainRow(
        source=source,
        setup=setup,
        rate=rate,
        images=len(counted),
        answered=len(answered),
        latency=time_stats([log.grasp_latency[int(stamp)] for stamp in answered]),
        error_N=rms(error),
        error_now_N=rms(error_now(log, truth, sent)),
        largest_N=float(np.nanmax(truth.force)),
        cpu=run.cpu,
        memory_MB=sum(run.memory.values()) / 1e6,
        others=run.others,
        refused={name: state["refused"] for name, state in log.health.items() if "refused" in state},
    )


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


def format_table(figures: ChainFigures) -> str:
    """Return the rows as a table in Markdown."""
    lines = [
        "| chain from | stages in | Hz | images | answered/% | latency: p50/ms | p95 | p99 | max "
        "| error: image/N | now/N | nodes/% of a core | memory/MB | other load/% |",
        "|---|---|---|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    lines += [
        f"| {row.source} | {row.setup} | {row.rate} | {row.images} | {100.0 * row.answered / row.images:.1f} "
        f"| {row.latency.p50:.1f} | {row.latency.p95:.1f} | {row.latency.p99:.1f} "
        f"| {row.latency.max:.1f} | {row.error_N:.3f} | {row.error_now_N:.3f} "
        f"| {sum(row.cpu.values()):.0f} | {row.memory_MB:.0f} | {row.others:.0f} |"
        for row in figures.rows
    ]
    largest = max((row.largest_N for row in figures.rows), default=float("nan"))
    meaning = f"Largest true grasp force {largest:.2f} N; now: the newest force that has arrived against the truth."
    return "\n".join([*lines, meaning, describe_load(row.others for row in figures.rows if row.setup != BUSY)])


def as_json(figures: ChainFigures) -> dict[str, Any]:
    """Return the figures as plain values; times in ms."""
    return asdict(figures)


def draw(figures: ChainFigures, path: Path | str) -> None:
    """Draw latency against the error now, by source and setup from 30 to 90 Hz; hollow: a tenth or more was dropped."""
    series = []
    for source, setup in dict.fromkeys((row.source, row.setup) for row in figures.rows):
        rows = [row for row in figures.rows if (row.source, row.setup) == (source, setup)]
        points = [
            ErrorPoint(text=f"{row.rate} Hz", time=row.latency.p50, slow=row.latency.p99, error=row.error_now_N)
            for row in rows
        ]
        lost = [100.0 * (1.0 - row.answered / row.images) for row in rows]
        words = ", ".join(f"{share:.0f}" for share in lost)
        name = f"from {source},\n{setup}\n(dropped {words} %)"
        series.append(ErrorSeries(name=name, points=points, complete=max(lost) < 10.0))
    busy = max((row.others for row in figures.rows if row.setup != BUSY), default=0.0) > QUIET
    draw_time_error(
        series,
        path,
        title="Whole chain: latency against error of the force now" + (" — ON A BUSY MACHINE" if busy else ""),
        error="newest force less truth at that time, RMS [N]",
        time="image out to grasp force in [ms]",
    )
