"""Recordings with true forces cut into steady loads and their mean key points."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from finforce_ifea.errors import CalibrationError
from finforce_ifea.jaw.jaw import Jaw
from finforce_ifea.observation import Contact, Observation
from finforce_ifea.settings import EstimatorSettings
from finforce_ifea.tare import compute_tare
from finforce_ifea.tracking.keypoint_gate import KeypointGate

_UNLOADED = 0.01
_LEAST_FORCE = 0.15
_STEADY_SPAN = 10
_STEADY_CHANGE = 0.02
_LEAST_FRAMES = 20
_FARTHEST = 1.8e-3
INSTANTS = 5


@dataclass(frozen=True, kw_only=True, eq=False)
class CalibrationCase:
    """One recording with ground truth.

    Attributes:
        name: of the recording.
        observations: its key points, in order.
        contact: height of first touch.
        stamps_true: (n,) [s].
        forces_true: (n, 3) [N], jaw frame.
    """

    name: str
    observations: Sequence[Observation]
    contact: Contact
    stamps_true: NDArray
    forces_true: NDArray


@dataclass(frozen=True, kw_only=True, eq=False)
class Plateau:
    """A steady load.

    Attributes:
        case: number of the recording.
        keypoints: mean displacements (K, 2) along x and z [m], NaN where too seldom seen.
        variance: of each mean (K,) [m^2].
        instants: indices into the case's true forces, spread over the plateau.
        force: mean true magnitude [N].
    """

    case: int
    keypoints: NDArray
    variance: NDArray
    instants: NDArray
    force: float


def find_plateaus(
    cases: Sequence[CalibrationCase], jaw: Jaw, settings: EstimatorSettings, *, per_case: int
) -> list[Plateau]:
    """Returns at most `per_case` steady loads of each recording.

    Raises:
        CalibrationError: A recording has no unloaded start or no steady load.
    """
    plateaus = []
    for number, case in enumerate(cases):
        found = _plateaus_of_case(number, case, jaw, settings)
        chosen = np.unique(np.linspace(0, len(found) - 1, per_case).round().astype(int))
        plateaus += [found[i] for i in chosen]
    return plateaus


def _plateaus_of_case(number: int, case: CalibrationCase, jaw: Jaw, settings: EstimatorSettings) -> list[Plateau]:
    gate = KeypointGate(jaw, settings)
    stamps = np.array([observation.stamp for observation in case.observations])
    points = np.stack([gate.accept(observation) for observation in case.observations])
    magnitude = np.linalg.norm(case.forces_true, axis=1)
    at = np.searchsorted(case.stamps_true, stamps).clip(0, len(magnitude) - 1)
    force = magnitude[at]
    loaded = np.flatnonzero(force > _UNLOADED)
    start = loaded[0] if len(loaded) else len(force)
    tare = compute_tare(list(points[:start]), jaw.keypoints) if start >= settings.tare_frames // 2 else None
    if tare is None:
        raise CalibrationError(f"{case.name}: expected at least a second without load at the start, for the tare")
    rest = np.where(tare.counts[:, None] > 0, jaw.keypoints + tare.offsets, np.nan)
    found = []
    for first, last in _steady_runs(force):
        mean, count = _robust_mean(points[first:last] - rest)
        mean[count < 0.5 * (last - first)] = np.nan
        variance = np.trace(tare.noise) / 3.0 * (1.0 / np.maximum(count, 1) + 1.0 / np.maximum(tare.counts, 1))
        instants = at[np.linspace(first, last - 1, INSTANTS).round().astype(int)]
        found.append(
            Plateau(
                case=number,
                keypoints=mean[:, [0, 2]],
                variance=variance,
                instants=instants,
                force=float(force[first:last].mean()),
            )
        )
    if not found:
        raise CalibrationError(f"{case.name}: no load is held steady for {_LEAST_FRAMES} frames; hold each for seconds")
    return found


def _steady_runs(force: NDArray) -> list[tuple[int, int]]:
    """Returns the ranges of frames over which the force hardly changes."""
    later = np.r_[force[_STEADY_SPAN:], np.full(_STEADY_SPAN, force[-1])]
    steady = (np.abs(later - force) < _STEADY_CHANGE * np.maximum(force, 0.3) + 0.01) & (force > _LEAST_FORCE)
    edges = np.flatnonzero(np.diff(np.r_[0, steady.astype(int), 0]))
    return [(a, b) for a, b in edges.reshape(-1, 2) if b - a >= _LEAST_FRAMES]


def _robust_mean(samples: NDArray) -> tuple[NDArray, NDArray]:
    """Returns the mean (K, 3) of samples (n, K, 3) without gross errors, and the counts behind it (K,)."""
    samples = samples.copy()
    seen = np.isfinite(samples[..., 0]).any(0)
    middle = np.zeros(samples.shape[1:])
    middle[seen] = np.nanmedian(samples[:, seen], axis=0)
    samples[np.linalg.norm(samples - middle, axis=2) > _FARTHEST] = np.nan
    count = np.isfinite(samples[..., 0]).sum(0)
    mean = np.nansum(samples, axis=0) / np.maximum(count, 1)[:, None]
    return mean, count
