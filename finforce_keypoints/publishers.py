"""The topics that a key point detector writes, and what stands in each of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from finforce.ros import node as ros
from finforce.transforms import pose_numbers
from finforce_keypoints.diagnostics import build_skeleton, describe_names, draw_keypoints
from finforce_keypoints.geometry.jaw_localizer import REASONS
from finforce_keypoints.parameters import DetectorParameters

if TYPE_CHECKING:
    from finforce_keypoints.detector import KeypointDetector
    from finforce_keypoints.geometry.jaw_localizer import JawKeypoints


class DetectorOutputs:
    """The publishers of a key point detector node.

    Args:
        stage: makes publishers and watches them.
        parameters: which jaws, and the camera's frame.
        names: of the rows of the clouds; sent once, and kept for whoever comes later.
        detector: that finds them.
    """

    def __init__(
        self, stage: ros.Stage, parameters: DetectorParameters, names: Sequence[str], detector: KeypointDetector
    ) -> None:
        sides = parameters.sides
        self._frame, self._skeleton = parameters.camera_frame, build_skeleton(names)
        self.keypoints = {side: stage.publisher(ros.PointCloud2, f"{side}/keypoints", ros.RESULT) for side in sides}
        self.pose = {side: stage.publisher(ros.PoseStamped, f"{side}/jaw_pose", ros.RESULT) for side in sides}
        self.annotated = stage.publisher(ros.Image, "~/annotated", ros.RESULT)
        self.names = stage.publisher(ros.String, "~/keypoint_names", ros.LATCHED)
        self.names.publish(ros.String(data=describe_names(names, detector)))

    @property
    def are_heard(self) -> bool:
        """Whether anybody subscribes to what is made of images."""
        outputs = (*self.keypoints.values(), *self.pose.values(), self.annotated)
        return any(output.get_subscription_count() for output in outputs)

    def send_jaw(self, side: str, stamp: int, found: JawKeypoints) -> None:
        """Send the key points of a jaw and its pose, of the image at `stamp` [ns]."""
        time = ros.stamp_message(stamp)
        # the pose goes first: the contact estimator and the solver work at the same time then
        header = ros.Header(stamp=time, frame_id=self._frame)
        self.pose[side].publish(ros.pose_message(header, pose_numbers(found.T_camera_jaw)))
        ros.send_cloud(self.keypoints[side], ros.Header(stamp=time, frame_id=f"{side}_jaw"), keypoint_columns(found))

    def send_annotated(self, stamp: int, color: NDArray, found: Mapping[str, JawKeypoints]) -> None:
        """Send the image at `stamp` [ns], (h, w, 3), with what was found in it, while someone subscribes."""
        if not self.annotated.get_subscription_count():
            return
        header = ros.Header(stamp=ros.stamp_message(stamp), frame_id=self._frame)
        self.annotated.publish(ros.image_message(header, draw_keypoints(color, found.values(), self._skeleton)))


def keypoint_columns(found: JawKeypoints) -> dict[str, NDArray]:
    """Return the columns of a cloud of key points, one row (K,) per key point of the jaw file."""
    u, v = np.asarray(found.pixels, dtype=np.float32).T
    stddev = np.asarray(found.stddev, dtype=np.float32).T
    return {
        **ros.xyz_columns(found.points),
        "likelihood": np.asarray(found.likelihood, dtype=np.float32),
        "u": u,
        "v": v,
        "valid": np.asarray(found.valid, dtype=np.uint8),
        "reason": reason_codes(found.reasons),
        **dict(zip(("stddev_x", "stddev_y", "stddev_z"), stddev, strict=True)),
    }


def reason_codes(reasons: NDArray) -> NDArray[np.uint8]:
    """Return why key points (K,) are refused as numbers: 0 for one that is used, else its place in `REASONS` from 1."""
    return np.select([reasons == reason for reason in REASONS], range(1, len(REASONS) + 1), default=0).astype(np.uint8)
