"""Colour and depth images and intrinsics in, whole RGB-D images out."""

from __future__ import annotations

from collections.abc import Callable
from time import monotonic
from typing import Any

import numpy as np
from numpy.typing import NDArray

from finforce.camera import CameraIntrinsics, ImageError
from finforce.messages import camera_from_info, check_frame, color_from_image, depth_from_image, same_camera, stamp_of
from finforce.stamps import SECOND, Synchronizer
from finforce_keypoints.errors import SyncError
from finforce_keypoints.images import ImagePair, RgbdImage
from finforce_keypoints.parameters import ALIGNED, AUTO, NO_DEPTH, DetectorParameters

SILENCE = 1.0  # s without an image, after which another colour topic may be the camera's
COLOR, DEPTH = "color", "depth"
WAITING = 3  # colour images that may wait for their depth: a tenth of a second at 30 Hz


class RgbdFeed:
    """Brings the images of a camera together by their stamps, the newest first.

    A colour image waits for its depth image; one that a newer whole image overtook is passed over. Where depth may be
    missing, the first image that waited in vain is taken alone, and so are those after it, until depth comes again. Of
    several colour topics the first that brings an image is listened to, until it is silent.

    Attributes:
        camera: intrinsics of both images, None until they came.
        passed: colour images that were overtaken while they waited.
        topic: the colour topic that is listened to, None before the first image.

    Args:
        parameters: frame, topics, unit of depth and maximum difference of stamps.
        clock: the time [s] of an arrival.
    """

    def __init__(self, parameters: DetectorParameters, clock: Callable[[], float] = monotonic) -> None:
        self._parameters, self._clock = parameters, clock
        self._tolerance = round(parameters.sync_tolerance / SECOND)
        self.camera: CameraIntrinsics | None = None
        self.passed = 0
        self.topic: str | None = None
        self._heard = clock()
        self.reset()

    @property
    def source(self) -> str:
        """The colour topic that is listened to, or those that may be."""
        return self.topic or " or ".join(self._parameters.color_topics)

    def reset(self) -> None:
        """Forget all images; intrinsics and topic stay."""
        self._images = Synchronizer({COLOR: None, DEPTH: WAITING + 1}, self._tolerance)
        self._alone = self._parameters.depth == NO_DEPTH

    def take_info(self, info: Any) -> None:
        """Take a sensor_msgs/CameraInfo.

        Raises:
            ObservationError: the frame is another one.
            IntrinsicsError: the numbers are no camera's.
        """
        camera = camera_from_info(info, self._parameters.camera_frame)
        if not same_camera(self.camera, camera):
            self.camera = camera

    def listens(self, topic: str) -> bool:
        """Say whether an image that has come on a colour topic is to be taken; after a silence another topic may be."""
        now = self._clock()
        if self.topic != topic and (self.topic is None or now - self._heard > SILENCE):
            self.topic = topic
            self._images.reset(COLOR)
        if self.topic == topic:
            self._heard = now
        return self.topic == topic

    def take_color(self, topic: str, message: Any) -> ImagePair | None:
        """Take a colour image and return it with its depth; None while that has not come, or of another topic.

        Raises:
            SyncError: no depth image came for an earlier image, and every one needs its own.
        """
        if not self.listens(topic):
            return None
        if self._alone:
            return ImagePair(stamp_of(message), message, None)
        self._images.add(COLOR, stamp_of(message), message)
        found, waiting = self._match(), self._images.entries(COLOR)
        if found is not None or len(waiting) <= WAITING:
            return found
        if self._parameters.depth == ALIGNED:
            raise self._missing_depth(waiting.popleft().stamp)
        self._alone = True
        self.passed += len(waiting)
        self._images.reset(COLOR)
        return ImagePair(stamp_of(message), message, None)

    def take_depth(self, message: Any) -> ImagePair | None:
        """Take a depth image and return it with its colour; None while that has not come."""
        self._alone = False
        self._images.add(DEPTH, stamp_of(message), message)
        return self._match()

    def _match(self) -> ImagePair | None:
        """Return the newest colour image that has its depth, and pass the older ones over."""
        pair = self._images.newest_pair(COLOR, DEPTH)
        if pair is None:
            return None
        color, depth = pair
        waiting = self._images.entries(COLOR)
        while waiting.popleft() is not color:
            self.passed += 1
        return ImagePair(color.stamp, color.value, depth.value)

    def decode(self, pair: ImagePair) -> RgbdImage:
        """Return the image of a pair.

        Raises:
            ObservationError: a frame is another one.
            ImageError: the images cannot be used, or the intrinsics are not known yet.
        """
        if self.camera is None:
            raise ImageError(f"images came, but no camera_info on {self._parameters.info_topic} yet")
        check_frame(pair.color, self._parameters.camera_frame, "the colour image")
        color, depth = color_from_image(pair.color), self._read_depth(pair.depth)
        return RgbdImage(stamp=SECOND * pair.stamp, color=color, depth=depth, camera=self.camera)

    def _read_depth(self, message: Any) -> NDArray | None:
        """Return the depth (h, w) [m] of a depth image; None without one, or of an empty one that is not needed."""
        if message is None:
            return None
        depth = depth_from_image(message, self._parameters.camera_frame, self._parameters.depth_scale)
        is_empty = self._parameters.depth == AUTO and not np.isfinite(depth).any()
        return None if is_empty else depth

    def _missing_depth(self, stamp: int) -> SyncError:
        """Return the error of a colour image [ns] that has waited long enough."""
        nearest = self._images.nearest(DEPTH, stamp)
        limit = f"{1e3 * self._parameters.sync_tolerance:g} ms"
        if nearest is None:
            return SyncError(
                f"colour images come, but no depth image on {self._parameters.depth_topic}; "
                "start the camera with align_depth.enable:=true, or the detector with depth:=none"
            )
        return SyncError(
            f"no depth image within {limit} of the colour image at {SECOND * stamp:.3f} s, the nearest lies "
            f"{1e3 * SECOND * abs(nearest.stamp - stamp):.1f} ms away; start the camera with enable_sync:=true or "
            "raise sync_tolerance"
        )
