"""The forces on every jaw in every image of a recording, without any truth, and what the gripper feels of them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from finforce.errors import ObservationError
from finforce_contact.jaw_contact import ContactSource, ForceLoop
from finforce_eval.errors import RecordingError
from finforce_eval.evaluation.evaluate import Estimator, check_keypoint_count
from finforce_eval.evaluation.manipulation import find_distances
from finforce_eval.evaluation.setup import EvaluationSetup
from finforce_eval.recordings.tracks import JAWS, Recording
from finforce_ifea.grasp_force import Grasp, Wrench, combine_wrenches, single_jaw_grasp
from finforce_ifea.observation import Contact, Solution


@dataclass(frozen=True, kw_only=True, eq=False)
class JawForces:
    """What an object does to one jaw, image by image; NaN wherever it is not known.

    Attributes:
        side: "left" or "right".
        stamps: of the images (n,) [ns], rising.
        force: (n, 3) [N], jaw frame.
        torque: about the jaw's origin (n, 3) [N m].
        force_stddev: (n, 3) [N].
        torque_stddev: (n, 3) [N m].
        place: where the contact's force acts on the undeformed jaw (n, 3) [m].
        point: the same on the deformed one (n, 3) [m].
        contact: columns of the points at which the object may touch, as on the topic, of each image; None without.
        status: of the solution (n,): "ok", "unloaded", or why there is none.
        reason: in words (n,), "" where there is a force.
    """

    side: str
    stamps: NDArray[np.int64]
    force: NDArray[np.float64]
    torque: NDArray[np.float64]
    force_stddev: NDArray[np.float64]
    torque_stddev: NDArray[np.float64]
    place: NDArray[np.float64]
    point: NDArray[np.float64]
    contact: list[dict[str, NDArray] | None]
    status: NDArray[np.str_]
    reason: list[str]

    @property
    def answered(self) -> NDArray[np.bool_]:
        """Whether an image has a force (n,)."""
        return np.isfinite(self.force).all(axis=1)

    def is_answered(self, row: int) -> bool:
        """Say whether one image has a force."""
        return bool(np.isfinite(self.force[row]).all())


@dataclass(frozen=True, kw_only=True, eq=False)
class GraspForces:
    """What an object does to the gripper, at the images of which every jaw has a force, else NaN.

    Attributes:
        stamps: (n,) [ns].
        grasp: magnitude along x (n, 3) [N].
        manipulation: net force in the gripper's frame (n, 3) [N].
        torque: about the gripper's origin (n, 3) [N m]; NaN where the jaws' distance is not known.
    """

    stamps: NDArray[np.int64]
    grasp: NDArray[np.float64]
    manipulation: NDArray[np.float64]
    torque: NDArray[np.float64]


class Shape(NamedTuple):
    """How a jaw stands in one image: deformed vertices (n, 3) [m], jaw frame, and their triangles (m, 3)."""

    side: str
    stamp: int
    vertices: NDArray[np.float64]
    triangles: NDArray[np.integer]


def estimate_forces(
    recording: Recording,
    setup: EvaluationSetup,
    progress: Callable[[int], Any] = lambda images: None,
    watch: Callable[[Shape], Any] | None = None,
    build: Callable[[str, bool], Estimator] | None = None,
) -> dict[str, JawForces]:
    """Return the forces on every jaw of a recording that has key points.

    Args:
        recording: with key points, recorded or found.
        setup: jaw, settings, calibration and contact.
        progress: called with the number of images done since its last call.
        watch: called with the shape of the jaw after every image.
        build: gives an estimator of a side that knows nothing yet, and whether both jaws hold; new ones without.

    Raises:
        FinforceError: the key points are another jaw's, or the contact cannot be known.
    """
    for side in recording.jaws:
        check_keypoint_count(recording, side, setup.jaw)
    both = len(recording.jaws) == len(JAWS)
    found = {}
    for side in recording.jaws:
        own = setup.side(side)
        estimator = build(side, both) if build else own.estimator(both)
        found[side] = _estimate_jaw(recording, side, estimator, own.source(recording), progress, watch)
    return found


def _estimate_jaw(
    recording: Recording,
    side: str,
    estimator: Estimator,
    source: ContactSource,
    progress: Callable[[int], Any],
    watch: Callable[[Shape], Any] | None,
) -> JawForces:
    """Return the forces on one jaw; an image that is refused is not answered, and says why."""
    track = recording.jaw(side).keypoints
    log, loop = _Log(side, track.stamps), ForceLoop(source, estimator)
    for index, stamp in enumerate(track.stamps.tolist()):
        try:
            solution = loop.update(track.observation(index))
        except (ObservationError, RecordingError) as error:
            solution = str(error)
        log.take(index, solution, loop.given)
        if watch is not None:
            watch(Shape(side, stamp, np.array(estimator.surface()), np.asarray(estimator.surface_triangles)))
        progress(1)
    return log.forces


class _Log:
    """Collects the answers of one jaw."""

    def __init__(self, side: str, stamps: NDArray[np.int64]) -> None:
        """Make room for every image [ns]; none is answered yet."""
        count = len(stamps)
        vectors = {
            name: np.full((count, 3), np.nan)
            for name in ("force", "torque", "force_stddev", "torque_stddev", "place", "point")
        }
        self.forces = JawForces(
            side=side,
            stamps=stamps,
            contact=[None] * count,
            status=np.full(count, "refused", dtype="U32"),
            reason=[""] * count,
            **vectors,
        )

    def take(self, index: int, solution: Solution | str, contact: Contact | None) -> None:
        """Keep what was said of image `index`."""
        forces = self.forces
        forces.contact[index] = None if contact is None else _contact_columns(contact)
        if isinstance(solution, str):
            forces.reason[index] = solution
            return
        forces.status[index] = solution.status
        if not solution.trusted:
            forces.reason[index] = solution.message or solution.status
            return
        forces.force[index], forces.torque[index] = solution.force, solution.torque
        forces.force_stddev[index], forces.torque_stddev[index] = solution.force_stddev, solution.torque_stddev
        forces.place[index], forces.point[index] = solution.contact_location, solution.contact_point


def _contact_columns(contact: Contact) -> dict[str, NDArray]:
    """Return the columns of the cloud of a contact."""
    columns = {axis: contact.points[:, number].astype(np.float32) for number, axis in enumerate("xyz")}
    touching = np.full(len(contact.points), bool(contact.touching), np.uint8)
    return columns | {"weight": np.asarray(contact.weights, np.float32), "touching": touching}


def combine_forces(recording: Recording, jaws: Mapping[str, JawForces]) -> GraspForces:
    """Return what the gripper feels: of both jaws, or of the only one."""
    stamps = np.unique(np.concatenate([forces.stamps for forces in jaws.values()]))
    wrenches = {side: _wrenches_at(forces, stamps) for side, forces in jaws.items()}
    distances = find_distances(recording, stamps) if len(jaws) == len(JAWS) else [None] * len(stamps)
    out = {name: np.full((len(stamps), 3), np.nan) for name in ("grasp", "manipulation", "torque")}
    for number, distance in enumerate(distances):
        found = {side: track[number] for side, track in wrenches.items()}
        if None in found.values():
            continue
        grasp = _combine(found, distance)
        out["grasp"][number], out["manipulation"][number] = grasp.grasp, grasp.manipulation
        if grasp.torque is not None:
            out["torque"][number] = grasp.torque
    return GraspForces(stamps=stamps, **out)


def _wrenches_at(forces: JawForces, stamps: NDArray[np.int64]) -> list[Wrench | None]:
    """Return the wrench on a jaw at each of some stamps (n,) [ns], None without a force."""
    answered = forces.answered
    known = zip(forces.stamps[answered].tolist(), forces.force[answered], forces.torque[answered], strict=True)
    wrenches = {stamp: Wrench(force, torque) for stamp, force, torque in known}
    return [wrenches.get(stamp) for stamp in stamps.tolist()]


def _combine(wrenches: Mapping[str, Wrench], distance: float | None) -> Grasp:
    """Return the grasp of the wrenches of one image, in which the jaws have a distance [m]."""
    if len(wrenches) == len(JAWS):
        return combine_wrenches(wrenches["left"], wrenches["right"], distance)
    ((side, wrench),) = wrenches.items()
    return single_jaw_grasp(wrench, side)
