"""How long after its true onset a force shows, at 30 and 90 Hz, through all stages in one process.

Short grasps that begin at other times between two images are played from images in real time. A force sets in where
the true grasp force crosses 0.02 N, and shows when a grasp force above 0.1 N has arrived. From the one to the other the
true force takes its time, the shorter the faster the gripper closes.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from finforce_eval.evaluation.results import Delay, DelayStats, delay_stats, force_delays
from finforce_eval.recordings.recording import read_recording
from finforce_eval.replay.node_run import describe_load, run_nodes
from finforce_eval.replay.synthetic_stream import stream_images
from lab.bench.chain import SIDES, TARE, chain_processes, true_grasp
from lab.bench.scenes import EVERY_RATE, BenchScene, find_scene

if TYPE_CHECKING:
    from finforce_eval.replay.live import ReplayLog
    from lab.bench.chain import TrueGrasp

GRASPS = 7


class Closing(NamedTuple):
    """How a gripper closes: speed of each jaw [m/s], clearance of the first grasp [m] and what each has more [m]."""

    speed: float
    clearance: float
    more: float

    def changes(self, grasp: int) -> dict[str, float]:
        """Return what is changed in the scene of a grasp; the usual speed is not."""
        faster = {} if self.speed == USUAL_SPEED else {"closing_speed": self.speed}
        return {**faster, "clearance": self.clearance + grasp * self.more}


USUAL_SPEED = 0.02
# a quarter of a second to the first touch, 6.5 ms more for each grasp
CLOSINGS = (Closing(USUAL_SPEED, 5e-3, 0.13e-3), Closing(0.06, 15e-3, 0.39e-3))
SHORT = {"settle": 0.2, "record": 0.2, "displacement": 0.002}
PHASES = tuple(slot for slot in EVERY_RATE if slot % 2 == 0)  # of the images of 30 Hz among those of 90 Hz


@dataclass(frozen=True, kw_only=True)
class OnsetRow:
    """The grasps at one rate.

    Attributes:
        rate: of the images [Hz].
        speed: at which each jaw closes [m/s].
        delays: of the force after its true onsets.
        others: CPU use of everything else but nodes and player [% of a core]; it should be small.
    """

    rate: int
    speed: float
    delays: DelayStats
    others: float


@dataclass(frozen=True, kw_only=True)
class OnsetFigures:
    """What was measured."""

    rows: Sequence[OnsetRow]


def measure(quick: bool) -> OnsetFigures:
    """Return how long forces take to show: of 21 grasps at each rate and speed, of three when `quick`.

    Raises:
        MissingDependencyError: ROS 2 is not installed.
        FinforceError: a scene cannot be rendered, or a node ended early.
    """
    rows = []
    for closing in CLOSINGS:
        for rate, phases in ((30, PHASES), (90, (0,) * len(PHASES))):
            runs = [_play(closing.changes(grasp), rate, phases) for grasp in range(1 if quick else GRASPS)]
            delays = delay_stats([delay for run in runs for delay in run.delays])
            others = max(run.others for run in runs)
            rows.append(OnsetRow(rate=rate, speed=closing.speed, delays=delays, others=others))
    return OnsetFigures(rows=rows)


class _Played(NamedTuple):
    """The delays of one grasp, played several times, and the CPU use of everything else [% of a core]."""

    delays: list[Delay]
    others: float


def _play(changes: Mapping[str, float], rate: int, phases: Sequence[int]) -> _Played:
    """Play a grasp at a rate [Hz], once from each phase of the images."""
    path = find_scene(BenchScene(scenario="grasp_cylinder", seed=101, changes=SHORT | changes, slots=EVERY_RATE))
    recording = read_recording(path)
    truth, played = true_grasp(recording), _Played([], 0.0)
    for phase in phases:
        stream = stream_images(path, rate, phase=phase)
        run = run_nodes(chain_processes(recording, images=True), stream, SIDES, heard=())
        played = _Played(played.delays + find_delays(run.log, truth), max(played.others, run.others))
    return played


def find_delays(log: ReplayLog, truth: TrueGrasp) -> list[Delay]:
    """Return the delay after each onset in a run."""
    sent = np.array(sorted(log.jaws[SIDES[0]].sent))
    stamps = sent[sent >= sent[0] + int(0.5e9 * TARE)]
    estimate = np.array([log.grasp.get(int(stamp), np.nan) for stamp in stamps])
    lag = np.array([log.grasp_latency.get(int(stamp), np.nan) for stamp in stamps])
    return force_delays(1e-9 * (stamps - stamps[0]), truth.at(stamps), estimate, lag)


def format_table(figures: OnsetFigures) -> str:
    """Return the rows as a table in Markdown."""
    lines = [
        "| closing/mm/s | Hz | onsets | missed | shows after: median/ms | max | the true force itself/ms |",
        "|---|---|---|---|---|---|---|",
    ]
    lines += [
        f"| {1e3 * row.speed:.0f} | {row.rate} | {row.delays.n} | {row.delays.missed} "
        f"| {row.delays.median_ms or np.nan:.0f} | {row.delays.max_ms or np.nan:.0f} "
        f"| {row.delays.rise_ms or np.nan:.0f} |"
        for row in figures.rows
    ]
    return "\n".join([*lines, describe_load(row.others for row in figures.rows)])


def as_json(figures: OnsetFigures) -> dict[str, Any]:
    """Return the figures as plain values; times in ms."""
    return asdict(figures)
