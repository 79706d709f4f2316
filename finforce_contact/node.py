"""The contact estimator node: poses, surfaces and images in, contacts out."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from time import perf_counter
from typing import Any, NamedTuple

from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.node import Node

from finforce.errors import FinforceError
from finforce.health import Health, Outcome, Report
from finforce.messages import stamp_of
from finforce.ros import node as ros
from finforce.settings import refresh_record
from finforce.skipping import CONTACT, IDLE, Skips
from finforce.stamps import Idling, StampGate
from finforce_contact.jaw_contact import TimedEstimate
from finforce_contact.parameters import ContactParameters, ContactSettings, TrackerSettings
from finforce_contact.publishers import ContactOutputs, describe, object_alarms, outcome_of_estimate
from finforce_contact.session import ContactSession, StampedPose, detections_type

CAMERA = "/camera/camera"
WAITING = ros.QoSProfile(depth=20, reliability=ros.ReliabilityPolicy.BEST_EFFORT)  # a tenth of a second, and more


class Deferred(NamedTuple):
    """A message of a jaw's solver that is not read until the next contact is looked for, and what takes it."""

    take: Callable[[str, Any], list[TimedEstimate]]
    message: Any


class ContactEstimatorNode(Node):
    """Says where the object touches the jaws, image by image; lives on without an object.

    Args:
        stage: what the node is in a process of several.
        options: of `rclpy.node.Node`.

    Raises:
        FinforceError: a parameter or the jaw cannot be used.
    """

    def __init__(self, stage: ros.Stage | None = None, **options: Any) -> None:
        super().__init__("contact_estimator", **options)
        self.parameters = parameters = ros.declare_record(self, ContactParameters)
        contact = ros.declare_record(self, ContactSettings, "contact")
        tracker = ros.declare_record(self, TrackerSettings, "tracker")
        ros.name_unknown_parameters(self)
        sides, age = parameters.sides, parameters.max_age
        self.skips = Skips(CONTACT, parameters.skip_off)
        ros.warn_first_start(self)
        self.session = ContactSession(parameters, contact, tracker, self.skips)
        self.gates = {side: StampGate(max_age=age, restart_gap=parameters.restart_gap) for side in sides}
        self.health = {side: Health(source=f"{side}/jaw_pose", stale_after=age) for side in sides}
        self.qos = ros.QosWatch(self, stage)
        self.out = ContactOutputs(self.qos, parameters, self.skips)
        with self._refusals(sides):
            self.get_logger().info(self.session.load_mesh(parameters))
        self._serve()
        self.idling = {side: Idling() for side in sides}
        self.deferred: dict[str, dict[str, Deferred]] = {side: {} for side in sides}
        self._subscribe()
        self.get_logger().info(f"jaws: {parameters.jaws}, ready, object poses by {parameters.pose_source}")

    def _serve(self) -> None:
        """Offer services, whose long work holds up nothing else, and diagnostics."""
        session, period = self.session, self.parameters.diagnostics_period
        one_by_one = MutuallyExclusiveCallbackGroup()
        ros.serve_trigger(self.qos, "~/load_mesh", lambda: session.load_mesh(self._refreshed()), one_by_one)
        ros.serve_trigger(self.qos, "~/reconstruct", lambda: session.reconstruct(self._refreshed()), one_by_one)
        ros.serve_trigger(self.qos, "~/reset", session.reset)
        for side in self.parameters.sides:
            report = partial(self._report, side)
            ros.publish_diagnostics(self, self.qos, f"finforce: {side} contact", period, report)

    def _subscribe(self) -> None:
        """Subscribe to all that the parameters ask for.

        Raises:
            MissingDependencyError: a message type is not installed.
        """
        qos, session, source = self.qos, self.session, self.parameters.pose_source
        self.objects = None
        if self.parameters.tracks:
            self._subscribe_camera()
        elif source == "topic":
            self.objects = qos.subscription(ros.PoseStamped, "object_pose", self._on_object, ros.SENSOR)
        else:
            self.objects = qos.subscription(detections_type(), "object_detections", self._on_object, ros.SENSOR)
        for side in self.parameters.sides:
            for kind, name, take in (
                (ros.WrenchStamped, "wrench", session.take_wrench),
                (ros.PointCloud2, "surface", session.take_surface),
            ):
                keep = partial(self._on_solver, side, name, take)
                qos.subscription(kind, f"{side}/{name}", keep, ros.SENSOR)
            find = partial(self._on_jaw_pose, side)
            qos.subscription(ros.PoseStamped, f"{side}/jaw_pose", find, WAITING, can_wait=True)

    def _subscribe_camera(self) -> None:
        """Subscribe to the images in which the object is found; they wait for each other."""
        session, group = self.session, MutuallyExclusiveCallbackGroup()
        info, take_info = f"{CAMERA}/color/camera_info", partial(self._on_image, session.take_camera)
        self.qos.subscription(ros.CameraInfo, info, take_info, ros.SENSOR, callback_group=group)
        for topic, take in (
            ("object_mask", session.take_mask),
            (f"{CAMERA}/aligned_depth_to_color/image_raw", session.take_depth),
        ):
            ros.LargeSubscription(self.qos, ros.Image, topic, partial(self._on_image, take), callback_group=group)

    def _refreshed(self) -> ContactParameters:
        """Return the parameters with the present values of those that may be set at run time."""
        return refresh_record(self.parameters, lambda name: self.get_parameter(name).value)

    def _on_jaw_pose(self, side: str, pose: ros.PoseStamped) -> None:
        """Find the contact of an image, unless it may be passed over."""
        with self._refusals((side,)):
            self._find_contact(side, pose)

    def _find_contact(self, side: str, pose: ros.PoseStamped) -> None:
        """Find the contact of an image, unless it may be passed over."""
        began, stamp = perf_counter(), stamp_of(pose)
        self.health[side].arrive()
        # poses of the object that came while the image was looked at
        for message in ros.take_waiting(self.objects):
            self._on_object(message)
        if self.idling[side].passes(stamp):
            self.skips.count(IDLE)
            self.session.pass_over(side, stamp, lambda: pose)
            return
        if self.gates[side].enter(stamp, self._now()):
            self.session.restart(side)
            self.get_logger().warning("the stamps went back: a new recording; poses and contacts are forgotten")
        self.idling[side].end()
        for name, deferred in list(self.deferred[side].items()):
            self._on_solver(side, name, *deferred)
        self._send(side, began, self.session.take_jaw_pose(side, pose))
        is_idle = self.session.jaws[side].is_idle and self.skips.allows(IDLE)
        self.idling[side].note(stamp, is_idle)

    def _on_solver(self, side: str, name: str, take: Callable[[str, Any], list[TimedEstimate]], message: Any) -> None:
        """Keep what a jaw's solver says, and find the contact of an image that has no jaw pose of its own.

        Of an image that is passed over it is read when the next contact is looked for, if nothing newer came.
        """
        began = perf_counter()
        with self._refusals((side,)):
            if self.idling[side].passes(stamp_of(message)):
                self.deferred[side][name] = Deferred(take, message)
                return
            self.deferred[side].pop(name, None)
            self._check_ahead(message)
            self._send(side, began, take(side, message))

    def _on_object(self, message: Any) -> None:
        """Use the object's pose that another node has found."""
        with self._refusals(self.parameters.sides):
            self._check_ahead(message)
            self._hand_on(self.session.read_pose(message))

    async def _on_image(self, take: Callable[[Any], StampedPose | None], image: Any) -> None:
        """Use the object's pose, if one is found with an image, while other callbacks go on."""
        with self._refusals(self.parameters.sides):
            self._check_ahead(image)
            self._hand_on(await ros.run_aside(self, partial(take, image)))

    def _check_ahead(self, message: Any) -> None:
        """Refuse a stamp ahead of the clock before anything is kept that all later stamps would be behind."""
        now = self._now()
        self.gates[self.parameters.sides[0]].check_age(max(stamp_of(message), now), now)

    def _hand_on(self, found: StampedPose | None) -> None:
        """Give the jaws a pose of the object, if it was found."""
        began, everybody = perf_counter(), self.parameters.sides
        if found is None:
            return
        self.gates[everybody[0]].check_age(found.stamp, self._now())
        self.out.send_pose(found)
        for side in everybody:
            with self._refusals((side,)):
                self._send(side, began, self.session.take_object_pose(side, found))

    def _send(self, side: str, began: float, estimates: Iterable[TimedEstimate]) -> None:
        """Publish contacts that are still fresh; an object whose place is not known gives none."""
        for timed in estimates:
            self.gates[side].check_age(timed.stamp, self._now())
            outcome = outcome_of_estimate(timed.estimate)
            if timed.estimate.status == "no_pose":
                self._refuse(outcome, (side,))
                continue
            self.out.send_contact(side, timed)
            age = (self._now() - timed.stamp) / ros.NANOSECONDS
            self.health[side].publish(outcome, latency=perf_counter() - began, age=age)

    @contextmanager
    def _refusals(self, sides: Iterable[str]) -> Iterator[None]:
        """Survive what is wrong with a message, and say it."""
        try:
            yield
        except FinforceError as error:
            self._refuse(Outcome.of_error(error), sides)

    def _refuse(self, outcome: Outcome, sides: Iterable[str]) -> None:
        self.get_logger().warning(f"no contact: {outcome.text}", throttle_duration_sec=2.0)
        for side in sides:
            self.health[side].refuse(outcome)

    def _report(self, side: str, alarms: list[Outcome]) -> Report:
        """Return how one jaw's contact is doing."""
        values = describe(self.session, side) | self.skips.describe()
        return self.health[side].report([*alarms, *object_alarms(self.session)], values)

    def _now(self) -> int:
        return self.get_clock().now().nanoseconds


def main(args: Sequence[str] | None = None) -> int:
    """Run the node until Ctrl-C."""
    return ros.run_node("contact_estimator", ContactEstimatorNode, args)


if __name__ == "__main__":
    sys.exit(main())
