"""A recording through an estimator, image after image, and its scores."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from finforce.errors import FinforceError, ObservationError
from finforce_contact.loop import ContactSource, ForceLoop
from finforce_eval.errors import RecordingError
from finforce_eval.evaluation.manipulation import ManipulationStats, score_manipulation
from finforce_eval.evaluation.places import InnerSurface, true_lines
from finforce_eval.evaluation.results import compare_detection
from finforce_eval.evaluation.scoring import CaseScore, match_samples, match_truth, score_case
from finforce_eval.recordings.tracks import Recording
from finforce_eval.table import AXES, ForceSeries, Snapshot
from finforce_ifea.estimator import JawEstimator
from finforce_ifea.observation import Contact, Observation


@dataclass(frozen=True, kw_only=True)
class Evaluation:
    """Scores and time series of one call; `manipulation` has those recordings of which both jaws were evaluated."""

    results: Mapping[str, ForceSeries]
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
) -> ForceSeries:
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
    recording.truth(side)
    check_keypoint_count(recording, side, jaw)
    estimator = factory() if factory else JawEstimator(jaw)
    result = find_forces(recording, side, jaw, estimator, source, progress=progress)
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


def _check_solved(result: ForceSeries, recording: Recording) -> None:
    """Refuse a recording of which nothing can be said."""
    if not result.scored.any():
        raise RecordingError(f"{result.name}: {_why_unscored(result, recording)}")
    if not result.counted.any():
        unmatched = result.scored & result.solved & ~np.isfinite(result.true_magnitude)
        if unmatched.any():
            raise RecordingError(f"{result.name}: no ground truth at the stamps of the key points")
        words, counts = np.unique(result.column("status")[result.scored], return_counts=True)
        statuses = ", ".join(f"{count} {word}" for word, count in zip(words, counts, strict=True))
        message = result.column("message")[~result.solved][-1]
        reason = f" ({statuses}): {message}" if message else f" ({statuses})"
        raise RecordingError(f"{result.name}: none of the frames to be scored was solved{reason}")


def _why_unscored(result: ForceSeries, recording: Recording) -> str:
    """Return why no frame of a recording is to be scored."""
    count, phases = len(result), recording.phases
    if not count:
        return "there are no frames to be scored: no image has key points"
    none = f"none of the {count} frames is to be scored: "
    if phases is not None and not (phases.stage == "record").any():
        return f"{none}/bench/phase names no 'record' phase; expected one, or no /bench/phase: then all are scored"
    return f"{none}its 'record' phases lie at none of their stamps (two clocks?)"


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
        scores={result.name: score_case(result, span) for result in results},
        total=score_case(results, span),
        span=span,
        manipulation=score_manipulation(results),
    )


class Estimator(Protocol):
    """What is asked of an estimator; `JawEstimator` satisfies it."""

    surface_triangles: NDArray[np.integer]

    def update(self, observation: Observation, contact: Contact | None) -> Any:
        """Return the Solution for one observation."""

    def surface(self) -> NDArray[np.float64]:
        """Return the deformed vertices (n, 3) [m]."""


class _JawRun:
    """Runs the steps of one jaw and keeps a row for each.

    Args:
        recording: with key points.
        side: "left" or "right".
        jaw: the jaw of that side.
        estimator: a fresh one.
        source: where the contact comes from.
        strict: an image that is refused ends the run, else it has no force.
    """

    def __init__(
        self, recording: Recording, side: str, jaw: Any, estimator: Estimator, source: ContactSource, *, strict: bool
    ) -> None:
        self._jaw, self._strict, self.loop = jaw, strict, ForceLoop(source, estimator)
        self._track = recording.jaw(side).keypoints
        self._scored = recording.phases_at(self._track.stamps).scored
        self._surface0 = np.array(estimator.surface())
        self._lines = None
        if recording.jaw(side).truth is not None:
            self._face = InnerSurface(self._surface0, jaw.face)
            self._lines = true_lines(recording, side, self._track.stamps, self._face.face_x)
        self.rows: list[dict[str, Any]] = []
        self.snapshot: Snapshot | None = None

    def step(self, index: int) -> None:
        """Let the loop answer image `index`, and keep what it said."""
        row: dict[str, Any] = {"used": np.zeros(self._track.count, dtype=bool), "status": "refused", "message": ""}
        self.rows.append(row)
        try:
            solution = self.loop.update(self._track.observation(index))
        except (ObservationError, RecordingError) as error:
            if self._strict:
                raise
            row |= _contact_columns(self.loop.given) | {"message": str(error)}
            return
        row |= {"step_ms": self.loop.force_ms, "contact_ms": self.loop.contact_ms}
        row |= {"status": solution.status, "used": solution.keypoints_used, "residual": solution.residual}
        row |= _contact_columns(self.loop.given)
        estimate = self.loop.contact.estimate
        if estimate is not None:
            row |= {"touching": bool(estimate.touching), "contact_status": estimate.status}
        if self._lines is not None:
            surface = self.loop.force.surface()
            row["true_height"] = self._face.cut(surface, self._lines.points[index], self._lines.directions[index])
        if solution.trusted:
            row |= _force_columns(solution)
            if self._scored[index]:
                self._look(index, solution)
        else:
            row["message"] = solution.message

    def _look(self, index: int, solution: Any) -> None:
        """Keep jaw and object as they are now where the force is the largest so far."""
        largest = 0.0 if self.snapshot is None else float(np.linalg.norm(self.snapshot.force))
        # two per cent: the surface is copied now and then, not on every image of a rising force
        if float(np.linalg.norm(solution.force)) <= 1.02 * largest:
            return
        contact, estimator = self.loop.given, self.loop.force
        known = contact is not None and contact.outline is not None
        self.snapshot = Snapshot(
            stamp=int(self._track.stamps[index]),
            surface0=self._surface0,
            surface=np.array(estimator.surface()),
            triangles=np.asarray(estimator.surface_triangles),
            keypoints0=np.asarray(self._jaw.keypoints),
            keypoints=self._track.points[index],
            used=np.array(solution.keypoints_used),
            contact_point=np.array(solution.contact_point),
            force=np.array(solution.force),
            outline=contact.outline.placed() if known else (),
        )


def _contact_columns(contact: Contact | None) -> dict[str, Any]:
    """Return the columns of a contact as it was given to the solver; none without."""
    if contact is None:
        return {}
    points = np.asarray(contact.points, dtype=np.float64)
    known = {f"points_{axis}": points[:, number] for number, axis in enumerate(AXES)}
    known |= {"points_weight": np.asarray(contact.weights, np.float64), "points_touching": bool(contact.touching)}
    return known | ({"contact_height": np.average(points[:, 2], weights=contact.weights)} if len(points) else {})


def _force_columns(solution: Any) -> dict[str, Any]:
    """Return the columns of a trusted solution."""
    return {
        "force": solution.force,
        "torque": solution.torque,
        "force_stddev": solution.force_stddev,
        "torque_stddev": solution.torque_stddev,
        "magnitude_stddev": solution.magnitude_stddev,
        "contact_location": solution.contact_location,
        "contact_point": solution.contact_point,
    }


_FOUND = ("force", "torque", "force_stddev", "torque_stddev", "contact_location", "contact_point")
_NUMBERS = ("magnitude_stddev", "residual", "step_ms", "contact_height")
_OBJECTS = ("used", "points_x", "points_y", "points_z", "points_weight", "points_touching")


def find_forces(
    recording: Recording,
    side: str,
    jaw: Any,
    estimator: Estimator,
    source: ContactSource,
    *,
    strict: bool = True,
    progress: Callable[[int], Any] = lambda steps: None,
    watch: Callable[[int, Estimator], Any] | None = None,
) -> ForceSeries:
    """Return the force on one jaw in every image that has key points, and where it was measured, the true one.

    Args:
        recording: with key points.
        side: "left" or "right".
        jaw: the jaw of that side.
        estimator: a fresh one.
        source: where the contact of each image comes from; a fresh one.
        strict: an image that is refused ends the run, else it has no force and says why.
        progress: called with the number of images done since its last call.
        watch: called with stamp [ns] and estimator after every image.

    Raises:
        RecordingError: a pose or an image is refused.
        ObservationError: the estimator refuses an image.
    """
    stamps = recording.jaw(side).keypoints.stamps
    run = _JawRun(recording, side, jaw, estimator, source, strict=strict)
    for index, stamp in enumerate(stamps.tolist()):
        try:
            run.step(index)
        except ObservationError as error:
            raise ObservationError(f"{recording.name}: frame {index}: {error}") from error
        except RecordingError as error:
            raise RecordingError(f"{recording.name}: {error}") from error
        if watch is not None:
            watch(stamp, estimator)
        progress(1)
    nothing, phases = np.full(3, np.nan), recording.phases_at(stamps)
    columns: dict[str, Any] = {name: [row.get(name, nothing) for row in run.rows] for name in _FOUND}
    columns |= {name: [row.get(name, np.nan) for row in run.rows] for name in _NUMBERS}
    columns |= {name: [row.get(name) for row in run.rows] for name in _OBJECTS}
    columns |= {name: np.array([row[name] for row in run.rows], dtype=str) for name in ("status", "message")}
    columns |= {"cycle": phases.cycle, "direction": phases.direction, "scored": phases.scored}
    columns |= _truth_columns(recording, side) | _estimate_columns(source, run.rows) | sight_columns(recording, side)
    series = ForceSeries.build(recording.name, side, stamps, **columns)
    if "detector_ms" in columns:
        series = series.with_columns(latency_ms=series.column("step_ms") + columns["detector_ms"])
    return series.with_snapshot(run.snapshot)


def _truth_columns(recording: Recording, side: str) -> dict[str, Any]:
    """Return the measured wrenches at the stamps of the key points, none without any."""
    truth, stamps = recording.jaw(side).truth, recording.jaw(side).keypoints.stamps
    if truth is None:
        return {}
    return {
        "true_force": match_truth(truth, stamps),
        "true_torque": match_samples(truth.stamps, truth.torque, stamps),
    }


def _estimate_columns(source: ContactSource, rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Return what a contact source said of each image, and where the measured force pressed."""
    columns: dict[str, Any] = {"contact_source": source.name}
    columns["true_height"] = np.array([row.get("true_height", np.nan) for row in rows])
    columns["contact_status"] = np.array([row.get("contact_status", "") for row in rows], dtype=str)
    if source.estimate is not None:
        columns["touching"] = np.array([row.get("touching", False) for row in rows], dtype=bool)
        columns["contact_ms"] = np.array([row.get("contact_ms", np.nan) for row in rows])
    return columns


def sight_columns(recording: Recording, side: str) -> dict[str, Any]:
    """Return how the key points were seen, where they were found in images."""
    track = recording.jaw(side)
    if track.detection is None:
        return {}
    columns: dict[str, Any] = {"detector_ms": track.detection.step_ms}
    if track.sight is not None:
        errors = compare_detection(track.detection, track.sight).set_index("stamp")
        columns |= dict(errors.reindex(track.keypoints.stamps).items())
    return columns
