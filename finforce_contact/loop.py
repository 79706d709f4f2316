"""Contact and force of one jaw, image after image: the same offline, in nodes and from a Python prompt."""

from __future__ import annotations

from collections.abc import Iterable
from contextlib import suppress
from time import perf_counter
from typing import TYPE_CHECKING, NamedTuple, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from finforce.errors import FinforceError
from finforce.messages import SECOND
from finforce_contact.estimator import ContactEstimate, ContactEstimator
from finforce_contact.mesh.object_mesh import ObjectMesh
from finforce_ifea.observation import Contact, Observation, Solution, is_out_of_reach

if TYPE_CHECKING:
    from finforce_ifea.estimator import ForceEstimator

ValueT = TypeVar("ValueT")


class TimedEstimate(NamedTuple):
    """An estimate and the stamp of its image [ns]."""

    stamp: int
    estimate: ContactEstimate


Wrench = tuple[NDArray, NDArray]  # force (3,) [N] and torque (3,) [N m] about the jaw's origin


class ContactSource(Protocol):
    """Gives the contact of one image after the other.

    Attributes:
        name: what it is, for reports.
        estimate: what a contact estimator said last; None for a contact that was given.
    """

    name: str
    estimate: ContactEstimate | None

    def contact_at(self, stamp: int) -> Contact | None:
        """Return the contact of an image [ns]; None when nothing is known."""

    def learn(self, stamp: int, surface: NDArray, wrench: Wrench | None) -> None:
        """Take what the solver made of that image: vertices (n, 3) [m], jaw frame, and a wrench that is trusted."""

    def reset(self) -> None:
        """Forget all images."""


class GivenContact:
    """One contact for all images; None for none."""

    estimate = None

    def __init__(self, contact: Contact | None, name: str = "given") -> None:
        self.contact, self.name = contact, name

    def contact_at(self, stamp: int) -> Contact | None:
        """Return it."""
        return self.contact

    def learn(self, stamp: int, surface: NDArray, wrench: Wrench | None) -> None:
        """Learn nothing."""

    def reset(self) -> None:
        """Forget nothing."""


class ContactLoop:
    """The contact estimator of one jaw in the loop with the solver of that jaw.

    The contact of an image is found with the object's last pose, on the deformed jaw that the solver found in the image
    before. Offline and live run this same loop; live, its ends are topics.

    Attributes:
        estimator: of this jaw.
        last: the newest contact, None before the first.

    Args:
        estimator: of this jaw.
        max_age: greatest distance between the stamps of an image and of the surface and wrench used for it [ns].
    """

    name = "estimate"

    def __init__(self, estimator: ContactEstimator, *, max_age: int = 200_000_000) -> None:
        self.estimator = estimator
        self._max_age = max_age
        self._start()

    def _start(self) -> None:
        self.last: TimedEstimate | None = None
        self._surface: tuple[int, NDArray] | None = None
        self._wrench: tuple[int, Wrench] | None = None
        self._posed: int | None = None

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
        """Whether the object was out of the jaw's reach in the last contact."""
        contact = self.estimate.contact if self.estimate else None
        return contact is not None and is_out_of_reach(contact, self.estimator.jaw.inner_face_x)

    @property
    def is_idle(self) -> bool:
        """Whether nothing happens: the object is held still, or out of reach."""
        return self.estimator.still or self.is_out_of_reach

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

    @property
    def has_pose(self) -> bool:
        """Whether a pose of the object has come."""
        return self._posed is not None

    def keep_surface(self, stamp: int, surface: NDArray) -> None:
        """Keep the deformed vertices (n, 3) [m] that the solver found in an image [ns]."""
        self._surface = stamp, surface

    def take_wrench(self, stamp: int, wrench: Wrench) -> None:
        """Keep force (3,) [N] and torque (3,) [N m] of an image [ns]."""
        self._wrench = stamp, wrench

    def update(self, stamp: int) -> TimedEstimate | None:
        """Return the contact of an image [ns]; None when it is not newer than the last.

        Raises:
            MeshError: the surface is not that of the jaw's mesh.
        """
        if self.last is not None and stamp <= self.last.stamp:
            return None
        surface, wrench = self._fresh(self._surface, stamp), self._fresh(self._wrench, stamp)
        self.last = TimedEstimate(stamp, self.estimator.update(SECOND * stamp, surface, wrench))
        return self.last

    def _fresh(self, kept: tuple[int, ValueT] | None, stamp: int) -> ValueT | None:
        return kept[1] if kept and abs(stamp - kept[0]) <= self._max_age else None

    @property
    def estimate(self) -> ContactEstimate | None:
        """What the estimator said last."""
        return self.last.estimate if self.last else None

    def contact_at(self, stamp: int) -> Contact | None:
        """Return the contact of an image [ns]; see `update`."""
        self.update(stamp)
        return self.last.estimate.contact

    def learn(self, stamp: int, surface: NDArray, wrench: Wrench | None) -> None:
        """Keep what the solver made of an image [ns], for the next one."""
        self.keep_surface(stamp, surface)
        if wrench is not None:
            self.take_wrench(stamp, wrench)

    def has_surface(self) -> bool:
        """Say whether the last contact was found on the deformed jaw; else the undeformed one stood for it."""
        return self.last is not None and self._fresh(self._surface, self.last.stamp) is not None

    def pose_age(self) -> float:
        """Return the time from the object's last pose to the last contact [s], NaN before the first."""
        if self.last is None or self._posed is None:
            return float("nan")
        return SECOND * (self.last.stamp - self._posed)


class ForceLoop:
    """Contact and force of one jaw, image after image: where the contact comes from and the solver feed each other.

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
        self.contact_ms = self.force_ms = 0.0

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
        stamp = round(observation.stamp / SECOND)
        self.given = self.contact.contact_at(stamp)
        found = perf_counter()
        solution = self.force.update(observation, self.given)
        solved = perf_counter()
        wrench = (solution.force, solution.torque) if solution.trusted else None
        self.contact.learn(stamp, self.force.surface(), wrench)
        self.force_ms = 1e3 * (solved - found)
        self.contact_ms = 1e3 * (perf_counter() - begin) - self.force_ms
        return solution
