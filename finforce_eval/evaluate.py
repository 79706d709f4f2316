"""An estimator over recordings, offline, one frame after the other; knows nothing of tables or pictures."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from time import perf_counter
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from finforce_eval.errors import RecordingError
from finforce_eval.results import CaseResult, Snapshot
from finforce_eval.scoring import CaseScore, force_range, match_truth, score_case
from finforce_eval.tracks import Recording
from finforce_ifea.errors import FinforceError, ObservationError
from finforce_ifea.estimator import Contact, JawEstimator, Observation


class Estimator(Protocol):
    """What is asked of an estimator; `JawEstimator` satisfies it."""

    surface_triangles: NDArray[np.integer]

    def update(self, observation: Observation, contact: Contact | None) -> Any:
        """Return the Solution for one observation."""

    def surface(self) -> NDArray[np.float64]:
        """Return the deformed vertices (n, 3) [m]."""


Factory = Callable[..., Estimator]


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
    contact: Contact | None,
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
        contact: contact given with every frame.
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
    log = _StepLog(recording, side, jaw, estimator)
    for index in range(len(track.stamps)):
        try:
            log.step(index, contact)
        except ObservationError as error:
            raise ObservationError(f"{recording.name}: frame {index}: {error}") from error
        progress(1)
    result = log.result(truth)
    _check_solved(result)
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


def _check_solved(result: CaseResult) -> None:
    """Refuse a recording of which nothing can be said."""
    if not result.counted.any():
        unmatched = result.scored & result.solved & ~np.isfinite(result.true_magnitude)
        if unmatched.any():
            raise RecordingError(f"{result.name}: no ground truth at the stamps of the key points")
        words, counts = np.unique(result.status[result.scored], return_counts=True)
        statuses = ", ".join(f"{count} {word}" for word, count in zip(words, counts, strict=True))
        reason = f" ({statuses}): {result.message}" if result.message else f" ({statuses})"
        raise RecordingError(f"{result.name}: none of the frames to be scored was solved{reason}")


class _StepLog:
    """Runs the steps of one case and keeps what they said."""

    def __init__(self, recording: Recording, side: str, jaw: Any, estimator: Estimator) -> None:
        self.name, self.side, self.jaw, self.estimator = recording.name, side, jaw, estimator
        self.track = track = recording.jaw(side).keypoints
        self.phases = recording.phases_at(track.stamps)
        frames = len(track.stamps)
        self.force = np.full((frames, 3), np.nan)
        self.place = np.full((frames, 3), np.nan)
        self.stddev = np.full(frames, np.nan)
        self.residual = np.full(frames, np.nan)
        self.used = np.zeros((frames, track.count), dtype=bool)
        self.status = np.full(frames, "", dtype="U32")
        self.step_ms = np.zeros(frames)
        self.surface0 = np.array(estimator.surface())
        self.snapshot: Snapshot | None = None
        self.largest = 0.0
        self.message = ""

    def step(self, index: int, contact: Contact | None) -> None:
        """Give frame `index` to the estimator."""
        points = self.track.points[index]
        observation = Observation(
            stamp=self.track.stamps[index] * 1e-9, points=points, likelihood=self.track.likelihood[index]
        )
        begin = perf_counter()
        solution = self.estimator.update(observation, contact)
        self.step_ms[index] = 1e3 * (perf_counter() - begin)
        self.status[index] = solution.status
        self.used[index] = solution.keypoints_used
        self.residual[index] = solution.residual
        if not solution.trusted:
            self.message = solution.message
            return
        self.force[index] = solution.force
        self.place[index] = solution.contact_place
        self.stddev[index] = solution.magnitude_stddev
        magnitude = float(np.linalg.norm(solution.force))
        # two per cent: the surface is copied now and then, not on every frame of a rising force
        if self.phases.scored[index] and magnitude > 1.02 * self.largest:
            self.largest = magnitude
            self.snapshot = self._picture(index, points, solution)

    def _picture(self, index: int, points: NDArray[np.float64], solution: Any) -> Snapshot:
        """Keep the jaw as it is now."""
        return Snapshot(
            stamp=int(self.track.stamps[index]),
            surface0=self.surface0,
            surface=np.array(self.estimator.surface()),
            triangles=np.asarray(self.estimator.surface_triangles),
            keypoints0=np.asarray(self.jaw.keypoints),
            keypoints=points,
            used=np.array(solution.keypoints_used),
            contact_point=np.array(solution.contact_point),
            force=np.array(solution.force),
        )

    def result(self, truth: NDArray[np.float64]) -> CaseResult:
        """Return the time series, with the true forces (n, 3) [N]."""
        return CaseResult(
            name=self.name,
            side=self.side,
            stamps=self.track.stamps,
            truth=truth,
            force=self.force,
            place=self.place,
            stddev=self.stddev,
            residual=self.residual,
            used=self.used,
            status=self.status,
            step_ms=self.step_ms,
            cycle=self.phases.cycle,
            direction=self.phases.direction,
            scored=self.phases.scored,
            snapshot=self.snapshot,
            message=self.message,
        )


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
