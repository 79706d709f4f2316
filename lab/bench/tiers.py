"""The solver tiers that are compared, what each makes of a press, and how far that is from the truth."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from gc import collect, disable, enable
from time import perf_counter, thread_time

import numpy as np
from numpy.typing import NDArray

from finforce_eval.evaluation.scoring import rms
from finforce_ifea.estimator import JawEstimator
from finforce_ifea.jaw.jaw import Jaw
from finforce_ifea.settings import SOLVERS, EstimatorSettings
from lab.bench.cases import ReplayedPress

_WARM_UP_FRAMES = 150

# Solvers of sections alone, and of drawings alone.
_OF_SECTIONS, _OF_DRAWINGS = ("plane",), ("frame", "paper")


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
        """Returns the estimator's settings.

        Raises:
            ObservationError: There is no such solver.
        """
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


def list_tiers(*, slow: bool = True, section: bool = False) -> tuple[Tier, ...]:
    """Returns the tiers, with one for each solver that has been registered since the list was written.

    Args:
        slow: with those that take long.
        section: of a finger that is given by its section, no drawing.
    """
    listed, foreign = {tier.solver for tier in TIERS} | {"default"}, _OF_DRAWINGS if section else _OF_SECTIONS
    others = tuple(Tier(name=name, solver=name) for name in SOLVERS if name not in listed)
    every = [tier for tier in TIERS + others if tier.solver not in foreign]
    if section:  # of ten thousand and more unknowns, a second for a step: of the solids the smallest alone
        every = [tier for tier in every if tier.solver != "solid" or tier.mesh == "coarse"]
        every = [replace(tier, slow=tier.solver in ("solid", "plane")) for tier in every]
    return tuple(tier for tier in every if slow or not tier.slow)


@dataclass(frozen=True, kw_only=True, eq=False)
class Run:
    """What a tier made of one press.

    Attributes:
        press: that it was given.
        force: (n, 3) [N], NaN where it gave none that may be trusted.
        seconds: of the steps that gave a force (m,).
        cpu: the processor time of the same steps (m,) [s], from which other processes on the machine take nothing.
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
    """Runs one estimator over presses, each from the start; what compiles is compiled before.

    Args:
        tier: the way to solve.
        jaw: the finger.
        presses: what it is given.
        progress: called after each press.

    Raises:
        FinforceError: The tier does not exist, or cannot describe the jaw.
    """
    estimator = JawEstimator(jaw, settings=tier.settings())
    estimator.warm_up()
    _run_press(tier, estimator, presses[0], _WARM_UP_FRAMES)
    runs = []
    for press in presses:
        runs.append(_run_press(tier, estimator, press))
        progress()
    return runs


def _run_press(tier: Tier, estimator: JawEstimator, press: ReplayedPress, frames: int | None = None) -> Run:
    """Returns what an estimator that starts anew makes of the first frames of a press."""
    estimator.reset()
    force = np.full(press.force.shape, np.nan)
    seconds, cpu = [], []
    contacts = press.contacts(tier.contact)
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


@dataclass(frozen=True, kw_only=True)
class Accuracy:
    """Errors of the force's magnitude over presses, all [N] but `lost`.

    Attributes:
        rmse: over the last second of every level.
        bias: mean there.
        worst: largest there.
        lost: share of the frames there without a trusted force; they are in no error.
        moving: root mean square over the loaded frames between the levels.
        by_case: name -> `rmse` of one case.
    """

    rmse: float
    bias: float
    worst: float
    lost: float
    moving: float
    by_case: dict[str, float]


@dataclass(frozen=True, kw_only=True)
class ShapeErrors:
    """Errors at the end of each level, noise-free: one number per shape, all [N] but counts and factors.

    Attributes:
        n: shapes.
        solved: of them with a trusted force; the others are in no error.
        rmse: as estimated, nothing fitted.
        one_factor: after the one factor on all estimates that is best afterwards.
        factor_per_height: after the best factor for each height.
        factor: that one factor.
        by_height: "lower", "middle", "upper" -> `rmse`.
    """

    n: int
    solved: int
    rmse: float
    one_factor: float
    factor_per_height: float
    factor: float
    by_height: dict[str, float]


# Below this force [N] a moving frame is not one of a press.
_LOADED = 0.1


def score_runs(runs: Sequence[Run]) -> Accuracy:
    """Returns the errors of a tier's runs."""
    held = np.concatenate([run.errors[run.press.held] for run in runs])
    moving = np.concatenate([run.errors[_is_moving(run)] for run in runs])
    return Accuracy(
        rmse=rms(held),
        bias=_or_nan(np.nanmean, held),
        worst=_or_nan(np.nanmax, np.abs(held)),
        lost=float(np.isnan(held).mean()),
        moving=rms(moving),
        by_case={run.press.case.name: rms(run.errors[run.press.held]) for run in runs},
    )


def score_shapes(runs: Sequence[Run]) -> ShapeErrors:
    """Returns the errors at the end of each level of noise-free runs."""
    estimated = np.concatenate([np.linalg.norm(run.force[run.press.ends], axis=1) for run in runs])
    true = np.concatenate([np.linalg.norm(run.press.force[run.press.ends], axis=1) for run in runs])
    heights = np.concatenate([[run.press.case.height_name] * len(run.press.ends) for run in runs])
    factor = _best_factor(estimated, true)
    names = [name for name in ("lower", "middle", "upper") if (heights == name).any()]
    factors = {name: _best_factor(estimated[heights == name], true[heights == name]) for name in names}
    scaled = estimated * np.array([factors[height] for height in heights])
    return ShapeErrors(
        n=len(true),
        solved=int(np.isfinite(estimated).sum()),
        rmse=rms(estimated - true),
        one_factor=rms(factor * estimated - true),
        factor_per_height=rms(scaled - true),
        factor=factor,
        by_height={name: rms((estimated - true)[heights == name]) for name in names},
    )


def _is_moving(run: Run) -> NDArray:
    """Returns the frames (n,) of a press that are loaded and not held."""
    return ~run.press.held & (np.linalg.norm(run.press.force, axis=1) > _LOADED)


def _best_factor(estimated: NDArray, true: NDArray) -> float:
    """Returns the factor on the estimates with the least squared error."""
    known = np.isfinite(estimated)
    return float(true[known] @ estimated[known] / max(estimated[known] @ estimated[known], 1e-300))


def _or_nan(statistic, values: NDArray) -> float:
    return float(statistic(values)) if np.isfinite(values).any() else float("nan")
