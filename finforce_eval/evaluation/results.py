"""The time series of one jaw of one recording, how late its force was and how well its key points were seen."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
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


@dataclass(frozen=True, kw_only=True, eq=False)
class DetectionErrors:
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


def compare_detection(detection: DetectionTrack, sight: DetectionTruth) -> DetectionErrors:
    """Return a detection against the truth, at the images that both know."""
    _, ours, theirs = np.intersect1d(detection.stamps, sight.stamps, return_indices=True)
    visible, accepted = sight.visible[theirs], detection.accepted[ours]
    pixel_error = np.linalg.norm(detection.pixels[ours] - sight.pixels[theirs], axis=2)
    point_error = np.linalg.norm(detection.points[ours] - sight.points[theirs], axis=2)
    return DetectionErrors(
        pixel_error=np.where(visible, pixel_error, np.nan),
        point_error=np.where(accepted, point_error, np.nan),
        visible=visible,
        accepted=accepted,
    )


def detection_stats(series: Sequence[DetectionErrors]) -> DetectionStats:
    """Return the statistics of several series together."""
    visible, accepted = (
        np.concatenate([np.zeros(0, dtype=bool), *(getattr(entry, name).ravel() for entry in series)])
        for name in ("visible", "accepted")
    )
    pixels = _percentiles([entry.pixel_error for entry in series], 1.0)
    points = _percentiles([entry.point_error for entry in series], 1e3)
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


@dataclass(frozen=True, kw_only=True)
class Snapshot:
    """The jaw at one instant; all points in the jaw frame [m].

    Attributes:
        stamp: image time [ns].
        surface0: (n, 3) undeformed vertices.
        surface: (n, 3) deformed vertices.
        triangles: (t, 3) vertex indices.
        keypoints0: (K, 3) undeformed key points.
        keypoints: (K, 3) key points as seen, NaN = none.
        used: (K,) key points that the estimator used.
        contact_point: (3,) on the deformed surface.
        force: (3,) [N] on the jaw.
        outline: of the object, polygons (n, 2) of x and z; none where it is not known.
    """

    stamp: int
    surface0: NDArray[np.float64]
    surface: NDArray[np.float64]
    triangles: NDArray[np.integer]
    keypoints0: NDArray[np.float64]
    keypoints: NDArray[np.float64]
    used: NDArray[np.bool_]
    contact_point: NDArray[np.float64]
    force: NDArray[np.float64]
    outline: tuple[NDArray[np.float64], ...] = ()


@dataclass(frozen=True, kw_only=True, eq=False)
class ContactSeries:
    """Where the object was said to touch one jaw, image by image; n frames, heights on the undeformed surface.

    Attributes:
        source: what said it.
        given: (n,) weighted mean height of the contact that the image was solved with, live of the one that was
            published for it [m], NaN = none.
        truth: (n,) height of the pressure centre of the measured force [m], NaN where it is not known.
        touching: (n,) whether object and jaw were said to touch once the image was solved; None when nobody says.
        status: (n,) the contact estimator's own word, "" for a contact that was given.
        step_ms: (n,) wall time of the contact estimator [ms]; NaN for a contact that was given.
    """

    source: str
    given: NDArray[np.float64]
    truth: NDArray[np.float64]
    touching: NDArray[np.bool_] | None
    status: NDArray[np.str_]
    step_ms: NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class CaseResult:
    """The time series of one jaw of one recording; n frames, K key points.

    Attributes:
        name: name of the case.
        side: "left" or "right".
        stamps: (n,) image time [ns].
        truth: (n, 3) true force on the jaw [N], NaN where it was not measured.
        force: (n, 3) estimate [N], NaN where the estimator did not trust it.
        torque: (n, 3) of it about the jaw's origin [N m]; None where it was not kept.
        true_torque: (n, 3) of the true force [N m]; None where it was not kept.
        stddev: (n,) standard deviation of the magnitude [N].
        place: (n, 3) contact place on the undeformed surface [m].
        residual: (n,) weighted rms of the key points used [m].
        used: (n, K) key points used.
        status: (n,) the estimator's own word.
        step_ms: (n,) wall time of the step [ms]; NaN where nothing came back.
        cycle: (n,) loading cycle, 0 without phases.
        direction: (n,) "load", "unload", or "" without phases.
        scored: (n,) in a `record` phase; every frame without phases.
        snapshot: the jaw at the largest trusted force of a scored frame; None when there was none.
        message: the estimator's last words on a frame that it did not solve.
        contact: where the object was said to touch; None when it does not travel.
        sight: the key points that were found against the true ones; None where nothing says where they truly were.
        detector_ms: (n,) wall time from image to key points [ms], NaN where it was not timed; None without a detector.
        axis_stddev: (n, 3) stated standard deviation of the force [N], NaN where it is not trusted; None unknown.
        latency_ms: (n,) from what the call began with, images or key points, to the force [ms]; None for `step_ms`.
    """

    name: str
    side: str
    stamps: NDArray[np.int64]
    truth: NDArray[np.float64]
    force: NDArray[np.float64]
    stddev: NDArray[np.float64]
    place: NDArray[np.float64]
    residual: NDArray[np.float64]
    used: NDArray[np.bool_]
    status: NDArray[np.str_]
    step_ms: NDArray[np.float64]
    cycle: NDArray[np.int64]
    direction: NDArray[np.str_]
    scored: NDArray[np.bool_]
    snapshot: Snapshot | None = None
    message: str = ""
    contact: ContactSeries | None = None
    sight: DetectionErrors | None = None
    detector_ms: NDArray[np.float64] | None = None
    axis_stddev: NDArray[np.float64] | None = None
    latency_ms: NDArray[np.float64] | None = None
    torque: NDArray[np.float64] | None = None
    true_torque: NDArray[np.float64] | None = None

    @property
    def seconds(self) -> NDArray[np.float64]:
        """Time since the first frame (n,) [s]."""
        return (self.stamps - self.stamps[0]) * 1e-9

    @property
    def solved(self) -> NDArray[np.bool_]:
        """Frames with a trusted estimate (n,)."""
        return np.isfinite(self.force).all(axis=1)

    @property
    def magnitude(self) -> NDArray[np.float64]:
        """Norm of the estimate (n,) [N]."""
        return np.linalg.norm(self.force, axis=1)

    @property
    def true_magnitude(self) -> NDArray[np.float64]:
        """Norm of the true force (n,) [N]."""
        return np.linalg.norm(self.truth, axis=1)

    @property
    def error(self) -> NDArray[np.float64]:
        """Norm of the estimate minus norm of the truth (n,) [N]; NaN where either is missing."""
        return self.magnitude - self.true_magnitude

    @property
    def lag(self) -> NDArray[np.float64]:
        """What passes from what the call began with, images or key points, to the force (n,) [s]."""
        return 1e-3 * (self.step_ms if self.latency_ms is None else self.latency_ms)

    @property
    def delays(self) -> list[Delay]:
        """What the estimate took to show after each onset of the true force."""
        return force_delays(self.stamps * 1e-9, self.true_magnitude, self.magnitude, self.lag)

    @property
    def counted(self) -> NDArray[np.bool_]:
        """Frames that enter the score (n,): scored, solved, and with a truth."""
        return self.scored & np.isfinite(self.error)
