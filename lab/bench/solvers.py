"""Run time against force error of every solver tier: nine presses of an independent program, one thread, one run."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from gc import collect, disable, enable
from time import perf_counter, thread_time
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from finforce.errors import FinforceError
from finforce_eval.evaluation.scoring import rms
from finforce_ifea.estimator import ForceEstimator
from finforce_ifea.fem.solid import SolidModel
from finforce_ifea.jaw.jaw import Jaw, load_jaw
from finforce_ifea.settings import SOLVERS, EstimatorSettings
from lab.bench.cases import NoisyCamera, ReplayedPress, bench_finger, load_cases, record_press
from lab.harness import Figures, Tradeoff, percentiles, time_calls

SEED = 1
FACTORISATIONS = 20
WARM_UP_FRAMES = 150
# A tier that leaves more of the scored frames unanswered is on no front.
LEAST_ANSWERED = 99.0
# Quoted: SOFA v25.06 with SoftRobots.Inverse on the same 522 vertices and 45 shapes, and its yardstick.
SOFA = {"step_ms": 3.9, "yardstick_ms": 3.0, "rmse_N": 20.9, "one_factor_N": 1.01, "factor_per_height_N": 0.74}
# Quoted, Zuo, Yang, Chua, RA-L 2026: the rate of the whole loop, and the RMSE range of Tables I and II.
PAPER = {"rate_Hz": 40.0, "least_N": 0.20, "largest_N": 1.21}


@dataclass(frozen=True, kw_only=True)
class Tier:
    """One way to solve.

    Attributes:
        name: for tables.
        solver: `EstimatorSettings.solver`.
        mesh: `EstimatorSettings.mesh`.
        contact: what is known of the object: its "height" of first touch, or its "outline".
        slow: whether it is left out where time is short.
    """

    name: str
    solver: str
    mesh: str = "default"
    contact: str = "height"
    slow: bool = False

    def settings(self) -> EstimatorSettings:
        """Return the estimator's settings; raises ObservationError where there is no such solver."""
        return EstimatorSettings(solver=self.solver, mesh=self.mesh)


TIERS = (
    Tier(name="linear", solver="linear"),
    Tier(name="reduced", solver="reduced"),
    Tier(name="frame", solver="frame"),
    Tier(name="solid, 522 vertices", solver="solid", mesh="coarse"),
    Tier(name="solid, default mesh", solver="solid"),
    Tier(name="solid, fine mesh", solver="solid", mesh="fine", slow=True),
    Tier(name="paper's setting", solver="paper"),
    Tier(name="reduced, outline known", solver="reduced", contact="outline"),
    Tier(name="frame, outline known", solver="frame", contact="outline"),
    Tier(name="solid, default mesh, outline known", solver="solid", contact="outline"),
)


def list_tiers(*, slow: bool = True) -> tuple[Tier, ...]:
    """Return the tiers, those that take long too if `slow`, with one for each solver that the list does not name."""
    named = {tier.solver for tier in TIERS} | {"default", "plane"}  # the plane is for fingers without a drawing
    others = tuple(Tier(name=name, solver=name) for name in SOLVERS if name not in named)
    return tuple(tier for tier in TIERS + others if slow or not tier.slow)


def measure(quick: bool) -> Figures:
    """Return times and errors of every tier.

    Args:
        quick: three cases instead of nine, and no slow tier.
    """
    from tqdm import tqdm

    finger, tiers = bench_finger(), list_tiers(slow=not quick)
    cases = [case for case in load_cases() if case.name.startswith("Ø25") or not quick]
    presses = {
        "noise-free": [record_press(case, finger) for case in cases],
        "noisy": [record_press(case, finger, NoisyCamera(), SEED) for case in cases],
    }
    rows, by_case, shapes, notes = [], [], [], []
    with tqdm(total=len(tiers) * 2 * len(cases), unit="press", disable=None, leave=False) as bar:
        for tier in tiers:
            bar.set_description(tier.name)
            try:
                yardstick = time_factorisation()
                runs = {kind: run_tier(tier, finger, seen, bar.update) for kind, seen in presses.items()}
                yardstick = float(np.median(yardstick + time_factorisation()))
            except FinforceError as error:
                notes.append(f"{tier.name}: not measured: {error}")
                continue
            rows += [tier_row(tier, kind, found, yardstick) for kind, found in runs.items()]
            by_case += [case_row(tier, kind, found) for kind, found in runs.items()]
            shapes.append({"tier": tier.name, **score_shapes(runs["noise-free"]), **compare_with_sofa(rows[-1])})
    shapes.append({"tier": "SOFA, quoted", **quoted_shapes()})
    tables = {"tiers": rows, "cases": by_case, "shapes": shapes}
    return Figures(
        tables={name: pd.DataFrame(found) for name, found in tables.items()},
        notes=notes,
        picture=Tradeoff(
            table="tiers",
            method=("tier",),
            time="step p50/ms",
            slow="step p99/ms",
            error="RMSE/N",
            answered="answered/%",
            complete=LEAST_ANSWERED,
            log_error=True,
            title="Time of a step against force error: nine presses of an independent program",
        ),
        more={"quoted": {"sofa": SOFA, "paper": PAPER}},
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class Run:
    """What a tier makes of one press.

    Attributes:
        press: that it was given.
        force: (n, 3) [N], NaN where none is trusted.
        seconds: wall time of the steps that gave a force (m,).
        cpu: processor time of the same steps (m,) [s].
    """

    press: ReplayedPress
    force: NDArray
    seconds: NDArray
    cpu: NDArray

    @property
    def errors(self) -> NDArray:
        """Errors of the magnitude (n,) [N]; NaN where there is no estimate."""
        return np.linalg.norm(self.force, axis=1) - np.linalg.norm(self.press.force, axis=1)


def run_tier(
    tier: Tier, jaw: Jaw, presses: Sequence[ReplayedPress], progress: Callable[[], object] = lambda: None
) -> list[Run]:
    """Run one estimator over presses, each from the start; what compiles is compiled before.

    Raises:
        FinforceError: the tier does not exist, or cannot describe the jaw.
    """
    estimator = ForceEstimator(jaw, settings=tier.settings())
    estimator.warm_up()
    _run_press(tier, estimator, presses[0], WARM_UP_FRAMES)
    runs = []
    for press in presses:
        runs.append(_run_press(tier, estimator, press))
        progress()
    return runs


def _run_press(tier: Tier, estimator: ForceEstimator, press: ReplayedPress, frames: int | None = None) -> Run:
    """Return what an estimator that starts anew makes of the first frames of a press."""
    estimator.reset()
    force = np.full(press.force.shape, np.nan)
    seconds, cpu = [], []
    contacts = press.contacts[tier.contact]
    # a collection in the middle of a step is not the step's own time
    collect()
    disable()
    try:
        for index, observation in enumerate(press.observations[:frames]):
            begin, begin_cpu = perf_counter(), thread_time()
            solution = estimator.update(observation, contacts[index])
            passed, used = perf_counter() - begin, thread_time() - begin_cpu
            if solution.trusted:
                force[index] = solution.force
            # an unloaded or unsolved frame may be cheaper: it is not what a user waits for
            if solution.status == "ok":
                seconds.append(passed)
                cpu.append(used)
    finally:
        enable()
    return Run(press=press, force=force, seconds=np.array(seconds), cpu=np.array(cpu))


def tier_row(tier: Tier, kind: str, runs: Sequence[Run], yardstick: float) -> dict[str, Any]:
    """Return times and errors of a tier over its presses.

    Args:
        tier: the way to solve.
        kind: of key points.
        runs: over presses.
        yardstick: processor time of a factorisation of the whole jaw's stiffness matrix, 522 vertices [s].
    """
    held = np.concatenate([run.errors[run.press.held] for run in runs])
    step = percentiles(np.concatenate([run.seconds for run in runs]), "step")
    cpu = percentiles(np.concatenate([run.cpu for run in runs]), "CPU")
    known = held[np.isfinite(held)]
    return {
        "tier": tier.name,
        "key points": kind,
        **{name: value for name, value in step.items() if "p95" not in name},
        **{name: cpu[name] for name in ("CPU p50/ms", "CPU p99/ms")},
        "SuperLU/ms": 1e3 * yardstick,
        "RMSE/N": rms(held),
        "bias/N": float(known.mean()) if known.size else np.nan,
        "largest/N": float(np.abs(known).max()) if known.size else np.nan,
        "answered/%": 100.0 * known.size / held.size,
    }


def case_row(tier: Tier, kind: str, runs: Sequence[Run]) -> dict[str, Any]:
    """Return the RMSE of a tier on each press [N]."""
    errors = {f"{run.press.case.name}/N": rms(run.errors[run.press.held]) for run in runs}
    return {"tier": tier.name, "key points": kind, **errors}


def score_shapes(runs: Sequence[Run]) -> dict[str, Any]:
    """Return the errors at the end of each level of noise-free runs, one number per shape.

    Three of them are after fitting: nothing, the one best factor on all estimates, and the best one for each height.
    """
    estimated = np.concatenate([np.linalg.norm(run.force[run.press.ends], axis=1) for run in runs])
    true = np.concatenate([np.linalg.norm(run.press.force[run.press.ends], axis=1) for run in runs])
    heights = np.concatenate([[run.press.case.height_name] * len(run.press.ends) for run in runs])
    factors = {name: _best_factor(estimated[heights == name], true[heights == name]) for name in set(heights)}
    scaled = estimated * np.array([factors[height] for height in heights])
    by_height = {
        f"{name}/N": rms((estimated - true)[heights == name])
        for name in ("lower", "middle", "upper")
        if name in factors
    }
    return {
        "shapes": len(true),
        "solved": int(np.isfinite(estimated).sum()),
        "nothing fitted/N": rms(estimated - true),
        **by_height,
        "one factor/N": rms(_best_factor(estimated, true) * estimated - true),
        "a factor per height/N": rms(scaled - true),
    }


def _best_factor(estimated: NDArray, true: NDArray) -> float:
    """Return the factor on the estimates with the least squared error."""
    known = np.isfinite(estimated)
    return float(true[known] @ estimated[known] / max(estimated[known] @ estimated[known], 1e-300))


def time_factorisation() -> list[float]:
    """Return the processor times [s] of a SuperLU factorisation of the whole jaw's stiffness matrix."""
    from scipy.sparse.linalg import splu

    jaw = load_jaw("bench")
    model = SolidModel(jaw.build_mesh("coarse"), jaw.material, symmetric=False)
    stiffness = model.sparse_tangent(model.linearize(np.zeros(model.size)).tangent).tocsc()
    options = {"permc_spec": "MMD_AT_PLUS_A", "diag_pivot_thresh": 0.0, "options": {"SymmetricMode": True}}
    return time_calls(lambda: splu(stiffness, **options), FACTORISATIONS, clock=thread_time)


def compare_with_sofa(row: dict[str, Any]) -> dict[str, float]:
    """Return the rate of a tier in SOFA's, as measured and with SOFA's step scaled to this machine by the yardstick."""
    scaled = SOFA["step_ms"] * row["SuperLU/ms"] / SOFA["yardstick_ms"]
    return {"rate in SOFA's": SOFA["step_ms"] / row["step p50/ms"], "by the yardstick": scaled / row["CPU p50/ms"]}


def quoted_shapes() -> dict[str, float]:
    """Return SOFA's row of the shapes, as quoted."""
    errors = ("rmse_N", "one_factor_N", "factor_per_height_N")
    names = ("nothing fitted/N", "one factor/N", "a factor per height/N")
    quoted = dict(zip(names, (SOFA[name] for name in errors), strict=True))
    return {"shapes": 45, "solved": 45, **quoted, "rate in SOFA's": 1.0, "by the yardstick": 1.0}
