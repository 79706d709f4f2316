"""The solver node of one jaw: key points and contacts in, wrenches out."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from threading import Timer
from time import perf_counter
from typing import Any

from geometry_msgs.msg import PoseStamped, Vector3Stamped, WrenchStamped
from sensor_msgs.msg import PointCloud2

from finforce.gripper_frames import SIDES
from finforce.health import IDLE, Health, Outcome, Report, Skips
from finforce.messages import pose_from_message, stamp_of, wrench_from_message
from finforce.ros import node as ros
from finforce.stamps import Idling, StampGate
from finforce_ifea.grasp_force import ForcePairing, Wrench, single_jaw_grasp
from finforce_ifea.messages import observation_from_cloud
from finforce_ifea.observation import Observation, Solution
from finforce_ifea.parameters import (
    GravityFeed,
    NodeParameters,
    build_contact_feed,
    build_estimator,
    load_parameter_jaw,
)
from finforce_ifea.publishers import (
    SolverOutputs,
    describe_friction,
    describe_solution,
    outcome_of_solution,
    peer_alarms,
)
from finforce_ifea.settings import EstimatorSettings

_SLOW = 4.0  # s of preparation, after which somebody may wonder


class IfeaSolverNode(ros.ImageNode):
    """Solves one jaw, image by image, and publishes nothing that it does not trust.

    Args:
        build: makes the estimator from jaw, parameters and settings.
        pipeline: of a process of several nodes.
        options: of `rclpy.node.Node`.

    Raises:
        FinforceError: a parameter, the jaw or the calibration cannot be used.
    """

    answer = "wrench"

    def __init__(
        self,
        build: Callable[..., Any] = build_estimator,
        pipeline: ros.Pipeline | None = None,
        **options: Any,
    ) -> None:
        super().__init__("ifea_solver", **options)
        self.parameters = parameters = ros.declare_record(self, NodeParameters)
        settings = ros.declare_record(self, EstimatorSettings, "estimator")
        settings = settings.resolve_held(both=parameters.paired or bool(parameters.peer))
        ros.name_unknown_parameters(self)
        self.skips = Skips(parameters.skip_off)
        jaw = load_parameter_jaw(parameters)
        self.contacts = build_contact_feed(jaw, parameters)
        self.gravity = GravityFeed(parameters) if settings.may_be_held else None
        ros.warn_first_start()
        with self._announce_wait(jaw.name):
            self.estimator = build(jaw, parameters, settings)
        self.gate = StampGate(max_age=parameters.max_age, restart_gap=parameters.restart_gap)
        health = Health(source=f"{parameters.jaw_name}/keypoints", stale_after=parameters.max_age)
        self.health[parameters.jaw_name] = health
        self.pairing = ForcePairing(parameters.jaw_name)
        self.idling = Idling()
        self.waiting: tuple[PointCloud2, float] | None = None  # key points without their contact, and when they came
        self.last: Solution | None = None
        self.stage = ros.Stage(self, pipeline)
        self.out = SolverOutputs(self.stage, parameters, self.skips)
        self._serve(parameters.jaw_name)
        self._subscribe(parameters.jaw_name)
        source = "fixed" if self.contacts.is_fixed else "by topic"
        self.get_logger().info(f"{parameters.jaw_name} jaw '{jaw.name}' ready, contact {source}")

    @contextmanager
    def _announce_wait(self, jaw: str) -> Iterator[None]:
        """Say what takes so long, if it does."""
        words = f"preparing jaw '{jaw}': a minute or two at its first start, seconds later on"
        late = Timer(_SLOW, lambda: self.get_logger().info(words))
        late.start()
        try:
            yield
        finally:
            late.cancel()

    def _serve(self, side: str) -> None:
        """Offer services and diagnostics."""
        ros.serve_trigger(self.stage, f"{side}/tare", lambda: self.estimator.tare())
        ros.serve_trigger(self.stage, f"{side}/reset", lambda: self._restart("reset by service"))
        longest = self.parameters.contact_timeout
        self.overdue = self.create_timer(longest, self.stage.guard(self._solve_waiting), clock=ros.STEADY_CLOCK)
        self.overdue.cancel()
        period = self.parameters.diagnostics_period
        ros.publish_diagnostics(self.stage, f"finforce: {side} jaw", period, self._report)

    def _subscribe(self, side: str) -> None:
        """Create the subscriptions; a node that has them is ready."""
        if not self.contacts.is_fixed:
            # the outline first: a contact is whole with its own
            self.stage.subscription(PointCloud2, f"{side}/object_outline", self._on_outline, ros.SENSOR)
            self.stage.subscription(PointCloud2, f"{side}/contact", self._on_contact, ros.SENSOR)
        if peer := self.parameters.peer:
            self.stage.subscription(WrenchStamped, f"{peer}/wrench", self._on_peer, ros.RESULT)
            for jaw in SIDES:
                self.stage.subscription(PoseStamped, f"{jaw}/jaw_pose", partial(self._on_jaw_pose, jaw), ros.SENSOR)
        if self.gravity is not None:  # of what one jaw presses, friction tells nothing of its weight
            self.stage.subscription(Vector3Stamped, "gravity", self._on_gravity, ros.SENSOR)
        self.stage.subscription(PointCloud2, f"{side}/keypoints", self._on_keypoints, ros.NEWEST)

    def _on_keypoints(self, cloud: PointCloud2) -> None:
        """Take an image, to be solved with its contact, or with the one before where that takes too long."""
        began, stamp = perf_counter(), stamp_of(cloud)
        self.health[self.parameters.jaw_name].arrive()
        if self.idling.passes(stamp):
            self.skips.count(IDLE)
            return
        self.waiting = (cloud, began)
        if self.contacts.expect(stamp, began):
            self.overdue.reset()
        else:
            self._solve_waiting()

    def _solve_waiting(self) -> None:
        """Solve the image that waits for its contact, if there is one."""
        self.overdue.cancel()
        image, self.waiting = self.waiting, None
        if image is not None:
            self._solve(*image)

    def _solve(self, cloud: PointCloud2, began: float) -> None:
        """Solve an image and publish its wrench, if it can be trusted."""
        header, stamp = cloud.header, stamp_of(cloud)
        with self.rejections():
            gravity = self.gravity.at(stamp) if self.gravity is not None else None
            observation = observation_from_cloud(cloud, self.parameters.frame, gravity)
            if self.gate.enter(stamp, self.now()):
                self._restart("the stamps went back: a new recording")
            self.last = solution = self.estimator.update(observation, self.contacts.at(stamp))
            self.gate.check_age(stamp, self.now())
            self._note_idle(stamp)
            if not solution.trusted:
                self.reject(outcome_of_solution(solution))
                return
            self.out.send_wrench(header, solution)
            wrench = Wrench(solution.force, solution.torque)
            if self.parameters.peer:
                self.out.send_grasp(header, self.pairing.add(stamp, wrench, own=True))
            elif self.parameters.completes_grasp:
                self.out.send_grasp(header, single_jaw_grasp(wrench, self.parameters.jaw_name))
            self.out.send_stddev(header, solution)
            self.confirm(self.parameters.jaw_name, stamp, outcome_of_solution(solution), began)
            self.stage.afterwards(partial(self._finish, header, observation, solution))

    def _finish(self, header: Any, observation: Observation, solution: Solution) -> None:
        """Do what no force waits for."""
        self.out.send_shape(header, observation, solution, self.estimator)
        self.estimator.learn()

    def _note_idle(self, stamp: int) -> None:
        """Note whether the jaw was left alone in this image, and the next ones may be passed over."""
        self.idling.note(stamp, self.estimator.is_idle and self.skips.allows(IDLE))

    def _on_contact(self, cloud: PointCloud2) -> None:
        """Keep the newest contact."""
        with self.rejections():
            self.contacts.take(cloud, stamp_of(cloud))
        if self.contacts.completes(perf_counter()):
            self._solve_waiting()

    def _on_outline(self, cloud: PointCloud2) -> None:
        """Keep the newest outline of the object."""
        with self.rejections():
            self.contacts.take_outline(cloud, stamp_of(cloud))

    def _on_peer(self, wrench: WrenchStamped) -> None:
        """Complete the grasp with the other jaw's force."""
        stamp, peer = stamp_of(wrench), self.parameters.peer
        with self.rejections():
            found = Wrench(*wrench_from_message(wrench, f"{peer}_jaw"))
            self.gate.check_age(stamp, self.now())
            self.out.send_grasp(wrench.header, self.pairing.add(stamp, found, own=False))

    def _on_gravity(self, direction: Vector3Stamped) -> None:
        """Keep which way things fall."""
        with self.rejections():
            self.gravity.take(direction)

    def _on_jaw_pose(self, side: str, pose: PoseStamped) -> None:
        """Keep where a jaw is, for the torque on the gripper."""
        with self.rejections():
            T = pose_from_message(pose, pose.header.frame_id, f"the pose of the {side} jaw")
            self.pairing.distance.take(side, stamp_of(pose), T)

    def _restart(self, reason: str) -> str:
        self.estimator.reset()
        self.get_logger().warning(f"{reason}; the estimator begins anew")
        return reason

    def _report(self, alarms: list[Outcome]) -> Report:
        """Return how this node is doing."""
        limit = max(1.0, self.parameters.max_age)
        alarms = [*alarms, *peer_alarms(self.parameters.peer, self.pairing.silence, limit)]
        tared = {"tared": str(self.estimator.tared), "friction": describe_friction(self.estimator)}
        health = self.health[self.parameters.jaw_name]
        return health.report(alarms, describe_solution(self.last) | tared | self.skips.describe())


def main(args: Sequence[str] | None = None) -> int:
    """Run the node until Ctrl-C."""
    return ros.run_node("ifea_solver", IfeaSolverNode, args)


if __name__ == "__main__":
    sys.exit(main())
