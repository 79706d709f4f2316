"""Run time against force error of every solver tier: nine presses of an independent program, one thread, one run."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from time import thread_time
from typing import Any

import numpy as np
from numpy.typing import NDArray

from finforce.errors import FinforceError
from finforce_eval.evaluation.tables import align_rows
from finforce_eval.figures.figures import BLACK, BLUE, GREEN, GREY, ORANGE, new_figure, style_axes
from finforce_eval.figures.time_error import ErrorPoint, find_front
from finforce_ifea.fem.solid import SolidModel
from finforce_ifea.jaw.jaw import Jaw, load_jaw
from lab.bench.bench import Row, row_from_times, time_calls
from lab.bench.cases import (
    DIAMETERS,
    BenchCase,
    NoisyCamera,
    ReplayedPress,
    bench_finger,
    load_cases,
    press_cases,
    record_press,
)
from lab.bench.process import Start, measure_start
from lab.bench.recordings import RecordedFigures, find_recordings, measure_recordings
from lab.bench.tiers import Accuracy, ShapeErrors, Tier, list_tiers, run_tier, score_runs, score_shapes

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


def measure(quick: bool, folder: Path | str | None = None, jaw: str = "bench") -> SolverFigures:
    """Measures every tier, under a progress bar.

    Args:
        quick: three cases instead of nine, and no slow tier.
        folder: recordings to be taken, too; None for none.
        jaw: the finger; another one than that of the bench is pressed by its own solid model.

    Raises:
        FinforceError: The jaw cannot be used, the folder holds no recordings, or one that cannot be used.
    """
    from tqdm import tqdm

    name, jaw = jaw, bench_finger() if jaw == "bench" else load_jaw(jaw)
    tiers, cases = list_tiers(slow=not quick, section=jaw.section is not None), _find_cases(name, jaw, quick)
    exact = [record_press(case, jaw) for case in cases]
    noisy = [record_press(case, jaw, NoisyCamera(), SEED) for case in cases]
    recordings = len(find_recordings(folder)) if folder else 0
    total, figures, notes = len(tiers) * (2 * len(cases) + recordings), [], []
    with tqdm(total=total, unit="press", disable=None, leave=False) as bar:
        for tier in tiers:
            bar.set_description(tier.name)
            try:
                figures.append(_measure_tier(tier, (name, jaw), exact, noisy, bar.update))
            except FinforceError as error:
                notes.append(f"{tier.name}: not measured: {error}")
        recorded = measure_recordings(folder, tiers, lambda _: bar.update()) if folder else ()
    return SolverFigures(tiers=figures, recorded=recorded, notes=notes)


def _find_cases(name: str, jaw: Jaw, quick: bool) -> Sequence[BenchCase]:
    """Returns the presses of a jaw: of the bench's those of an independent program, else of its own solid model.

    Raises:
        FinforceError: No solid describes the jaw, or it bears no press.
    """
    if name == "bench":
        return [case for case in load_cases() if case.name.startswith("Ø25") or not quick]
    if jaw.drawing is not None and not jaw.drawing.is_solid:
        raise FinforceError(f"--jaw {name}: only the frame describes it, expected a finger with a solid model")
    cases = press_cases(jaw, DIAMETERS[1:2] if quick else DIAMETERS)
    if not cases:
        raise FinforceError(f"--jaw {name}: none of the presses finds an equilibrium")
    return cases


def _measure_tier(
    tier: Tier,
    named: tuple[str, Jaw],
    exact: Sequence[ReplayedPress],
    noisy: Sequence[ReplayedPress],
    progress: Callable[[], object],
) -> TierFigures:
    name, jaw = named
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
        start=measure_start(tier.solver, tier.mesh, name) if tier.contact == "height" else None,
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
    return "\n\n".join([*format_tables(figures).values(), *figures.notes])


def draw(figures: SolverFigures, path: Path | str) -> None:
    """Draws run time against force error, with the front, and writes it."""
    draw_pareto(figures).savefig(path)


def format_tables(figures: SolverFigures) -> Mapping[str, str]:
    """Returns the tables by name: "tiers", "cases", "peer" and, where there are recordings, "recorded"."""
    tables = {"tiers": _tiers(figures.tiers), "cases": _cases(figures.tiers), "peer": _peer(figures.tiers)}
    return {**tables, "recorded": _recorded(figures.recorded)} if figures.recorded else tables


def _tiers(tiers: Sequence[TierFigures]) -> str:
    head = ("tier", "p50/ms", "p99", "CPU p50", "CPU p99", "SuperLU/ms", "noise-free/N", "unanswered", "noisy/N",
            "unanswered", "memory/MB", "set-up/s", "anew/s")  # fmt: skip
    rows = []
    for tier in tiers:
        times = (tier.step.p50, tier.step.p99, tier.cpu.p50, tier.cpu.p99)
        row = [tier.tier.name, *(f"{time:.3f}" for time in times), f"{tier.yardstick.p50:.1f}"]
        for accuracy in (tier.exact, tier.noisy):
            row += [f"{accuracy.rmse:.3f}", f"{accuracy.lost:.1%}"]
        rows.append(row + _start_cells(tier))
    return align_rows(head, rows)


def _start_cells(tier: TierFigures) -> list[str]:
    """Returns memory and set-up of a process; empty cells where another tier has the same."""
    start = tier.start
    if start is None:
        return [""] * 3
    anew = "" if start.build_uncached is None else f"{start.build_uncached:.1f}"
    return [f"{start.memory:.0f}", f"{start.imports + start.build:.2f}", anew]


def _cases(tiers: Sequence[TierFigures]) -> str:
    """Returns the RMSE of every case, noise-free and noisy."""
    names = list(tiers[0].exact.by_case) if tiers else []
    rows = [
        [tier.tier.name, *(f"{tier.exact.by_case[name]:.2f} / {tier.noisy.by_case[name]:.2f}" for name in names)]
        for tier in tiers
    ]
    return align_rows(("noise-free / noisy, N", *names), rows)


def _peer(tiers: Sequence[TierFigures]) -> str:
    """Returns the errors at the held shapes beside those that are quoted of the peer."""
    heights = ("lower", "middle", "upper")
    head = ("noise-free shapes", "shapes", "solved", "nothing fitted/N", *heights, "one factor/N",
            "a factor per height/N", "rate, times SOFA's", "by the yardstick", "share of SOFA's error")  # fmt: skip
    rows = []
    for tier in tiers:
        shapes, compared = tier.shapes, compare_with_sofa(tier)
        row = [tier.tier.name, str(shapes.n), str(shapes.solved), f"{shapes.rmse:.3f}"]
        row += [f"{shapes.by_height[name]:.3f}" if name in shapes.by_height else "" for name in heights]
        row += [f"{shapes.one_factor:.3f}", f"{shapes.factor_per_height:.3f}"]
        rates = (compared["rate"], compared["rate_by_yardstick"])
        rows.append(row + [*(f"{rate:.1f}" for rate in rates), f"{compared['error_share']:.0%}"])
    quoted = [f"{SOFA['rmse_N']:g}", "", "", "", f"{SOFA['one_factor_N']:g}", f"{SOFA['factor_per_height_N']:g}"]
    return align_rows(head, [*rows, ["SOFA, quoted", "45", "45", *quoted, "1", "1", "100%"]])


def _recorded(recorded: Sequence[RecordedFigures]) -> str:
    head = ("recordings", "p50/ms", "p99", "RMSE/N", "bias/N", "unanswered", "not solved at all")
    rows = [
        [row.tier, f"{row.p50:.3f}", f"{row.p99:.3f}", f"{row.rmse:.3f}", f"{row.bias:+.3f}", f"{row.lost:.1%}",
         str(len(row.unsolved))]
        for row in recorded
    ]  # fmt: skip
    return align_rows(head, rows)


_STYLES = {"exact": (BLUE, "o", "noise-free key points"), "noisy": (ORANGE, "s", "noisy key points")}


def draw_pareto(figures: SolverFigures) -> Any:
    """Returns the figure: milliseconds per step against RMSE, both logarithmic, p99 as a whisker."""
    figure = new_figure(10.5, 6.2)
    axes = figure.subplots()
    style_axes(axes)
    axes.set(xscale="log", yscale="log", xlabel="time per step, one thread [ms]", ylabel="RMSE of the force [N]")
    points, fronts = front_points(figures), find_fronts(figures)
    for kind, (colour, marker, label) in _STYLES.items():
        for tier, point in zip(figures.tiers, points[kind], strict=True):
            face = colour if is_complete(getattr(tier, kind)) else "white"
            axes.plot([point.time, point.slow], [point.error] * 2, color=colour, linewidth=0.8, alpha=0.6)
            axes.plot(point.time, point.error, marker, color=colour, markerfacecolor=face, markersize=6)
        axes.plot([], [], marker, color=colour, linestyle="none", label=label)
        steps = [(point.time, point.error) for point in fronts[kind]]
        if steps:
            axes.step(*zip(*steps, strict=True), where="post", color=colour, linewidth=4, alpha=0.25, zorder=0)
    for tier, exact, noisy in zip(figures.tiers, points["exact"], points["noisy"], strict=True):
        axes.plot([exact.time, noisy.time], [exact.error, noisy.error], color=GREY, linewidth=0.6, zorder=1)
        # the tiers with an outline lie beside those without: one kind is named above its points, the other below
        is_above = tier.tier.contact == "height"
        place = (max if is_above else min)((exact, noisy), key=lambda point: point.error)
        style = {"textcoords": "offset points", "fontsize": 8, "color": BLACK if is_above else GREY}
        axes.annotate(tier.tier.name, (place.time, place.error), (4, 6) if is_above else (4, -12), **style)
    _draw_quoted(axes, figures)
    axes.set_title("Run time against force error: nine presses of an independent program", loc="left", fontsize=11)
    axes.plot([], [], "D", color=GREY, markerfacecolor="white", linestyle="none",
              label="hollow: leaves more than 1 % of the frames unanswered, on no front")  # fmt: skip
    figure.legend(loc="outside lower center", ncols=2, frameon=False, fontsize=9)
    return figure


def _draw_quoted(axes: Any, figures: SolverFigures) -> None:
    """Marks what others state: SOFA as quoted and scaled to this machine, the paper's rate and range of errors."""
    error, step = SOFA["factor_per_height_N"], SOFA["step_ms"]
    here = step * mean_yardstick(figures) / SOFA["yardstick_ms"]
    axes.plot(step, error, "*", color=GREEN, markersize=13, linestyle="none",
              label=f"SOFA, quoted: {step:g} ms, {error:g} N after one factor per height")  # fmt: skip
    axes.plot(here, error, "*", markeredgecolor=GREEN, color="white", markersize=13, linestyle="none",
              label=f"SOFA, its time scaled by the yardstick: {here:.1f} ms")  # fmt: skip
    period = 1e3 / PAPER["rate_Hz"]
    low, high = PAPER["least_N"], PAPER["largest_N"]
    axes.plot([period, period], [low, high], color=BLACK, linewidth=2.5, solid_capstyle="butt",
              label=f"the paper, quoted: {PAPER['rate_Hz']:g} Hz, {low:g} to {high:g} N on its own finger")  # fmt: skip
