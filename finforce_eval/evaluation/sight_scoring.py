"""How well key points were seen: pixels, places, what was accepted and lost, and time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from finforce_eval.recordings.tracks import DetectionTrack, SightTrack


@dataclass(frozen=True, kw_only=True, eq=False)
class SightSeries:
    """A detection against the truth, image by image; n images that have both, K key points.

    Attributes:
        pixel_error: (n, K) distance in the image [px]; NaN where the point was hidden, or no pixel was named.
        point_error: (n, K) distance in the jaw frame [m]; NaN where the point was not accepted.
        visible: (n, K) the camera could see the point.
        accepted: (n, K) it was handed on to the solver.
    """

    pixel_error: NDArray[np.float64]
    point_error: NDArray[np.float64]
    visible: NDArray[np.bool_]
    accepted: NDArray[np.bool_]


@dataclass(frozen=True, kw_only=True)
class SightStats:
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


def compare_sight(detection: DetectionTrack, sight: SightTrack) -> SightSeries:
    """Return a detection against the truth, at the images that both know."""
    _, ours, theirs = np.intersect1d(detection.stamps, sight.stamps, return_indices=True)
    visible, accepted = sight.visible[theirs], detection.accepted[ours]
    pixel_error = np.linalg.norm(detection.pixels[ours] - sight.pixels[theirs], axis=2)
    point_error = np.linalg.norm(detection.points[ours] - sight.points[theirs], axis=2)
    return SightSeries(
        pixel_error=np.where(visible, pixel_error, np.nan),
        point_error=np.where(accepted, point_error, np.nan),
        visible=visible,
        accepted=accepted,
    )


def sight_stats(series: Sequence[SightSeries]) -> SightStats:
    """Return the statistics of several series together."""
    visible, accepted = (
        np.concatenate([np.zeros(0, dtype=bool), *(getattr(entry, name).ravel() for entry in series)])
        for name in ("visible", "accepted")
    )
    pixels = _percentiles([entry.pixel_error for entry in series], 1.0)
    points = _percentiles([entry.point_error for entry in series], 1e3)
    return SightStats(
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
