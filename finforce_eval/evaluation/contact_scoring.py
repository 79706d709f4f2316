"""How well the contact was known: place against pressure centre, touch against onset."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from finforce_eval.evaluation.results import CaseResult

# Below it the pressure centre hardly matters; from it on the object is in contact [N].
LEAST_FORCE, ONSET_FORCE = 0.2, 0.02
# A touch that is not there to stay within so many frames after the true begin is missed.
WATCHED = 30


@dataclass(frozen=True, kw_only=True)
class PlaceStats:
    """Distances of heights from the true pressure centre [mm]; None where there is nothing to compute from."""

    n: int
    median_mm: float | None
    p95_mm: float | None
    max_mm: float | None


@dataclass(frozen=True, kw_only=True)
class OnsetStats:
    """Frames from the true begin of contact to the `touching` that stays, over loading cycles; negative is early.

    Attributes:
        n: loading cycles in which both are known.
        missed: those in which `touching` did not come within a second.
        median_frames: their median.
        earliest_frames: the least of them.
        max_frames: the largest of them.
        false_pct: share of the frames without true force that were said to touch.
    """

    n: int
    missed: int
    median_frames: float | None
    earliest_frames: int | None
    max_frames: int | None
    false_pct: float | None


def place_stats(distances: NDArray[np.float64]) -> PlaceStats:
    """Return the statistics of distances (n,) [m]; NaN is not counted."""
    known = 1e3 * distances[np.isfinite(distances)]
    if not known.size:
        return PlaceStats(n=0, median_mm=None, p95_mm=None, max_mm=None)
    median, p95, largest = (float(value) for value in np.percentile(known, [50, 95, 100]))
    return PlaceStats(n=known.size, median_mm=median, p95_mm=p95, max_mm=largest)


def given_distance(result: CaseResult) -> NDArray[np.float64]:
    """Return how far from the pressure centre the contact was that each loaded image was solved with (n,) [m]."""
    return _loaded_distance(result, None if result.contact is None else result.contact.given)


def solved_distance(result: CaseResult) -> NDArray[np.float64]:
    """Return how far from the pressure centre the estimator's own place was on each loaded image (n,) [m]."""
    return _loaded_distance(result, result.place[:, 2])


def _loaded_distance(result: CaseResult, heights: NDArray[np.float64] | None) -> NDArray[np.float64]:
    """Return the distance of heights (n,) from the truth, NaN where it is unknown or hardly anything presses."""
    if result.contact is None or heights is None:
        return np.full(len(result.stamps), np.nan)
    return np.where(result.true_magnitude > LEAST_FORCE, np.abs(heights - result.contact.truth), np.nan)


def onset_delays(result: CaseResult) -> list[int | None]:
    """Return for each loading cycle the frames from first true force to the `touching` that stays; None if missed.

    A `touching` that was never let go since the cycle before is early by the whole pause.
    """
    if result.contact is None or result.contact.touching is None:
        return []
    loaded = _loaded(result)
    delays = []
    for cycle in np.unique(result.cycle):
        rows = np.flatnonzero(result.cycle == cycle)
        pressed = rows[loaded[rows]]
        if pressed.size and pressed[0] > 0 and not loaded[pressed[0] - 1]:
            delays.append(_delay(result.contact.touching, loaded, int(pressed[0]), int(rows[-1])))
    return delays


def _loaded(result: CaseResult) -> NDArray[np.bool_]:
    """Return on which frames (n,) something truly presses."""
    return np.nan_to_num(result.true_magnitude) > ONSET_FORCE


def _delay(touching: NDArray[np.bool_], loaded: NDArray[np.bool_], onset: int, last: int) -> int | None:
    """Return the frames from `onset` to the begin of the touch that holds a second later, or at the cycle's end."""
    before = np.flatnonzero(loaded[:onset])
    released = int(before[-1]) + 1 if before.size else 0
    pressed = np.flatnonzero(~loaded[onset : last + 1])
    end = min(onset + WATCHED, last, onset + int(pressed[0]) - 1 if pressed.size else last)
    apart = np.flatnonzero(~touching[released : end + 1])
    begin = released + int(apart[-1]) + 1 if apart.size else released
    return begin - onset if begin <= end else None


def _false_share(results: Sequence[CaseResult]) -> float | None:
    """Return the share [%] of frames without true force that were said to touch."""
    said = [
        r.contact.touching[~_loaded(r)] for r in results if r.contact is not None and r.contact.touching is not None
    ]
    frames = np.concatenate(said) if said else np.zeros(0)
    return 100.0 * float(frames.mean()) if frames.size else None


def onset_stats(results: Sequence[CaseResult]) -> OnsetStats:
    """Return the delays of all loading cycles of several cases."""
    delays = [delay for result in results for delay in onset_delays(result)]
    known = [delay for delay in delays if delay is not None]
    return OnsetStats(
        n=len(known),
        missed=len(delays) - len(known),
        median_frames=float(np.median(known)) if known else None,
        earliest_frames=min(known, default=None),
        max_frames=max(known, default=None),
        false_pct=_false_share(results),
    )
