"""Depth images and masks in, poses of the object out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

from numpy.typing import NDArray

from finforce.camera import CameraIntrinsics, ImageError
from finforce.messages import camera_from_info, depth_from_image, mask_from_image, same_camera, stamp_of
from finforce.stamps import SECOND, Synchronizer
from finforce_contact.mesh.triangles import ObjectMesh
from finforce_contact.parameters import ContactParameters
from finforce_contact.pose.source import ObjectPose
from finforce_contact.pose.tracker import PoseTracker
from finforce_contact.settings import TrackerSettings

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
