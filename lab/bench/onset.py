"""How long after its true onset a force shows, at 30 and 90 Hz, through all stages in one process.

Short grasps that begin at other times between two images are played from images in real time. A force sets in where
the true grasp force crosses 0.02 N, and shows when a grasp force above 0.1 N has arrived. From the one to the other the
true force takes its time, the shorter the faster the gripper closes.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from finforce_eval.evaluation.scoring import delay_stats, force_delays
from finforce_eval.recordings.recording import read_recording
from finforce_eval.replay.live import ReplayLog
from finforce_eval.replay.node_run import describe_load, run_nodes
from lab.bench.chain import SIDES, TARE, TrueGrasp, chain_processes, true_grasp
from lab.bench.streams import stream_images
from lab.harness import Figures
from lab.scenes import EVERY_RATE, TwinScene, find_scene

GRASPS = 7
USUAL_SPEED = 0.02


class Closing(NamedTuple):
    """How a gripper closes: speed of each jaw [m/s], clearance of the first grasp [m] and the increment of each [m]."""

    speed: float
    clearance: float
    increment: float

    def changes(self, grasp: int) -> dict[str, float]:
        """Return what is changed in the scene of a grasp; the usual speed is not."""
        faster = {} if self.speed == USUAL_SPEED else {"closing_speed": self.speed}
        return {**faster, "clearance": self.clearance + grasp * self.increment}


# a quarter of a second to the first touch, 6.5 ms more for each grasp
CLOSINGS = (Closing(USUAL_SPEED, 5e-3, 0.13e-3), Closing(0.06, 15e-3, 0.39e-3))
SHORT = {"settle": 0.2, "record": 0.2, "displacement": 0.002}
PHASES = tuple(slot for slot in EVERY_RATE if slot % 2 == 0)  # of the images of 30 Hz among those of 90 Hz


def measure(quick: bool) -> Figures:
    """Return how long forces take to show: of 21 grasps at each rate and speed, of three when `quick`.

    Raises:
        MissingDependencyError: ROS 2 is not installed.
        FinforceError: a scene cannot be rendered, or a node ended early.
    """
    rows, loads = [], []
    for closing in CLOSINGS:
        for rate, phases in ((30, PHASES), (90, (0,) * len(PHASES))):
            delays: list[NDArray] = []
            for grasp in range(1 if quick else GRASPS):
                found, load = _play(closing.changes(grasp), rate, phases)
                delays.append(found)
                loads.append(load)
            stats = delay_stats(delays)
            rows.append(
                {
                    "closing/mm/s": 1e3 * closing.speed,
                    "Hz": rate,
                    "onsets": stats["n"],
                    "missed": stats["missed"],
                    "shows after: median/ms": stats["median_ms"] or np.nan,
                    "largest/ms": stats["max_ms"] or np.nan,
                    "rise of the true force/ms": stats["rise_ms"] or np.nan,
                }
            )
    return Figures(tables={"onset": pd.DataFrame(rows)}, notes=[describe_load(loads)])


def _play(changes: Mapping[str, float], rate: int, phases: Sequence[int]) -> tuple[NDArray, float]:
    """Play a grasp at a rate [Hz], once from each phase of the images; return delays and other load [% of a core]."""
    path = find_scene(TwinScene(scenario="grasp_cylinder", seed=101, changes=SHORT | changes, slots=EVERY_RATE))
    recording = read_recording(path)
    truth, delays, load = true_grasp(recording), np.zeros((0, 2)), 0.0
    for phase in phases:
        stream = stream_images(path, rate, phase=phase)
        run = run_nodes(chain_processes(recording, images=True), stream, SIDES, heard=())
        delays, load = np.vstack((delays, find_delays(run.log, truth))), max(load, run.others)
    return delays, load


def find_delays(log: ReplayLog, truth: TrueGrasp) -> NDArray:
    """Return the delay after each onset in a run."""
    sent = np.array(sorted(log.sent[SIDES[0]]))
    stamps = sent[sent >= sent[0] + int(0.5e9 * TARE)]
    estimate = np.array([log.grasp.get(int(stamp), np.nan) for stamp in stamps])
    lag = np.array([log.grasp_latency.get(int(stamp), np.nan) for stamp in stamps])
    return force_delays(1e-9 * (stamps - stamps[0]), truth.at(stamps), estimate, lag)
