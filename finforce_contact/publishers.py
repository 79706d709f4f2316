"""The topics that a contact estimator writes, and what stands in each of them."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from finforce.ros import node as ros
from finforce.skipping import Skips
from finforce.stamps import SECOND
from finforce.transforms import pose_numbers
from finforce_ifea.messages import columns_from_outline

if TYPE_CHECKING:
    from finforce_contact.camera_feed import StampedPose
    from finforce_contact.estimator import ContactEstimate
    from finforce_contact.jaw_contact import TimedEstimate
    from finforce_contact.localization.slip import Slip
    from finforce_contact.parameters import ContactParameters


class ContactOutputs:
    """The publishers of a contact estimator node.

    Args:
        qos: makes publishers and watches them.
        parameters: which jaws, and whether the object's poses are found here.
        skips: whether what nobody subscribes to is left out.
    """

    def __init__(self, qos: ros.QosWatch, parameters: ContactParameters, skips: Skips) -> None:
        cloud, sides = ros.PointCloud2, parameters.sides
        self._frame, self._skips = parameters.camera_frame, skips
        self.contact = {side: qos.publisher(cloud, f"{side}/contact", ros.RESULT) for side in sides}
        self.outline = {side: qos.publisher(cloud, f"{side}/object_outline", ros.RESULT) for side in sides}
        self.slip = {side: qos.publisher(ros.TwistStamped, f"{side}/slip", ros.RESULT) for side in sides}
        self._slip_told = dict.fromkeys(sides, -math.inf)
        self.pose = qos.publisher(ros.PoseStamped, "object_pose", ros.RESULT) if parameters.tracks else None

    def send_contact(self, side: str, timed: TimedEstimate) -> None:
        """Send outline and contact of an image; no rows say that there is none."""
        header = ros.Header(stamp=ros.stamp_message(timed.stamp), frame_id=f"{side}_jaw")
        # the outline goes first: the solver looks for it when the contact comes
        if ros.is_wanted(self.outline[side], self._skips):
            ros.send_cloud(self.outline[side], header, columns_from_outline(timed.estimate.outline))
        if ros.is_wanted(self.contact[side], self._skips):
            ros.send_cloud(self.contact[side], header, contact_columns(timed.estimate))
        self._send_slip(side, timed.estimate.slip)

    def _send_slip(self, side: str, slip: Slip | None) -> None:
        """Send how the object moves over a jaw, once for every pose of the object while it touches."""
        if slip is None or not slip.stamp > self._slip_told[side] or not np.isfinite(slip.stddev):
            return
        self._slip_told[side] = slip.stamp
        if ros.is_wanted(self.slip[side], self._skips):
            stamp = ros.stamp_message(round(slip.stamp / SECOND))
            header = ros.Header(stamp=stamp, frame_id=f"{side}_jaw")
            self.slip[side].publish(ros.twist_message(header, slip.velocity))

    def send_pose(self, found: StampedPose) -> None:
        """Send the object's pose, unless it came by topic."""
        if self.pose is not None and ros.is_wanted(self.pose, self._skips):
            header = ros.Header(stamp=ros.stamp_message(found.stamp), frame_id=self._frame)
            self.pose.publish(ros.pose_message(header, pose_numbers(found.pose.T_camera_object)))


def contact_columns(estimate: ContactEstimate) -> dict[str, NDArray]:
    """Return the columns of a contact cloud, one row per contact, none without an object."""
    points = np.asarray(estimate.points, dtype=np.float32).reshape(-1, 3)
    return {
        **dict(zip("xyz", points.T, strict=True)),
        "candidate": np.asarray(estimate.candidates, dtype=np.uint16),
        "touching": np.full(len(points), estimate.touching, dtype=np.uint8),
        "weight": np.asarray(estimate.weights, dtype=np.float32),
    }
