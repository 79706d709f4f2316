"""The contact of one jaw in the loop with its solver: the same offline, in nodes and from a Python prompt."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable
from contextlib import suppress
from itertools import pairwise
from time import perf_counter
from typing import NamedTuple, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from finforce.errors import FinforceError
from finforce.stamps import SECOND, Stamped, Synchronizer
from finforce.transforms import invert_pose
from finforce_contact.estimator import ContactEstimate, ContactEstimator
from finforce_contact.mesh.object_mesh import ObjectMesh
from finforce_ifea.estimator import JawEstimator
from finforce_ifea.observation import Contact, Observation, Solution
from finforce_ifea.tracking.influence import is_out_of_reach

ValueT = TypeVar("ValueT")


class TimedEstimate(NamedTuple):
    """An estimate and the stamp of its image [ns]."""

    stamp: int
    estimate: ContactEstimate


class PassedImage(NamedTuple):
    """An image without a contact: its stamp [ns], and what gives the jaw's pose (4, 4) in it."""

    stamp: int
    read: Callable[[], NDArray]


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


class ContactLoop:
    """The contact estimator of one jaw in the loop with the solver of that jaw.

    The contact of an image is found with the object's last pose, on the deformed jaw that the solver found in the image
    before. Offline and live run this same loop; live, its ends are topics.

    Attributes:
        estimator: of this jaw.
        last: the newest contact, None before the first.
        is_out_of_reach: whether the object stood out of the jaw's reach in it.

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
        self._wrench: tuple[int, tuple[NDArray, NDArray]] | None = None
        self._posed: int | None = None
        self.is_out_of_reach = False

    def reset(self) -> None:
        """Forget everything but the object's mesh."""
        self.estimator.reset()
        self._start()

    @property
    def is_idle(self) -> bool:
        """Whether nothing happens: the object is out of reach, or held still."""
        return self.is_out_of_reach or self.estimator.still

    def take_pose(
        self, stamp: int, T_jaw_object: NDArray, covariance: NDArray | None = None, camera: NDArray | None = None
    ) -> None:
        """Take the object's pose (4, 4) in an image [ns]; one that is not newer than the last is left out.

        Args:
            stamp: of the image [ns].
            T_jaw_object: (4, 4) [m].
            covariance: (6, 6) [m, rad], along the jaw's axes; None when unknown.
            camera: place (3,) of the camera in the jaw frame [m].

        Raises:
            PoseError: the pose makes no sense.
        """
        if self._posed is None or stamp > self._posed:
            self.estimator.take_pose(SECOND * stamp, T_jaw_object, covariance, camera=camera)
            self._posed = stamp

    def keep_surface(self, stamp: int, surface: NDArray) -> None:
        """Keep the deformed vertices (n, 3) [m] that the solver found in an image [ns]."""
        self._surface = stamp, surface

    def take_wrench(self, stamp: int, wrench: tuple[NDArray, NDArray]) -> None:
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
        contact = self.last.estimate.contact
        self.is_out_of_reach = contact is not None and is_out_of_reach(contact, self.estimator.jaw.inner_face_x)
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

    def __init__(self, contact: ContactEstimator | ContactSource, force: JawEstimator) -> None:
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


class JawContact(ContactLoop):
    """The loop with poses in the camera's frame, which come late or not at all.

    A jaw pose makes the contact of its image due. Images without one, where poses are rarer than key points, are due
    with the surface that the solver found in them.

    Args:
        estimator: of this jaw.
        tolerance: greatest distance between the stamps of jaw pose and object pose [ns].
        max_age: greatest distance between the stamps of an image and of the surface and wrench used for it [ns].
    """

    def __init__(self, estimator: ContactEstimator, *, tolerance: int, max_age: int) -> None:
        self._pairing = PosePairing(tolerance)
        super().__init__(estimator, max_age=max_age)

    def _start(self) -> None:
        super()._start()
        self._pairing.reset()
        self._passed: deque[PassedImage] = deque(maxlen=DEPTH)
        self._over: deque[int] = deque(maxlen=DEPTH)
        self._jaw: NDArray | None = None

    def set_object(self, mesh: ObjectMesh | None) -> None:
        """Take another object; its pose is not known yet.

        Raises:
            FinforceError: the mode of the estimator cannot do with this object.
        """
        self.estimator.set_object(mesh)
        if mesh is not None:
            self._warm_up()
        self._pairing.reset()
        self._passed.clear()
        self._posed = None

    def _warm_up(self) -> None:
        """Let what is compiled on first use be compiled before the first image waits for it."""
        T = np.eye(4)
        for stamp, place in enumerate(self.estimator.jaw.candidates[[0, -1]]):
            T[:3, 3] = place
            with suppress(FinforceError):
                self.estimator.take_pose(float(stamp), T, camera=-place)
                self.estimator.update(float(stamp))
        self.estimator.reset()

    def take_surface(self, stamp: int, surface: NDArray) -> list[TimedEstimate]:
        """Take the deformed vertices (n, 3) [m] of an image [ns]; return the contacts that are known now.

        Raises:
            MeshError: the surface is not that of the jaw's mesh.
        """
        self.keep_surface(stamp, surface)
        known = self._posed is not None and not self._pairing.is_waiting(stamp) and stamp not in self._over
        return self._due(stamp) if known else []

    def take_jaw_pose(self, stamp: int, T_camera_jaw: NDArray) -> list[TimedEstimate]:
        """Take the jaw's pose (4, 4) in an image [ns]; return the contacts that are known now.

        Raises:
            PoseError: a pose of the object in the jaw frame makes no sense.
            MeshError: the surface is not that of the jaw's mesh.
        """
        return self._follow(self._pairing.add_jaw(stamp, T_camera_jaw))

    def take_object_pose(
        self, stamp: int, T_camera_object: NDArray, covariance: NDArray | None = None
    ) -> list[TimedEstimate]:
        """Take the object's pose (4, 4) in an image [ns], with its covariance (6, 6); as `take_jaw_pose`."""
        estimates = self._follow(self._pairing.add_object(stamp, T_camera_object, covariance))
        self._catch_up(stamp)
        return estimates

    def pass_over(self, stamp: int, read: Callable[[], NDArray]) -> None:
        """Leave an image [ns] without a contact; `read` gives the jaw's pose (4, 4), should the object's pose come."""
        self._over.append(stamp)
        if self._pairing.has_object(stamp):
            self._follow(self._pairing.add_late(stamp, read()))
        else:
            self._passed.append(PassedImage(stamp, read))

    def _catch_up(self, stamp: int) -> None:
        """Use the object's pose in an image [ns] that was passed over."""
        for image in [image for image in self._passed if self._pairing.belong(image.stamp, stamp)]:
            self._passed.remove(image)
            self._follow(self._pairing.add_late(image.stamp, image.read()))

    def _follow(self, steps: Iterable[PoseStep]) -> list[TimedEstimate]:
        """Hand poses on and update for the images that are due."""
        estimates = []
        for step in steps:
            T_jaw_object = self._carry(step)
            if T_jaw_object is not None:
                covariance = turn_covariance(step.covariance, step.T_jaw_camera)
                self.take_pose(step.stamp, T_jaw_object, covariance, step.T_jaw_camera[:3, 3])
            if step.is_due:
                estimates += self._due(step.stamp)
        return estimates

    def _carry(self, step: PoseStep) -> NDArray | None:
        """Take the jaw's own motion; return the object's pose (4, 4), if there is one, as the jaw is now.

        Between two poses of the object, which may be rare, the jaw goes on: what is known goes with the camera.
        """
        if self._jaw is None:
            self._jaw = step.T_jaw_camera
        if np.abs(step.T_jaw_camera - self._jaw).max() <= UNMOVED:
            return step.T_jaw_object
        motion = step.T_jaw_camera @ invert_pose(self._jaw)
        if step.is_due:
            self.estimator.carry(motion)
            self._jaw = step.T_jaw_camera
            return step.T_jaw_object
        return None if step.T_jaw_object is None else invert_pose(motion) @ step.T_jaw_object

    def _due(self, stamp: int) -> list[TimedEstimate]:
        estimate = self.update(stamp)
        return [estimate] if estimate else []


def turn_covariance(covariance: NDArray | None, T_jaw_camera: NDArray) -> NDArray | None:
    """Return a pose's covariance (6, 6) [m, rad], given along the camera's axes, along those of the jaw."""
    if covariance is None:
        return None
    turn = np.kron(np.eye(2), T_jaw_camera[:3, :3])
    return turn @ covariance @ turn.T


JAW, OBJECT = "jaw", "object"
DEPTH = 48  # images that may wait for their other pose: half a second of 90 Hz, as poses may be late
BRIDGED = 250_000_000  # [ns] between two poses of a jaw that stand for the time between, while it does not move
UNMOVED = 0.2e-3  # [m] and, for its axes, [1]: a jaw that differs by less has not moved


class PoseStep(NamedTuple):
    """What is to be done next.

    Attributes:
        stamp: of the image [ns].
        T_jaw_object: (4, 4), a new pose of the object in the jaw frame; None when the image has none (yet).
        T_jaw_camera: (4, 4), of the same image.
        covariance: (6, 6) of the object's pose, camera axes; None when unknown.
        is_due: the contact of this image is due; else only its pose came late.
    """

    stamp: int
    T_jaw_object: NDArray | None
    T_jaw_camera: NDArray
    covariance: NDArray | None
    is_due: bool


class PosePairing:
    """Brings the poses of jaw and object together by their stamps.

    An image is due when its jaw pose comes. It waits for its object pose, at most until the next jaw pose, as long as
    object poses have kept up so far; a slow tracker delays nothing. Of a jaw that stands still not every image is told:
    an object pose between two equal poses of the jaw is used with them.

    Args:
        tolerance: greatest distance of stamps that belong together [ns].
    """

    def __init__(self, tolerance: int) -> None:
        self._tolerance = tolerance
        self._poses = Synchronizer({JAW: DEPTH, OBJECT: DEPTH}, tolerance)
        self.reset()

    def reset(self) -> None:
        """Forget all poses."""
        self._poses.reset()
        self._waiting = self._in_step = False

    def add_jaw(self, stamp: int, T_camera_jaw: NDArray) -> list[PoseStep]:
        """Take the pose (4, 4) of the jaw in an image [ns]; return what is to be done now."""
        jaws = self._poses.entries(JAW)
        overdue = [self._step(jaws[-1], None)] if self._waiting else []
        self._in_step &= not self._waiting
        self._poses.add(JAW, stamp, invert_pose(T_camera_jaw))
        last = list(jaws)[-2:]
        between = [step for pose in self._poses.entries(OBJECT) for step in self._bridge(pose, last[0], last[-1])]
        found = self._poses.find(OBJECT, stamp)
        self._waiting = found is None and self._in_step
        steps = [*overdue, *between[-1:]]
        return steps if self._waiting else [*steps, self._step(jaws[-1], found)]

    def add_object(self, stamp: int, T_camera_object: NDArray, covariance: NDArray | None = None) -> list[PoseStep]:
        """Take the pose (4, 4) of the object in an image [ns]; return what is to be done now."""
        self._poses.add(OBJECT, stamp, (T_camera_object, covariance))
        jaws, pose = self._poses.entries(JAW), self._poses.entries(OBJECT)[-1]
        jaw = self._poses.find(JAW, stamp)
        if jaw is None:
            return [step for last in pairwise(jaws) for step in self._bridge(pose, *last)]
        is_newest = jaw is jaws[-1]
        is_due = is_newest and self._waiting
        self._in_step |= is_newest
        self._waiting &= not is_newest
        return [self._step(jaw, pose, is_due=is_due)]

    def _bridge(self, pose: Stamped, before: Stamped, after: Stamped) -> list[PoseStep]:
        """Return what is to be done with an object pose between two poses of a jaw, nothing if the jaw has moved."""
        is_between = before.stamp + self._tolerance < pose.stamp < after.stamp - self._tolerance
        is_near = after.stamp - before.stamp <= BRIDGED
        if not (is_between and is_near and np.abs(after.value - before.value).max() <= UNMOVED):
            return []
        return [self._step(Stamped(pose.stamp, before.value), pose, is_due=False)]

    def has_object(self, stamp: int) -> bool:
        """Say whether the object's pose in an image [ns] is known."""
        return self._poses.find(OBJECT, stamp) is not None

    def add_late(self, stamp: int, T_camera_jaw: NDArray) -> list[PoseStep]:
        """Take the pose (4, 4) of the jaw in an image [ns] that is not due any more; return what is to be done now."""
        found = self._poses.find(OBJECT, stamp)
        return [self._step(Stamped(stamp, invert_pose(T_camera_jaw)), found, is_due=False)] if found else []

    def is_waiting(self, stamp: int) -> bool:
        """Say whether an image [ns] waits for its object pose."""
        return self._waiting and self.belong(self._poses.entries(JAW)[-1].stamp, stamp)

    def belong(self, one: int, other: int) -> bool:
        """Say whether two stamps [ns] are those of one image."""
        return self._poses.belong(one, other)

    def _step(self, jaw: Stamped, pose: Stamped | None, *, is_due: bool = True) -> PoseStep:
        """Return the step of a jaw's inverted pose and the object's pose with its covariance."""
        T_camera_object, covariance = pose.value if pose else (None, None)
        T_jaw_object = jaw.value @ T_camera_object if pose else None
        return PoseStep(jaw.stamp, T_jaw_object, jaw.value, covariance, is_due)
