"""Contact and force of one jaw, image after image: the same offline, in nodes and from a Python prompt."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from contextlib import suppress
from time import perf_counter
from typing import TYPE_CHECKING, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from finforce.errors import FinforceError
from finforce.messages import SECOND
from finforce.transforms import invert_pose
from finforce_contact.estimator import ContactEstimate, ContactEstimator
from finforce_contact.mesh.object_mesh import ObjectMesh
from finforce_ifea.observation import Contact, Observation, Solution, is_out_of_reach
from finforce_ifea.resting import RestingContact

if TYPE_CHECKING:
    from finforce_ifea.estimator import ForceEstimator

Surface = Callable[[], NDArray | None]  # gives the jaw's deformed vertices (n, 3) [m], None where nobody knows them
UNMOVED = 0.2e-3  # [m] and, for its axes, [1]: a jaw that differs by less has not moved


class TimedEstimate(NamedTuple):
    """An estimate and the stamp of its image [ns]."""

    stamp: int
    estimate: ContactEstimate


class ContactSource(Protocol):
    """Gives the contact of one image after the other.

    Attributes:
        name: its name in reports.
        estimate: last answer of the contact estimator; None for a contact that was given.
    """

    name: str
    estimate: ContactEstimate | None

    def contact_at(self, stamp: int, surface: Surface | None = None) -> Contact | None:
        """Return the contact of an image [ns]; None when nothing is known; see `ContactLoop.update`."""

    def reset(self) -> None:
        """Forget all images."""


class GivenContact:
    """One contact for all images; None for none."""

    estimate = None

    def __init__(self, contact: Contact | None, name: str = "given") -> None:
        self.contact, self.name = contact, name

    def contact_at(self, stamp: int, surface: Surface | None = None) -> Contact | None:
        """Return it."""
        return self.contact

    def reset(self) -> None:
        """Forget nothing."""


class ContactLoop:
    """The contact estimator of one jaw, fed with stamps in nanoseconds; offline and live use this same one.

    Attributes:
        estimator: of this jaw.
        last: the newest contact, None before the first.

    Args:
        estimator: of this jaw.
    """

    name = "estimate"

    def __init__(self, estimator: ContactEstimator) -> None:
        self.estimator = estimator
        self._start()

    def _start(self) -> None:
        self.last: TimedEstimate | None = None
        self._posed: int | None = None
        self._T_jaw_camera: NDArray | None = None

    def reset(self) -> None:
        """Forget everything but the object's mesh."""
        self.estimator.reset()
        self._start()

    def set_object(self, mesh: ObjectMesh | None) -> None:
        """Take another object; its pose is not known yet.

        Raises:
            FinforceError: the mode of the estimator cannot do with this object.
        """
        self.estimator.set_object(mesh)
        self._posed = None
        if mesh is not None:  # what is compiled on first use is so before the first image waits for it
            T = np.eye(4)
            for stamp, candidate in enumerate(self.estimator.jaw.candidates[[0, -1]]):
                T[:3, 3] = candidate
                with suppress(FinforceError):
                    self.estimator.take_pose(float(stamp), T, camera=-candidate)
                    self.estimator.update(float(stamp))
            self.estimator.reset()

    @property
    def is_out_of_reach(self) -> bool:
        """True if the object was out of the jaw's reach in the last contact."""
        contact = self.estimate.contact if self.estimate else None
        return contact is not None and is_out_of_reach(contact, self.estimator.jaw.inner_face_x)

    def take_pose(
        self, stamp: int, T_jaw_object: NDArray, covariance: NDArray | None = None, camera: NDArray | None = None
    ) -> None:
        """Take the object's pose (4, 4) in an image [ns]; one that is not newer than the last is left out.

        Args:
            stamp: of the image [ns].
            T_jaw_object: (4, 4) [m].
            covariance: (6, 6) [m, rad], along the jaw's axes; None when unknown.
            camera: position (3,) of the camera in the jaw frame [m].

        Raises:
            PoseError: the pose makes no sense.
        """
        if self._posed is None or stamp > self._posed:
            self.estimator.take_pose(SECOND * stamp, T_jaw_object, covariance, camera=camera)
            self._posed = stamp

    def follow_jaw(self, T_jaw_camera: NDArray) -> None:
        """Take the camera's pose (4, 4) in the jaw frame, with which what is known of the object goes.

        Between two poses of the object, which may be rare, the jaw goes on.
        """
        if not self._is_moved(T_jaw_camera):
            return
        self.estimator.carry(T_jaw_camera @ invert_pose(self._T_jaw_camera))
        self._T_jaw_camera = T_jaw_camera

    def as_now(self, T_jaw_object: NDArray, T_jaw_camera: NDArray) -> NDArray:
        """Return the object's pose (4, 4) in the frame of the jaw as it was last followed; both of one image."""
        if not self._is_moved(T_jaw_camera):
            return T_jaw_object
        return self._T_jaw_camera @ invert_pose(T_jaw_camera) @ T_jaw_object

    def _is_moved(self, T_jaw_camera: NDArray) -> bool:
        """Return whether the jaw has moved since it was last followed; it is followed from here if it never was."""
        if self._T_jaw_camera is None:
            self._T_jaw_camera = T_jaw_camera
        return bool(np.abs(T_jaw_camera - self._T_jaw_camera).max() > UNMOVED)

    def update(self, stamp: int, surface: Surface | None = None) -> TimedEstimate | None:
        """Return the contact of an image; None when it is not newer than the last.

        Args:
            stamp: of the image [ns].
            surface: asked for the deformed jaw by mode "paper", which takes it as undeformed where nobody answers.

        Raises:
            MeshError: the surface is not that of the jaw's mesh.
        """
        if self.last is not None and stamp <= self.last.stamp:
            return None
        vertices = surface() if surface is not None and self.estimator.needs_surface else None
        self.last = TimedEstimate(stamp, self.estimator.update(SECOND * stamp, vertices))
        return self.last

    @property
    def estimate(self) -> ContactEstimate | None:
        """The last answer of the estimator."""
        return self.last.estimate if self.last else None

    def contact_at(self, stamp: int, surface: Surface | None = None) -> Contact | None:
        """Return the contact of an image [ns]; see `update`."""
        self.update(stamp, surface)
        return self.last.estimate.contact

    def pose_age(self) -> float:
        """Return the time from the object's last pose to the last contact [s], NaN before the first."""
        if self.last is None or self._posed is None:
            return float("nan")
        return SECOND * (self.last.stamp - self._posed)


class ForceLoop:
    """Contact and force of one jaw, image after image.

    Attributes:
        contact: where the contact comes from.
        force: the solver.
        given: the contact that the last image was solved with.
        contact_ms: time that the contact of the last image took [ms].
        force_ms: time that the solver took for it [ms].

    Args:
        contact: a contact estimator, with the object's mesh and the jaw as calibrated (`force.jaw`), or any source.
        force: the solver of that jaw, with the same mesh density.
    """

    def __init__(self, contact: ContactEstimator | ContactSource, force: ForceEstimator) -> None:
        self.contact = ContactLoop(contact) if isinstance(contact, ContactEstimator) else contact
        self.force, self.given = force, None
        self._resting = RestingContact()
        self.contact_ms = self.force_ms = 0.0

    def forget(self) -> None:
        """Forget what earlier images told of jaw and force; the object's pose stays."""
        self.force.forget()
        self._resting.reset()

    def follow_jaw(self, T_camera_jaw: NDArray) -> None:
        """Take the jaw's pose (4, 4) in the camera frame, with which the object goes; before the image's `update`."""
        if isinstance(self.contact, ContactLoop):
            self.contact.follow_jaw(invert_pose(T_camera_jaw))

    def take_pose(self, stamp: float, T_jaw_object: NDArray) -> None:
        """Take the object's pose (4, 4) [m] in the jaw frame, in an image [s].

        Raises:
            PoseError: the pose makes no sense.
        """
        self.contact.take_pose(round(stamp / SECOND), T_jaw_object)

    def update(self, observation: Observation, poses: Iterable[tuple[float, NDArray]] = ()) -> Solution:
        """Return the force in an image.

        Args:
            observation: its key points.
            poses: of the object since the image before, as for `take_pose`.

        Raises:
            ObservationError: the key points are not those of the jaw.
            PoseError: a pose makes no sense.
        """
        self.given = None
        begin = perf_counter()
        for pose in poses:
            self.take_pose(*pose)
        contact = self.contact.contact_at(round(observation.stamp / SECOND), self.force.surface)
        self.given = self._resting.complete(contact, observation.stamp)
        found = perf_counter()
        solution = self.force.update(observation, self.given)
        self._resting.note(solution, observation.stamp)
        self.contact_ms, self.force_ms = 1e3 * (found - begin), 1e3 * (perf_counter() - found)
        return solution
