"""What SOFA is quoted for beside its speed: white noise on every key point, and targets that no force reaches."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
from tqdm import tqdm

from finforce_eval.evaluation.tables import align_rows
from lab.bench.cases import LEVELS, ReplayedPress, bench_finger, load_cases, record_press
from lab.bench.tiers import TIERS, Run, Tier, run_tier

SEED = 1
NOISE = 0.2e-3  # [m] in every direction on every key point: that of SOFA's quoted errors
SCATTERS = (
    0.5e-3,
    1e-3,
    2e-3,
    5e-3,
)  # [m] per axis, of key points that no force can bring to where they are said to be
HEIGHTS = ("lower", "middle", "upper")


@dataclass(frozen=True, kw_only=True)
class NoiseErrors:
    """Mean errors over the held images, relative to the true force: along x, of all three axes; and the share lost."""

    height: str
    along_x: float
    in_3d: float
    lost: float


@dataclass(frozen=True, kw_only=True)
class Unreachable:
    """Share of images of unreachable targets with a trusted force, and by how much that jumps [N]."""

    scatter_mm: float
    answered: float
    largest_jump_N: float


@dataclass(frozen=True, kw_only=True)
class PeerFigures:
    """Everything of one run."""

    noise: Sequence[NoiseErrors]
    unreachable: Sequence[Unreachable]


def measure(quick: bool) -> PeerFigures:
    """Measures the default solver on nine presses with white noise, under a progress bar.

    Args:
        quick: three presses instead of nine.
    """
    tier = next(tier for tier in TIERS if tier.solver == "reduced")
    jaw = bench_finger()
    cases = [case for case in load_cases() if not quick or case.name.startswith("Ø25")]
    noisy = [_add_noise(record_press(case, jaw), SEED + number) for number, case in enumerate(cases)]
    with tqdm(total=(1 + len(SCATTERS)) * len(noisy), unit="press", disable=None, leave=False) as bar:
        runs = run_tier(tier, jaw, noisy, bar.update)
        unreachable = [_measure_unreachable(tier, noisy, scatter, bar.update) for scatter in SCATTERS]
    return PeerFigures(noise=[_score_noise(runs, name) for name in HEIGHTS], unreachable=unreachable)


def _add_noise(press: ReplayedPress, seed: int) -> ReplayedPress:
    """Returns a press with white noise on every key point, all of them seen."""
    random = np.random.default_rng(seed)
    seen = [
        replace(one, points=one.points + NOISE * random.standard_normal(one.points.shape)) for one in press.observations
    ]
    return replace(press, observations=seen)


def _score_noise(runs: Sequence[Run], height: str) -> NoiseErrors:
    runs = [run for run in runs if run.press.case.height_name == height]
    true = np.concatenate([run.press.force[run.press.held] for run in runs])
    wrong = np.concatenate([run.force[run.press.held] for run in runs]) - true
    return NoiseErrors(
        height=height,
        along_x=float(np.nanmean(np.abs(wrong[:, 0] / true[:, 0]))),
        in_3d=float(np.nanmean(np.linalg.norm(wrong, axis=1) / np.linalg.norm(true, axis=1))),
        lost=float(np.isnan(wrong[:, 0]).mean()),
    )


def _measure_unreachable(
    tier: Tier, noisy: Sequence[ReplayedPress], scatter: float, progress: Callable[[], object]
) -> Unreachable:
    presses = [scatter_targets(press, scatter, SEED + number) for number, press in enumerate(noisy)]
    forces = [run.force[run.press.held] for run in run_tier(tier, bench_finger(), presses, progress)]
    jumps = np.concatenate([np.linalg.norm(np.diff(force, axis=0), axis=1) for force in forces])
    return Unreachable(
        scatter_mm=1e3 * scatter,
        answered=float(np.isfinite(np.concatenate(forces)[:, 0]).mean()),
        largest_jump_N=float(np.nanmax(jumps, initial=0.0)),
    )


def scatter_targets(press: ReplayedPress, scatter: float, seed: int) -> ReplayedPress:
    """Returns a press whose key points stay, from the 4 mm level on, at places that no force can bring them to.

    Args:
        press: whose first seconds have the noise of a camera, which the tare learns.
        scatter: of those places about the right ones, along each axis [m].
        seed: of the places.
    """
    last = press.ends[LEVELS.index(0.004)]
    targets = press.observations[last].points
    targets = targets + scatter * np.random.default_rng(seed).standard_normal(targets.shape)
    held = np.arange(len(press.force)) > last
    seen = [replace(one, points=targets) if stays else one for one, stays in zip(press.observations, held, strict=True)]
    return replace(press, observations=seen, held=held)


def format_tables(figures: PeerFigures) -> dict[str, str]:
    """Returns the tables "noise" and "unreachable" in Markdown, with what is quoted of SOFA."""
    quoted = {"lower": ("13 %", "92 %"), "middle": ("3.2 %", "20 %"), "upper": ("2.1 %", "33 %")}
    noise = [
        [row.height, f"{row.along_x:.1%}", quoted[row.height][0], f"{row.in_3d:.1%}", quoted[row.height][1],
         f"{row.lost:.0%}"]
        for row in figures.noise
    ]  # fmt: skip
    unreachable = [
        [f"{row.scatter_mm:g}", f"{row.answered:.0%}", f"{row.largest_jump_N:.2f}" if row.answered else ""]
        for row in figures.unreachable
    ]
    return {
        "noise": align_rows(("contact", "F_x", "SOFA", "F in 3D", "SOFA", "unanswered"), noise),
        "unreachable": align_rows(("targets off by, mm", "answered", "largest jump, N"), unreachable),
    }


def format_table(figures: PeerFigures) -> str:
    """Returns both tables."""
    return "\n\n".join(format_tables(figures).values())


def as_json(figures: PeerFigures) -> dict[str, Any]:
    """Returns the figures as plain values, with their tables."""
    return {**asdict(figures), "tables": format_tables(figures)}
