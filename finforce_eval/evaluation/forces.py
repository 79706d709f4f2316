"""The forces on the jaws of a recording, image after image, as rows of the table of forces."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from math import ceil
from typing import TYPE_CHECKING, Any

import numpy as np

from finforce.errors import ObservationError
from finforce.gripper_frames import SIDES
from finforce.health import Idling
from finforce.messages import SECOND
from finforce_contact.estimator import CONTRADICTED
from finforce_contact.loop import ContactSource, ForceLoop, GivenContact
from finforce_eval.errors import RecordingError
from finforce_eval.evaluation.gripper import with_gripper
from finforce_eval.evaluation.pressure_centre import InnerSurface, true_lines
from finforce_eval.evaluation.scoring import ONSET_FORCE, compare_detection, match_samples, match_truth
from finforce_eval.recordings.objects import read_friction
from finforce_eval.recordings.tracks import DetectionTrack, Recording
from finforce_eval.table import AXES, ForceSeries
from finforce_eval.tasks import progress_bar
from finforce_ifea.grasp_force import to_jaw

if TYPE_CHECKING:
    from finforce_eval.evaluation.setup import EvaluationSetup
    from finforce_ifea.estimator import ForceEstimator
    from finforce_ifea.observation import Observation, Solution
    from finforce_ifea.tare import Tare

_VECTORS = ("force", "torque", "force_stddev", "torque_stddev", "contact_location", "contact_point")
_NUMBERS = ("magnitude_stddev", "residual", "step_ms", "contact_ms", "contact_height", "true_height")
_POINTS = ("points_x", "points_y", "points_z", "points_weight", "points_touching")


NOT_FOUND, REFUSED = "not found", "refused"  # status of a jaw that is in none of the images, and of a bad image
STILL_UPDATES = 30  # updates with the same still, for its contact to settle
STILL_PERIOD = 0.03  # [s], between them
PICKED_STDDEV = 1e-3  # [m] of key points that say nothing of it: picked by hand, they scatter by a millimetre or two
LEAST_ANSWERED = 0.1  # share of the images with a force, below which there is no such finger in them


def evaluate_jaws(recording: Recording, setup: EvaluationSetup) -> list[ForceSeries]:
    """Return the forces on every jaw with ground truth of a recording, under a progress bar.

    Raises:
        RecordingError: no ground truth, another number of key points than the jaw's, or not one frame solved.
        FinforceError: the contact cannot be known, or the estimator refuses a frame.
    """
    sides = truth_sides(recording)
    found = estimate_shown(recording, setup, sides, ImageRun(strict=True))
    results = [each.renamed(f"{recording.name}/{side}") if len(sides) > 1 else each for side, each in found.items()]
    for result in results:
        check_solved(result, recording)
    return results


def truth_sides(recording: Recording) -> list[str]:
    """Return the jaws of a recording that have ground truth.

    Raises:
        RecordingError: there is none.
    """
    sides = [side for side, track in recording.jaws.items() if track.truth is not None]
    if not sides:
        recording.truth(next(iter(recording.jaws)))
    return sides


@dataclass(frozen=True, kw_only=True)
class ImageRun:
    """How the images of a recording are run through.

    Attributes:
        strict: an image that is refused ends the run, else it has no force and says why.
        as_live: the images that the solver's node passes over are left out.
        stills: nothing of one image is known in the next.
        progress: called with the number of images done since its last call.
        watch: called with side, stamp [ns] and estimator after every image.
    """

    strict: bool = False
    as_live: bool = False
    stills: bool = False
    progress: Callable[[int], Any] = lambda images: None
    watch: Callable[[str, int, ForceEstimator], Any] = lambda side, stamp, estimator: None


def estimate_forces(
    recording: Recording,
    setup: EvaluationSetup,
    sides: Collection[str] = (),
    run: ImageRun | None = None,
    tares: Mapping[str, Tare] | None = None,
) -> dict[str, ForceSeries]:
    """Return the forces on some jaws of a recording that has key points, and the distance of two.

    Args:
        recording: with key points, recorded or found.
        setup: jaw, settings, calibration and contact, and which images count.
        sides: of the jaws; all without.
        run: how refused images are taken, and who watches.
        tares: offsets of the key points by side, where others than those of the first images are wanted.

    Raises:
        FinforceError: the key points are another jaw's, or the contact cannot be known.
    """
    sides = sides or list(recording.jaws)
    for side in sides:
        check_keypoint_count(recording, side, setup.jaw)
    both, found, friction = len(sides) == len(SIDES), {}, read_friction(recording)
    run = replace(run or ImageRun(), as_live=setup.as_live, stills=setup.stills)
    for side in sides:
        own = setup.side(side)
        source = GivenContact(None) if _is_unseen(recording, side) else own.source(recording)
        estimator = own.estimator(both)
        estimator.expect_friction(friction)
        if tares:
            estimator.adopt_tare(tares[side])
        found[side] = find_forces(recording, own.jaw, source, estimator, side, run)
    return with_gripper(found, recording) if both else found


def estimate_shown(
    recording: Recording, setup: EvaluationSetup, sides: Collection[str] = (), run: ImageRun | None = None
) -> dict[str, ForceSeries]:
    """Return the same under a progress bar; see `estimate_forces`."""
    frames = sum(len(recording.jaw(side).keypoints.stamps_ns) for side in sides or recording.jaws)
    with progress_bar(frames, "frame", recording.name) as bar:
        return estimate_forces(recording, setup, sides, replace(run or ImageRun(), progress=bar.update))


def _is_unseen(recording: Recording, side: str) -> bool:
    """Say whether a detector found a jaw in none of the images."""
    track = recording.jaw(side)
    return track.detection is not None and track.pose is None


def check_keypoint_count(recording: Recording, side: str, jaw: Any) -> None:
    """Refuse a recording of another jaw.

    Raises:
        RecordingError: the numbers of key points differ.
    """
    track, expected = recording.jaw(side), len(jaw.keypoint_names)
    counts = {f"key points in /{side}/keypoints": track.keypoints.count}
    if track.sight is not None:  # in addition to points that were found with that jaw in the images
        counts[f"true key points of the {side} jaw"] = track.sight.points.shape[1]
    for what, count in counts.items():
        if count != expected:
            raise RecordingError(
                f"{recording.name}: {count} {what}; the jaw '{jaw.name}' has {expected} (another --jaw?)"
            )


def check_solved(result: ForceSeries, recording: Recording) -> None:
    """Refuse a recording of which nothing is known.

    Raises:
        RecordingError: no frame that is to be scored was solved, and why.
    """
    if not result.scored.any():
        raise RecordingError(f"{result.name}: {_why_unscored(result, recording)}")
    counted, loaded = result.counted, result.scored & (np.nan_to_num(result.true_magnitude) > ONSET_FORCE)
    blind = counted.any() and loaded.any() and not (loaded & result.solved).any()
    if blind or not counted.any():
        if not blind and (result.scored & result.solved).any():
            late = SECOND * float(recording.truth(result.side).stamps_ns[0] - result.stamps_ns[0])
            when = f"it begins {abs(late):.1f} s {'after' if late > 0.0 else 'before'} them: two clocks?"
            raise RecordingError(f"{result.name}: no ground truth at the stamps of the key points; {when}")
        words, counts = np.unique(result.column("status")[loaded if blind else result.scored], return_counts=True)
        statuses = ", ".join(f"{count} {word}" for word, count in zip(words, counts, strict=True))
        message = result.column("message")[~result.solved][-1]
        reason = f" ({statuses}): {message}" if message else f" ({statuses})"
        what = "frames under load" if blind else "frames to be scored"
        raise RecordingError(f"{result.name}: none of the {what} was solved{reason}")


def _why_unscored(result: ForceSeries, recording: Recording) -> str:
    """Return why no frame of a recording is to be scored."""
    count, phases = len(result), recording.phases
    if not count:
        return "there are no frames to be scored: no image has key points"
    none = f"none of the {count} frames is to be scored: "
    if phases is not None and not (phases.stage == "record").any():
        return f"{none}/bench/phase names no 'record' phase; expected one, or no /bench/phase: then all are scored"
    return f"{none}its 'record' phases lie at none of their stamps (two clocks?)"


def find_forces(
    recording: Recording,
    jaw: Any,
    source: ContactSource,
    estimator: ForceEstimator,
    side: str,
    how: ImageRun,
) -> ForceSeries:
    """Return the force on one jaw in every image that has key points, and where it was measured, the true one.

    Deterministic: the same recording gives the same estimates.

    Args:
        recording: with key points.
        jaw: the jaw of that side.
        source: where the contact of each image comes from; a fresh one.
        estimator: one that knows of no recording.
        side: "left" or "right".
        how: images are run through.

    Raises:
        RecordingError: a pose or an image is refused.
        ObservationError: the estimator refuses an image.
    """
    stamps = recording.jaw(side).keypoints.stamps_ns
    run, rows = _JawRun(recording, side, jaw, ForceLoop(source, estimator), how.stills), []
    idling, passed = Idling(), np.zeros(len(stamps), dtype=bool)
    unseen = _is_unseen(recording, side)
    for index, stamp in enumerate(stamps.tolist()):
        how.progress(1)
        if unseen:
            rows.append(run.row(NOT_FOUND, f"the {side} jaw is in none of the images"))
            continue
        passed[index] = idling.passes(stamp)
        if passed[index]:
            source.contact_at(stamp, estimator.surface)  # its node has rules of its own
            rows.append(run.row("", ""))
            continue
        rows.append(run.answer(index, how.strict))
        idling.note(stamp, how.as_live and rows[-1]["status"] != REFUSED and estimator.is_idle)
        how.watch(side, stamp, estimator)
    columns = _stack_rows(rows, source)
    columns |= recording.phases_at(stamps) | truth_columns(recording, side) | sight_columns(recording, side)
    if "detector_ms" in columns:
        columns["latency_ms"] = columns["step_ms"] + columns["detector_ms"]
    series = ForceSeries.build(recording.name, side, stamps, **columns)
    return series.at(~passed) if how.as_live else series


def _stack_rows(rows: Sequence[Mapping[str, Any]], source: ContactSource) -> dict[str, Any]:
    """Return the rows of a run as columns, with where its contacts came from."""
    columns = {name: np.array([row[name] for row in rows]) for name in (*_VECTORS, *_NUMBERS)}
    columns |= {name: [row[name] for row in rows] for name in (*_POINTS, "used")}
    columns |= {name: np.array([row[name] for row in rows], str) for name in ("status", "message", "contact_status")}
    if source.estimate is not None:
        columns["touching"] = np.array([row["touching"] for row in rows], dtype=bool)
    else:
        del columns["contact_ms"]
    return columns | {"contact_source": source.name}


class _JawRun:
    """The images of one jaw through the loop of contact and force.

    Args:
        recording: with key points.
        side: "left" or "right".
        jaw: the jaw of that side.
        loop: a fresh one.
        stills: True if nothing of one image is known in the next.
    """

    def __init__(self, recording: Recording, side: str, jaw: Any, loop: ForceLoop, stills: bool) -> None:
        self._name, self._stills, self._seen = recording.name, stills, None
        self._loop, self._track = loop, recording.jaw(side).keypoints
        self._lines, self._side, self._gravity = None, side, recording.gravity
        if recording.jaw(side).truth is not None:
            self._face = InnerSurface(np.array(loop.force.surface()), jaw.face)
            self._lines = true_lines(recording, side, self._track.stamps_ns, self._face.face_x)

    def answer(self, index: int, strict: bool) -> dict[str, Any]:
        """Return what the loop makes of image `index`; one that is refused ends the run if `strict`; see `step`."""
        try:
            return self.step(index)
        except (ObservationError, RecordingError) as error:
            if strict:
                frame = f"frame {index}: " if isinstance(error, ObservationError) else ""
                raise type(error)(f"{self._name}: {frame}{error}") from error
            return self.row(REFUSED, str(error))

    def step(self, index: int) -> dict[str, Any]:
        """Return what the loop makes of image `index`.

        Raises:
            ObservationError: the estimator refuses it.
            RecordingError: the contact estimator refuses a pose.
        """
        loop, observation = self._loop, self._track.observation(index)
        if self._gravity is not None:
            posture = to_jaw(self._gravity.at(int(self._track.stamps_ns[index])), self._side)
            observation = replace(observation, posture=posture)
        solution = self._solve_still(observation) if self._stills else loop.update(observation)
        row = self.row(solution.status, "" if solution.trusted else solution.message)
        row |= {"step_ms": loop.force_ms, "contact_ms": loop.contact_ms}
        row |= {"used": solution.keypoints_used, "residual": solution.residual}
        if loop.contact.estimate is not None:
            row |= {"touching": solution.touching, "contact_status": loop.contact.estimate.status}
            if loop.contact.estimate.status == CONTRADICTED or solution.status == "no_contact":
                row["message"] = loop.contact.estimate.message or row["message"]
        if self._lines is not None:
            line = self._lines.points[index], self._lines.directions[index]
            row["true_height"] = self._face.cut(loop.force.surface(), *line)
        if solution.trusted:
            row |= {name: getattr(solution, name) for name in (*_VECTORS, "magnitude_stddev")}
        return row

    def _solve_still(self, observation: Observation) -> Solution:
        """Return what the loop makes of a photograph, which several images may show."""
        if observation.stddev is None:
            observation = replace(observation, stddev=np.full(observation.points.shape, PICKED_STDDEV))
        seen = np.column_stack([observation.points, observation.stddev, observation.likelihood])
        if self._seen is None or not np.array_equal(seen, self._seen, equal_nan=True):
            self._loop.forget()
            for number in range(STILL_UPDATES):
                at = observation.stamp + number * STILL_PERIOD
                self._solution = self._loop.update(replace(observation, stamp=at))
            self._seen = seen
        return self._solution

    def row(self, status: str, message: str) -> dict[str, Any]:
        """Return a row without a force, with the contact as it was given to the solver, if there was any."""
        row = dict.fromkeys(_NUMBERS, np.nan) | dict.fromkeys(_POINTS) | dict.fromkeys(_VECTORS, np.full(3, np.nan))
        row |= {"used": np.zeros(self._track.count, dtype=bool), "touching": False, "contact_status": ""}
        contact = self._loop.given
        if contact is not None:
            points = np.asarray(contact.points, dtype=np.float64)
            row |= {f"points_{axis}": points[:, number] for number, axis in enumerate(AXES)}
            row |= {"points_weight": np.asarray(contact.weights, np.float64), "points_touching": bool(contact.touching)}
            if len(points):
                row["contact_height"] = np.average(points[:, 2], weights=contact.weights)
        return row | {"status": status, "message": message}


def truth_columns(recording: Recording, side: str) -> dict[str, Any]:
    """Return the measured wrenches at the stamps of the key points, none without any."""
    truth, stamps = recording.jaw(side).truth, recording.jaw(side).keypoints.stamps_ns
    if truth is None:
        return {}
    return {
        "true_force": match_truth(truth, stamps),
        "true_torque": match_samples(truth.stamps_ns, truth.torque, stamps),
    }


def sight_columns(recording: Recording, side: str) -> dict[str, Any]:
    """Return how the key points were seen, where they were found in images."""
    track = recording.jaw(side)
    if track.detection is None:
        return {}
    columns: dict[str, Any] = {"detector_ms": track.detection.step_ms}
    if track.sight is not None:
        errors = compare_detection(track.detection, track.sight).set_index("stamp")
        columns |= dict(errors.reindex(track.keypoints.stamps_ns).items())
    return columns


def why_unanswered(jaws: Collection[ForceSeries]) -> str:
    """Return why a recording counts as one without forces, "" where it does not.

    Key points that a detector takes for a jaw where there is none give a force now and then. Counted are the images in
    which every jaw that was found at all has one.
    """
    found = [each for each in jaws if not (each.column("status") == NOT_FOUND).all()]
    images, answered = max(map(len, jaws)), int(np.all([each.solved for each in found], axis=0).sum()) if found else 0
    least = max(1, ceil(LEAST_ANSWERED * images))
    if answered >= least:
        return ""
    counts = Counter(reason for each in jaws for reason in no_force_reasons(each) if reason)
    reasons = "; ".join(reason for reason, _ in counts.most_common(2))
    is_taring = all(np.isin(each.column("status"), ("waiting", NOT_FOUND)).all() for each in jaws)
    hint = " (separate photographs? give --stills)" if is_taring and found else ""
    told = f"a force in {answered} of {images} images, on all jaws that were found, expected {least} at least"
    return f"{told}: {reasons}{hint}"


def no_force_reasons(forces: ForceSeries) -> list[str]:
    """Return for each image why it has no force, "" where it has one."""
    columns = zip(forces.solved, forces.column("message"), forces.column("status"), strict=True)
    return ["" if solved else str(message or status) for solved, message, status in columns]


def describe_contradictions(jaws: Collection[ForceSeries]) -> list[str]:
    """Return what the images last said against the mesh of the object, once each; empty where nothing does."""
    told = [each.column("message")[each.column("contact_status") == CONTRADICTED] for each in jaws]
    return list(dict.fromkeys(str(texts[-1]) for texts in told if len(texts)))


def share_reached(forces: ForceSeries, detection: DetectionTrack | None) -> float | None:
    """Return which share of the key points accepted in answered images the mechanics can reach; None if unknown."""
    if detection is None or not forces.solved.any():
        return None
    accepted = detection.accepted[np.searchsorted(detection.stamps_ns, forces.stamps_ns[forces.solved])]
    return float((forces.column("used")[forces.solved] & accepted).sum() / accepted.sum()) if accepted.any() else None
