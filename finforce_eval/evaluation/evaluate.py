"""A recording through an estimator, image after image, and its scores."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from finforce.errors import FinforceError, ObservationError
from finforce_contact.jaw_contact import ContactSource, ForceLoop
from finforce_eval.errors import RecordingError
from finforce_eval.evaluation.manipulation import ManipulationStats, score_manipulation
from finforce_eval.evaluation.places import InnerSurface, true_lines
from finforce_eval.evaluation.results import CaseResult, ContactSeries, Snapshot, compare_detection
from finforce_eval.evaluation.scoring import CaseScore, force_range, match_samples, match_truth, score_case
from finforce_eval.recordings.tracks import Recording, WrenchTrack
from finforce_ifea.estimator import JawEstimator
from finforce_ifea.observation import Contact, Observation


@dataclass(frozen=True, kw_only=True)
class Evaluation:
    """Scores and time series of one call; `manipulation` has those recordings of which both jaws were evaluated."""

    results: Mapping[str, CaseResult]
    scores: Mapping[str, CaseScore]
    total: CaseScore
    span: float
    manipulation: Mapping[str, ManipulationStats] = field(default_factory=dict)


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
    truth = recording.truth(side)
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
    track, expected = recording.jaw(side), len(jaw.keypoint_names)
    counts = {f"key points in /{side}/keypoints": track.keypoints.count}
    if track.sight is not None:  # beside points that were found with that jaw in the images
        counts[f"true key points of the {side} jaw"] = track.sight.points.shape[1]
    for what, count in counts.items():
        if count != expected:
            raise RecordingError(
                f"{recording.name}: {count} {what}; the jaw '{jaw.name}' has {expected} (another --jaw?)"
            )


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
        manipulation=score_manipulation(results, recordings),
    )


class Estimator(Protocol):
    """What is asked of an estimator; `JawEstimator` satisfies it."""

    surface_triangles: NDArray[np.integer]

    def update(self, observation: Observation, contact: Contact | None) -> Any:
        """Return the Solution for one observation."""

    def surface(self) -> NDArray[np.float64]:
        """Return the deformed vertices (n, 3) [m]."""


class StepLog:
    """Runs the steps of one case and keeps what they said.

    Args:
        recording: with key points and ground truth of that side.
        side: "left" or "right".
        jaw: the jaw of that side.
        estimator: a fresh one.
        source: where the contact comes from.
    """

    def __init__(self, recording: Recording, side: str, jaw: Any, estimator: Estimator, source: ContactSource) -> None:
        """Make room for every image."""
        self.name, self.side, self.jaw, self.estimator = recording.name, side, jaw, estimator
        self._jaw_track = recording.jaw(side)
        self.track = track = self._jaw_track.keypoints
        self.phases = recording.phases_at(track.stamps)
        frames = len(track.stamps)
        self.force = np.full((frames, 3), np.nan)
        self.torque = np.full((frames, 3), np.nan)
        self.place = np.full((frames, 3), np.nan)
        self.stddev = np.full(frames, np.nan)
        self.axis_stddev = np.full((frames, 3), np.nan)
        self.residual = np.full(frames, np.nan)
        self.used = np.zeros((frames, track.count), dtype=bool)
        self.status = np.full(frames, "", dtype="U32")
        self.step_ms = np.zeros(frames)
        self.surface0 = np.array(estimator.surface())
        self.loop = ForceLoop(source, estimator)
        self.contacts = ContactLog(recording, side, self.loop, InnerSurface(self.surface0, jaw.face))
        self.snapshot: Snapshot | None = None
        self.largest = 0.0
        self.message = ""

    def step(self, index: int) -> None:
        """Let the loop answer image `index`, and keep what it said."""
        solution = self.loop.update(self.track.observation(index))
        contact = self.loop.given
        self.step_ms[index] = self.loop.force_ms
        self.status[index] = solution.status
        self.used[index] = solution.keypoints_used
        self.residual[index] = solution.residual
        self.contacts.keep(index)
        if solution.trusted:
            self._keep(index, solution, contact)
        else:
            self.message = solution.message

    def _keep(self, index: int, solution: Any, contact: Contact | None) -> None:
        """Keep a trusted estimate."""
        self.force[index] = solution.force
        self.torque[index] = solution.torque
        self.place[index] = solution.contact_location
        self.stddev[index] = solution.magnitude_stddev
        self.axis_stddev[index] = solution.force_stddev
        magnitude = float(np.linalg.norm(solution.force))
        # two per cent: the surface is copied now and then, not on every frame of a rising force
        if self.phases.scored[index] and magnitude > 1.02 * self.largest:
            self.largest = magnitude
            self.snapshot = self._picture(index, solution, contact)

    def _picture(self, index: int, solution: Any, contact: Contact | None) -> Snapshot:
        """Keep the jaw and the object as they are now."""
        known = contact is not None and contact.outline is not None
        return Snapshot(
            stamp=int(self.track.stamps[index]),
            surface0=self.surface0,
            surface=np.array(self.estimator.surface()),
            triangles=np.asarray(self.estimator.surface_triangles),
            keypoints0=np.asarray(self.jaw.keypoints),
            keypoints=self.track.points[index],
            used=np.array(solution.keypoints_used),
            contact_point=np.array(solution.contact_point),
            force=np.array(solution.force),
            outline=contact.outline.placed() if known else (),
        )

    def result(self, truth: WrenchTrack) -> CaseResult:
        """Return the time series, with the true wrenches."""
        stamps = self.track.stamps
        return CaseResult(
            name=self.name,
            side=self.side,
            stamps=stamps,
            truth=match_truth(truth, stamps),
            true_torque=match_samples(truth.stamps, truth.torque, stamps),
            force=self.force,
            torque=self.torque,
            place=self.place,
            stddev=self.stddev,
            axis_stddev=self.axis_stddev,
            residual=self.residual,
            used=self.used,
            status=self.status,
            step_ms=self.step_ms,
            cycle=self.phases.cycle,
            direction=self.phases.direction,
            scored=self.phases.scored,
            snapshot=self.snapshot,
            message=self.message,
            contact=self.contacts.series(),
            **self._seen(),
        )

    def _seen(self) -> dict[str, Any]:
        """Return how the key points were seen, where this call has found them in images."""
        detection, sight = self._jaw_track.detection, self._jaw_track.sight
        if detection is None:
            return {}
        return {
            "sight": None if sight is None else compare_detection(detection, sight),
            "detector_ms": detection.step_ms,
            "latency_ms": self.step_ms + detection.step_ms,
        }


class ContactLog:
    """Keeps what the loop said of the contact, and where the truth was."""

    def __init__(self, recording: Recording, side: str, loop: ForceLoop, surface: InnerSurface) -> None:
        """Make room for every image."""
        self._loop, self._surface = loop, surface
        self._stamps = recording.jaw(side).keypoints.stamps
        self._lines = true_lines(recording, side, self._stamps, surface.face_x)
        frames = len(self._stamps)
        self._given, self._truth, self._ms = (np.full(frames, np.nan) for _ in range(3))
        self._touching = np.zeros(frames, dtype=bool)
        self._status = np.full(frames, "", dtype="U16")

    def keep(self, index: int) -> None:
        """Keep the contact of image `index`, and find the true place on the deformed surface."""
        contact, estimate = self._loop.given, self._loop.contact.estimate
        if contact is not None and len(contact.points):
            self._given[index] = np.average(contact.points[:, 2], weights=contact.weights)
        self._ms[index] = self._loop.contact_ms
        if estimate is not None:
            self._touching[index], self._status[index] = estimate.touching, estimate.status
        surface = self._loop.force.surface()
        self._truth[index] = self._surface.cut(surface, self._lines.points[index], self._lines.directions[index])

    def series(self) -> ContactSeries:
        """Return the time series."""
        is_estimated = self._loop.contact.estimate is not None
        return ContactSeries(
            source=self._loop.contact.name,
            given=self._given,
            truth=self._truth,
            touching=self._touching if is_estimated else None,
            status=self._status,
            step_ms=self._ms if is_estimated else np.full(len(self._stamps), np.nan),
        )
