"""Topics and diagnostics of a contact estimator."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from finforce.health import Level, Outcome
from finforce.ros import node as ros
from finforce.skipping import Skips
from finforce.stamps import SECOND
from finforce.transforms import pose_numbers
from finforce_contact.mesh.object_mesh import ObjectMesh, describe_mesh
from finforce_ifea.messages import columns_from_outline

if TYPE_CHECKING:
    from finforce_contact.estimator import ContactEstimate
    from finforce_contact.jaw_contact import JawContact, TimedEstimate
    from finforce_contact.localization.slip import Slip
    from finforce_contact.parameters import ContactParameters
    from finforce_contact.pose.source import ObjectPose
    from finforce_contact.session import ContactSession, StampedPose


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


LEVELS = {"touching": Level.OK, "apart": Level.OK}  # any other status: WARN


def outcome_of_estimate(estimate: ContactEstimate) -> Outcome:
    """Return the level of an estimate's status and its sentence."""
    if estimate.slip is not None and estimate.slip.sliding:
        return Outcome(level=Level.WARN, reason="slip", text=f"the object slides: {describe_slip(estimate.slip)}")
    level = LEVELS.get(estimate.status, Level.WARN)
    return Outcome(level=level, reason=estimate.status, text=estimate.message or estimate.status)


def object_alarms(session: ContactSession) -> list[Outcome]:
    """Return the alarm of an object mesh that cannot be used."""
    return [Outcome(level=Level.ERROR, reason="object", text=session.trouble)] if session.trouble else []


def describe(session: ContactSession, side: str) -> dict[str, str]:
    """Return what is known of the object and of its contact with one jaw, as text."""
    return _describe_object(session.mesh, session.pose) | _describe_contact(session.jaws[side])


def _describe_contact(jaw: JawContact) -> dict[str, str]:
    """Return the figures of a jaw's last contact, and the work done and skipped since the start."""
    counts = ", ".join(f"{count} {reason}" for reason, count in jaw.estimator.counts.items() if count) or "none"
    last = jaw.last
    if last is None:
        return {"work": counts}
    return {
        "status": last.estimate.status,
        "contacts": str(len(last.estimate.points)),
        "pose age [ms]": f"{1e3 * jaw.pose_age():.0f}",
        "jaw surface": "deformed" if jaw.has_surface() else "undeformed: no fresh surface",
        "slip": describe_slip(last.estimate.slip),
        "last skipped": last.estimate.skipped or "nothing",
        "work": counts,
    }


def describe_slip(slip: Slip | None) -> str:
    """Return how an object moves over a jaw, in words."""
    if slip is None or not np.isfinite(slip.stddev):
        return "unknown"
    speed = 1e3 * float(np.linalg.norm(slip.velocity))
    return f"{speed:.1f} ± {1e3 * slip.stddev:.1f} mm/s{', slides' if slip.sliding else ''}"


def _describe_object(mesh: ObjectMesh | None, pose: ObjectPose | None) -> dict[str, str]:
    if mesh is None:
        return {"object": "unknown"}
    known = {"object": describe_mesh(mesh)}
    return known if pose is None else known | {"pose source": pose.source, "pose fitness": f"{pose.fitness:.2f}"}
