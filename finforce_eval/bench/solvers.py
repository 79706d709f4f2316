"""Run time against force error of every solver tier: nine presses of an independent program, one thread, one run."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from time import thread_time
from typing import Any

import numpy as np
from numpy.typing import NDArray

from finforce.errors import FinforceError
from finforce_eval.bench.bench import Row, row_from_times, time_calls
from finforce_eval.bench.camera import NoisyCamera
from finforce_eval.bench.cases import ReplayedPress, bench_finger, load_cases, record_press
from finforce_eval.bench.process import Start, measure_start
from finforce_eval.bench.recordings import RecordedFigures, find_recordings, measure_recordings
from finforce_eval.bench.scores import Accuracy, ShapeErrors, score_runs, score_shapes
from finforce_eval.bench.tiers import Tier, list_tiers, run_tier
from finforce_eval.figures.time_error import ErrorPoint, find_front
from finforce_ifea.fem.solid import SolidModel
from finforce_ifea.jaw.jaw import load_jaw

SEED = 1
FACTORISATIONS = 20
# A tier that leaves more than this share of the scored frames unanswered is on no front.
MOST_LOST = 0.01
# Quoted, NOTES on the peer: SOFA v25.06 with SoftRobots.Inverse on the same 522 vertices and 45 shapes.
SOFA = {"step_ms": 3.9, "yardstick_ms": 3.0, "rmse_N": 20.9, "one_factor_N": 1.01, "factor_per_height_N": 0.74}
# Quoted, Zuo, Yang, Chua, RA-L 2026: the rate of the whole loop, and the RMSE range of Tables I and II.
PAPER = {"rate_Hz": 40.0, "least_N": 0.20, "largest_N": 1.21}


@dataclass(frozen=True, kw_only=True)
class TierFigures:
    """What was measured of one tier.

    Attributes:
        tier: the way to solve.
        exact: errors with noise-free key points.
        noisy: errors with those of the bench's camera.
        shapes: errors at the 45 noise-free shapes.
        step_exact: time per step with noise-free key points [ms].
        step: time per step with noisy ones [ms].
        cpu: processor time of the same steps [ms].
        yardstick: processor time of SuperLU on the whole jaw's stiffness matrix, 522 vertices, around these steps [ms].
        start: memory and set-up of a fresh process; None where another tier has the same.
    """

    tier: Tier
    exact: Accuracy
    noisy: Accuracy
    shapes: ShapeErrors
    step_exact: Row
    step: Row
    cpu: Row
    yardstick: Row
    start: Start | None


@dataclass(frozen=True, kw_only=True)
class SolverFigures:
    """Everything of one run.

    Attributes:
        tiers: as far as they exist.
        recorded: the tiers over recordings; empty without a folder.
        notes: what was not measured, and why.
    """

    tiers: Sequence[TierFigures]
    recorded: Sequence[RecordedFigures] = ()
    notes: Sequence[str] = field(default_factory=tuple)


def measure(quick: bool, folder: Path | str | None = None) -> SolverFigures:
    """Measures every tier, under a progress bar.

    Args:
        quick: three cases instead of nine, and no slow tier.
        folder: recordings to be taken, too; None for none.

    Raises:
        FinforceError: The folder holds no recordings, or one that cannot be used.
    """
    from tqdm import tqdm

    tiers, cases = list_tiers(slow=not quick), load_cases()
    cases = [case for case in cases if case.name.startswith("Ø25")] if quick else cases
    jaw = bench_finger()
    exact = [record_press(case, jaw) for case in cases]
    noisy = [record_press(case, jaw, NoisyCamera(), SEED) for case in cases]
    recordings = len(find_recordings(folder)) if folder else 0
    total, figures, notes = len(tiers) * (2 * len(cases) + recordings), [], []
    with tqdm(total=total, unit="press", disable=None, leave=False) as bar:
        for tier in tiers:
            bar.set_description(tier.name)
            try:
                figures.append(_measure_tier(tier, exact, noisy, bar.update))
            except FinforceError as error:
                notes.append(f"{tier.name}: not measured: {error}")
        recorded = measure_recordings(folder, tiers, lambda _: bar.update()) if folder else ()
    return SolverFigures(tiers=figures, recorded=recorded, notes=notes)


def _measure_tier(
    tier: Tier, exact: Sequence[ReplayedPress], noisy: Sequence[ReplayedPress], progress: Callable[[], object]
) -> TierFigures:
    jaw = bench_finger()
    yardstick = measure_factorisation()
    without = run_tier(tier, jaw, exact, progress)
    with_noise = run_tier(tier, jaw, noisy, progress)
    yardstick += measure_factorisation()
    return TierFigures(
        tier=tier,
        exact=score_runs(without),
        noisy=score_runs(with_noise),
        shapes=score_shapes(without),
        step_exact=_row(tier, [run.seconds for run in without]),
        step=_row(tier, [run.seconds for run in with_noise]),
        cpu=_row(tier, [run.cpu for run in with_noise]),
        yardstick=row_from_times(tier.name, yardstick),
        start=measure_start(tier.solver, tier.mesh) if tier.contact == "height" else None,
    )


def _row(tier: Tier, times: Sequence[NDArray]) -> Row:
    return row_from_times(tier.name, np.concatenate(times))


def measure_factorisation(mesh: str = "coarse") -> list[float]:
    """Returns the processor times [s] of a SuperLU factorisation of the whole jaw's stiffness matrix."""
    from scipy.sparse.linalg import splu

    jaw = load_jaw("bench")
    model = SolidModel(jaw.build_mesh(mesh), jaw.material, symmetric=False)
    stiffness = model.sparse_tangent(model.linearize(np.zeros(model.size)).tangent).tocsc()
    options = {"permc_spec": "MMD_AT_PLUS_A", "diag_pivot_thresh": 0.0, "options": {"SymmetricMode": True}}
    return time_calls(lambda: splu(stiffness, **options), FACTORISATIONS, clock=thread_time)


def compare_with_sofa(tier: TierFigures) -> dict[str, float]:
    """Returns how much faster and more exact than SOFA, as quoted, a tier is.

    The rate is taken as measured, and with SOFA's step scaled to this machine by the two yardsticks, in processor time.
    """
    scale = tier.yardstick.p50 / SOFA["yardstick_ms"]
    return {
        "rate": SOFA["step_ms"] / tier.step.p50,
        "rate_by_yardstick": scale * SOFA["step_ms"] / tier.cpu.p50,
        "error_share": tier.shapes.rmse / SOFA["factor_per_height_N"],
    }


def mean_yardstick(figures: SolverFigures) -> float:
    """Returns the median of the tiers' median yardsticks [ms]; NaN without tiers."""
    return float(np.median([tier.yardstick.p50 for tier in figures.tiers])) if figures.tiers else float("nan")


def as_json(figures: SolverFigures) -> dict[str, Any]:
    """Returns the figures as plain values, with what is quoted."""
    from finforce_eval.bench.tables import format_tables

    fronts = {kind: [point.text for point in front] for kind, front in find_fronts(figures).items()}
    return {
        "yardstick_ms": mean_yardstick(figures),
        "tiers": [{**asdict(tier), "sofa": compare_with_sofa(tier)} for tier in figures.tiers],
        "fronts": fronts,
        "recorded": [asdict(row) for row in figures.recorded],
        "tables": dict(format_tables(figures)),
        "notes": list(figures.notes),
        "quoted": {"sofa": SOFA, "paper": PAPER},
    }


def front_points(figures: SolverFigures) -> dict[str, list[ErrorPoint]]:
    """Returns a point for every tier, noise-free ("exact") and noisy."""
    return {
        "exact": [_point(tier, tier.step_exact, tier.exact) for tier in figures.tiers],
        "noisy": [_point(tier, tier.step, tier.noisy) for tier in figures.tiers],
    }


def _point(tier: TierFigures, step: Row, accuracy: Accuracy) -> ErrorPoint:
    return ErrorPoint(text=tier.tier.name, time=step.p50, slow=step.p99, error=accuracy.rmse)


def is_complete(accuracy: Accuracy) -> bool:
    """Whether a tier answers so often that its error can be compared; one that gives up where it is hard cannot."""
    return accuracy.lost <= MOST_LOST


def find_fronts(figures: SolverFigures) -> dict[str, list[ErrorPoint]]:
    """Returns the Pareto fronts of noise-free and noisy key points, of tiers that answer."""
    fronts = {}
    for kind, points in front_points(figures).items():
        whole = [is_complete(getattr(tier, kind)) for tier in figures.tiers]
        fronts[kind] = find_front([point for point, complete in zip(points, whole, strict=True) if complete])
    return fronts


def format_table(figures: SolverFigures) -> str:
    """Returns times, errors, memory and set-up of every tier as tables in Markdown."""
    from finforce_eval.bench.tables import format_tables

    return "\n\n".join([*format_tables(figures).values(), *figures.notes])


def draw(figures: SolverFigures, path: Path | str) -> None:
    """Draws run time against force error, with the front, and writes it."""
    from finforce_eval.bench.pareto import draw_pareto

    draw_pareto(figures).savefig(path)
