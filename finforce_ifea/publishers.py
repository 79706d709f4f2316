"""The topics that a solver writes: wrenches, the jaw as RViz and Foxglove show it, words for the diagnostics."""

from __future__ import annotations

from time import monotonic
from typing import TYPE_CHECKING, Any

import numpy as np

from finforce.health import Level, Outcome, Skips
from finforce.ros import node as ros
from finforce.ros.messages import points_marker
from finforce_ifea.grasp_force import Grasp
from finforce_ifea.messages import ARROW, CONTACT, CONTACT_DIAMETER, FORCE, NEWTONS_PER_METRE
from finforce_ifea.parameters import NodeParameters

if TYPE_CHECKING:
    from finforce_ifea.estimator import JawEstimator
    from finforce_ifea.observation import Observation, Solution


class SolverOutputs:
    """The publishers of a solver node.

    Args:
        stage: makes publishers and watches them.
        parameters: which jaw, and whether the forces on the gripper are completed here.
        skips: whether what nobody subscribes to is left out.
    """

    def __init__(self, stage: ros.Stage, parameters: NodeParameters, skips: Skips) -> None:
        side = parameters.jaw_name
        self._parameters, self._skips = parameters, skips
        self.wrench = stage.publisher(ros.WrenchStamped, f"{side}/wrench", ros.RESULT)
        self.stddev = stage.publisher(ros.WrenchStamped, f"{side}/wrench_stddev", ros.RESULT)
        self.surface = stage.publisher(ros.PointCloud2, f"{side}/surface", ros.RESULT)
        self.markers = stage.publisher(ros.MarkerArray, f"{side}/markers", ros.RESULT)
        if parameters.peer or parameters.completes_grasp:
            self.grasp = stage.publisher(ros.WrenchStamped, "grasp_wrench", ros.RESULT)
            self.manipulation = stage.publisher(ros.WrenchStamped, "manipulation_wrench", ros.RESULT)
        self._markers_sent = -float("inf")

    def send_wrench(self, header: Any, solution: Solution) -> None:
        """Send what the object does to the jaw.

        Raises:
            ObservationError: a component is not finite.
        """
        self.wrench.publish(ros.wrench_message(header, solution.force, solution.torque))

    def send_stddev(self, header: Any, solution: Solution) -> None:
        """Send one standard deviation of the wrench.

        Raises:
            ObservationError: a component is not finite.
        """
        if ros.is_wanted(self.stddev, self._skips):
            self.stddev.publish(ros.wrench_message(header, solution.force_stddev, solution.torque_stddev))

    def send_grasp(self, header: Any, grasp: Grasp | None) -> None:
        """Send what the object does to the gripper, once it is known; a torque that is not known is left at zero."""
        if grasp is None:
            return
        header = ros.Header(stamp=header.stamp, frame_id=self._parameters.gripper_frame)
        if ros.is_wanted(self.grasp, self._skips):
            self.grasp.publish(ros.wrench_message(header, grasp.grasp))
        if ros.is_wanted(self.manipulation, self._skips):
            torque = (0.0, 0.0, 0.0) if grasp.torque is None else grasp.torque
            self.manipulation.publish(ros.wrench_message(header, grasp.manipulation, torque))

    def send_shape(self, header: Any, observation: Observation, solution: Solution, estimator: JawEstimator) -> None:
        """Send the deformed surface, and markers at their own rate; markers only to listeners, whatever the rules."""
        if self._parameters.publish_surface and ros.is_wanted(self.surface, self._skips):
            ros.send_cloud(self.surface, header, ros.xyz_columns(estimator.surface()))
        due = monotonic() - self._markers_sent >= 1.0 / self._parameters.marker_rate
        if due and self.markers.get_subscription_count():
            self._markers_sent = monotonic()
            markers = _build_markers(header, observation, solution, estimator)
            self.markers.publish(ros.MarkerArray(markers=markers))


_SURFACE = (0.45, 0.55, 0.65, 0.6)
_USED = (0.1, 0.8, 0.2, 1.0)
_UNUSED = (0.9, 0.2, 0.1, 1.0)
_KEYPOINT_DIAMETER = 0.003


def _build_markers(header: Any, observation: Observation, solution: Solution, estimator: JawEstimator) -> list[Any]:
    """Return the markers of one image, in the jaw frame: contact and force only where they are trusted."""
    triangles = np.asarray(estimator.surface())[np.asarray(estimator.surface_triangles)].reshape(-1, 3)
    seen = np.isfinite(observation.points).all(axis=1)
    colors = [_USED if used else _UNUSED for used in np.asarray(solution.keypoints_used)[seen]]
    touched = solution.trusted and np.any(solution.force)
    place = np.asarray(solution.contact_point)
    # the arrow ends on the surface that the object presses on
    arrow = np.stack([place - np.asarray(solution.force) / NEWTONS_PER_METRE, place]) if touched else ()
    return [
        points_marker(header, "surface", "triangles", triangles, color=_SURFACE, scale=(1.0, 1.0, 1.0)),
        points_marker(
            header,
            "keypoints",
            "spheres",
            observation.points[seen],
            color=_USED,
            colors=colors,
            scale=(_KEYPOINT_DIAMETER,) * 3,
        ),
        points_marker(
            header,
            "contact",
            "spheres",
            place if touched else (),
            color=CONTACT,
            scale=(CONTACT_DIAMETER,) * 3,
        ),
        points_marker(header, "force", "arrow", arrow, color=FORCE, scale=ARROW),
    ]


_LEVELS = {"ok": Level.OK, "unloaded": Level.OK, "diverged": Level.ERROR}  # any other status: WARN


def outcome_of_solution(solution: Solution) -> Outcome:
    """Return the level of a solution's status and its sentence."""
    level = _LEVELS.get(solution.status, Level.WARN)
    return Outcome(level=level, reason=solution.status, text=solution.message or solution.status)


def describe_friction(estimator: JawEstimator) -> str:
    """Return the object's coefficient of friction as far as it is known, and how full the cone is."""
    mean, stddev = estimator.friction
    return f"{mean:.2f} ± {stddev:.2f}, cone used to {100.0 * abs(estimator.mobilised):.0f} %"


def describe_solution(solution: Solution | None) -> dict[str, str]:
    """Return the figures of the last solution as text, nothing before the first."""
    if solution is None:
        return {}
    used = np.asarray(solution.keypoints_used)
    return {
        "status": solution.status,
        "key points used": f"{int(used.sum())} of {used.size}",
        "force [N]": f"{np.linalg.norm(solution.force):.3f}",
        "force standard deviation [N]": f"{solution.magnitude_stddev:.3f}",
        "residual [mm]": f"{1e3 * solution.residual:.3f}",
        "kkt": f"{solution.kkt:.2e}",
        "iterations": str(solution.iterations),
    }


def peer_alarms(peer: str, silence: float, limit: float) -> list[Outcome]:
    """Return the alarm of a jaw `peer` that has not been heard of for longer than `limit` [s]."""
    if not peer or silence <= limit:
        return []
    text = f"no wrench of the {peer} jaw, therefore no grasp_wrench"
    return [Outcome(level=Level.WARN, reason="peer", text=text)]
