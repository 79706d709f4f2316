"""Latency and memory of solver nodes while both jaws are live; plays a shipped recording as both."""

from __future__ import annotations

import argparse
import tempfile
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, replace
from os import getpid
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from finforce.stamps import NANOSECONDS
from finforce_eval.bench.bench import Row, format_rows, row_from_times
from finforce_eval.evaluation.setup import make_setup
from finforce_eval.recordings.recording import SHIPPED as RECORDING
from finforce_eval.recordings.recording import read_recording
from finforce_eval.recordings.tracks import JawTrack, Recording
from finforce_eval.recordings.writer import write_recording
from finforce_eval.replay.cpu_share import child_processes, resident_bytes
from finforce_eval.replay.replay import replay

# a mirror image y -> -y; moments are axial vectors
MIRROR, MIRROR_MOMENT = np.array([1.0, -1.0, 1.0]), np.array([-1.0, 1.0, -1.0])


@dataclass(frozen=True, kw_only=True)
class LiveFigures:
    """What was measured while both jaws were live.

    Attributes:
        latency: (n,) from key points out to wrench in, over the middleware and back [s].
        memory: largest resident memory of a solver node [bytes].
    """

    latency: NDArray[np.float64]
    memory: int


def with_both_jaws(recording: Recording, seconds: float) -> Recording:
    """Return the first seconds of a recording of the left jaw, with its mirror image as the right jaw."""
    start = int(recording.jaw("left").keypoints.stamps[0])
    part = recording.between(start, start + int(seconds * NANOSECONDS))
    left, truth = part.jaw("left"), part.truth("left")
    right = JawTrack(
        keypoints=replace(left.keypoints, points=left.keypoints.points * MIRROR),
        truth=replace(truth, force=truth.force * MIRROR, torque=truth.torque * MIRROR_MOMENT),
    )
    return replace(part, jaws={"left": left, "right": right})


@dataclass
class _Watch:
    """Looks at the memory of this process's children from time to time."""

    largest: int = 0
    done: threading.Event = field(default_factory=threading.Event)

    def run(self) -> None:
        while not self.done.wait(0.5):
            sizes = [resident_bytes(process) for process in child_processes(getpid())]
            self.largest = max([self.largest, *sizes])


@contextmanager
def _watched() -> Iterator[_Watch]:
    watch = _Watch()
    thread = threading.Thread(target=watch.run, daemon=True)
    thread.start()
    try:
        yield watch
    finally:
        watch.done.set()
        thread.join()


def measure(quick: bool) -> LiveFigures:
    """Play the shipped recording through one solver node per jaw.

    Args:
        quick: ten seconds of it instead of twenty.

    Raises:
        MissingDependencyError: ROS 2 is not installed.
        ProcessError: a node cannot be started, or ended early.
    """
    names = argparse.Namespace(jaw="bench", solver="default", mesh="default", contact=[], calibration=None)
    with tempfile.TemporaryDirectory() as folder, _watched() as watch:
        both = with_both_jaws(read_recording(RECORDING), 10.0 if quick else 20.0)
        path = write_recording(both, Path(folder) / "both")
        result = replay(read_recording(path), make_setup(names))
    times = np.concatenate([case.step_ms for case in result.evaluation.results.values()])
    return LiveFigures(latency=1e-3 * times[np.isfinite(times)], memory=watch.largest)


def format_table(figures: LiveFigures) -> str:
    """Return the latency [ms] and the memory as text."""
    return f"{format_rows([_row(figures)])}\n\nlargest solver node: {1e-6 * figures.memory:.0f} MB"


def as_json(figures: LiveFigures) -> dict[str, Any]:
    """Return the figures as plain values."""
    return {"latency_ms": asdict(_row(figures)), "node_MB": 1e-6 * figures.memory}


def draw(figures: LiveFigures, path: Path | str) -> None:
    """Draw the distribution of the latency and write it."""
    from finforce_eval.figures.figures import BLUE, new_figure, style_axes

    figure = new_figure(7.0, 3.6)
    axes = figure.subplots()
    style_axes(axes)
    times = 1e3 * np.sort(figures.latency)
    axes.plot(times, np.arange(1, len(times) + 1) / len(times), color=BLUE)
    axes.set(xlabel="key points out to wrench in [ms]", ylabel="share of the images", xscale="log", ylim=(0, 1))
    figure.savefig(path)


def _row(figures: LiveFigures) -> Row:
    return row_from_times("key points to wrench, both jaws live", figures.latency)
