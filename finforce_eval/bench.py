"""Times of a solver step and memory of a solver, single-threaded, beside a yardstick of the machine."""

from __future__ import annotations

import argparse
import os
import platform
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np
from numpy.typing import NDArray

from finforce_eval.bench_live import measure_live
from finforce_eval.commands import write_json
from finforce_eval.contacts import ContactChoice
from finforce_eval.errors import OptionError
from finforce_eval.recording import read_recording
from finforce_eval.tracks import Recording
from finforce_ifea.errors import MissingDependencyError
from finforce_ifea.estimator import Contact, JawEstimator
from finforce_ifea.jaw import Jaw, load_jaw
from finforce_ifea.settings import EstimatorSettings
from finforce_ifea.solid import SolidModel

RECORDING = Path(__file__).parent / "data" / "bench_cyl25_middle"
SOLVERS = (
    ("solid, 522 vertices", "solid", "coarse"),
    ("solid, default mesh", "solid", "default"),
    ("frame", "frame", "default"),
    ("paper's setting", "paper", "default"),
)
FACTORISATIONS = 50
LIBRARIES = ("numpy", "scipy", "numba", "open3d", "manifold3d", "trimesh", "small_gicp", "coal")


@dataclass(frozen=True, kw_only=True)
class Row:
    """Times of one kind of work [ms]."""

    name: str
    n: int
    p50: float
    p95: float
    p99: float
    max: float


@dataclass(frozen=True, kw_only=True)
class Figures:
    """Everything that a benchmark measured: times, memory [MB] by name, and what could not be measured."""

    rows: Sequence[Row]
    memory: Mapping[str, float]
    notes: Sequence[str]


def row_from_times(name: str, times: Sequence[float] | NDArray[np.float64]) -> Row:
    """Return the percentiles of times [s] in milliseconds."""
    p50, p95, p99, longest = (1e3 * float(value) for value in np.percentile(times, [50, 95, 99, 100]))
    return Row(name=name, n=len(times), p50=p50, p95=p95, p99=p99, max=longest)


def measure_steps(recording: Recording, jaw: Jaw, solver: str, mesh: str, frames: int) -> NDArray[np.float64]:
    """Return the times of the solved steps (n,) [s], the first run, which compiles, left out.

    Args:
        recording: frames from an unloaded jaw to a loaded one.
        jaw: the jaw.
        solver: name of the solver.
        mesh: name of the mesh density.
        frames: frames to be timed.
    """
    contact = Contact.fixed(jaw, ContactChoice().height(recording))
    settings = EstimatorSettings(solver=solver, mesh=mesh)
    track = recording.jaw(jaw.side).keypoints
    seen = [track.observation(index) for index in range(len(track.stamps))]
    warm_up = JawEstimator(jaw, settings=settings)
    for observation in seen[:200]:
        warm_up.update(observation, contact)
    estimator = JawEstimator(jaw, settings=settings)
    times = []
    for observation in seen[:frames]:
        begin = perf_counter()
        solution = estimator.update(observation, contact)
        # an unloaded or unsolved frame may be cheaper: it is not what a user waits for
        if solution.status == "ok":
            times.append(perf_counter() - begin)
    return np.array(times)


def measure_factorisation(jaw: Jaw, mesh: str) -> NDArray[np.float64]:
    """Return the times (n,) [s] of a SuperLU factorisation of the whole jaw's stiffness matrix."""
    from scipy.sparse.linalg import splu

    model = SolidModel(jaw.build_mesh(mesh), jaw.material, symmetric=False)
    stiffness = model.sparse_tangent(model.linearize(np.zeros(model.size)).tangent).tocsc()
    options = {"permc_spec": "MMD_AT_PLUS_A", "diag_pivot_thresh": 0.0, "options": {"SymmetricMode": True}}
    return np.array([_time_call(lambda: splu(stiffness, **options)) for _ in range(FACTORISATIONS)])


def _time_call(call: Callable[[], Any]) -> float:
    """Return the duration of a call [s]."""
    begin = perf_counter()
    call()
    return perf_counter() - begin


MEMORY_PROBE = """
import sys
from finforce_eval.bench import RECORDING, measure_steps
from finforce_eval.memory import resident_bytes
from finforce_eval.recording import read_recording
from finforce_ifea.jaw import load_jaw
measure_steps(read_recording(RECORDING), load_jaw("bench"), sys.argv[1], sys.argv[2], 300)
print(resident_bytes())
"""


def measure_memory(solver: str, mesh: str) -> float:
    """Return the resident memory of a fresh process that runs an estimator [MB]."""
    command = [sys.executable, "-c", MEMORY_PROBE, solver, mesh]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    return int(done.stdout.split()[-1]) / 1e6


def describe_machine() -> dict[str, Any]:
    """Return processor, cores, versions of what is installed, and commit."""
    return {
        "processor": _processor(),
        "cores": os.cpu_count(),
        "system": platform.platform(),
        "python": platform.python_version(),
        **dict(_find_versions()),
        "commit": _commit(),
    }


def write_figures(path: Path | str, figures: Mapping[str, Any]) -> None:
    """Write figures as JSON with the machine, versions and commit that they are of; what is not finite becomes null."""
    write_json(path, {"machine": describe_machine(), **_without_nan(figures)})


def _without_nan(content: Any) -> Any:
    """Return nested mappings and sequences with None for numbers that are not finite."""
    if isinstance(content, Mapping):
        return {name: _without_nan(value) for name, value in content.items()}
    if isinstance(content, list | tuple):
        return [_without_nan(value) for value in content]
    return None if isinstance(content, float) and not np.isfinite(content) else content


def _find_versions() -> Iterator[tuple[str, str]]:
    """Yield the installed libraries with their versions."""
    for name in LIBRARIES:
        with suppress(PackageNotFoundError):
            yield name, version(name)


def _processor() -> str:
    """Return the name of the processor."""
    info = Path("/proc/cpuinfo")
    lines = info.read_text(encoding="utf-8").splitlines() if info.exists() else []
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor()


def _commit() -> str:
    """Return the commit of the sources, with a mark when they were changed since."""
    command = ["git", "describe", "--always", "--dirty", "--abbrev=12"]
    folder = Path(__file__).parent
    try:
        return subprocess.run(command, cwd=folder, capture_output=True, text=True, check=True).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        return "unknown"


def format_rows(rows: Sequence[Row]) -> str:
    """Return the table of the times [ms]."""
    width = max(len(row.name) for row in rows)
    head = f"{'one thread, ms'.ljust(width)}  {'p50':>7}  {'p95':>7}  {'p99':>7}  {'max':>7}  {'n':>6}"
    lines = [
        f"{row.name.ljust(width)}  {row.p50:7.2f}  {row.p95:7.2f}  {row.p99:7.2f}  {row.max:7.2f}  {row.n:6d}"
        for row in rows
    ]
    return "\n".join([head, "-" * len(head), *lines])


def measure_all(frames: int) -> Figures:
    """Measure everything, under a progress bar; without ROS 2 a note says what was left out."""
    from tqdm import tqdm

    jaw, recording = load_jaw("bench"), read_recording(RECORDING)
    rows, memory, notes = [], {}, []
    with tqdm(total=2 * len(SOLVERS) + 3, disable=None, leave=False) as bar:
        for mesh, name in (("coarse", "522 vertices"), ("default", "default mesh")):
            rows.append(row_from_times(f"SuperLU, {name}", measure_factorisation(jaw, mesh)))
            bar.update()
        for name, solver, mesh in SOLVERS:
            bar.set_description(name)
            rows.append(row_from_times(f"step: {name}", measure_steps(recording, jaw, solver, mesh, frames)))
            bar.update()
            memory[name] = measure_memory(solver, mesh)
            bar.update()
        bar.set_description("both jaws live")
        try:
            live = measure_live(RECORDING)
            rows.append(row_from_times("key points to wrench, both jaws live", live.latency))
            memory["solver node"] = live.memory / 1e6
        except MissingDependencyError as error:
            notes.append(f"both jaws live: not measured: {error}")
    return Figures(rows=rows, memory=memory, notes=notes)


def run_bench(options: argparse.Namespace) -> None:
    """Measure, print the table, write the JSON."""
    if options.frames < 1:
        raise OptionError(f"--frames {options.frames}: expected at least 1")
    figures, machine = measure_all(options.frames), describe_machine()
    print(format_rows(figures.rows))
    print("\nresident memory of a process with one solver:")
    print("\n".join(f"  {name}: {megabytes:.0f} MB" for name, megabytes in figures.memory.items()))
    print("\n".join(figures.notes))
    print(f"{machine['processor']}, {machine['cores']} cores, Python {machine['python']}, {machine['commit']}")
    if options.json:
        rows = [asdict(row) for row in figures.rows]
        write_figures(options.json, {"times_ms": rows, "memory_MB": figures.memory})
