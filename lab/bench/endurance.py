"""An hour of grasps through all stages in one process: growth of memory, drift of the force, lost images.

One rendered grasp is played again and again from images, in real time, as one long stream. The finger's material
remembers the grasps before, and so does the solver; the true force of each grasp is therefore that of the whole hour,
relaxed from end to end, and not that of a finger that begins anew each time.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
import pandas as pd

from finforce.skipping import IDLE
from finforce.stamps import NANOSECONDS
from finforce_eval.errors import OptionError
from finforce_eval.evaluation.scoring import rms
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
from lab.harness import Figures, percentiles
from lab.scenes import GRASP, find_scene

RATE = 30  # [Hz]
HOUR, QUICK_MINUTES = 60.0, 0.5
SETTLED = 2  # grasps until whatever is only needed in one has been taken into memory
EDGE = 0.1  # share of the grasps whose mean is compared, at either end


def measure(quick: bool, minutes: float | None = None) -> Figures:
    """Return the figures of an hour, of half a minute when `quick`.

    Args:
        quick: whether half a minute is enough.
        minutes: another duration.

    Raises:
        MissingDependencyError: ROS 2 is not installed.
        OptionError: the duration is none.
        FinforceError: the scene cannot be rendered, or the process ended early.
    """
    minutes = minutes if minutes is not None else QUICK_MINUTES if quick else HOUR
    if not 0.0 < minutes < np.inf:
        raise OptionError(f"--minutes {minutes:g}: expected a duration above zero")
    path = find_scene(GRASP)
    recording, once = read_recording(path), stream_images(path, RATE)
    stream = replace(once, repeats=max(SETTLED + 1, round(60.0 * minutes * NANOSECONDS / once.period)))
    memory_MB: list[float] = []

    def note_memory(pids: Mapping[str, int], message: RawMessage) -> None:
        if message.time >= stream.begin + len(memory_MB) * stream.period:
            memory_MB.append(sum(resident_bytes(pid) for pid in pids.values()) / 1e6)

    processes = chain_processes(recording, images=True, off=(IDLE,))
    run = run_nodes(processes, stream, SIDES, heard=(), watch=note_memory)
    truth = true_hour(recording, load_calibration("twin").relaxation, stream)
    grasps = divide_grasps(run.log, truth, stream, memory_MB)
    summary = {
        "minutes": run.seconds / 60.0,
        **summarise(grasps),
        **percentiles(list(run.log.grasp_latency.values()), "latency"),
        "process/% of a core": sum(run.cpu.values()),
    }
    count = len(grasps)
    shown = sorted({0, 1, 2, count // 4, count // 2, 3 * count // 4, count - 1})
    return Figures(
        tables={"endurance": pd.DataFrame([summary]), "grasps": grasps.iloc[shown]},
        notes=[describe_load([run.others])],
        more={"every_grasp": grasps.to_dict("records")},
    )


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
) -> pd.DataFrame:
    """Return a row for each grasp; memory (n,) is that at each grasp's begin [MB]."""
    sent = np.array(sorted(log.jaws[SIDES[0]].sent))
    sent = sent[sent >= sent[0] + TARE * NANOSECONDS]
    force = np.array([log.grasp.get(int(stamp), np.nan) for stamp in sent])
    error, number = force - truth.at(sent), (sent - stream.messages[0].stamp) // stream.period
    rows = []
    for grasp, memory in enumerate(memory_MB):
        own = error[number == grasp]
        found = own[np.isfinite(own)]
        rows.append(
            {
                "grasp": grasp + 1,
                "images": len(own),
                "answered": int(np.isfinite(force[number == grasp]).sum()),
                "bias/N": float(found.mean()) if found.size else np.nan,
                "RMSE/N": rms(own),
                "memory/MB": memory,
            }
        )
    return pd.DataFrame(rows)


def summarise(grasps: pd.DataFrame) -> dict[str, float]:
    """Return counts, growth of memory since all was used once [MB], and drift of the mean error [N].

    The drift is from the first tenth of the grasps to the last, without the one in which the tare is taken.
    """
    memory, bias = grasps["memory/MB"], grasps["bias/N"].iloc[1:].dropna()
    count = max(1, int(EDGE * len(bias)))
    return {
        "grasps": len(grasps),
        "images": int(grasps["images"].sum()),
        "lost": int((grasps["images"] - grasps["answered"]).sum()),
        "growth/MB": memory.iloc[-1] - memory.iloc[min(SETTLED, len(memory) - 1)],
        "drift/N": bias.iloc[-count:].mean() - bias.iloc[:count].mean(),
    }
