"""How late forces were, and how well key points were seen."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from finforce_eval.errors import OptionError
from finforce_eval.recordings.tracks import DetectionTrack, DetectionTruth

TRUTH_VALUES = {"true": True, "yes": True, "1": True, "false": False, "no": False, "0": False}


def parse_changes(option: str, kind: str, texts: Sequence[str], defaults: Mapping[str, Any]) -> dict[str, Any]:
    """Return `NAME=VALUE` texts as values by name, each of the type of the default that it changes.

    Args:
        option: of the command line, for messages.
        kind: what a name is the name of, for messages.
        texts: as they were given.
        defaults: by name; a list takes its values with commas between.

    Raises:
        OptionError: a name is not known, or a value is not of its type.
    """
    changes = {}
    for text in texts:
        name, _, value = text.partition("=")
        if name not in defaults:
            raise OptionError(f"{option} {text}: unknown {kind}; expected one of {', '.join(defaults)}")
        changes[name] = _parse_value(f"{option} {text}", value, defaults[name])
    return changes


def _parse_value(given: str, text: str, default: Any) -> Any:
    """Return a text as a value of the type of a default."""
    if isinstance(default, tuple | list):
        kind = type(default[0]) if default else str
        return [_parse_value(given, part, kind()) for part in text.split(",")]
    try:
        return TRUTH_VALUES[text.lower()] if isinstance(default, bool) else type(default)(text)
    except (KeyError, ValueError):
        raise OptionError(f"{given}: '{text}' is no {type(default).__name__}") from None


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


def force_delays(
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


@dataclass(frozen=True, kw_only=True)
class DetectionStats:
    """How well the key points of a case, or of all cases together, were seen; None where nothing can be said.

    Attributes:
        n_visible: points that the camera could see, over all images.
        n_hidden: the others.
        pixel_median_px: of the distances in the image, over the points that were visible.
        pixel_p95_px: of the same.
        point_median_mm: of the distances in the jaw frame, over the points that were accepted.
        point_p95_mm: of the same.
        hidden_accepted_pct: share of the hidden points that were accepted.
        visible_lost_pct: share of the visible points that were not.
    """

    n_visible: int
    n_hidden: int
    pixel_median_px: float | None
    pixel_p95_px: float | None
    point_median_mm: float | None
    point_p95_mm: float | None
    hidden_accepted_pct: float | None
    visible_lost_pct: float | None


SIGHT = ("pixel_error", "point_error", "visible", "accepted")


def compare_detection(detection: DetectionTrack, sight: DetectionTruth) -> pd.DataFrame:
    """Return a detection against the truth, at the images that both know: columns of the table of forces."""
    stamps, ours, theirs = np.intersect1d(detection.stamps, sight.stamps, return_indices=True)
    visible, accepted = sight.visible[theirs], detection.accepted[ours]
    pixel_error = np.linalg.norm(detection.pixels[ours] - sight.pixels[theirs], axis=2)
    point_error = np.linalg.norm(detection.points[ours] - sight.points[theirs], axis=2)
    columns = (np.where(visible, pixel_error, np.nan), np.where(accepted, point_error, np.nan), visible, accepted)
    return pd.DataFrame({"stamp": stamps} | dict(zip(SIGHT, map(list, columns), strict=True)))


def detection_stats(tables: Sequence[pd.DataFrame]) -> DetectionStats:
    """Return the statistics of the rows of several tables together that have the columns of `compare_detection`."""
    known = [table[table["visible"].notna()] for table in tables if "visible" in table]
    visible, accepted = (np.concatenate([np.zeros(0, bool), *(row for each in known for row in each[name])])
                         for name in ("visible", "accepted"))  # fmt: skip
    pixels = _percentiles([row for each in known for row in each["pixel_error"]], 1.0)
    points = _percentiles([row for each in known for row in each["point_error"]], 1e3)
    return DetectionStats(
        n_visible=int(visible.sum()),
        n_hidden=int((~visible).sum()),
        pixel_median_px=pixels[0],
        pixel_p95_px=pixels[1],
        point_median_mm=points[0],
        point_p95_mm=points[1],
        hidden_accepted_pct=_share(accepted[~visible]),
        visible_lost_pct=_share(~accepted[visible]),
    )


def _percentiles(errors: Sequence[NDArray[np.float64]], scale: float) -> tuple[float | None, float | None]:
    """Return the median and the 95th percentile of what is finite."""
    values = np.concatenate([np.zeros(0), *(error.ravel() for error in errors)])
    values = scale * values[np.isfinite(values)]
    if not values.size:
        return None, None
    median, p95 = (float(value) for value in np.percentile(values, [50, 95]))
    return median, p95


def _share(chosen: NDArray[np.bool_]) -> float | None:
    """Return the share of what is true [%]."""
    return 100.0 * float(chosen.mean()) if chosen.size else None
