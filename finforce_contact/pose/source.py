"""Sources of the object's poses: another program's messages, or depth images."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from math import inf
from threading import Condition, RLock
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from finforce.camera import ImageError
from finforce.errors import MissingDependencyError, ObservationError, PoseError
from finforce.messages import (
    SECOND,
    CameraStream,
    Synchronizer,
    pose_from_message,
    stamp_of,
)
from finforce.optional import import_open3d
from finforce_contact.mesh.object_mesh import ObjectMesh
from finforce_contact.parameters import ORIGINS, ContactParameters, TrackerSettings
from finforce_contact.pose.alignment import DepthImage
from finforce_contact.pose.mesh_check import MeshCheck, is_due
from finforce_contact.pose.tracker import ObjectPose, PoseTracker, check_camera_outside

DEPTH, MASK, POSES = "depth images", "masks", "poses"
LONGEST_WAIT = 1.0  # [s] of an image for its pose
KEPT = 32  # images that may wait for their mask, which a segmentation takes a while to find


class StampedPose(NamedTuple):
    """A pose of the object and the exact stamp of its image [ns]."""

    stamp: int
    pose: ObjectPose


class ExternalPoseSource:
    """Poses that another program publishes, each refused or taken as it is.

    Attributes:
        latest: the newest pose taken; a refused one does not replace it.

    Args:
        stream: of the camera, in whose frame the messages must be.
        mesh: the object, for the check that it is not around the camera; None to do without.
        origin: reference of the poses, one of `ORIGINS`.
    """

    def __init__(self, stream: CameraStream, *, mesh: ObjectMesh | None = None, origin: str = "mesh") -> None:
        self.latest: ObjectPose | None = None
        self._stream, self._mesh = stream, mesh
        self._back = np.zeros(3) if mesh is None else -ORIGINS[origin] * mesh.middle

    def reset(self) -> None:
        """Forget the latest pose, so that a stamp before it is taken again."""
        self.latest = None

    def take(self, message: Any) -> ObjectPose | None:
        """Take a PoseStamped, or a Detection3DArray, of which the first detection counts.

        A detection's pose is `bbox.center`, where isaac_ros_foundationpose writes it, or `results[0].pose.pose` when
        the former was left as the message type makes it.

        Returns:
            The pose, None when nothing was detected.

        Raises:
            ObservationError: The frame is another one.
            PoseError: The stamp is not after the last one taken, the numbers are no rigid pose, the detection holds
                none, or the object would be around the camera.
        """
        source = "PoseStamped"
        if hasattr(message, "detections"):
            if not message.detections:
                return None
            source = "Detection3DArray"
            message = SimpleNamespace(header=message.header, pose=_pose_of_detection(message.detections[0]))
        stamp = SECOND * stamp_of(message)
        T_camera_object = pose_from_message(message, self._stream.frame_of(message, is_sure=False), source)
        if self.latest is not None and stamp <= self.latest.stamp:
            raise PoseError(
                f"{source}: got stamp {stamp:.6f} s, expected one after {self.latest.stamp:.6f} s; "
                "reset after time has jumped back"
            )
        T_camera_object[:3, 3] += T_camera_object[:3, :3] @ self._back
        if self._mesh is not None:
            check_camera_outside(T_camera_object, self._mesh)
        self.latest = ObjectPose(
            stamp=stamp, T_camera_object=T_camera_object, covariance=None, fitness=1.0, source=source
        )
        return self.latest


def _pose_of_detection(detection: Any) -> Any:
    """Return the first pose of a detection that was set; raises PoseError where none was."""
    for pose in (detection.bbox.center, *(result.pose.pose for result in detection.results[:1])):
        place, turn = pose.position, pose.orientation
        if any((place.x, place.y, place.z, turn.x, turn.y, turn.z)):
            return pose
    raise PoseError("Detection3DArray: got a detection with neither bbox.center nor results[0].pose.pose set")


class MeshFeed:
    """Compares the mesh, in the poses that another program tells, with a depth image now and then.

    Several threads may call it. An image waits for its pose, which comes later.

    Attributes:
        contradiction: as of `MeshCheck`.
        compared: images so far.
        trouble: why the last image could not be compared; empty when it could.

    Args:
        parameters: topics, and greatest distance of stamps.
        stream: of the camera, from which images and poses must be.
    """

    def __init__(self, parameters: ContactParameters, stream: CameraStream) -> None:
        self._stream, self._info_topic = stream, parameters.info_topic
        self._tolerance = round(parameters.pose_tolerance / SECOND)
        self._arrival = Condition(RLock())
        self.set_object(None)

    def set_object(self, mesh: ObjectMesh | None) -> None:
        """Compare another object from now on."""
        if mesh is not None:
            with suppress(MissingDependencyError):  # which the comparison tells
                import_open3d()  # now: later, images would wait for a third of a second
        with self._arrival:
            self._mesh = mesh
            self.reset()

    def reset(self) -> None:
        """Forget poses and images."""
        with self._arrival:
            self._check: MeshCheck | None = None
            self._poses = Synchronizer({POSES: KEPT}, self._tolerance)
            self._last = -inf
            self.contradiction = self.trouble = ""
            self.compared = 0

    def take_camera(self, info: Any) -> None:
        """Take a sensor_msgs/CameraInfo; see `DepthFeed.take_camera`."""
        with self._arrival:
            if self._stream.take_info(info):
                self._check = None

    def take_pose(self, found: StampedPose) -> None:
        """Take a pose of the object."""
        with self._arrival:
            self._poses.add(POSES, found.stamp, found.pose.T_camera_object)
            self._arrival.notify_all()

    @property
    def is_due(self) -> bool:
        """True if a depth image is wanted."""
        with self._arrival:
            poses = self._poses.entries(POSES)
            elapsed = SECOND * poses[-1].stamp - self._last if poses else 0.0
            return self._mesh is not None and bool(poses) and (elapsed < 0.0 or is_due(self.compared, elapsed))

    def take_depth(self, image: Any) -> None:
        """Compare a depth image once the object's pose in it has come; without one the image is dropped."""
        stamp = stamp_of(image)
        with self._arrival:
            if not self.is_due:
                return
            mesh = self._mesh
            self._arrival.wait_for(
                lambda: self._poses.entries(POSES)[-1].stamp >= stamp - self._tolerance, LONGEST_WAIT
            )
            pose = self._poses.find(POSES, stamp)
            if pose is None or self._mesh is not mesh:
                return
            self._last, check = SECOND * stamp, self._check
        try:
            camera = self._stream.known_camera(self._info_topic)
            check = check or MeshCheck(mesh, camera)
            contradiction = check.add(self._stream.read_depth(image), pose.value)
        except (ImageError, ObservationError, MissingDependencyError) as error:
            self.trouble = str(error)
            return
        with self._arrival:
            if self._mesh is mesh:
                self._check, self.contradiction, self.trouble = check, contradiction, ""
                self.compared += 1


class DepthFeed:
    """Brings depth images and masks together and hands them to a tracker, which is made for object and camera.

    A mask is needed to find the object first, or again when it was lost; between, depth images are enough. Several
    threads may call it.

    Args:
        parameters: topics, and greatest distance of stamps.
        settings: of the tracker.
        stream: of the camera, from which all images must be.
    """

    def __init__(self, parameters: ContactParameters, settings: TrackerSettings, stream: CameraStream) -> None:
        self._settings, self._stream, self._info_topic = settings, stream, parameters.info_topic
        self._tolerance = round(parameters.pose_tolerance / SECOND)
        self._mesh: ObjectMesh | None = None
        self._guesses: tuple[NDArray, ...] = ()
        self._lock = RLock()
        self.reset()

    def reset(self) -> None:
        """Forget images and pose."""
        with self._lock:
            self.latest: ObjectPose | None = None
            self._tracker: PoseTracker | None = None
            self._lost = True
            self._images = Synchronizer({DEPTH: KEPT, MASK: KEPT}, self._tolerance)

    def set_object(self, mesh: ObjectMesh | None, guesses: Sequence[NDArray] = ()) -> None:
        """Look for another object from now on, at first near the given poses (4, 4)."""
        with self._lock:
            self._mesh, self._guesses, self._tracker = mesh, tuple(guesses), None
            self.latest, self._lost = None, True

    def take_camera(self, info: Any) -> None:
        """Take a sensor_msgs/CameraInfo.

        Raises:
            ObservationError: the frame is another one.
            IntrinsicsError: the numbers are no camera's.
        """
        with self._lock:
            if self._stream.take_info(info):
                self._tracker, self._lost = None, True

    def take_depth(self, image: Any) -> StampedPose | None:
        """Take a depth image and return the object's pose in it; None while it waits for a mask.

        Raises:
            ObservationError: the frame is another one.
            ImageError: the image cannot be used, or the camera is not known yet.
            PoseLostError: the object was not found again.
        """
        stamp = stamp_of(image)
        with self._lock:
            self._images.add(DEPTH, stamp, image)
            mask = self._images.find(MASK, stamp)
            if self._mesh is None:
                return None
            if self._lost and mask is not None:
                return self._locate(image, mask.value)
            if self._tracker is None or self.latest is None:
                return None
            self._lost = True  # until it was found again
            found = None if mask is None else self._stream.read_mask(mask.value)
            self.latest = self._tracker.track(SECOND * stamp, self._stream.read_depth(image), found)
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
        with self._lock:
            self._images.add(MASK, stamp, image)
            depth = self._images.find(DEPTH, stamp)
            wanted = self._lost and self._mesh is not None and depth is not None
            return self._locate(depth.value, image) if wanted else None

    def view(self) -> DepthImage:
        """Return the newest depth image that has a mask.

        Raises:
            ImageError: there is none.
        """
        with self._lock:
            pair = self._images.newest_pair(DEPTH, MASK)
            if pair is None:
                have = " and ".join(f"{len(self._images.entries(name))} {name}" for name in (DEPTH, MASK))
                raise ImageError(f"no depth image with its mask: {have} are here, expected a pair of equal stamps")
            depth, mask = (entry.value for entry in pair)
            return DepthImage(
                self._stream.read_depth(depth),
                self._stream.known_camera(self._info_topic),
                self._stream.read_mask(mask),
            )

    def _locate(self, depth: Any, mask: Any) -> StampedPose:
        tracker = self._tracker = self._tracker or PoseTracker(
            self._mesh, self._stream.known_camera(self._info_topic), self._settings
        )
        stamp = stamp_of(depth)
        found = self._stream.read_mask(mask)
        self.latest = tracker.locate(SECOND * stamp, self._stream.read_depth(depth), found, self._guesses)
        self._lost = False
        return StampedPose(stamp, self.latest)
