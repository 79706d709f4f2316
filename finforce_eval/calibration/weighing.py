"""The stiffness of a finger from a kitchen scale: held forces against the readings of the scale, in their order.

For a given shape the force is proportional to the modulus; one factor is all that a scale can tell. Shape, relaxation
and clamp stay as they were.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from finforce_eval.errors import RecordingError
from finforce_ifea.errors import CalibrationError
from finforce_ifea.jaw.calibration import WORST_MISFIT, Calibration, load_calibration, name_mechanics
from finforce_ifea.jaw.jaw import Jaw, load_jaw

GRAVITY = 9.80665  # [m/s^2] by which kitchen scales turn weight into grams
LEAST_HOLD = 1.5  # [s]
SHORT_HOLD = 0.5  # [s] from which a steady force is mentioned that is too short to count
LEAST_FORCE = 0.1  # [N]; below it a hold is not told from rest
_WINDOW = 1.0  # [s] of the end of a hold, when the scale is read
# Largest drift in one window of a hold: relaxation is slower, pressing is faster.
_DRIFT = 0.04  # [-], of the force
_DRIFT_FLOOR = 0.02  # [N]
_NOISE_SIGMAS = 3.0  # standard errors of the drift by which noise may exceed that
_SCALE_ERROR = 0.02  # [N]: two grams
_RELATIVE_ERROR = 0.02  # of one reading, by the height at which it was pressed
_FEWEST_SHIFTED = 3  # readings by which a shift of all of them, or a constant in all of them, is told
_FORCE_ERRORS = 0.005, 0.5  # [-] least and largest relative deviation of forces that a weighing can leave


@dataclass(frozen=True, kw_only=True)
class Hold:
    """A force that was held steady.

    Attributes:
        start: [s] since the first image.
        end: [s] likewise.
        force: estimated component along the closing direction, mean of the last second [N].
    """

    start: float
    end: float
    force: float


@dataclass(frozen=True, kw_only=True, eq=False)
class Weighing:
    """Estimated forces against a scale.

    Attributes:
        factor: by which the modulus has to be multiplied [-].
        stddev: of the factor [-].
        holds: the weights held, in order of time.
        weights: readings of the scale [N].
        misfit: root mean square of what is left, relative to each weight [-].
    """

    factor: float
    stddev: float
    holds: tuple[Hold, ...]
    weights: NDArray[np.float64]
    misfit: float


def find_holds(times: NDArray[np.float64], pressing: NDArray[np.float64], shortest: float = LEAST_HOLD) -> list[Hold]:
    """Return where a force was held steady for long enough to read a scale, in time.

    Args:
        times: (n,) [s], rising.
        pressing: (n,) [N], NaN where unknown.
        shortest: duration of a hold [s].
    """
    known = np.isfinite(pressing)
    times, pressing = times[known], pressing[known]
    before = np.searchsorted(times, times - 0.5 * _WINDOW)
    after = np.searchsorted(times, times + 0.5 * _WINDOW, side="right")
    steady = np.zeros(len(times), dtype=bool)
    for index, (low, high) in enumerate(zip(before, after, strict=True)):
        half = (low + high) // 2
        if half - low < 2 or high - half < 2:
            continue
        level, later, earlier = np.median(pressing[low:high]), pressing[half:high], pressing[low:half]
        drift = abs(np.median(later) - np.median(earlier))
        noise = (later[: half - low] - earlier[: high - half]).std() / np.sqrt(half - low)
        largest = 0.5 * (_DRIFT * level + _DRIFT_FLOOR) + _NOISE_SIGMAS * noise
        steady[index] = level > LEAST_FORCE and drift < largest
    edges = np.flatnonzero(np.diff(np.r_[False, steady, False].astype(int)))
    spans = [(start, end - 1) for start, end in zip(edges[::2], edges[1::2], strict=True)]
    return [
        Hold(start=float(times[a]), end=float(times[b]), force=_last(times[a : b + 1], pressing[a : b + 1]))
        for a, b in spans
        if times[b] - times[a] >= shortest
    ]


def _last(times: NDArray, pressing: NDArray) -> float:
    """Return the mean of the last second of a hold [N]."""
    return float(pressing[times >= times[-1] - _WINDOW].mean())


def calibrate_with_scale(
    times: ArrayLike,
    forces: ArrayLike,
    grams: Sequence[float],
    *,
    jaw: Jaw | str | Path,
    calibration: Calibration | str | Path | None = None,
    solver: str = "default",
    force: bool = False,
) -> Calibration:
    """Return the calibration of a finger from readings of a kitchen scale, one at the end of each steady press.

    Args:
        times: (n,) of the images [s], rising.
        forces: (n,) estimated along the closing direction [N], either sign, or vectors (n, 3); NaN where unknown.
        grams: reading of the zeroed scale at the end of each press [g], in order.
        jaw: jaw, jaw file or name of the jaw that the forces were estimated with.
        calibration: calibration that they were estimated with; None for the material of the jaw file.
        solver: solver that they were estimated with.
        force: True to accept a modulus that the material of the jaw file cannot have.

    Raises:
        RecordingError: the numbers of presses and readings differ, or the readings do not fit the presses.
        CalibrationError: the material of the jaw file cannot have the modulus found.
    """
    jaw, forces = load_jaw(jaw), np.asarray(forces, dtype=float)
    holds = find_holds(np.asarray(times, dtype=float), np.abs(forces if forces.ndim == 1 else forces[:, 0]))
    base = None if calibration is None else load_calibration(calibration)
    return scale_calibration(weigh(holds, grams), jaw, base, solver=solver, force=force)


def scale_calibration(
    weighing: Weighing, jaw: Jaw, base: Calibration | None, *, solver: str = "default", force: bool = False
) -> Calibration:
    """Return the calibration that forces were estimated with, scaled by a weighing; see `calibrate_with_scale`."""
    base = base or Calibration(young_modulus=jaw.material.young_modulus, jaw=jaw.name, finger=jaw.digest)
    scaled = base.changed(
        solver=name_mechanics(jaw, solver),
        young_modulus=base.young_modulus * weighing.factor,
        force_error=float(np.clip(max(weighing.misfit, base.force_error), *_FORCE_ERRORS)),
    )
    if not force:
        try:
            scaled.check_plausible(jaw)
        except CalibrationError as error:
            raise CalibrationError(f"{error}{_suspect_unit(scaled, weighing, jaw)}") from None
    stddev = scaled.young_modulus * weighing.stddev / weighing.factor
    return scaled.changed(uncertainty={"young_modulus": stddev})


def _suspect_unit(scaled: Calibration, weighing: Weighing, jaw: Jaw) -> str:
    """Return a hint where the readings make sense in another unit."""
    for unit, grams in {"newtons": 1e3 / GRAVITY, "kilograms": 1e3, "ounces": 28.35}.items():
        try:
            scaled.changed(young_modulus=scaled.young_modulus * grams).check_plausible(jaw)
        except CalibrationError:
            continue
        readings = " ".join(f"{grams * weight * 1e3 / GRAVITY:.0f}" for weight in weighing.weights)
        return f"; the readings look like {unit}, in grams they are {readings}"
    return ""


def weigh(holds: Sequence[Hold], grams: Sequence[float], name: str = "the recording") -> Weighing:
    """Return the factor that brings the holds to the readings: weighted least squares of m g = factor F.

    Args:
        holds: found in the recordings, in time.
        grams: read off the scale at the end of each hold, the scale at zero before; the same number.
        name: of the recording, for messages.

    Raises:
        RecordingError: the numbers of holds and readings differ, or the readings do not fit the holds.
    """
    weights = np.asarray(grams, dtype=float) * 1e-3 * GRAVITY
    if not len(weights) or not np.isfinite(weights).all() or (weights <= 0.0).any():
        raise RecordingError(
            f"{name}: readings {np.asarray(grams).tolist()}: expected grams above zero, one for each hold"
        )
    if len(weights) != len(holds):
        counts = f"{len(weights)} readings for {len(holds)} holds"
        counts += " (decimal points, not commas?)" if len(weights) == 2 * len(holds) > 2 else ""
        raise RecordingError(f"{name}: {counts}; holds found: {list_holds(holds)}")
    weighing = _fit_factor(tuple(holds), weights)
    hint = _suspect_offset(weighing)
    if hint or weighing.misfit > WORST_MISFIT:
        left = f"{100 * weighing.misfit:.0f} % of a reading left over"
        left += f", expected at most {100 * WORST_MISFIT:.0f} %" if weighing.misfit > WORST_MISFIT else ""
        hint = _suspect_shift(weighing) or hint
        raise RecordingError(
            f"{name}: the readings do not fit the holds: {left}{hint}; holds found: {list_holds(holds)}"
        )
    return weighing


def list_holds(holds: Sequence[Hold]) -> str:
    """Return holds with their times and forces on one line."""
    return ", ".join(f"{hold.start:.1f}-{hold.end:.1f} s ({hold.force:.2f} N)" for hold in holds) or "none"


def _fit_factor(holds: tuple[Hold, ...], weights: NDArray[np.float64]) -> Weighing:
    """Return the least-squares factor of weights [N] over the forces of as many holds."""
    forces = np.array([hold.force for hold in holds])
    variance = _reading_variance(weights)
    information = float((forces**2 / variance).sum())
    factor = float((forces * weights / variance).sum() / information)
    misfit = float(np.sqrt(np.mean((1.0 - factor * forces / weights) ** 2)))
    spread = max(1.0, float(np.sqrt(np.mean((weights - factor * forces) ** 2 / variance))))
    return Weighing(factor=factor, stddev=spread / np.sqrt(information), holds=holds, weights=weights, misfit=misfit)


def _reading_variance(weights: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the variance of readings of a scale, of weights [N]."""
    return _SCALE_ERROR**2 + (_RELATIVE_ERROR * weights) ** 2


def _suspect_offset(weighing: Weighing) -> str:
    """Return a hint where a constant in all readings has changed the factor by more than readings may scatter."""
    forces, weights = np.array([hold.force for hold in weighing.holds]), weighing.weights
    if len(forces) < _FEWEST_SHIFTED or np.ptp(forces) < 0.5 * forces.max():  # these tell no constant
        return ""
    certainty = 1.0 / np.sqrt(_reading_variance(weights))
    (slope, offset), covariance = np.polyfit(forces, weights, 1, w=certainty, cov="unscaled")
    is_wrong = abs(slope / weighing.factor - 1.0) > WORST_MISFIT and abs(offset) > 3.0 * np.sqrt(covariance[1, 1])
    much = f"{1e3 * abs(offset) / GRAVITY:.0f} g too {'much' if offset > 0.0 else 'little'}"
    return f"; each seems to have {much}: was the scale at zero, is the contact height right?" if is_wrong else ""


def _suspect_shift(weighing: Weighing) -> str:
    """Return a hint where the readings fit the holds once they are shifted against them."""
    holds, weights, shifted = weighing.holds, weighing.weights, {}
    for shift in range(1, len(holds) - _FEWEST_SHIFTED + 1):
        missed = f"reading {1 + shift} fits hold 1: does reading 1 belong to a hold that was not found?"
        shifted[missed] = _fit_factor(holds[:-shift], weights[shift:]).misfit
        unread = f"reading 1 fits hold {1 + shift}: does a hold lack a reading?"
        shifted[unread] = _fit_factor(holds[shift:], weights[:-shift]).misfit
    best = min(shifted, key=shifted.__getitem__, default="")
    return f"; {best}" if best and shifted[best] < min(WORST_MISFIT, 0.5 * weighing.misfit) else ""


def format_weighing(weighing: Weighing) -> str:
    """Return the table of the holds, the factor and what is left."""
    lines = [f"{'hold [s]':>16} {'scale [N]':>10} {'estimate [N]':>13} {'after [N]':>10}"]
    for hold, weight in zip(weighing.holds, weighing.weights, strict=True):
        span = f"{hold.start:.1f} - {hold.end:.1f}"
        lines.append(f"{span:>16} {weight:10.3f} {hold.force:13.3f} {weighing.factor * hold.force:10.3f}")
    left = f"left over {100 * weighing.misfit:.1f} % of a reading"
    lines.append(f"modulus times {weighing.factor:.3f} ± {weighing.stddev:.3f}; {left}")
    return "\n".join(lines)
