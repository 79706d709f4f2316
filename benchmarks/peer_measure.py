"""What the comparison with the peer measures itself: steps beside a yardstick, noise, starts."""

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from time import perf_counter, thread_time
from typing import Any

import numpy as np
from peer_install import measure_installation, read_project
from tqdm import tqdm

from finforce_eval.bench.bench import row_from_times, time_calls
from finforce_eval.bench.cases import LEVELS, ReplayedPress, bench_finger, load_cases, record_press
from finforce_eval.bench.growth import factorise_sparse
from finforce_eval.bench.tiers import TIERS, Run, Tier, run_tier, score_shapes
from finforce_eval.replay.processes import ProcessError
from finforce_ifea.fem.solid import SolidModel
from finforce_ifea.jaw.jaw import load_jaw

ROOT = Path(__file__).resolve().parents[1]
SEED = 1
NOISE = 0.2e-3  # [m] in every direction on every key point: that of SOFA's quoted errors
SCATTERS = (
    0.5e-3,
    1e-3,
    2e-3,
    5e-3,
)  # [m] per axis, of key points that no force can bring to where they are said to be
DEFAULT, OUTLINE, FULL = "reduced", "reduced, outline known", "solid, 522 vertices"
HEIGHTS = ("lower", "middle", "upper")
_FACTORISATIONS = 8  # between two presses
_CACHED_STARTS = 3


def measure_all() -> dict[str, Any]:
    """Returns everything that this module measures as plain values, under a progress bar."""
    tiers = [next(tier for tier in TIERS if tier.name == name) for name in (DEFAULT, OUTLINE, FULL)]
    jaw = bench_finger()
    exact = [record_press(case, jaw) for case in load_cases()]
    noisy = [add_noise(press, SEED + number) for number, press in enumerate(exact)]
    total = (len(tiers) * 2 + len(SCATTERS)) * len(exact) + 3
    with tqdm(total=total, unit="press", disable=None, leave=False) as bar:
        steps = [measure_tier(tier, exact, noisy, bar.update) for tier in tiers]
        unreachable = [measure_unreachable(tiers[0], noisy, scatter, bar.update) for scatter in SCATTERS]
        starts = measure_starts(DEFAULT, bar.update)
    project = read_project(ROOT)
    return {
        "tiers": steps,
        "unreachable": unreachable,
        "starts": [asdict(start) for start in starts],
        "core": asdict(measure_installation(project)),
        "full": asdict(measure_installation(project, project.extras)),
        "own_bytes": project.size,
    }


def add_noise(press: ReplayedPress, seed: int) -> ReplayedPress:
    """Returns a press with white noise on every key point, all of them seen."""
    random = np.random.default_rng(seed)
    seen = [
        replace(one, points=one.points + NOISE * random.standard_normal(one.points.shape)) for one in press.observations
    ]
    return replace(press, observations=seen)


def build_yardstick() -> Callable[[], object]:
    """Returns the SuperLU factorisation of the whole finger's stiffness matrix, 522 vertices of hexahedra."""
    jaw = load_jaw("bench")
    model = SolidModel(jaw.build_mesh("coarse"), jaw.material, symmetric=False)
    matrix = model.sparse_tangent(model.linearize(np.zeros(model.size)).tangent).tocsc()
    return lambda: factorise_sparse(matrix)


def measure_tier(
    tier: Tier, exact: Sequence[ReplayedPress], noisy: Sequence[ReplayedPress], progress: Callable[[], object]
) -> dict[str, Any]:
    """Returns steps beside the yardstick, and errors without and with noise.

    The yardstick is taken after every press, so that both see the same machine, and both in processor time: on a busy
    machine the wall time of the yardstick, which is long, has other processes in it, that of a step, which is short,
    has not, and their ratio would flatter the step.
    """
    factorise, beside = build_yardstick(), []

    def take_yardstick() -> None:
        beside.extend(time_calls(factorise, _FACTORISATIONS, thread_time))
        progress()

    without = run_tier(tier, bench_finger(), exact, take_yardstick)
    runs = run_tier(tier, bench_finger(), noisy, take_yardstick)
    step = row_from_times("step", np.concatenate([run.cpu for run in runs]))
    yardstick = row_from_times("SuperLU", beside)
    return {
        "name": tier.name,
        "wall": asdict(row_from_times("step", np.concatenate([run.seconds for run in runs]))),
        "cpu": asdict(step),
        "yardstick": asdict(yardstick),
        "in_yardsticks": step.p50 / yardstick.p50,
        "shapes": asdict(score_shapes(without)),
        "fitted_by_height": {name: score_shapes(part).factor_per_height for name, part in _split(without).items()},
        "unanswered": list_unanswered(without),
        "noise": {name: score_noise(part) for name, part in _split(runs).items()},
    }


def _split(runs: Sequence[Run]) -> dict[str, list[Run]]:
    """Returns the runs by height."""
    return {name: [run for run in runs if run.press.case.height_name == name] for name in HEIGHTS}


def list_unanswered(runs: Sequence[Run]) -> list[str]:
    """Returns the shapes without a trusted force, as "Ø35 lower 10 mm"."""
    return [
        f"{run.press.case.name} {1e3 * level:.0f} mm"
        for run in runs
        for level, end in zip(LEVELS, run.press.ends, strict=True)
        if np.isnan(run.force[end]).any()
    ]


def score_noise(runs: Sequence[Run]) -> dict[str, float]:
    """Returns mean errors over the held images, relative to the true force: along x, of all three axes; and lost."""
    estimated = np.concatenate([run.force[run.press.held] for run in runs])
    true = np.concatenate([run.press.force[run.press.held] for run in runs])
    wrong = estimated - true
    return {
        "along_x": float(np.nanmean(np.abs(wrong[:, 0] / true[:, 0]))),
        "in_3d": float(np.nanmean(np.linalg.norm(wrong, axis=1) / np.linalg.norm(true, axis=1))),
        "lost": float(np.isnan(wrong[:, 0]).mean()),
    }


def scatter_targets(press: ReplayedPress, scatter: float, seed: int) -> ReplayedPress:
    """Returns a press whose key points stay, from the 4 mm level on, at places that no force can bring them to.

    Args:
        press: whose first seconds have the noise of a camera, which the tare learns.
        scatter: of those places about the right ones, along each axis [m].
        seed: of the places.
    """
    shape = press.observations[0].points.shape
    last = press.ends[LEVELS.index(0.004)]
    targets = press.observations[last].points + scatter * np.random.default_rng(seed).standard_normal(shape)
    held = np.arange(len(press.force)) > last
    seen = [replace(one, points=targets) if stays else one for one, stays in zip(press.observations, held, strict=True)]
    return replace(press, observations=seen, held=held)


def measure_unreachable(
    tier: Tier, noisy: Sequence[ReplayedPress], scatter: float, progress: Callable[[], object]
) -> dict[str, float]:
    """Returns the share of images of unreachable targets with a trusted force, and by how much that jumps [N]."""
    presses = [scatter_targets(press, scatter, SEED + number) for number, press in enumerate(noisy)]
    runs = run_tier(tier, bench_finger(), presses, progress)
    forces = [run.force[run.press.held] for run in runs]
    jumps = np.concatenate([np.linalg.norm(np.diff(force, axis=0), axis=1) for force in forces])
    return {
        "scatter_mm": 1e3 * scatter,
        "answered": float(np.isfinite(np.concatenate(forces)[:, 0]).mean()),
        "largest_jump_N": float(np.nanmax(jumps, initial=0.0)),
    }


@dataclass(frozen=True, kw_only=True)
class FirstAnswers:
    """A fresh process with one estimator, from its start until 200 images are answered and it has ended.

    Attributes:
        cached: what it found from a process before.
        seconds: median over the processes [s].
        processes: that were started.
        memory: resident after the last image [MB].
        caches: compiled code and stored equilibria that are there at the end [MB].
    """

    cached: str
    seconds: float
    processes: int
    memory: float
    caches: float


def measure_starts(solver: str, progress: Callable[[], object] = lambda: None) -> list[FirstAnswers]:
    """Returns the start with nothing cached, with compiled code alone, and with everything.

    Raises:
        ProcessError: A process failed.
    """
    with tempfile.TemporaryDirectory() as folder:
        code, first, second = (f"{folder}/{name}" for name in ("code", "first", "second"))
        rows = []
        for name, cache, count in (("nothing", first, 1), ("code", second, 1), ("all", second, _CACHED_STARTS)):
            places = {"NUMBA_CACHE_DIR": code, "FINFORCE_CACHE": cache}
            rows.append(_summarise_starts(name, [_start(solver, places) for _ in range(count)]))
            progress()
    return rows


def _summarise_starts(name: str, starts: Sequence[Mapping[str, float]]) -> FirstAnswers:
    median = {key: float(np.median([start[key] for start in starts])) for key in starts[0]}
    return FirstAnswers(cached=name, processes=len(starts), **median)


def _start(solver: str, places: Mapping[str, str]) -> dict[str, float]:
    """Returns time [s], memory and caches [MB] of one process; its caches are in the given places."""
    command = [sys.executable, "-m", "finforce_eval.bench.process", solver, "default"]
    begin = perf_counter()
    done = subprocess.run(command, capture_output=True, text=True, check=False, env={**os.environ, **places}, cwd=ROOT)
    seconds = perf_counter() - begin
    if done.returncode:
        raise ProcessError(f"the process with solver {solver} ended with {done.returncode}: {done.stderr[-300:]}")
    memory = json.loads(done.stdout.splitlines()[-1])["memory"]
    caches = sum(path.stat().st_size for place in places.values() for path in Path(place).rglob("*") if path.is_file())
    return {"seconds": seconds, "memory": memory, "caches": 1e-6 * caches}
