"""The topics that a solver writes: what stands in each of them, and when it is sent; decides no trust."""

from __future__ import annotations

from time import monotonic
from typing import TYPE_CHECKING, Any

import finforce_ros as ros
from finforce_ifea.gripper import Grasp
from finforce_ifea.markers import build_markers
from finforce_ifea.parameters import NodeParameters
from finforce_skipping import Skips

if TYPE_CHECKING:
    from finforce_ifea.estimator import JawEstimator
    from finforce_ifea.observation import Observation, Solution


class SolverOutputs:
    """The publishers of a solver node.

    Args:
        qos: makes publishers and watches them.
        parameters: which jaw, and whether the forces on the gripper are completed here.
        skips: whether what nobody subscribes to is left out.
    """

    def __init__(self, qos: ros.QosWatch, parameters: NodeParameters, skips: Skips) -> None:
        side = parameters.jaw_name
        self._parameters, self._skips = parameters, skips
        self.wrench = qos.publisher(ros.WrenchStamped, f"{side}/wrench", ros.RESULT)
        self.stddev = qos.publisher(ros.WrenchStamped, f"{side}/wrench_stddev", ros.RESULT)
        self.surface = qos.publisher(ros.PointCloud2, f"{side}/surface", ros.RESULT)
        self.markers = qos.publisher(ros.MarkerArray, f"{side}/markers", ros.RESULT)
        if parameters.peer or parameters.completes_grasp:
            self.grasp = qos.publisher(ros.WrenchStamped, "grasp_wrench", ros.RESULT)
            self.manipulation = qos.publisher(ros.WrenchStamped, "manipulation_wrench", ros.RESULT)
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
        """Send what the object does to the gripper, once it is known."""
        if grasp is None:
            return
        header = ros.Header(stamp=header.stamp, frame_id=self._parameters.gripper_frame)
        if ros.is_wanted(self.grasp, self._skips):
            self.grasp.publish(ros.wrench_message(header, grasp.grasp))
        if ros.is_wanted(self.manipulation, self._skips):
            self.manipulation.publish(ros.wrench_message(header, grasp.manipulation))

    def send_shape(self, header: Any, observation: Observation, solution: Solution, estimator: JawEstimator) -> None:
        """Send the deformed surface, and markers at their own rate; markers only to listeners, whatever the rules."""
        if self._parameters.publish_surface and ros.is_wanted(self.surface, self._skips):
            self.surface.publish(ros.cloud_message(header, ros.xyz_columns(estimator.surface())))
        due = monotonic() - self._markers_sent >= 1.0 / self._parameters.marker_rate
        if due and self.markers.get_subscription_count():
            self._markers_sent = monotonic()
            markers = build_markers(header, observation, solution, estimator)
            self.markers.publish(ros.MarkerArray(markers=markers))
