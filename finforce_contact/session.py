"""The object, its poses from topics or depth images, and the jaws that it touches, for several threads."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib import import_module
from threading import RLock
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from finforce.camera import CameraIntrinsics, ImageError
from finforce.errors import FinforceError, MissingDependencyError, ObservationError
from finforce.messages import (
    camera_from_info,
    check_cloud,
    decode_keypoints,
    depth_from_image,
    mask_from_image,
    pose_from_message,
    same_camera,
    stamp_of,
    wrench_from_message,
)
from finforce.skipping import Skips
from finforce.stamps import SECOND, Synchronizer
from finforce_contact.errors import ReconstructionError
from finforce_contact.estimator import ContactEstimator
from finforce_contact.jaw_contact import JawContact, TimedEstimate
from finforce_contact.mesh.object_mesh import ObjectMesh, describe_mesh, load_object_mesh
from finforce_contact.parameters import ContactParameters, ContactSettings, TrackerSettings, load_generated, load_jaws
from finforce_contact.pose.source import ExternalPoseSource, ObjectPose
from finforce_contact.pose.tracker import PoseTracker

DEPTH, MASK = "depth images", "masks"
KEPT = 32  # images that may wait for their mask, which a segmentation takes a while to find


class StampedPose(NamedTuple):
    """A pose of the object and the exact stamp of its image [ns]."""

    stamp: int
    pose: ObjectPose


@dataclass(frozen=True, kw_only=True, eq=False)
class MaskedView:
    """One depth image with the object's mask.

    Attributes:
        stamp: of the depth image [ns].
        depth: (h, w) [m], NaN where there is none.
        mask: (h, w) bool, the object.
        camera: of both.
    """

    stamp: int
    depth: NDArray
    mask: NDArray
    camera: CameraIntrinsics


class DepthFeed:
    """Brings depth images and masks together and hands them to a tracker, which is made for object and camera.

    A mask is needed to find the object first, or again when it was lost; between, depth images are enough.

    Args:
        parameters: frame, unit of depth and greatest distance of stamps.
        settings: of the tracker.
    """

    def __init__(self, parameters: ContactParameters, settings: TrackerSettings) -> None:
        self._parameters, self._settings = parameters, settings
        self._tolerance = round(parameters.pose_tolerance / SECOND)
        self._mesh: ObjectMesh | None = None
        self._camera: CameraIntrinsics | None = None
        self._guesses: tuple[NDArray, ...] = ()
        self.reset()

    def reset(self) -> None:
        """Forget images and pose."""
        self.latest: ObjectPose | None = None
        self._tracker: PoseTracker | None = None
        self._lost = True
        self._images = Synchronizer({DEPTH: KEPT, MASK: KEPT}, self._tolerance)

    def set_object(self, mesh: ObjectMesh | None, guesses: Sequence[NDArray] = ()) -> None:
        """Look for another object from now on, at first near the given poses (4, 4)."""
        self._mesh, self._guesses, self._tracker = mesh, tuple(guesses), None
        self.latest, self._lost = None, True

    def take_camera(self, info: Any) -> None:
        """Take a sensor_msgs/CameraInfo.

        Raises:
            ObservationError: the frame is another one.
            IntrinsicsError: the numbers are no camera's.
        """
        camera = camera_from_info(info, self._parameters.camera_frame)
        if not same_camera(self._camera, camera):
            self._camera, self._tracker, self._lost = camera, None, True

    def take_depth(self, image: Any) -> StampedPose | None:
        """Take a depth image and return the object's pose in it; None while it waits for a mask.

        Raises:
            ObservationError: the frame is another one.
            ImageError: the image cannot be used, or the camera is not known yet.
            PoseLostError: the object was not found again.
        """
        stamp = stamp_of(image)
        self._images.add(DEPTH, stamp, image)
        mask = self._images.find(MASK, stamp)
        if self._mesh is None:
            return None
        if self._lost and mask is not None:
            return self._locate(image, mask.value)
        if self._tracker is None or self.latest is None:
            return None
        self._lost = True  # until it was found again
        found = None if mask is None else self._decode_mask(mask.value)
        self.latest = self._tracker.track(SECOND * stamp, self._decode_depth(image), found)
        self._lost = False
        return StampedPose(stamp, self.latest)

    def take_mask(self, image: Any) -> StampedPose | None:
        """Take a mask and return the object's pose in its depth image, if it is looked for.

        Raises:
            ObservationError: the frame is another one.
            ImageError: one of the images cannot be used.
            PoseLostError: the object was not found.
        """
        stamp = stamp_of(image)
        self._images.add(MASK, stamp, image)
        depth = self._images.find(DEPTH, stamp)
        wanted = self._lost and self._mesh is not None and depth is not None
        return self._locate(depth.value, image) if wanted else None

    def view(self) -> MaskedView:
        """Return the newest depth image that has a mask.

        Raises:
            ImageError: there is none.
        """
        pair = self._images.newest_pair(DEPTH, MASK)
        if pair is None:
            have = " and ".join(f"{len(self._images.entries(name))} {name}" for name in (DEPTH, MASK))
            raise ImageError(f"no depth image with its mask: {have} are here, expected a pair of equal stamps")
        depth, mask = pair
        return MaskedView(
            stamp=depth.stamp,
            depth=self._decode_depth(depth.value),
            mask=self._decode_mask(mask.value),
            camera=self._known_camera(),
        )

    def _locate(self, depth: Any, mask: Any) -> StampedPose:
        tracker = self._tracker = self._tracker or PoseTracker(self._mesh, self._known_camera(), self._settings)
        stamp = stamp_of(depth)
        found = self._decode_mask(mask)
        self.latest = tracker.locate(SECOND * stamp, self._decode_depth(depth), found, self._guesses)
        self._lost = False
        return StampedPose(stamp, self.latest)

    def _decode_depth(self, image: Any) -> NDArray:
        return depth_from_image(image, self._parameters.camera_frame, self._parameters.depth_scale)

    def _decode_mask(self, image: Any) -> NDArray:
        return mask_from_image(image, self._parameters.camera_frame)

    def _known_camera(self) -> CameraIntrinsics:
        if self._camera is None:
            raise ImageError("a depth image came, but no camera_info yet")
        return self._camera


class ContactSession:
    """Everything between messages and contacts.

    Attributes:
        mesh: of the object, None while it is unknown.
        trouble: why there is no mesh, empty when there is nothing wrong with it.
        jaws: by side.

    Args:
        parameters: of the node.
        contact: settings of the contact estimators.
        tracker: settings of the pose tracker.
        skips: rules of what need not be done; all of them when absent.

    Raises:
        FinforceError: the jaw cannot be used.
    """

    def __init__(
        self,
        parameters: ContactParameters,
        contact: ContactSettings,
        tracker: TrackerSettings,
        skips: Skips | None = None,
    ) -> None:
        tolerance, max_age = round(parameters.pose_tolerance / SECOND), round(parameters.max_age / SECOND)
        self.jaws = {
            side: JawContact(ContactEstimator(jaw, settings=contact, skips=skips), tolerance=tolerance, max_age=max_age)
            for side, jaw in load_jaws(parameters).items()
        }
        self.mesh: ObjectMesh | None = None
        self.trouble = ""
        self._frame = parameters.camera_frame
        self._origin = parameters.pose_origin
        self._source = ExternalPoseSource(self._frame)
        self._camera = DepthFeed(parameters, tracker) if parameters.tracks else None
        self._camera_lock, self._lock = RLock(), RLock()

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

        if self._camera is None:
            raise ImageError("reconstruct needs images: set pose_source to tracker, or use finforce reconstruct")
        with self._camera_lock:
            view = self._camera.view()
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
        with self._camera_lock, self._lock:
            self.mesh, self.trouble = mesh, ""
            self._source = ExternalPoseSource(self._frame, mesh=mesh, origin=self._origin)
            for jaw in self.jaws.values():
                jaw.set_object(mesh)
            if self._camera:
                self._camera.set_object(mesh, guesses)

    def reset(self) -> str:
        """Forget poses, contacts and images; the object stays."""
        with self._camera_lock, self._lock:
            self._source.reset()
            for jaw in self.jaws.values():
                jaw.reset()
            if self._camera:
                self._camera.reset()
        return "contacts and poses are forgotten; the object stays"

    def restart(self, side: str) -> None:
        """Forget a jaw's contact and the object's pose: their stamps belong to an earlier recording."""
        with self._lock:
            self.jaws[side].reset()
            self._source.reset()

    @property
    def pose(self) -> ObjectPose | None:
        """The newest pose of the object that was taken or found."""
        return self._camera.latest if self._camera else self._source.latest

    def take_jaw_pose(self, side: str, message: Any) -> list[TimedEstimate]:
        """Take a jaw's PoseStamped; return its contacts that are known now.

        Raises:
            FinforceError: frame or numbers are wrong, or no contact can be found with what is known.
        """
        T_camera_jaw = pose_from_message(message, self._frame, f"the pose of the {side} jaw")
        with self._lock:
            return self.jaws[side].take_jaw_pose(stamp_of(message), T_camera_jaw)

    def take_object_pose(self, side: str, found: StampedPose) -> list[TimedEstimate]:
        """Take the object's pose; return the contacts on a jaw that are known now; see `take_jaw_pose`."""
        with self._lock:
            # what an external pose is worth is not said with it; the estimator finds out
            covariance = found.pose.covariance if self._camera else None
            return self.jaws[side].take_object_pose(found.stamp, found.pose.T_camera_object, covariance)

    def take_surface(self, side: str, cloud: Any) -> list[TimedEstimate]:
        """Take a jaw's deformed surface; return its contacts that are known now.

        Raises:
            FinforceError: frame, fields, number or place of the vertices are wrong.
        """
        surface = surface_from_cloud(cloud, f"{side}_jaw")
        with self._lock:
            return self.jaws[side].take_surface(stamp_of(cloud), surface)

    def take_wrench(self, side: str, message: Any) -> list[TimedEstimate]:
        """Take the wrench on a jaw, with which no contact is due; raises ObservationError for frame or numbers."""
        wrench = wrench_from_message(message, f"{side}_jaw")
        with self._lock:
            self.jaws[side].take_wrench(stamp_of(message), wrench)
        return []

    def pass_over(self, side: str, stamp: int, read: Callable[[], Any]) -> None:
        """Leave an image [ns] without a contact on a jaw; `read` gives the jaw's PoseStamped when it is needed."""
        what = f"the pose of the {side} jaw"
        with self._lock:
            self.jaws[side].pass_over(stamp, lambda: pose_from_message(read(), self._frame, what))

    def read_pose(self, message: Any) -> StampedPose | None:
        """Return the object's pose of a PoseStamped or a Detection3DArray, None when nothing was detected.

        Raises:
            PoseError: frame, stamp or numbers are wrong.
        """
        with self._lock:
            take = self._source.take_detections if hasattr(message, "detections") else self._source.take_pose
            pose = take(message)
        return pose and StampedPose(stamp_of(message), pose)

    def take_camera(self, info: Any) -> None:
        """Take a camera's intrinsics; see `DepthFeed`."""
        with self._camera_lock:
            self._camera.take_camera(info)

    def take_depth(self, image: Any) -> StampedPose | None:
        """Return the object's pose in a depth image, if it is tracked; see `DepthFeed`."""
        with self._camera_lock:
            return self._camera.take_depth(image)

    def take_mask(self, image: Any) -> StampedPose | None:
        """Return the object's pose in the image that a mask belongs to, if it is looked for; see `DepthFeed`."""
        with self._camera_lock:
            return self._camera.take_mask(image)


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
