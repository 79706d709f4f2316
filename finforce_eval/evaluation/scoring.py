"""Errors of force, grasp force and contact against the truth, as numbers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from finforce_eval.evaluation.results import (
    Delay,
    DelayStats,
    DetectionStats,
    delay_stats,
    detection_stats,
    force_delays,
)
from finforce_eval.recordings.tracks import Recording, WrenchTrack
from finforce_eval.table import ForceSeries

# Below it the pressure centre hardly matters; from it on the object is in contact [N].
LEAST_FORCE, ONSET_FORCE = 0.2, 0.02
# A touch that is not there to stay within so many frames after the true begin is missed.
WATCHED = 30
_NOTHING = 1e-3  # [N] along an axis, which needs no standard deviation


def rms(errors: NDArray) -> float:
    """Return the root mean square of what is finite; NaN of nothing."""
    finite = errors[np.isfinite(errors)]
    return float(np.sqrt(np.mean(finite**2))) if finite.size else float("nan")


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


def given_distance(result: ForceSeries) -> NDArray[np.float64]:
    """Return how far from the pressure centre the contact was that each loaded image was solved with (n,) [m]."""
    return _loaded_distance(result, result.column("contact_height"))


def solved_distance(result: ForceSeries) -> NDArray[np.float64]:
    """Return how far from the pressure centre the estimator's own place was on each loaded image (n,) [m]."""
    return _loaded_distance(result, result.column("contact_location")[:, 2])


def _loaded_distance(result: ForceSeries, heights: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the distance of heights (n,) from the truth, NaN where it is unknown or hardly anything presses."""
    return np.where(result.true_magnitude > LEAST_FORCE, np.abs(heights - result.column("true_height")), np.nan)


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
            delays.append(_delay(touching, loaded, int(pressed[0]), int(rows[-1])))
    return delays


def _loaded(result: ForceSeries) -> NDArray[np.bool_]:
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


def _false_share(results: Sequence[ForceSeries]) -> float | None:
    """Return the share [%] of frames without true force that were said to touch."""
    said = [each.column("touching")[~_loaded(each)].astype(float) for each in results if each.has("touching")]
    frames = np.concatenate(said) if said else np.zeros(0)
    return 100.0 * float(frames.mean()) if frames.size else None


def onset_stats(results: Sequence[ForceSeries]) -> OnsetStats:
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


@dataclass(frozen=True, kw_only=True)
class Stats:
    """Errors over a set of frames, named as in the JSON; None where there is nothing to compute from.

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
        answered_pct: share of the frames that were to be answered [%].
        torque_rmse_Nm: root mean square length of the difference of the torques about the jaw's origin [N m].
        torque_pct: the same over the root mean square of the true torque [%].
    """

    n: int
    rmse_N: float | None
    nrmsd_pct: float | None
    max_error_N: float | None
    bias_N: float | None
    vector_rmse_N: float | None = None
    axis_rmse_N: tuple[float, float, float] | None = None
    within_3_sigma_pct: tuple[float, float, float] | None = None
    answered_pct: float | None = None
    torque_rmse_Nm: float | None = None
    torque_pct: float | None = None


@dataclass(frozen=True, kw_only=True)
class Spread:
    """Mean and sample standard deviation over cycles; `std` is None for a single cycle."""

    mean: float | None
    std: float | None


@dataclass(frozen=True, kw_only=True)
class CycleStats:
    """How the errors vary from loading cycle to loading cycle."""

    n: int
    rmse_N: Spread
    nrmsd_pct: Spread


@dataclass(frozen=True, kw_only=True)
class StepTimes:
    """Wall time per step [ms]; None without steps."""

    p50: float | None
    p95: float | None
    p99: float | None
    max: float | None


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
        step_ms: time per step.
        cycles: "all", "load", "unload" -> variation over the loading cycles.
        mean_rmse_N: mean of the RMSE of the cases.
        contact_ms: time per step of the contact estimator.
        place: distance of the contact that was given to the estimator from the true pressure centre.
        solved_place: the same of the estimator's own contact place.
        onset: delay of `touching`.
        delay: of the force after its true onset.
        sight: how well the key points were seen.
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
    step_ms: StepTimes
    cycles: Mapping[str, CycleStats]
    mean_rmse_N: float | None
    contact_ms: StepTimes
    place: PlaceStats
    solved_place: PlaceStats
    onset: OnsetStats
    delay: DelayStats
    sight: DetectionStats
    detector_ms: StepTimes


def match_truth(truth: WrenchTrack, stamps: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return the true force at the given stamps (n, 3) [N], matched as by `match_samples`.

    Args:
        truth: measured wrenches.
        stamps: (n,) image times [ns].
    """
    return match_samples(truth.stamps, truth.force, stamps)


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


def compute_stats(errors: NDArray[np.float64], span: float) -> Stats:
    """Return the statistics of errors.

    Args:
        errors: (n,) norm of the estimate minus norm of the truth [N].
        span: range of the true force [N]; 0 leaves `nrmsd_pct` open.
    """
    if errors.size == 0:
        return Stats(n=0, rmse_N=None, nrmsd_pct=None, max_error_N=None, bias_N=None)
    rmse = float(np.sqrt(np.mean(errors**2)))
    return Stats(
        n=int(errors.size),
        rmse_N=rmse,
        nrmsd_pct=100.0 * rmse / span if span > 0.0 else None,
        max_error_N=float(np.abs(errors).max()),
        bias_N=float(errors.mean()),
    )


def _vector_stats(cases: Sequence[ForceSeries], phase: str) -> dict[str, Any]:
    """Return what `Stats` says of the force as a vector, and how often there was one.

    A truth that is along x throughout is a magnitude that was written there, and says nothing of the vector.
    """
    asked = sum(int((case.scored & _is_phase(case, phase)).sum()) for case in cases)
    answered = sum(int((case.scored & case.solved & _is_phase(case, phase)).sum()) for case in cases)
    found: dict[str, Any] = {"answered_pct": 100.0 * answered / asked if asked else None}
    chosen = [_selected(case, phase) for case in cases]
    differences = np.concatenate(
        [(case.force - case.true_force)[rows] for case, rows in zip(cases, chosen, strict=True)]
    )
    if not any(np.nan_to_num(case.true_force[:, 1:]).any() for case in cases) or not len(differences):
        return found
    stated = None
    if all(case.has("force_stddev") for case in cases):
        stated = np.concatenate([case.column("force_stddev")[rows] for case, rows in zip(cases, chosen, strict=True)])
    return found | compare_vectors(differences, stated) | _torque_stats(cases, chosen)


def _torque_stats(cases: Sequence[ForceSeries], chosen: Sequence[NDArray[np.bool_]]) -> dict[str, float]:
    """Return what `Stats` says of the torque; nothing where a case has none, or its truth is zero throughout."""
    pairs = [(case.column("torque"), case.column("true_torque")) for case in cases]
    if not all(case.has("torque") for case in cases) or not all(np.nan_to_num(true).any() for _, true in pairs):
        return {}
    parts = [(found[rows], true[rows]) for (found, true), rows in zip(pairs, chosen, strict=True)]
    found, true = (np.concatenate(part) for part in zip(*parts, strict=True))
    return compare_torques(found, true)


def compare_torques(found: NDArray[np.float64], true: NDArray[np.float64]) -> dict[str, float]:
    """Return `torque_rmse_Nm` and, unless the true ones are zero, `torque_pct` of torques (n, 3) [N m]."""
    error, size = (float(np.sqrt((values**2).sum(axis=1).mean())) for values in (found - true, true))
    return {"torque_rmse_Nm": error} | ({"torque_pct": 100.0 * error / size} if size > 0.0 else {})


def compare_vectors(differences: NDArray[np.float64], stated: NDArray[np.float64] | None) -> dict[str, Any]:
    """Return `vector_rmse_N`, `axis_rmse_N` and, where deviations are stated, `within_3_sigma_pct` of `Stats`.

    Args:
        differences: (n, 3) [N], at least one.
        stated: standard deviations (n, 3) [N]; None where none is known.
    """
    axes = np.sqrt((differences**2).mean(axis=0))
    found: dict[str, Any] = {"vector_rmse_N": float(np.linalg.norm(axes)), "axis_rmse_N": tuple(axes.tolist())}
    if stated is not None:
        within = np.abs(differences) <= np.maximum(3.0 * stated, _NOTHING)
        found["within_3_sigma_pct"] = tuple((100.0 * within.mean(axis=0)).tolist())
    return found


def _is_phase(result: ForceSeries, phase: str) -> NDArray[np.bool_]:
    return np.ones(len(result), dtype=bool) if phase == "all" else result.column("direction") == phase


def _spread(values: Sequence[float | None]) -> Spread:
    """Return mean and sample standard deviation of the numbers among values."""
    numbers = [value for value in values if value is not None]
    if not numbers:
        return Spread(mean=None, std=None)
    return Spread(mean=float(np.mean(numbers)), std=float(np.std(numbers, ddof=1)) if numbers[1:] else None)


def _selected(result: ForceSeries, phase: str) -> NDArray[np.bool_]:
    """Return the frames (n,) that count for "all", "load" or "unload"."""
    return result.counted & _is_phase(result, phase)


def _errors(results: Sequence[ForceSeries], phase: str) -> NDArray[np.float64]:
    """Return the errors of a phase over all results (n,) [N]."""
    return np.concatenate([result.error[_selected(result, phase)] for result in results])


def _cycle_stats(results: Sequence[ForceSeries], phase: str, span: float) -> CycleStats:
    """Score every loading cycle for itself."""
    cycles = []
    for result in results:
        chosen = _selected(result, phase)
        numbers, error = result.column("cycle"), result.error
        cycles += [compute_stats(error[chosen & (numbers == k)], span) for k in np.unique(numbers[chosen])]
    return CycleStats(
        n=len(cycles),
        rmse_N=_spread([cycle.rmse_N for cycle in cycles]),
        nrmsd_pct=_spread([cycle.nrmsd_pct for cycle in cycles]),
    )


def _detector_times(cases: Sequence[ForceSeries]) -> list[NDArray[np.float64]]:
    """Return the times of the detector, once for each recording: it sees both jaws in one pass."""
    times = [case.column("detector_ms") for case in cases if case.has("detector_ms")]
    return list({each.tobytes(): each for each in times}.values())


def _step_times(steps: NDArray[np.float64]) -> StepTimes:
    """Return the percentiles of times (n,) [ms]; NaN is a step that was not timed."""
    timed = steps[np.isfinite(steps)]
    if timed.size == 0:
        return StepTimes(p50=None, p95=None, p99=None, max=None)
    p50, p95, p99, longest = (float(value) for value in np.percentile(timed, [50, 95, 99, 100]))
    return StepTimes(p50=p50, p95=p95, p99=p99, max=longest)


def case_delays(case: ForceSeries) -> list[Delay]:
    """Return what the estimate took to show after each onset of the true force."""
    return force_delays(case.stamps * 1e-9, case.true_magnitude, case.magnitude, case.lag)


def score_case(results: ForceSeries | Sequence[ForceSeries], span: float) -> CaseScore:
    """Score one case, or several together.

    Args:
        results: the time series.
        span: range of the true force over the call's recordings [N].
    """
    cases = [results] if isinstance(results, ForceSeries) else list(results)
    frames = sum(len(case) for case in cases)
    solved = sum(int(case.solved.sum()) for case in cases)
    stats = {
        phase: replace(compute_stats(_errors(cases, phase), span), **_vector_stats(cases, phase))
        for phase in ("all", "load", "unload")
    }
    each = [compute_stats(case.error[case.counted], span).rmse_N for case in cases]
    return CaseScore(
        frames=frames,
        solved=solved,
        skipped=frames - solved,
        record_frames=sum(int(case.scored.sum()) for case in cases),
        record_skipped=sum(int((case.scored & ~case.solved).sum()) for case in cases),
        step_ms=_step_times(np.concatenate([case.column("step_ms") for case in cases])),
        cycles={phase: _cycle_stats(cases, phase, span) for phase in stats},
        mean_rmse_N=_spread(each).mean,
        contact_ms=_step_times(np.concatenate([np.zeros(0), *(case.column("contact_ms") for case in cases)])),
        place=place_stats(np.concatenate([given_distance(case) for case in cases])),
        solved_place=place_stats(np.concatenate([solved_distance(case) for case in cases])),
        onset=onset_stats(cases),
        delay=delay_stats([delay for case in cases for delay in case_delays(case)]),
        sight=detection_stats([case.table for case in cases]),
        detector_ms=_step_times(np.concatenate([np.zeros(0), *_detector_times(cases)])),
        **stats,
    )


@dataclass(frozen=True, kw_only=True)
class GraspScore:
    """The grasp force against the smaller of the jaws' true forces.

    Attributes:
        error: over the record phases, or over every image without phases.
        frames: images that were to be scored, with or without an answer.
        largest: true grasp force [N]; NaN where it is not known.
        delay: after the true onsets.
    """

    error: Stats
    frames: int
    largest: float
    delay: DelayStats


def score_grasp(recording: Recording, grasp: Mapping[int, float], lag: Mapping[int, float]) -> GraspScore:
    """Return how good grasp forces were; of a recording without the truth of all jaws nothing is known.

    Args:
        recording: that was played.
        grasp: by recorded stamp [ns] -> [N].
        lag: from the image to the grasp force [s], by recorded stamp [ns].
    """
    if any(track.truth is None for track in recording.jaws.values()):
        nothing = compute_stats(np.zeros(0), 0.0)
        return GraspScore(error=nothing, frames=0, largest=float("nan"), delay=delay_stats([]))
    stamps = next(iter(recording.jaws.values())).keypoints.stamps
    forces = [np.linalg.norm(match_truth(recording.truth(side), stamps), axis=1) for side in recording.jaws]
    truth, said = np.min(forces, axis=0), _rows(grasp, stamps)
    scored = recording.phases_at(stamps).scored & np.isfinite(truth)
    error = (said - truth)[scored]
    known = truth[np.isfinite(truth)]
    return GraspScore(
        error=compute_stats(error[np.isfinite(error)], float(np.ptp(known)) if known.size else 0.0),
        frames=int(scored.sum()),
        largest=float(known.max()) if known.size else float("nan"),
        delay=delay_stats(force_delays(stamps * 1e-9, truth, said, _rows(lag, stamps))),
    )


def _rows(values: Mapping[int, float], stamps: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return one value per stamp, NaN where there is none."""
    return np.array([values.get(int(stamp), np.nan) for stamp in stamps])
