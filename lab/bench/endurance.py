"""An hour of grasps through all stages in one process: growth of memory, drift of the force, lost images.

One rendered grasp is played again and again from images, in real time, as one long stream. The finger's material
remembers the grasps before, and so does the solver; the true force of each grasp is therefore that of the whole hour,
relaxed from end to end, and not that of a finger that begins anew each time.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from finforce.skipping import IDLE
from finforce.stamps import NANOSECONDS
from finforce_eval.errors import OptionError
from finforce_eval.evaluation.scoring import rms
from finforce_eval.figures.time_error import TimeStats, time_stats
from finforce_eval.recordings.recording import read_recording
from finforce_eval.recordings.tracks import Recording
from finforce_eval.replay.live import ReplayLog
from finforce_eval.replay.node_run import describe_load, run_nodes
from finforce_eval.replay.playback import RawMessage
from finforce_eval.replay.processes import resident_bytes
from finforce_eval.replay.synthetic_stream import SyntheticStream, stream_images
from finforce_ifea.jaw.calibration import load_calibration
from finforce_ifea.relaxation import RelaxationTerm, apply_relaxation, invert_relaxation
from lab.bench.chain import SIDES, TARE, TrueGrasp, chain_processes
from lab.bench.scenes import GRASP, find_scene

RATE = 30  # [Hz]
MINUTES, QUICK_MINUTES = 60.0, 0.5
SETTLED = 2  # grasps until whatever is only needed in one has been taken into memory
EDGE = 0.1  # share of the grasps whose mean is compared, at either end


@dataclass(frozen=True, kw_only=True)
class GraspRow:
    """One grasp of the hour.

    Attributes:
        images: that were sent after the tare.
        answered: of which a grasp force came.
        bias_N: mean error [N].
        error_N: root mean square error [N].
        memory_MB: resident when the grasp began.
    """

    images: int
    answered: int
    bias_N: float
    error_N: float
    memory_MB: float


@dataclass(frozen=True, kw_only=True)
class EnduranceFigures:
    """What was measured.

    Attributes:
        rate: of the images [Hz].
        seconds: for which they were played.
        grasps: one after the other.
        latency: from the image to the grasp force [ms].
        cpu: of the process [% of a core].
        others: CPU use of everything else but process and player [% of a core].
        refused: what each node says that it refused, and how often.
    """

    rate: int
    seconds: float
    grasps: Sequence[GraspRow]
    latency: TimeStats
    cpu: float
    others: float
    refused: Mapping[str, str]

    @property
    def lost(self) -> int:
        """Images without an answer."""
        return sum(row.images - row.answered for row in self.grasps)

    @property
    def growth(self) -> float:
        """By how much more memory the last grasp begins with than the one after all was used once [MB]."""
        return self.grasps[-1].memory_MB - self.grasps[min(SETTLED, len(self.grasps) - 1)].memory_MB

    @property
    def drift(self) -> float:
        """By how much the mean error of the last tenth of grasps differs from the first's, without the tare's [N]."""
        bias = [row.bias_N for row in self.grasps[1:] if np.isfinite(row.bias_N)]
        count = max(1, int(EDGE * len(bias)))
        return float(np.mean(bias[-count:]) - np.mean(bias[:count])) if bias else np.nan


def measure(quick: bool, *, minutes: float | None = None) -> EnduranceFigures:
    """Return the figures of an hour, of half a minute when `quick`.

    Args:
        quick: whether half a minute is enough.
        minutes: another time.

    Raises:
        MissingDependencyError: ROS 2 is not installed.
        OptionError: the time is none.
        FinforceError: the scene cannot be rendered, or the process ended early.
    """
    if minutes is None:
        minutes = QUICK_MINUTES if quick else MINUTES
    if not 0.0 < minutes < np.inf:
        raise OptionError(f"{minutes:g} minutes of grasps; expected a time above zero")
    path = find_scene(GRASP)
    recording, once = read_recording(path), stream_images(path, RATE)
    wanted = 60.0 * minutes * NANOSECONDS
    stream = replace(once, repeats=max(SETTLED + 1, round(wanted / once.period)))
    watch = _MemoryWatch(stream)
    processes = chain_processes(recording, images=True, off=(IDLE,))
    run = run_nodes(processes, stream, SIDES, heard=(), watch=watch.look)
    truth = true_hour(recording, load_calibration("twin").relaxation, stream)
    return EnduranceFigures(
        rate=RATE,
        seconds=run.seconds,
        grasps=divide_grasps(run.log, truth, stream, watch.memory_MB),
        latency=time_stats(list(run.log.grasp_latency.values())),
        cpu=sum(run.cpu.values()),
        others=run.others,
        refused={name: state["refused"] for name, state in run.log.health.items() if "refused" in state},
    )


class _MemoryWatch:
    """Reads the memory of all processes where a grasp begins."""

    def __init__(self, stream: SyntheticStream) -> None:
        self._stream = stream
        self.memory_MB: list[float] = []

    def look(self, pids: Mapping[str, int], message: RawMessage) -> None:
        """Note that a message leaves."""
        if message.time >= self._stream.begin + len(self.memory_MB) * self._stream.period:
            self.memory_MB.append(sum(resident_bytes(pid) for pid in pids.values()) / 1e6)


def true_hour(recording: Recording, terms: Sequence[RelaxationTerm], stream: SyntheticStream) -> TrueGrasp:
    """Return the true grasp force of a grasp that is repeated by a finger which relaxes by `terms` all the time.

    Args:
        recording: with the truth of one grasp, which begins relaxed and lets go once.
        terms: of the finger's material.
        stream: how often the grasp is repeated.
    """
    shifts = stream.period * np.arange(stream.repeats)
    forces = []
    for side in SIDES:
        track = recording.truth(side)
        stamps = (track.stamps[None] + shifts[:, None]).ravel()
        times = 1e-9 * (stamps - stamps[0])
        force = np.linalg.norm(track.force, axis=1)
        elastic = invert_relaxation(force, times[: len(track.stamps)], terms)
        elastic[force == 0.0] = 0.0  # let go: the overstress that is left pulls at nothing
        forces.append(apply_relaxation(np.tile(elastic, stream.repeats), times, terms))
    return TrueGrasp(stamps=stamps, force=np.min(forces, axis=0))


def divide_grasps(
    log: ReplayLog, truth: TrueGrasp, stream: SyntheticStream, memory_MB: Sequence[float]
) -> list[GraspRow]:
    """Return the figures grasp by grasp; memory (n,) is that of each grasp's begin [MB]."""
    sent = np.array(sorted(log.jaws[SIDES[0]].sent))
    sent = sent[sent >= sent[0] + TARE * NANOSECONDS]
    force = np.array([log.grasp.get(int(stamp), np.nan) for stamp in sent])
    error, number = force - truth.at(sent), (sent - stream.messages[0].stamp) // stream.period
    rows = []
    for grasp, memory in enumerate(memory_MB):
        own = error[number == grasp]
        found = own[np.isfinite(own)]
        rows.append(
            GraspRow(
                images=len(own),
                answered=int(np.isfinite(force[number == grasp]).sum()),
                bias_N=float(found.mean()) if found.size else np.nan,
                error_N=rms(own),
                memory_MB=memory,
            )
        )
    return rows


def format_table(figures: EnduranceFigures) -> str:
    """Return the figures as a table in Markdown, with some grasps one by one."""
    images = sum(row.images for row in figures.grasps)
    lines = [
        "| minutes | grasps | images | lost | memory grew by/MB | force drifted by/N | latency: p50/ms | p95 | p99 "
        "| max | process/% of a core |",
        "|---|---|---|---|---|---|---|---|---|---|---|",
        f"| {figures.seconds / 60.0:.1f} | {len(figures.grasps)} | {images} | {figures.lost} "
        f"| {figures.growth:+.1f} | {figures.drift:+.4f} | {figures.latency.p50:.1f} | {figures.latency.p95:.1f} "
        f"| {figures.latency.p99:.1f} | {figures.latency.max:.1f} | {figures.cpu:.0f} |",
        "",
        "| grasp | answered | mean error/N | RMSE/N | memory/MB |",
        "|---|---|---|---|---|",
    ]
    count = len(figures.grasps)
    for number in sorted({0, 1, 2, count // 4, count // 2, 3 * count // 4, count - 1}):
        row = figures.grasps[number]
        lines.append(
            f"| {number + 1} | {row.answered} of {row.images} | {row.bias_N:+.3f} | {row.error_N:.3f} "
            f"| {row.memory_MB:.1f} |"
        )
    return "\n".join([*lines, describe_load([figures.others])])


def as_json(figures: EnduranceFigures) -> dict[str, Any]:
    """Return the figures as plain values; times in ms."""
    summary = {"lost": figures.lost, "growth_MB": figures.growth, "drift_N": figures.drift}
    return {**asdict(figures), **summary}


def draw(figures: EnduranceFigures, path: Path | str) -> None:
    """Draw error, lost images and memory over the grasps."""
    from matplotlib.figure import Figure

    picture = Figure(figsize=(7.0, 5.0), layout="constrained")
    top, middle, bottom = picture.subplots(3, sharex=True)
    minutes = np.arange(len(figures.grasps)) * figures.seconds / 60.0 / len(figures.grasps)

    def read(name: str) -> NDArray[np.float64]:
        return np.array([getattr(row, name) for row in figures.grasps])

    top.plot(minutes, 1e3 * read("error_N"), ".-", label="RMSE")
    top.plot(minutes, 1e3 * read("bias_N"), ".-", label="mean error")
    top.set_ylabel("force [mN]")
    top.legend(loc="best")
    middle.plot(minutes, read("images") - read("answered"), ".-")
    middle.set_ylabel("lost images")
    bottom.plot(minutes, read("memory_MB"), ".-")
    bottom.set_ylabel("memory [MB]")
    bottom.set_xlabel("begin of a grasp [min]")
    picture.suptitle(f"{len(figures.grasps)} grasps from images of {figures.rate} Hz, one process")
    picture.savefig(path, dpi=120)
