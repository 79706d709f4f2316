"""Errors and delays of forces, grasp force, contact and key points against the truth.

Numbers are named as in the JSON of `finforce evaluate`, with their units; None stands for nothing to compute from.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from finforce.errors import FinforceError
from finforce_eval.evaluation.gripper import combine_jaws
from finforce_eval.recordings.tracks import DetectionTrack, DetectionTruth, Recording, WrenchTrack
from finforce_eval.table import ForceSeries

LEAST_FORCE = 0.2  # [N], below which the pressure centre is not scored
ONSET_FORCE = 0.02  # [N] of true force, from which on something presses
SHOWN = 0.10  # [N] of estimated force, from which on it shows
FREE = 5  # images without true force before an onset counts as one
WAITED = 1.0  # [s] after which a force that did not show is missed
WATCHED = 30  # frames after the true begin, by which a touch has to be there to stay
PHASES = ("all", "load", "unload")
OFF = 0.3  # [N] along an axis, from which on an image is counted as off
NO_ERROR = 1e-5  # root mean square of errors that are none [N, N m]: rounding
_NOTHING = 1e-3  # [N] along an axis, which needs no standard deviation
Numbers = dict[str, Any]


@dataclass(frozen=True, kw_only=True)
class Stats:
    """Errors over a set of frames.

    Attributes:
        n: frames.
        rmse_N: root mean square error [N].
        nrmsd_pct: the same over the range of the true force [%].
        max_error_N: largest absolute error [N].
        bias_N: mean error [N]; positive when the estimate is too large.
        vector_rmse_N: root mean square length of the difference of the forces as vectors [N].
        axis_rmse_N: root mean square difference along x, y and z of the jaw [N].
        within_3_sigma_pct: share of the frames in which the difference along x, y and z is within three of the stated
            standard deviations, or 1 mN [%].
        sharpness: root mean square of the stated standard deviation along x, y and z over that of the difference: below
            1 too small, far above 1 says nothing; None along an axis without differences.
        n_off: frames in which the difference along an axis is more than 0.3 N.
        answered_pct: share of the frames that were to be answered [%].
        torque_rmse_Nm: root mean square length of the difference of the torques about the jaw's origin [N m].
        torque_pct: the same over the root mean square of the true torque [%].
    """

    n: int
    rmse_N: float | None = None
    nrmsd_pct: float | None = None
    max_error_N: float | None = None
    bias_N: float | None = None
    vector_rmse_N: float | None = None
    axis_rmse_N: tuple[float, float, float] | None = None
    within_3_sigma_pct: tuple[float, float, float] | None = None
    sharpness: tuple[float | None, float | None, float | None] | None = None
    n_off: int | None = None
    answered_pct: float | None = None
    torque_rmse_Nm: float | None = None
    torque_pct: float | None = None


@dataclass(frozen=True, kw_only=True)
class CaseScore:
    """The score of a case, or of all cases together.

    Attributes:
        frames: key point frames given to the estimator.
        solved: those with a trusted estimate.
        skipped: the others; they are in no error.
        record_frames: frames of the `record` phases (every frame without phases).
        record_skipped: those of them without a trusted estimate.
        all: errors over the record phases.
        load: of them, on the way in.
        unload: of them, on the way out.
        moving: errors over all other images with a truth, as on ramps; of none without phases.
        stages: errors over the record phases by direction and cycle, as "load 1"; none without phases.
        step_ms: time per step, `p50`, `p95`, `p99` and `max`.
        cycles: "all", "load", "unload" -> number `n` of loading cycles, `mean` and sample standard deviation `std` of
            `rmse_N` and `nrmsd_pct` over them.
        mean_rmse_N: mean of the RMSE of the cases.
        contact_ms: time per step of the contact estimator.
        place: distance of the contact that was given to the estimator from the true pressure centre; see `distances`.
        solved_place: the same of the estimator's own contact location.
        onset: delay of `touching`; see `onset_stats`.
        delay: of the force after its true onset; see `delay_stats`.
        sight: errors of the key points; see `detection_stats`.
        detector_ms: time per image of the key point detector.
    """

    frames: int
    solved: int
    skipped: int
    record_frames: int
    record_skipped: int
    all: Stats
    load: Stats
    unload: Stats
    moving: Stats
    stages: Mapping[str, Stats]
    step_ms: Numbers
    cycles: Mapping[str, Numbers]
    mean_rmse_N: float | None
    contact_ms: Numbers
    place: Numbers
    solved_place: Numbers
    onset: Numbers
    delay: Numbers
    sight: Numbers
    detector_ms: Numbers


@dataclass(frozen=True, kw_only=True)
class Evaluation:
    """Scores and time series of one call; `manipulation` has those recordings of which both jaws were evaluated."""

    results: Mapping[str, ForceSeries]
    scores: Mapping[str, CaseScore]
    total: CaseScore
    span: float
    manipulation: Mapping[str, Stats] = field(default_factory=dict)


def score_results(results: Sequence[ForceSeries], recordings: Sequence[Recording]) -> Evaluation:
    """Score the cases of one call together.

    Args:
        results: one or more per recording.
        recordings: the recordings of the call; the range of their true forces normalises `nrmsd_pct`.

    Raises:
        FinforceError: two cases have the same name.
    """
    ranges = [limits for recording in recordings for limits in [true_range(recording)] if limits]
    return score_series(results, ranges)


def true_range(recording: Recording) -> tuple[float, float] | None:
    """Return the least and the largest norm of the true forces of a recording [N]; None without any."""
    tracks = [jaw.truth for jaw in recording.jaws.values() if jaw.truth is not None]
    norms = np.concatenate([np.zeros(0), *(np.linalg.norm(track.force, axis=1) for track in tracks)])
    norms = norms[np.isfinite(norms)]
    return (float(norms.min()), float(norms.max())) if norms.size else None


def score_series(results: Sequence[ForceSeries], ranges: Sequence[tuple[float, float]]) -> Evaluation:
    """Score the cases of one call together, with the ranges of the true forces of its recordings [N].

    Raises:
        FinforceError: two cases have the same name.
    """
    names = [result.name for result in results]
    twice = {name for name in names if names.count(name) > 1}
    if twice:
        raise FinforceError(f"two recordings are called {', '.join(sorted(twice))}; give each once")
    span = max(high for _, high in ranges) - min(low for low, _ in ranges) if ranges else 0.0
    return Evaluation(
        results={result.name: result for result in results},
        scores={result.name: score_case([result], span) for result in results},
        total=score_case(results, span),
        span=span,
        manipulation=score_manipulation(results),
    )


def score_case(cases: Sequence[ForceSeries], span: float) -> CaseScore:
    """Score one case, or several together.

    Args:
        cases: the time series.
        span: range of the true force over the call's recordings [N].
    """
    frames = sum(len(case) for case in cases)
    solved = sum(int(case.solved.sum()) for case in cases)
    # one pass of the detector finds both jaws: its times count once for each recording
    detector = {case.column("detector_ms").tobytes(): case.column("detector_ms") for case in cases}
    rows = {phase: [case.scored & _is_phase(case, phase) for case in cases] for phase in PHASES}
    rows["moving"] = [~case.scored & np.isfinite(case.true_magnitude) for case in cases]
    return CaseScore(
        frames=frames,
        solved=solved,
        skipped=frames - solved,
        record_frames=sum(int(case.scored.sum()) for case in cases),
        record_skipped=sum(int((case.scored & ~case.solved).sum()) for case in cases),
        **{name: _score_rows(cases, asked, span) for name, asked in rows.items()},
        stages=_score_stages(cases, rows, span),
        step_ms=_times(case.column("step_ms") for case in cases),
        cycles={phase: _cycle_stats(cases, phase, span) for phase in PHASES},
        mean_rmse_N=_spread([compute_stats(case.error[case.counted], span).rmse_N for case in cases])["mean"],
        contact_ms=_times(case.column("contact_ms") for case in cases),
        place=distances([loaded_distance(case, case.column("contact_height")) for case in cases]),
        solved_place=distances([loaded_distance(case, case.column("contact_location")[:, 2]) for case in cases]),
        onset=onset_stats(cases),
        delay=delay_stats([force_delays(case.stamps, case.true_magnitude, case.magnitude, case.lag) for case in cases]),
        sight=detection_stats([case.table for case in cases]),
        detector_ms=_times(detector.values()),
    )


def _score_rows(cases: Sequence[ForceSeries], asked: Sequence[NDArray[np.bool_]], span: float) -> Stats:
    """Return the errors over some rows of the cases, which were to be answered."""
    chosen = [rows & np.isfinite(case.error) for case, rows in zip(cases, asked, strict=True)]
    stats = compute_stats(np.concatenate([case.error[rows] for case, rows in zip(cases, chosen, strict=True)]), span)
    answered = np.concatenate([case.solved[rows] for case, rows in zip(cases, asked, strict=True)])
    found: Numbers = {"answered_pct": _share(answered)}
    force, truth, stated = (_join(cases, chosen, name) for name in ("force", "true_force", "force_stddev"))
    # a truth that is along x throughout is a magnitude that was written there, and says nothing of the vector
    if any(np.nan_to_num(case.true_force[:, 1:]).any() for case in cases) and len(force):
        is_stated = all(case.has("force_stddev") for case in cases)
        found |= compare_vectors(force - truth, stated if is_stated else None)
        turned = (case.has("torque") and np.nan_to_num(case.column("true_torque")).any() for case in cases)
        if all(turned):
            found |= compare_torques(*(_join(cases, chosen, name) for name in ("torque", "true_torque")))
    return replace(stats, **found)


def _score_stages(
    cases: Sequence[ForceSeries], rows: Mapping[str, Sequence[NDArray[np.bool_]]], span: float
) -> Mapping[str, Stats]:
    """Return the errors by direction and cycle, in the order of time, over the rows of each direction."""
    found = {}
    for cycle in np.unique(np.concatenate([case.column("cycle")[case.scored] for case in cases])):
        for phase in PHASES[1:]:
            asked = [own & (case.column("cycle") == cycle) for case, own in zip(cases, rows[phase], strict=True)]
            if any(own.any() for own in asked):
                found[f"{phase} {cycle}"] = _score_rows(cases, asked, span)
    return found


def _is_phase(case: ForceSeries, phase: str) -> NDArray[np.bool_]:
    return np.ones(len(case), dtype=bool) if phase == "all" else case.column("direction") == phase


def _join(cases: Sequence[ForceSeries], chosen: Sequence[NDArray], name: str) -> NDArray[np.float64]:
    """Return the chosen rows of a column of all cases."""
    return np.concatenate([case.column(name)[rows] for case, rows in zip(cases, chosen, strict=True)])


def _cycle_stats(cases: Sequence[ForceSeries], phase: str, span: float) -> Numbers:
    """Return how the errors vary from loading cycle to loading cycle."""
    cycles = []
    for case in cases:
        rows = case.counted & _is_phase(case, phase)
        errors = pd.Series(case.error[rows]).groupby(case.column("cycle")[rows])
        cycles += [compute_stats(each.to_numpy(), span) for _, each in errors]
    return {
        "n": len(cycles),
        **{name: _spread([getattr(cycle, name) for cycle in cycles]) for name in ("rmse_N", "nrmsd_pct")},
    }


def _spread(values: Sequence[float | None]) -> Numbers:
    """Return mean and sample standard deviation of the numbers among values."""
    numbers = [value for value in values if value is not None]
    mean = float(np.mean(numbers)) if numbers else None
    return {"mean": mean, "std": float(np.std(numbers, ddof=1)) if numbers[1:] else None}


def compute_stats(errors: NDArray[np.float64], span: float) -> Stats:
    """Return the statistics of errors.

    Args:
        errors: (n,) norm of the estimate minus norm of the truth [N].
        span: range of the true force [N]; 0 leaves `nrmsd_pct` open.
    """
    if errors.size == 0:
        return Stats(n=0)
    rmse = rms(errors)
    return Stats(
        n=int(errors.size),
        rmse_N=rmse,
        nrmsd_pct=100.0 * rmse / span if span > 0.0 else None,
        max_error_N=float(np.abs(errors).max()),
        bias_N=float(errors.mean()),
    )


def rms(errors: NDArray) -> float:
    """Return the root mean square of what is finite; NaN of nothing."""
    finite = errors[np.isfinite(errors)]
    return float(np.sqrt(np.mean(finite**2))) if finite.size else float("nan")


def compare_torques(found: NDArray[np.float64], true: NDArray[np.float64]) -> dict[str, float]:
    """Return `torque_rmse_Nm` and, unless the true ones are zero, `torque_pct` of torques (n, 3) [N m]."""
    error, size = (float(np.sqrt((values**2).sum(axis=1).mean())) for values in (found - true, true))
    return {"torque_rmse_Nm": error} | ({"torque_pct": 100.0 * error / size} if size > 0.0 else {})


def compare_vectors(differences: NDArray[np.float64], stated: NDArray[np.float64] | None) -> Numbers:
    """Return what `Stats` has of forces as vectors: of the deviations only where they are stated.

    Args:
        differences: (n, 3) [N], at least one.
        stated: standard deviations (n, 3) [N]; None where none is known.
    """
    axes = np.sqrt((differences**2).mean(axis=0)).tolist()
    found: Numbers = {"vector_rmse_N": float(np.linalg.norm(axes)), "axis_rmse_N": tuple(axes)}
    found["n_off"] = int((np.abs(differences) > OFF).any(axis=1).sum())
    if stated is not None:
        within = np.abs(differences) <= np.maximum(3.0 * stated, _NOTHING)
        found["within_3_sigma_pct"] = tuple((100.0 * within.mean(axis=0)).tolist())
        ratios = measure_sharpness(stated, differences).tolist()
        found["sharpness"] = tuple(ratio if np.isfinite(ratio) else None for ratio in ratios)
    return found


def measure_sharpness(stated: NDArray, errors: NDArray) -> NDArray:
    """Return how sharp stated standard deviations are, their root mean square over that of the errors.

    Below 1 they are too small, far above 1 they say nothing.

    Args:
        stated: standard deviations (n, k); rows with one that is not finite count for nothing.
        errors: (n, k).

    Returns:
        One number for each column (k,); NaN where there is no error.
    """
    known = np.isfinite(stated).all(axis=1) & np.isfinite(errors).all(axis=1)
    squares = [np.square(values[known]).sum(axis=0) / max(known.sum(), 1) for values in (stated, errors)]
    ratio = np.full(stated.shape[1], np.nan)
    return np.sqrt(np.divide(*squares, out=ratio, where=squares[1] > NO_ERROR**2))


def _percentiles(parts: Iterable[NDArray], scale: float = 1.0, **percents: float) -> Numbers:
    """Return percentiles of what is finite in some arrays, by name."""
    values = np.concatenate([np.zeros(0), *(np.ravel(part) for part in parts)])
    values = scale * values[np.isfinite(values)]
    found = np.percentile(values, list(percents.values())).tolist() if values.size else [None] * len(percents)
    return dict(zip(percents, found, strict=True))


def _times(parts: Iterable[NDArray]) -> Numbers:
    """Return the percentiles of times [ms]; NaN is a step that was not timed."""
    return _percentiles(parts, p50=50, p95=95, p99=99, max=100)


def _share(chosen: NDArray[np.bool_]) -> float | None:
    """Return the share of what is true [%]."""
    return 100.0 * float(chosen.mean()) if chosen.size else None


def match_truth(truth: WrenchTrack, stamps: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return the true force (n, 3) [N] at image times (n,) [ns], matched as by `match_samples`."""
    return match_samples(truth.stamps_ns, truth.force, stamps)


def match_samples(
    times: NDArray[np.int64], values: NDArray[np.float64], stamps: NDArray[np.int64]
) -> NDArray[np.float64]:
    """Return what was sampled at other times, at the given stamps.

    A sample at the very stamp is taken as it is; between two that are no further apart than two and a half periods of
    the samples it is interpolated; elsewhere it is NaN.

    Args:
        times: (m,) of the samples [ns].
        values: (m, k) the samples.
        stamps: (n,) [ns].

    Returns:
        (n, k).
    """
    matched = np.full((len(stamps), values.shape[1]), np.nan)
    after = np.clip(np.searchsorted(times, stamps, side="left"), 0, len(times) - 1)
    exact = times[after] == stamps
    matched[exact] = values[after[exact]]
    before = after - 1
    inside = ~exact & (before >= 0) & (times[after] > stamps)
    if inside.any():
        gap = times[after] - times[before]
        inside &= gap <= 2.5 * np.median(np.diff(times))
    rows, left, right = np.flatnonzero(inside), before[inside], after[inside]
    share = (stamps[rows] - times[left]) / (times[right] - times[left])
    matched[rows] = values[left] + share[:, None] * (values[right] - values[left])
    return matched


def distances(parts: Sequence[NDArray[np.float64]]) -> Numbers:
    """Return number `n`, `median_mm`, `p95_mm` and `max_mm` of distances [m]; NaN is not counted."""
    count = sum(int(np.isfinite(part).sum()) for part in parts)
    return {"n": count, **_percentiles(parts, 1e3, median_mm=50, p95_mm=95, max_mm=100)}


def loaded_distance(result: ForceSeries, heights: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return how far heights (n,) [m] are from the pressure centre, NaN where it is unknown or little presses."""
    return np.where(result.true_magnitude > LEAST_FORCE, np.abs(heights - result.column("true_height")), np.nan)


def onset_stats(results: Sequence[ForceSeries]) -> Numbers:
    """Return the frames from the true begin of contact to the `touching` that stays, over loading cycles.

    `n` cycles in which both are known, and `missed`, in which `touching` did not come within a second; `median_frames`,
    `earliest_frames` and `max_frames`, negative is early; `false_pct`, the share of the frames without true force that
    were reported as touching.
    """
    delays = [delay for result in results for delay in onset_delays(result)]
    known = [delay for delay in delays if delay is not None]
    touches = [each.column("touching")[~_loaded(each)].astype(float) for each in results if each.has("touching")]
    return {
        "n": len(known),
        "missed": len(delays) - len(known),
        "median_frames": float(np.median(known)) if known else None,
        "earliest_frames": min(known, default=None),
        "max_frames": max(known, default=None),
        "false_pct": _share(np.concatenate([np.zeros(0), *touches])),
    }


def onset_delays(result: ForceSeries) -> list[int | None]:
    """Return for each loading cycle the frames from first true force to the `touching` that stays; None if missed.

    A `touching` that was never let go since the cycle before is early by the whole pause.
    """
    if not result.has("touching"):
        return []
    loaded = _loaded(result)
    delays, cycles, touching = [], result.column("cycle"), result.column("touching").astype(bool)
    for cycle in np.unique(cycles):
        rows = np.flatnonzero(cycles == cycle)
        pressed = rows[loaded[rows]]
        if pressed.size and pressed[0] > 0 and not loaded[pressed[0] - 1]:
            delays.append(_touch_delay(touching, loaded, int(pressed[0]), int(rows[-1])))
    return delays


def _loaded(result: ForceSeries) -> NDArray[np.bool_]:
    """Return on which frames (n,) something truly presses."""
    return np.nan_to_num(result.true_magnitude) > ONSET_FORCE


def _touch_delay(touching: NDArray[np.bool_], loaded: NDArray[np.bool_], onset: int, last: int) -> int | None:
    """Return the frames from `onset` to the begin of the touch that holds a second later, or at the cycle's end."""
    before = np.flatnonzero(loaded[:onset])
    released = int(before[-1]) + 1 if before.size else 0
    pressed = np.flatnonzero(~loaded[onset : last + 1])
    end = min(onset + WATCHED, last, onset + int(pressed[0]) - 1 if pressed.size else last)
    apart = np.flatnonzero(~touching[released : end + 1])
    begin = released + int(apart[-1]) + 1 if apart.size else released
    return begin - onset if begin <= end else None


def force_delays(
    times: NDArray[np.float64], truth: NDArray[np.float64], estimate: NDArray[np.float64], lag: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return until when after each onset of the true force the estimate showed.

    The onset lies between two images, where the line through their true forces crosses 0.02 N.

    Args:
        times: (n,) of the images [s].
        truth: (n,) magnitude of the true force [N], NaN where it is not known.
        estimate: (n,) magnitude of the estimate [N], NaN where there is none.
        lag: (n,) from the image to the estimate [s]; NaN counts as none.

    Returns:
        (m, 2) time until the estimate is above 0.1 N and has been computed, and until the true force is above it [s];
        NaN where that was not within a second.
    """
    known = np.nan_to_num(truth)
    loaded = known > ONSET_FORCE
    delays = []
    for index in np.flatnonzero(loaded[1:] & ~loaded[:-1]) + 1:
        if index < FREE or loaded[index - FREE : index].any():
            continue
        onset = _crossing(times, known, index, ONSET_FORCE)
        later = slice(index, int(np.searchsorted(times, onset + WAITED)))
        shown = index + np.flatnonzero(np.nan_to_num(estimate[later]) > SHOWN)
        risen = index + np.flatnonzero(known[later] > SHOWN)
        ends = (
            times[shown[0]] + float(np.nan_to_num(lag[shown[0]])) if shown.size else np.nan,
            _crossing(times, known, risen[0], SHOWN) if risen.size else np.nan,
        )
        delays.append([end - onset for end in ends])
    return np.array(delays).reshape(-1, 2)


def _crossing(times: NDArray[np.float64], values: NDArray[np.float64], index: int, level: float) -> float:
    """Return when values that are above a level at `index` and not before rose through it [s]."""
    before, after = values[index - 1], values[index]
    return float(times[index - 1] + (level - before) / (after - before) * (times[index] - times[index - 1]))


def delay_stats(delays: Sequence[NDArray[np.float64]]) -> Numbers:
    """Return the statistics of what `force_delays` found in some series.

    `n` onsets after which the estimate showed, `missed` after which it did not; `median_ms` and `max_ms` of the delay;
    `rise_ms`, the median of what the true force itself took.
    """
    shown, risen = np.concatenate([np.zeros((0, 2)), *delays]).T
    count = int(np.isfinite(shown).sum())
    found = _percentiles([shown], 1e3, median_ms=50, max_ms=100) | _percentiles([risen], 1e3, rise_ms=50)
    return {"n": count, "missed": len(shown) - count, **found}


def compare_detection(detection: DetectionTrack, sight: DetectionTruth) -> pd.DataFrame:
    """Return a detection against the truth, at the images that both know: columns of the table of forces."""
    stamps, ours, theirs = np.intersect1d(detection.stamps_ns, sight.stamps_ns, return_indices=True)
    visible, accepted = sight.visible[theirs], detection.accepted[ours]
    pixel_error = np.linalg.norm(detection.pixels[ours] - sight.pixels[theirs], axis=2)
    point_error = np.linalg.norm(detection.points[ours] - sight.points[theirs], axis=2)
    columns = {
        "pixel_error": np.where(visible, pixel_error, np.nan),
        "point_error": np.where(accepted, point_error, np.nan),
        "visible": visible,
        "accepted": accepted,
    }
    return pd.DataFrame({"stamp": stamps} | {name: list(values) for name, values in columns.items()})


def detection_stats(tables: Sequence[pd.DataFrame]) -> Numbers:
    """Return the statistics of the rows of several tables together that have the columns of `compare_detection`.

    `n_visible` points that the camera could see, and `n_hidden`; median and 95th percentile of the distances in the
    image, over the visible points, and in the jaw frame, over the accepted ones; `hidden_accepted_pct` and
    `visible_lost_pct`, the shares that were wrongly accepted, and wrongly not.
    """
    known = pd.concat([pd.DataFrame(columns=["visible", "accepted", "pixel_error", "point_error"]), *tables])
    known = known[known["visible"].notna()]
    visible, accepted = (np.concatenate([np.zeros(0, bool), *known[name]]) for name in ("visible", "accepted"))
    return {
        "n_visible": int(visible.sum()),
        "n_hidden": int((~visible).sum()),
        **_percentiles(known["pixel_error"], pixel_median_px=50, pixel_p95_px=95),
        **_percentiles(known["point_error"], 1e3, point_median_mm=50, point_p95_mm=95),
        "hidden_accepted_pct": _share(accepted[~visible]),
        "visible_lost_pct": _share(~accepted[visible]),
    }


def score_manipulation(results: Iterable[ForceSeries]) -> dict[str, Stats]:
    """Return the score of every recording of which both jaws were evaluated, by its name."""
    pairs: dict[str, dict[str, ForceSeries]] = {}
    for result in results:
        pairs.setdefault(result.name.removesuffix(f"/{result.side}"), {})[result.side] = result
    return {name: score_net(join_net(pair)) for name, pair in pairs.items() if len(pair) == 2}


def join_net(jaws: Mapping[str, ForceSeries]) -> ForceSeries:
    """Return what `combine_jaws` does, in the images of the record phases in which both jaws were measured."""
    net = combine_jaws(jaws)
    return net.at(net.scored & np.isfinite(net.true_force).all(axis=1))


def score_net(net: ForceSeries) -> Stats:
    """Return how far `/manipulation_wrench` is from the truth, in `gripper_base`; see `join_net`."""
    answered = _share(net.solved)
    net = net.at(net.solved)
    if not len(net):
        return Stats(n=0, answered_pct=answered)
    found, true = net.column("torque"), net.column("true_torque")
    known = np.isfinite(found - true).all(axis=1)
    torque = compare_torques(found[known], true[known]) if known.any() and np.nan_to_num(true).any() else {}
    stated = net.column("force_stddev")
    vectors = compare_vectors(net.force - net.true_force, stated if np.isfinite(stated).any() else None)
    return Stats(n=len(net), answered_pct=answered, **vectors, **torque)


@dataclass(frozen=True, kw_only=True)
class GraspScore:
    """The grasp force against the smaller of the jaws' true forces.

    Attributes:
        error: over the record phases, or over every image without phases.
        frames: images that were to be scored, with or without an answer.
        largest: true grasp force [N]; NaN where it is not known.
        delay: after the true onsets; see `delay_stats`.
    """

    error: Stats
    frames: int
    largest: float
    delay: Numbers


def score_grasp(recording: Recording, grasp: Mapping[int, float], lag: Mapping[int, float]) -> GraspScore:
    """Return how good grasp forces were; of a recording without the truth of all jaws nothing is known.

    Args:
        recording: that was played.
        grasp: by recorded stamp [ns] -> [N].
        lag: from the image to the grasp force [s], by recorded stamp [ns].
    """
    if any(track.truth is None for track in recording.jaws.values()):
        return GraspScore(error=Stats(n=0), frames=0, largest=float("nan"), delay=delay_stats([]))
    stamps = next(iter(recording.jaws.values())).keypoints.stamps_ns
    forces = [np.linalg.norm(match_truth(recording.truth(side), stamps), axis=1) for side in recording.jaws]
    found, late = (pd.Series(values, dtype=float).reindex(stamps).to_numpy() for values in (grasp, lag))
    truth = np.min(forces, axis=0)
    scored = recording.phases_at(stamps)["scored"] & np.isfinite(truth)
    error = (found - truth)[scored]
    known = truth[np.isfinite(truth)]
    return GraspScore(
        error=compute_stats(error[np.isfinite(error)], float(np.ptp(known)) if known.size else 0.0),
        frames=int(scored.sum()),
        largest=float(known.max()) if known.size else float("nan"),
        delay=delay_stats([force_delays(stamps * 1e-9, truth, found, late)]),
    )
