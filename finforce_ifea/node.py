"""The solver node of one jaw: key points and contacts in, wrenches out; it converts, calls and publishes."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from time import monotonic, perf_counter
from typing import Any

from geometry_msgs.msg import WrenchStamped
from rclpy.node import Node
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import Header
from visualization_msgs.msg import MarkerArray

import finforce_ros as ros
from finforce_health import Health, Outcome, Report, StampGate
from finforce_ifea.errors import FinforceError
from finforce_ifea.observation import Contact, Observation, Solution
from finforce_ifea.gripper import ForcePairing, Grasp, single_jaw_grasp
from finforce_ifea.markers import build_markers
from finforce_ifea.messages import contact_from_cloud, force_from_wrench, observation_from_cloud
from finforce_ifea.parameters import NodeParameters, build_estimator, load_parameter_jaw
from finforce_ifea.report import describe_solution, outcome_of_solution, peer_alarms
from finforce_ifea.settings import EstimatorSettings


class IfeaSolverNode(Node):
    """Solves one jaw, image by image, and publishes nothing that it does not trust.

    Args:
        build: makes the estimator from jaw, parameters and settings.
        options: of `rclpy.node.Node`.

    Raises:
        FinforceError: a parameter, the jaw or the calibration cannot be used.
    """

    def __init__(self, build: Callable[..., Any] = build_estimator, **options: Any) -> None:
        super().__init__("ifea_solver", **options)
        self.parameters = parameters = ros.declare_record(self, NodeParameters)
        settings = ros.declare_record(self, EstimatorSettings, "estimator")
        ros.name_unknown_parameters(self)
        jaw = load_parameter_jaw(parameters)
        self.estimator = build(jaw, parameters, settings)
        side, fixed = parameters.jaw_name, parameters.is_contact_fixed
        self.contact: Contact | None = Contact.fixed(jaw, parameters.contact_height) if fixed else None
        self.contact_stamp = 0
        self.gate = StampGate(max_age=parameters.max_age, restart_gap=parameters.restart_gap)
        self.health = Health(source=f"{side}/keypoints", stale_after=parameters.max_age)
        self.pairing = ForcePairing(side)
        self.markers_sent = -float("inf")
        self.last: Solution | None = None
        self._open_outputs(side)
        self._open_inputs(side)
        self.get_logger().info(f"{side} jaw '{jaw.name}' ready, contact {'fixed' if fixed else 'by topic'}")

    def _open_outputs(self, side: str) -> None:
        """Create publishers, services and diagnostics."""
        self.qos = ros.QosWatch(self)
        self.wrench = self.qos.publisher(WrenchStamped, f"{side}/wrench", ros.RESULT)
        self.stddev = self.qos.publisher(WrenchStamped, f"{side}/wrench_stddev", ros.RESULT)
        self.surface = self.qos.publisher(PointCloud2, f"{side}/surface", ros.RESULT)
        self.markers = self.qos.publisher(MarkerArray, f"{side}/markers", ros.RESULT)
        if self.parameters.peer or self.parameters.completes_grasp:
            self.grasp = self.qos.publisher(WrenchStamped, "grasp_wrench", ros.RESULT)
            self.manipulation = self.qos.publisher(WrenchStamped, "manipulation_wrench", ros.RESULT)
        ros.serve_trigger(self, f"{side}/tare", lambda: str(self.estimator.tare()))
        ros.serve_trigger(self, f"{side}/reset", lambda: self._restart("reset by service"))
        period = self.parameters.diagnostics_period
        ros.publish_diagnostics(self, self.qos, f"finforce: {side} jaw", period, self._report)

    def _open_inputs(self, side: str) -> None:
        """Create the subscriptions; a node that has them is ready."""
        if not self.parameters.is_contact_fixed:
            self.qos.subscription(PointCloud2, f"{side}/contact", self._on_contact, ros.SENSOR)
        if peer := self.parameters.peer:
            self.qos.subscription(WrenchStamped, f"{peer}/wrench", self._on_peer, ros.RESULT)
        topic = f"{side}/keypoints"
        self.keypoints = self.qos.subscription(PointCloud2, topic, self._on_keypoints, ros.SENSOR)

    def _on_keypoints(self, cloud: PointCloud2) -> None:
        """Solve the newest image and publish its wrench, if it can be trusted."""
        began = perf_counter()
        cloud, superseded = ros.take_newest(self.keypoints, cloud)
        self.health.arrive(superseded)
        stamp = ros.nanoseconds(cloud.header.stamp)
        try:
            observation = observation_from_cloud(cloud, self.parameters.frame)
            if self.gate.enter(stamp, self._now()):
                self._restart("the stamps went back: a new recording")
            self.last = solution = self.estimator.update(observation, self._contact_at(stamp))
            self.gate.check_age(stamp, self._now())
            if solution.trusted:
                self._publish_wrench(cloud.header, solution)
        except FinforceError as error:
            self._refuse(Outcome.of_error(error))
            return
        if not solution.trusted:
            self._refuse(outcome_of_solution(solution))
            return
        age = (self._now() - stamp) / ros.NANOSECONDS
        self.health.publish(outcome_of_solution(solution), latency=perf_counter() - began, age=age)
        self._publish_shape(cloud.header, observation, solution)

    def _publish_wrench(self, header: Header, solution: Solution) -> None:
        """Publish what the object does to this jaw, and to the gripper where this node completes that."""
        self.wrench.publish(ros.wrench_message(header, solution.force, solution.torque))
        if self.parameters.peer:
            grasp = self.pairing.add(ros.nanoseconds(header.stamp), solution.force, own=True)
            self._publish_grasp(header, grasp)
        elif self.parameters.completes_grasp:
            self._publish_grasp(header, single_jaw_grasp(solution.force, self.parameters.jaw_name))
        self.stddev.publish(ros.wrench_message(header, solution.force_stddev, solution.torque_stddev))

    def _publish_grasp(self, header: Header, grasp: Grasp | None) -> None:
        """Publish the forces on the gripper, once there are any."""
        if grasp is not None:
            header = Header(stamp=header.stamp, frame_id=self.parameters.gripper_frame)
            self.grasp.publish(ros.wrench_message(header, grasp.grasp))
            self.manipulation.publish(ros.wrench_message(header, grasp.manipulation))

    def _publish_shape(self, header: Header, observation: Observation, solution: Solution) -> None:
        """Publish the deformed surface, and markers while someone listens."""
        if self.parameters.publish_surface:
            self.surface.publish(ros.cloud_message(header, ros.xyz_columns(self.estimator.surface())))
        due = monotonic() - self.markers_sent >= 1.0 / self.parameters.marker_rate
        if due and self.markers.get_subscription_count():
            self.markers_sent = monotonic()
            markers = build_markers(header, observation, solution, self.estimator)
            self.markers.publish(MarkerArray(markers=markers))

    def _on_contact(self, cloud: PointCloud2) -> None:
        """Keep the newest contact; a cloud that cannot be read leaves none."""
        self.contact, self.contact_stamp = None, ros.nanoseconds(cloud.header.stamp)
        try:
            free = self.parameters.contact_free
            self.contact = contact_from_cloud(cloud, self.parameters.frame, free=free)
        except FinforceError as error:
            self._refuse(Outcome.of_error(error))

    def _contact_at(self, stamp: int) -> Contact | None:
        """Return the contact for an image; one that came by topic only while it is fresh."""
        fresh = abs(stamp - self.contact_stamp) <= self.parameters.max_age * ros.NANOSECONDS
        return self.contact if fresh or self.parameters.is_contact_fixed else None

    def _on_peer(self, wrench: WrenchStamped) -> None:
        """Complete the grasp with the other jaw's force."""
        stamp, peer = ros.nanoseconds(wrench.header.stamp), self.parameters.peer
        try:
            force = force_from_wrench(wrench, f"{peer}_jaw", f"the wrench of the {peer} jaw")
            self.gate.check_age(stamp, self._now())
            self._publish_grasp(wrench.header, self.pairing.add(stamp, force, own=False))
        except FinforceError as error:
            self._refuse(Outcome.of_error(error))

    def _restart(self, reason: str) -> str:
        self.estimator.reset()
        self.get_logger().warning(f"{reason}; the estimator begins anew")
        return reason

    def _refuse(self, outcome: Outcome) -> None:
        self.get_logger().warning(f"no wrench: {outcome.text}", throttle_duration_sec=2.0)
        self.health.refuse(outcome)

    def _report(self, alarms: list[Outcome]) -> Report:
        """Return how this node is doing."""
        limit = max(1.0, self.parameters.max_age)
        alarms = [*alarms, *peer_alarms(self.parameters.peer, self.pairing.silence, limit)]
        return self.health.report(alarms, describe_solution(self.last) | {"tared": str(self.estimator.tared)})

    def _now(self) -> int:
        return self.get_clock().now().nanoseconds


def main(args: Sequence[str] | None = None) -> int:
    """Run the node until Ctrl-C."""
    return ros.run_node("ifea_solver", IfeaSolverNode, args)


if __name__ == "__main__":
    sys.exit(main())
