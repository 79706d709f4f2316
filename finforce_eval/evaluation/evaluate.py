"""An estimator over recordings, offline, one frame after the other."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from finforce.errors import FinforceError, ObservationError
from finforce_eval.errors import RecordingError
from finforce_eval.evaluation.contact_source import ContactSource
from finforce_eval.evaluation.results import CaseResult
from finforce_eval.evaluation.scoring import CaseScore, force_range, match_truth, score_case
from finforce_eval.evaluation.steps import Estimator, StepLog
from finforce_eval.recordings.tracks import Recording
from finforce_ifea.estimator import JawEstimator


@dataclass(frozen=True, kw_only=True)
class Evaluation:
    """Scores and time series of one call."""

    results: Mapping[str, CaseResult]
    scores: Mapping[str, CaseScore]
    total: CaseScore
    span: float


def evaluate_recording(
    recording: Recording,
    jaw: Any,
    source: ContactSource,
    *,
    side: str = "left",
    factory: Callable[[], Estimator] | None = None,
    progress: Callable[[int], Any] = lambda steps: None,
) -> CaseResult:
    """Run an estimator over all frames of one jaw of a recording.

    Deterministic: the same recording gives the same estimates.

    Args:
        recording: what was recorded.
        jaw: the jaw of that side.
        source: where the contact of each frame comes from; a fresh one.
        side: "left" or "right".
        factory: makes a fresh estimator; `JawEstimator(jaw)` without one.
        progress: called with the number of frames done since its last call.

    Raises:
        RecordingError: no ground truth, another number of key points than the jaw's, or not one frame solved.
        ObservationError: the estimator refuses a frame.
    """
    track = recording.jaw(side).keypoints
    truth = match_truth(recording.truth(side), track.stamps)
    check_keypoint_count(recording, side, jaw)
    estimator = factory() if factory else JawEstimator(jaw)
    log = StepLog(recording, side, jaw, estimator, source)
    for index in range(len(track.stamps)):
        try:
            log.step(index)
        except ObservationError as error:
            raise ObservationError(f"{recording.name}: frame {index}: {error}") from error
        except RecordingError as error:
            raise RecordingError(f"{recording.name}: {error}") from error
        progress(1)
    result = log.result(truth)
    _check_solved(result, recording)
    return result


def check_keypoint_count(recording: Recording, side: str, jaw: Any) -> None:
    """Refuse a recording of another jaw.

    Raises:
        RecordingError: the numbers of key points differ.
    """
    count, expected = recording.jaw(side).keypoints.count, len(jaw.keypoint_names)
    if count != expected:
        what = f"{count} key points in /{side}/keypoints; the jaw '{jaw.name}' has {expected}"
        raise RecordingError(f"{recording.name}: {what} (another --jaw?)")


def _check_solved(result: CaseResult, recording: Recording) -> None:
    """Refuse a recording of which nothing can be said."""
    if not result.scored.any():
        raise RecordingError(f"{result.name}: {_why_unscored(result, recording)}")
    if not result.counted.any():
        unmatched = result.scored & result.solved & ~np.isfinite(result.true_magnitude)
        if unmatched.any():
            raise RecordingError(f"{result.name}: no ground truth at the stamps of the key points")
        words, counts = np.unique(result.status[result.scored], return_counts=True)
        statuses = ", ".join(f"{count} {word}" for word, count in zip(words, counts, strict=True))
        reason = f" ({statuses}): {result.message}" if result.message else f" ({statuses})"
        raise RecordingError(f"{result.name}: none of the frames to be scored was solved{reason}")


def _why_unscored(result: CaseResult, recording: Recording) -> str:
    """Return why no frame of a recording is to be scored."""
    count, phases = len(result.stamps), recording.phases
    if not count:
        return "there are no frames to be scored: no image has key points"
    none = f"none of the {count} frames is to be scored: "
    if phases is not None and not (phases.stage == "record").any():
        return f"{none}/bench/phase names no 'record' phase; expected one, or no /bench/phase: then all are scored"
    return f"{none}its 'record' phases lie at none of their stamps (two clocks?)"


def score_results(results: Sequence[CaseResult], recordings: Sequence[Recording]) -> Evaluation:
    """Score the cases of one call together.

    Args:
        results: one or more per recording.
        recordings: the recordings of the call; the range of their true forces normalises `nrmsd_pct`.

    Raises:
        FinforceError: two cases have the same name.
    """
    names = [result.name for result in results]
    twice = {name for name in names if names.count(name) > 1}
    if twice:
        raise FinforceError(f"two recordings are called {', '.join(sorted(twice))}; give each once")
    tracks = [jaw.truth for recording in recordings for jaw in recording.jaws.values()]
    span = force_range(track.force for track in tracks if track is not None)
    return Evaluation(
        results={result.name: result for result in results},
        scores={result.name: score_case(result, span) for result in results},
        total=score_case(results, span),
        span=span,
    )
