"""Latency and memory of solver nodes while both jaws are live; plays a shipped recording as both."""

from __future__ import annotations

import argparse
import tempfile
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from os import getpid
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from finforce_eval.commands import make_setup
from finforce_eval.memory import child_processes, resident_bytes
from finforce_eval.recording import read_recording
from finforce_eval.replay import replay
from finforce_eval.tracks import NANOSECONDS, JawTrack, Recording
from finforce_eval.writer import write_recording

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


def measure_live(source: Path, seconds: float = 20.0) -> LiveFigures:
    """Play a recording through one solver node per jaw.

    Args:
        source: recording of the left bench jaw.
        seconds: how much of it.

    Raises:
        MissingDependencyError: ROS 2 is not installed.
        ProcessError: a node cannot be started, or ended early.
    """
    names = argparse.Namespace(jaw="bench", solver="default", mesh="default", contact=[], calibration=None)
    with tempfile.TemporaryDirectory() as folder, _watched() as watch:
        path = write_recording(with_both_jaws(read_recording(source), seconds), Path(folder) / "both")
        result = replay(read_recording(path), make_setup(names))
    times = np.concatenate([case.step_ms for case in result.evaluation.results.values()])
    return LiveFigures(latency=1e-3 * times[np.isfinite(times)], memory=watch.largest)
