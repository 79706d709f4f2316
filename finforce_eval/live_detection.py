"""What the key point detector node answered during a replay; starts nothing and scores nothing."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from finforce_contact.messages import pose_from_message
from finforce_eval.detection import SideLog
from finforce_ifea.pointcloud import decode_columns, decode_keypoints
from finforce_keypoints.jaw_localizer import REASONS


@dataclass(frozen=True, kw_only=True, eq=False)
class HeardKeypoints:
    """The key points of one jaw in one image as they came by topic; see `finforce_keypoints.JawKeypoints`."""

    points: NDArray[np.float64]
    likelihood: NDArray[np.float64]
    pixels: NDArray[np.float64]
    valid: NDArray[np.bool_]
    stddev: NDArray[np.float64]
    T_camera_jaw: NDArray[np.float64]
    reasons: NDArray[np.str_]


@dataclass(kw_only=True)
class DetectionLog:
    """The messages of one jaw, by recorded stamp [ns].

    Attributes:
        poses: T_camera_jaw (4, 4).
        clouds: key points.
        step_ms: from the image's leaving to their arrival [ms].
    """

    poses: dict[int, NDArray[np.float64]] = field(default_factory=dict)
    clouds: dict[int, Any] = field(default_factory=dict)
    step_ms: dict[int, float] = field(default_factory=dict)

    def take_pose(self, stamp: int, message: Any) -> None:
        """Keep the pose of the jaw."""
        self.poses[stamp] = pose_from_message(message, message.header.frame_id, "the jaw's pose")

    def take_cloud(self, stamp: int, message: Any, delay: float | None) -> None:
        """Keep key points that arrived `delay` [s] after their image had left."""
        self.clouds[stamp] = message
        if delay is not None:
            self.step_ms[stamp] = 1e3 * delay

    def side_log(self) -> SideLog:
        """Return what was said of each image, where pose and key points both came."""
        stamps = self.poses.keys() & self.clouds.keys()
        found = {stamp: heard_keypoints(self.clouds[stamp], self.poses[stamp]) for stamp in stamps}
        return SideLog(found=found, step_ms=self.step_ms)


def heard_keypoints(cloud: Any, T_camera_jaw: NDArray[np.float64]) -> HeardKeypoints:
    """Return the key points of a cloud and the pose (4, 4) that came with it."""
    seen = decode_keypoints(cloud)
    columns = decode_columns(cloud, ("u", "v", "reason"))
    return HeardKeypoints(
        points=seen.points,
        likelihood=seen.likelihood,
        pixels=np.stack([columns["u"], columns["v"]], axis=1).astype(np.float64),
        valid=np.isfinite(seen.points).all(axis=1),
        stddev=np.full_like(seen.points, np.nan) if seen.stddev is None else seen.stddev,
        T_camera_jaw=T_camera_jaw,
        reasons=np.array(["", *REASONS])[columns["reason"]],
    )
