"""Time from the start of a node until it is ready, and its memory then: with an empty cache and with a full one.

The first start compiles and builds into an empty folder, which later ones find full.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path
from time import monotonic, sleep
from typing import Any

import numpy as np
import pandas as pd

from finforce.ros.transport import free_domain
from finforce.systems.processes import (
    PIPELINE,
    Process,
    ReplayOptions,
    executables_of,
    merge,
    replay_processes,
)
from finforce_eval.recordings.objects import find_mesh
from finforce_eval.recordings.recording import DEMO, read_recording
from finforce_eval.replay.processes import ProcessError, ProcessGroup, resident_bytes
from finforce_eval.tasks import progress_bar
from lab.harness import Figures

READY = b" ready"  # every node says so once, when it takes messages
LONGEST = 600.0  # [s]
TIMES = 5
POLL = 0.005  # [s]
IMPORT = "import time; begin = time.perf_counter(); import finforce; print(time.perf_counter() - begin)"


def measure(quick: bool) -> Figures:
    """Return the times of all starts, each once when `quick`.

    Raises:
        MissingDependencyError: ROS 2 is not installed.
        ProcessError: a node ended, or was not ready after ten minutes.
    """
    times, nodes = 1 if quick else TIMES, list_nodes()
    pipeline, seen = merge(nodes), {node.executable: node for node in nodes}
    rows = []
    with (
        tempfile.TemporaryDirectory() as folder,
        progress_bar(1 + times * (1 + len(seen)), "start") as bar,
    ):
        rows.append(_start(pipeline, 1, folder, bar.update, compiled=False))
        rows += [_start(node, times, folder, bar.update) for node in (pipeline, *seen.values())]
    took = [float(subprocess.check_output([sys.executable, "-c", IMPORT])) for _ in range(times)]
    return Figures(
        tables={"start": pd.DataFrame(rows)}, notes=[f"`import finforce` takes {1e3 * float(np.median(took)):.1f} ms."]
    )


def list_nodes() -> list[Process]:
    """Return the nodes of both jaws, from images to the grasp force, with the object of the embedded recording."""
    options = ReplayOptions(
        jaws="both",
        jaw_file="bench",
        calibration_file="bench",
        object_mesh=str(find_mesh(read_recording(DEMO)).resolve()),
        images=True,
        use_sim_time=False,
        composed=False,
    )
    return replay_processes(options, Path())


def _start(
    process: Process, times: int, folder: str, progress: Callable[[], Any], *, compiled: bool = True
) -> dict[str, Any]:
    """Start a process several times, one after the other, with a folder for what it keeps."""
    environment = {"FINFORCE_CACHE": folder, "NUMBA_CACHE_DIR": ""}
    name = "all in one process" if process.executable == PIPELINE else process.executable
    seconds, memory = [], []
    for _ in range(times):
        took, taken = time_start(process, environment)
        seconds.append(took)
        memory.append(1e-6 * taken)
        progress()
    return {
        "start of": name,
        "compiled": "before" if compiled else "meanwhile",
        "n": times,
        "ready after: median/s": float(np.median(seconds)),
        "largest/s": max(seconds),
        "memory/MB": float(np.median(memory)),
    }


def time_start(process: Process, environment: Mapping[str, str]) -> tuple[float, int]:
    """Start a process and end it as soon as all its nodes are ready.

    Args:
        process: that runs nodes.
        environment: variables in addition to those of this process.

    Returns:
        The time until then [s], and its resident memory [bytes].

    Raises:
        ProcessError: it ended, or was not ready after ten minutes.
    """
    begin, nodes = monotonic(), len(executables_of([process]))
    with ProcessGroup([process], {**environment, "ROS_DOMAIN_ID": str(free_domain())}) as group:
        while group.count_lines(READY) < nodes:
            group.check()
            if monotonic() - begin > LONGEST:
                raise ProcessError(f"{process.label} is not ready after {LONGEST:g} s")
            sleep(POLL)
        return monotonic() - begin, resident_bytes(*group.pids.values())
