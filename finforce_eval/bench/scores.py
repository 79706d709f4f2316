"""Forces of a tier against the truth of presses, as numbers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from finforce_eval.bench.tiers import Run


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


def rms(errors: NDArray) -> float:
    """Returns the root mean square of errors, those that are NaN left out; NaN when there are no others."""
    return float(np.sqrt(_or_nan(np.nanmean, np.square(errors))))


def _is_moving(run: Run) -> NDArray:
    """Returns the frames (n,) of a press that are loaded and not held."""
    return ~run.press.held & (np.linalg.norm(run.press.force, axis=1) > _LOADED)


def _best_factor(estimated: NDArray, true: NDArray) -> float:
    """Returns the factor on the estimates with the least squared error."""
    known = np.isfinite(estimated)
    return float(true[known] @ estimated[known] / max(estimated[known] @ estimated[known], 1e-300))


def _or_nan(statistic, values: NDArray) -> float:
    return float(statistic(values)) if np.isfinite(values).any() else float("nan")
