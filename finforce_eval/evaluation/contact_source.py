"""Where the contact of an image comes from: given once, or estimated from mesh, pose and deformed jaw.

The contact source that a choice names for one jaw of a recording.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from finforce.errors import PoseError
from finforce.stamps import SECOND
from finforce_contact.jaw_contact import ContactLoop
from finforce_eval.errors import RecordingError
from finforce_eval.evaluation.contact_choice import ESTIMATED, FIXED, ContactChoice
from finforce_eval.evaluation.contact_scoring import ONSET_FORCE
from finforce_eval.recordings.objects import ObjectTrack, mean_pose, require_mesh, track_object
from finforce_eval.recordings.tracks import Recording
from finforce_ifea.jaw.jaw import Jaw
from finforce_ifea.observation import Contact

Wrench = tuple[NDArray[np.float64], NDArray[np.float64]]


class ContactSource(Protocol):
    """Gives the contact for one image after the other.

    Attributes:
        name: what it is, for the report.
        estimate: what the contact estimator said last (a ContactEstimate); None for a contact that was given.
    """

    name: str
    estimate: Any

    def contact_at(self, stamp: int) -> Contact | None:
        """Return the contact for an image [ns]; None when nothing is known."""

    def learn(self, stamp: int, surface: NDArray[np.float64], wrench: Wrench | None) -> None:
        """Take what the solver made of that image.

        Args:
            stamp: of the image [ns].
            surface: deformed vertices (n, 3) [m], jaw frame.
            wrench: force (3,) [N] and torque (3,) [N m] about the jaw's origin; None when not trusted.
        """


@dataclass(frozen=True, kw_only=True, eq=False)
class GivenContact:
    """One contact for all images."""

    contact: Contact | None
    name: str = "given"
    estimate: None = None

    def contact_at(self, stamp: int) -> Contact | None:
        """Return it."""
        return self.contact

    def learn(self, stamp: int, surface: NDArray[np.float64], wrench: Wrench | None) -> None:
        """Learn nothing."""


class EstimatedContact:
    """The contact estimator's loop, given the poses of a recording as they come.

    Args:
        estimator: a fresh ContactEstimator.
        track: the object's poses in the jaw frame.
        name: for the report.
    """

    def __init__(self, estimator: Any, track: ObjectTrack, name: str) -> None:
        """Start before the first pose."""
        self.name = name
        self.estimate: Any = None
        self._loop, self._track, self._next = ContactLoop(estimator), track, 0

    def contact_at(self, stamp: int) -> Contact | None:
        """Give the poses up to an image to the estimator, and return what it says of the image.

        Raises:
            RecordingError: the estimator refuses a pose.
        """
        while self._next < len(self._track.stamps) and self._track.stamps[self._next] <= stamp:
            self._take_pose(self._next)
            self._next += 1
        self._loop.update(stamp)
        self.estimate = self._loop.last.estimate
        return self.estimate.contact

    def _take_pose(self, index: int) -> None:
        """Give one pose to the estimator."""
        stamp = int(self._track.stamps[index])
        camera = None if self._track.cameras is None else self._track.cameras[index]
        try:
            self._loop.take_pose(stamp, self._track.poses[index], camera=camera)
        except PoseError as error:
            raise RecordingError(f"object pose at {SECOND * stamp:.3f} s: {error}") from error

    def learn(self, stamp: int, surface: NDArray[np.float64], wrench: Wrench | None) -> None:
        """Keep what the solver found, for the next image."""
        self._loop.keep_surface(stamp, surface)
        if wrench is not None:
            self._loop.take_wrench(stamp, wrench)


# Poses from which the place of first touch is averaged at least.
LEAST_POSES = 3


def build_source(choice: ContactChoice, recording: Recording, jaw: Jaw, mesh: str = "default") -> ContactSource:
    """Return a fresh contact source for one jaw of a recording.

    Args:
        choice: what was asked for.
        recording: it tells height, or mesh and poses.
        jaw: the jaw of that side, as calibrated.
        mesh: mesh density of the solver, whose surface the contact estimator gets.

    Raises:
        FinforceError: height, mesh or poses are missing or cannot be used.
    """
    mode = choice.mode_for(recording, jaw.side)
    if mode == FIXED:
        height = choice.height(recording)
        return GivenContact(contact=Contact.fixed(jaw, height), name=f"fixed:{1e3 * height:g}")
    estimator = build_estimator(choice, mode, recording, jaw, mesh)
    return EstimatedContact(estimator, track_object(recording, jaw.side), name=mode)


def build_estimator(choice: ContactChoice, mode: str, recording: Recording, jaw: Jaw, mesh: str = "default") -> Any:
    """Return a fresh contact estimator that knows the object of a recording.

    Raises:
        RecordingError: no object mesh.
        ObjectMeshError: the mesh cannot be used.
        MissingDependencyError: a library that reads or cuts meshes is not installed.
    """
    from finforce_contact.estimator import ContactEstimator
    from finforce_contact.mesh.object_mesh import load_object_mesh
    from finforce_contact.settings import ContactSettings

    body = load_object_mesh(require_mesh(recording, choice.object_file), unit=choice.object_unit)
    return ContactEstimator(jaw, mesh=body, settings=ContactSettings(mode=mode, mesh=mesh))


def first_touch(choice: ContactChoice, recording: Recording, jaw: Jaw, mesh: str = "default") -> Contact:
    """Return the contact of a whole recording: where its object first touches the undeformed jaw.

    By estimation it is found from the average of the poses before the true force rises, which pose noise of n samples
    enters with 1/sqrt(n) of its size only.

    Args:
        choice: what was asked for.
        recording: with ground truth.
        jaw: the jaw of that side.
        mesh: mesh density of the solver.

    Returns:
        One free point, with the object's outline where the contact estimator gives one.

    Raises:
        FinforceError: height, mesh or poses are missing or cannot be used.
    """
    mode = choice.mode_for(recording, jaw.side)
    if mode not in ESTIMATED:
        return Contact.fixed(jaw, choice.height(recording))
    estimator = build_estimator(choice, mode, recording, jaw, mesh)
    track = _before_load(track_object(recording, jaw.side), recording, jaw.side)
    stamp = float(track.stamps[-1] * 1e-9)
    estimator.take_pose(stamp, mean_pose(track.poses))
    estimate = estimator.update(stamp)
    if estimate.contact is None or not len(estimate.contact.points):
        raise RecordingError(f"{recording.name}: no place of first touch: {estimate.message or estimate.status}")
    point = np.average(estimate.contact.points, axis=0, weights=estimate.contact.weights)
    return Contact(points=point[None], weights=np.ones(1), touching=False, free=True, outline=estimate.contact.outline)


def _before_load(track: ObjectTrack, recording: Recording, side: str) -> ObjectTrack:
    """Return the poses before the true force rises.

    Raises:
        RecordingError: there are hardly any.
    """
    truth = recording.truth(side)
    loaded = np.flatnonzero(np.linalg.norm(truth.force, axis=1) > ONSET_FORCE)
    begin = truth.stamps[loaded[0]] if loaded.size else track.stamps[-1] + 1
    early = track.stamps < begin
    if early.sum() < LEAST_POSES:
        raise RecordingError(
            f"{recording.name}: {early.sum()} object poses before the force rises; expected at least {LEAST_POSES}"
        )
    return ObjectTrack(stamps=track.stamps[early], poses=track.poses[early])
