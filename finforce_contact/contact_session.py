"""From messages to contacts: the object, its poses and those of the jaws, which come late or not at all."""

from __future__ import annotations

from collections.abc import Iterable
from importlib import import_module
from itertools import pairwise
from threading import RLock
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from finforce.camera import ImageError
from finforce.errors import FinforceError, MissingDependencyError, ObservationError
from finforce.messages import (
    SECOND,
    CameraStream,
    Stamped,
    Synchronizer,
    check_cloud,
    decode_keypoints,
    pose_from_message,
    stamp_of,
)
from finforce.transforms import invert_pose
from finforce_contact.errors import ReconstructionError
from finforce_contact.estimator import ContactEstimator
from finforce_contact.loop import UNMOVED, ContactLoop, TimedEstimate
from finforce_contact.mesh.object_mesh import ObjectMesh, describe_mesh, load_object_mesh
from finforce_contact.paper_contact import check_surface
from finforce_contact.parameters import ContactParameters, ContactSettings, TrackerSettings, load_generated, load_jaws
from finforce_contact.pose.source import DepthFeed, ExternalPoseSource, MeshFeed, StampedPose
from finforce_contact.pose.tracker import ObjectPose


class JawContact:
    """The contact loop of one jaw, with poses in the camera's frame; a jaw pose makes the contact of its image due.

    Attributes:
        loop: contact estimator and what it said last.

    Args:
        estimator: of this jaw.
        tolerance: greatest distance between the stamps of jaw pose and object pose [ns].
        max_age: greatest distance between the stamps of an image and of the surface used for it [ns].
    """

    def __init__(self, estimator: ContactEstimator, *, tolerance: int, max_age: int) -> None:
        self.loop, self._pairing, self._max_age = ContactLoop(estimator), PosePairing(tolerance), max_age
        self._surface: Stamped | None = None

    def reset(self) -> None:
        """Forget everything but the object's mesh."""
        self.loop.reset()
        self._pairing.reset()
        self._surface = None

    def set_object(self, mesh: ObjectMesh | None) -> None:
        """Take another object; its pose is not known yet.

        Raises:
            FinforceError: the mode of the estimator cannot do with this object.
        """
        self.loop.set_object(mesh)
        self._pairing.reset()

    def keep_surface(self, stamp: int, surface: NDArray) -> None:
        """Keep the deformed vertices (n, 3) [m] of an image [ns], for the paper's method.

        Raises:
            MeshError: the surface is not that of the jaw's mesh.
        """
        self._surface = Stamped(stamp, check_surface(surface, self.loop.estimator.face.mesh))

    def take_jaw_pose(self, stamp: int, T_camera_jaw: NDArray) -> list[TimedEstimate]:
        """Take the jaw's pose (4, 4) in an image [ns]; return the contacts that are known now.

        Raises:
            PoseError: a pose of the object in the jaw frame makes no sense.
        """
        return self._follow(self._pairing.add_jaw(stamp, T_camera_jaw))

    def take_object_pose(
        self, stamp: int, T_camera_object: NDArray, covariance: NDArray | None = None
    ) -> list[TimedEstimate]:
        """Take the object's pose (4, 4) in an image [ns], with its covariance (6, 6); as `take_jaw_pose`."""
        return self._follow(self._pairing.add_object(stamp, T_camera_object, covariance))

    def pass_over(self, stamp: int, T_camera_jaw: NDArray) -> None:
        """Leave an image [ns] without a contact; the jaw's pose (4, 4) serves the object's pose in it alone."""
        self._follow(self._pairing.pass_over(stamp, T_camera_jaw))

    def _follow(self, steps: Iterable[PoseStep]) -> list[TimedEstimate]:
        """Hand poses on and update for the images that are due."""
        estimates, loop = [], self.loop
        for step in steps:
            if step.is_due:
                loop.follow_jaw(step.T_jaw_camera)
            if step.T_jaw_object is not None:
                covariance = turn_covariance(step.covariance, step.T_jaw_camera)
                T_jaw_object = loop.as_now(step.T_jaw_object, step.T_jaw_camera)
                loop.take_pose(step.stamp, T_jaw_object, covariance, step.T_jaw_camera[:3, 3])
            if step.is_due:
                estimates += self._due(step.stamp)
        return estimates

    def _due(self, stamp: int) -> list[TimedEstimate]:
        kept = self._surface
        surface = kept.value if kept and abs(stamp - kept.stamp) <= self._max_age else None
        estimate = self.loop.update(stamp, lambda: surface)
        return [estimate] if estimate else []


def turn_covariance(covariance: NDArray | None, T_jaw_camera: NDArray) -> NDArray | None:
    """Return a pose's covariance (6, 6) [m, rad], given along the camera's axes, along those of the jaw."""
    if covariance is None:
        return None
    turn = np.kron(np.eye(2), T_jaw_camera[:3, :3])
    return turn @ covariance @ turn.T


JAW, PASSED, OBJECT = "jaw", "passed", "object"
WAITING = 48  # images that may wait for their other pose: half a second of 90 Hz, as poses may be late
BRIDGED = 250_000_000  # [ns] between two poses of a jaw that stand for the time between, while it does not move


class PoseStep(NamedTuple):
    """The next work to do.

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

    An image is due when its jaw pose comes, unless it is passed over. It waits for its object pose, at most until the
    next jaw pose, as long as object poses have kept up so far; a slow tracker delays nothing. Of a jaw that stands
    still not every image is told: an object pose between two equal poses of the jaw is used with them.

    Args:
        tolerance: greatest distance of stamps that belong together [ns].
    """

    def __init__(self, tolerance: int) -> None:
        self._tolerance = tolerance
        self._poses = Synchronizer({JAW: WAITING, PASSED: WAITING, OBJECT: WAITING}, tolerance)
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
            passed = self._poses.take(PASSED, stamp)
            late = [self._step(passed, pose, is_due=False)] if passed else []
            return late or [step for last in pairwise(jaws) for step in self._bridge(pose, *last)]
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

    def pass_over(self, stamp: int, T_camera_jaw: NDArray) -> list[PoseStep]:
        """Take the pose (4, 4) of the jaw in an image [ns] that is not due; return what is to be done now."""
        self._poses.add(PASSED, stamp, invert_pose(T_camera_jaw))
        found = self._poses.find(OBJECT, stamp)
        return [self._step(self._poses.entries(PASSED)[-1], found, is_due=False)] if found else []

    def _step(self, jaw: Stamped, pose: Stamped | None, *, is_due: bool = True) -> PoseStep:
        """Return the step of a jaw's inverted pose and the object's pose with its covariance."""
        T_camera_object, covariance = pose.value if pose else (None, None)
        T_jaw_object = jaw.value @ T_camera_object if pose else None
        return PoseStep(jaw.stamp, T_jaw_object, jaw.value, covariance, is_due)


class ContactSession:
    """Everything between messages and contacts.

    Attributes:
        mesh: of the object, None while it is unknown.
        trouble: why there is no mesh, empty when there is nothing wrong with it.
        jaws: by side.
        stream: of the camera, in the frame of the first image or pose of a jaw unless the parameters name it.
        camera: finds the object's pose in depth images; None where it comes by topic.
        check: compares the mesh with depth images, where its pose comes by topic; None where it is not asked for.

    Args:
        parameters: of the node.
        contact: settings of the contact estimators.
        tracker: settings of the pose tracker.

    Raises:
        FinforceError: the jaw cannot be used.
    """

    def __init__(self, parameters: ContactParameters, contact: ContactSettings, tracker: TrackerSettings) -> None:
        tolerance, max_age = round(parameters.pose_tolerance / SECOND), round(parameters.max_age / SECOND)
        self.jaws = {
            side: JawContact(ContactEstimator(jaw, settings=contact), tolerance=tolerance, max_age=max_age)
            for side, jaw in load_jaws(parameters).items()
        }
        self.mesh: ObjectMesh | None = None
        self.trouble = ""
        self.stream = CameraStream(parameters.camera_frame, parameters.depth_scale, parameters.depth_topic)
        self._frames = parameters.jaw_frame
        self._origin = parameters.pose_origin
        self._source = ExternalPoseSource(self.stream)
        self.camera = DepthFeed(parameters, tracker, self.stream) if parameters.tracks else None
        is_checked = parameters.compare_mesh and not parameters.tracks
        self.check = MeshFeed(parameters, self.stream) if is_checked else None
        self._lock = RLock()

    def load_mesh(self, parameters: ContactParameters) -> str:
        """Load the mesh file that the parameters name and return what it is; without a name the object is unknown.

        Raises:
            FinforceError: the file is no object; it is unknown from now on.
        """
        self._set_object(None)
        if not parameters.object_mesh:
            return "no object mesh is named: the object is unknown"
        try:
            self._set_object(load_object_mesh(parameters.object_mesh, unit=parameters.object_mesh_unit))
        except FinforceError as error:
            self._set_object(None)
            self.trouble = f"the object is unknown: {error}"
            raise
        return describe_mesh(self.mesh)

    def reconstruct(self, parameters: ContactParameters) -> str:
        """Find the object's mesh in the newest depth image with a mask, and return what it is.

        Raises:
            ImageError: there are no images, or they cannot be used.
            FinforceError: no mesh explains the image; the object stays what it was.
        """
        from finforce_contact.reconstruction.evidence import collect_evidence
        from finforce_contact.reconstruction.reconstruction import reconstruct

        if self.camera is None:
            raise ImageError("reconstruct needs images: set pose_source to tracker, or use finforce reconstruct")
        view = self.camera.view()
        evidence = collect_evidence(view.depth, view.mask, view.camera)
        generated = load_generated(parameters)
        try:
            found = reconstruct(evidence, generated, parameters.reconstruct_method)
        except FinforceError:
            raise
        except (RuntimeError, ValueError, ArithmeticError) as error:  # of the libraries behind it
            raise ReconstructionError(f"the mesh could not be reconstructed: {error}") from error
        before = self.mesh
        try:
            self._set_object(found.mesh, (found.T_camera_object,))
        except FinforceError:
            self._set_object(before)
            raise
        return f"{describe_mesh(found.mesh)} Found by the method {found.method}."

    def _set_object(self, mesh: ObjectMesh | None, guesses: tuple[NDArray, ...] = ()) -> None:
        """Work with another object from now on, to be looked for near the guessed poses (4, 4)."""
        with self._lock:
            self.mesh, self.trouble = mesh, ""
            self._source = ExternalPoseSource(self.stream, mesh=mesh, origin=self._origin)
            for jaw in self.jaws.values():
                jaw.set_object(mesh)
            if self.camera:
                self.camera.set_object(mesh, guesses)
            if self.check:
                self.check.set_object(mesh)

    def reset(self) -> str:
        """Forget poses, contacts and images; the object stays."""
        with self._lock:
            self._source.reset()
            for jaw in self.jaws.values():
                jaw.reset()
            if self.camera:
                self.camera.reset()
            if self.check:
                self.check.reset()
        return "contacts and poses are cleared; the object is kept"

    def restart(self, side: str) -> None:
        """Forget a jaw's contact and the object's pose: their stamps belong to an earlier recording."""
        with self._lock:
            self.jaws[side].reset()
            self._source.reset()
            if self.check:
                self.check.reset()

    @property
    def pose(self) -> ObjectPose | None:
        """The newest pose of the object that was taken or found."""
        return self.camera.latest if self.camera else self._source.latest

    def take_jaw_pose(self, side: str, message: Any) -> list[TimedEstimate]:
        """Take a jaw's PoseStamped; return its contacts that are known now.

        Raises:
            FinforceError: frame or numbers are wrong, or no contact can be found with what is known.
        """
        told, frame = self.stream.frame, self.stream.frame_of(message)
        if told not in ("", frame):
            self.reset()  # poses of the object had come in another frame
        T_camera_jaw = pose_from_message(message, frame, f"the pose of the {side} jaw")
        with self._lock:
            return self.jaws[side].take_jaw_pose(stamp_of(message), T_camera_jaw)

    def take_object_pose(self, side: str, found: StampedPose) -> list[TimedEstimate]:
        """Take the object's pose; return the contacts on a jaw that are known now; see `take_jaw_pose`."""
        with self._lock:
            return self.jaws[side].take_object_pose(found.stamp, found.pose.T_camera_object, found.pose.covariance)

    def keep_surface(self, side: str, cloud: Any) -> None:
        """Keep a jaw's deformed surface, for the paper's method.

        Raises:
            FinforceError: frame, fields, number or place of the vertices are wrong.
        """
        surface = surface_from_cloud(cloud, self._frames(side))
        with self._lock:
            self.jaws[side].keep_surface(stamp_of(cloud), surface)

    def pass_over(self, side: str, message: Any) -> None:
        """Leave the image of a jaw's PoseStamped without a contact on that jaw."""
        T_camera_jaw = pose_from_message(message, self.stream.frame_of(message), f"the pose of the {side} jaw")
        with self._lock:
            self.jaws[side].pass_over(stamp_of(message), T_camera_jaw)

    def read_pose(self, message: Any) -> StampedPose | None:
        """Return the object's pose of a PoseStamped or a Detection3DArray, None when nothing was detected.

        Raises:
            FinforceError: frame, stamp or numbers are wrong.
        """
        with self._lock:
            pose = self._source.take(message)
        found = pose and StampedPose(stamp_of(message), pose)
        if found and self.check:
            self.check.take_pose(found)
        return found

    def compare(self, image: Any) -> None:
        """Compare the mesh with a depth image, once its pose has come; what contradicts it holds for all jaws."""
        self.check.take_depth(image)
        with self._lock:
            for jaw in self.jaws.values():
                jaw.loop.estimator.contradiction = self.check.contradiction


def surface_from_cloud(cloud: Any, frame: str) -> NDArray:
    """Return the deformed vertices (n, 3) [m] of a solver's surface.

    Raises:
        ObservationError: the frame or the fields are wrong, or a vertex is not finite.
    """
    check_cloud(cloud, frame, "the surface")
    points = decode_keypoints(cloud).points
    if not np.isfinite(points).all():
        raise ObservationError("the surface has vertices that are not finite")
    return points


def detections_type() -> type:
    """Return vision_msgs/Detection3DArray; raises MissingDependencyError where vision_msgs is not installed."""
    try:
        return import_module("vision_msgs.msg").Detection3DArray
    except ImportError as error:
        hint = "source ROS 2 and apt install ros-jazzy-vision-msgs, or have poses sent as PoseStamped"
        raise MissingDependencyError(f"pose_source detections needs vision_msgs: {hint} ({error})") from error
