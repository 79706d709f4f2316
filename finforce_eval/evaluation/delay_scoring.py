"""How long a force takes from its true onset to a published estimate."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

ONSET = 0.02  # [N] of true force, from which on something presses
SHOWN = 0.10  # [N] of estimated force, from which on it shows
FREE = 5  # images without true force before an onset counts as one
WAITED = 1.0  # [s] after which a force that did not show is missed


@dataclass(frozen=True, kw_only=True)
class DelayStats:
    """Delays over the onsets of the true force; None without any.

    Attributes:
        n: onsets after which the estimate showed.
        missed: onsets after which it did not within a second.
        median_ms: from the true onset until the estimate is above 0.1 N and has been computed.
        max_ms: the largest of them.
        rise_ms: median of what the true force itself takes from its onset to 0.1 N.
    """

    n: int
    missed: int
    median_ms: float | None
    max_ms: float | None
    rise_ms: float | None


@dataclass(frozen=True, kw_only=True)
class Delay:
    """One onset: seconds until the estimate showed and until the true force reached as much; NaN if never."""

    shown: float
    risen: float


def onset_delays(
    times: NDArray[np.float64], truth: NDArray[np.float64], estimate: NDArray[np.float64], lag: NDArray[np.float64]
) -> list[Delay]:
    """Return the delay after each onset of the true force.

    The onset lies between two images, where the line through their true forces crosses 0.02 N.

    Args:
        times: (n,) of the images [s].
        truth: (n,) magnitude of the true force [N], NaN where it is not known.
        estimate: (n,) magnitude of the estimate [N], NaN where there is none.
        lag: (n,) from the image to the estimate [s]; NaN counts as none.
    """
    known = np.nan_to_num(truth)
    loaded = known > ONSET
    delays = []
    for index in np.flatnonzero(loaded[1:] & ~loaded[:-1]) + 1:
        if index < FREE or loaded[index - FREE : index].any():
            continue
        onset = _crossing(times, known, index, ONSET)
        later = slice(index, int(np.searchsorted(times, onset + WAITED)))
        shown = np.flatnonzero(np.nan_to_num(estimate[later]) > SHOWN)
        risen = np.flatnonzero(known[later] > SHOWN)
        row = index + int(shown[0]) if shown.size else None
        delays.append(
            Delay(
                shown=np.nan if row is None else times[row] + float(np.nan_to_num(lag[row])) - onset,
                risen=_crossing(times, known, index + int(risen[0]), SHOWN) - onset if risen.size else np.nan,
            )
        )
    return delays


def _crossing(times: NDArray[np.float64], values: NDArray[np.float64], index: int, level: float) -> float:
    """Return when values that are above a level at `index` and not before rose through it [s]."""
    before, after = values[index - 1], values[index]
    return float(times[index - 1] + (level - before) / (after - before) * (times[index] - times[index - 1]))


def delay_stats(delays: Sequence[Delay]) -> DelayStats:
    """Return the statistics of delays."""
    shown = 1e3 * np.array([delay.shown for delay in delays if np.isfinite(delay.shown)])
    risen = 1e3 * np.array([delay.risen for delay in delays if np.isfinite(delay.risen)])
    return DelayStats(
        n=shown.size,
        missed=len(delays) - shown.size,
        median_ms=float(np.median(shown)) if shown.size else None,
        max_ms=float(shown.max()) if shown.size else None,
        rise_ms=float(np.median(risen)) if risen.size else None,
    )
