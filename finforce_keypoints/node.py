"""The key point detector node: images in, key points and poses of the jaws out; it converts, calls and publishes."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from time import perf_counter
from typing import TYPE_CHECKING, Any

from rcl_interfaces.msg import ParameterDescriptor
from rclpy.node import Node
from sensor_msgs.msg import CameraInfo, Image

import finforce_ros as ros
from finforce_health import Health, Outcome, Report, StampGate
from finforce_ifea.errors import FinforceError
from finforce_keypoints.camera_feed import CameraFeed
from finforce_keypoints.dot_image import DotSettings
from finforce_keypoints.finders import BuiltDetector, build_detector
from finforce_keypoints.images import StampedImage
from finforce_keypoints.outputs import DetectorOutputs
from finforce_keypoints.parameters import DetectorParameters, load_jaws
from finforce_keypoints.report import describe, outcome_of_keypoints
from finforce_keypoints.settings import DetectorSettings

if TYPE_CHECKING:
    from finforce_keypoints.detector import JawKeypoints


class KeypointDetectorNode(Node):
    """Finds the key points of the jaws, image by image; publishes nothing of an image that it does not trust.

    Args:
        build: makes the detector from jaws, parameters, and the settings of detector and dots.
        options: of `rclpy.node.Node`.

    Raises:
        FinforceError: a parameter, a jaw or the network cannot be used.
    """

    def __init__(self, build: Callable[..., BuiltDetector] = build_detector, **options: Any) -> None:
        super().__init__("keypoint_detector", **options)
        self.parameters = parameters = ros.declare_record(self, DetectorParameters)
        settings = ros.declare_record(self, DetectorSettings, "detector")
        dots = ros.declare_record(self, DotSettings, "dots")
        jaws = load_jaws(parameters)
        names = next(iter(jaws.values())).keypoint_names
        said = ParameterDescriptor(description="what the rows of the clouds are", read_only=True)
        self.declare_parameter("keypoint_names", list(names), said, ignore_override=True)
        ros.name_unknown_parameters(self)
        self.detector, self.card = build(jaws, parameters, settings, dots)
        self.feed = CameraFeed(parameters)
        self.gate = StampGate(max_age=parameters.max_age, restart_gap=parameters.restart_gap)
        source, age = self.feed.source, parameters.max_age
        self.health = {side: Health(source=source, stale_after=age) for side in parameters.sides}
        self.found: Mapping[str, JawKeypoints] = {}
        self.qos = ros.QosWatch(self)
        self.out = DetectorOutputs(self.qos, parameters, names, self.card)
        self.detector.warm_up()  # before images come: those that came meanwhile would be lost
        self._serve()
        self._subscribe()
        self.get_logger().info(f"jaws: {parameters.jaws}, ready, key points by {self.card.name}")

    def _serve(self) -> None:
        """Offer services and diagnostics."""
        ros.serve_trigger(self, "~/reset", lambda: self._restart("reset by service"))
        for side in self.parameters.sides:
            report, period = partial(self._report, side), self.parameters.diagnostics_period
            ros.publish_diagnostics(self, self.qos, f"finforce: {side} key points", period, report)

    def _subscribe(self) -> None:
        """Create the subscriptions; images that a newer one overtook are passed over."""
        parameters, feed = self.parameters, self.feed
        self.qos.subscription(CameraInfo, parameters.info_topic, partial(self._take, feed.take_info), ros.SENSOR)
        self.depths = ros.LargeSubscription(
            self.qos, Image, parameters.depth_topic, partial(self._take, feed.take_depth)
        )
        self.colors = {
            topic: ros.LargeSubscription(self.qos, Image, topic, partial(self._on_color, topic))
            for topic in parameters.color_topics
        }

    def _on_color(self, topic: str, message: Image) -> None:
        """Take the newest colour image of the camera's topic."""
        message, superseded = ros.take_newest(self.colors[topic].current, message)
        if not self.feed.listens(topic):
            return
        for health in self.health.values():
            health.source = self.feed.source
            health.arrive(superseded)
        self._take(partial(self.feed.take_color, topic), message)

    def _take(self, take: Callable[[Any], StampedImage | None], message: Any) -> None:
        """Hand a message to the feed, and find the key points in an image that is whole with it."""
        began = perf_counter()
        with self._refusals():
            taken = take(message)
            if taken is not None:
                self._detect(taken, began)

    def _detect(self, taken: StampedImage, began: float) -> None:
        """Find the key points of all jaws and publish them while they are fresh."""
        if self.gate.enter(taken.stamp, self._now()):
            self._restart("the stamps went back: a new recording")
        self.found = {}  # until they are found again
        self.found = found = self.detector.detect(taken.image)
        self.gate.check_age(taken.stamp, self._now())
        for side, health in self.health.items():
            outcome = outcome_of_keypoints(found.get(side), side, self.detector.warnings.get(side, ""))
            if side not in found:
                self._refuse(outcome, (side,))
                continue
            self.out.send_jaw(side, taken.stamp, found[side])
            age = (self._now() - taken.stamp) / ros.NANOSECONDS
            health.publish(outcome, latency=perf_counter() - began, age=age)
        self.out.send_annotated(taken, found)

    def _restart(self, reason: str) -> str:
        self.detector.reset()
        self.feed.reset()
        self.found = {}
        self.get_logger().warning(f"{reason}; images and jaws are forgotten")
        return reason

    @contextmanager
    def _refusals(self) -> Iterator[None]:
        """Survive what is wrong with a message, and say it."""
        try:
            yield
        except FinforceError as error:
            self._refuse(Outcome.of_error(error), self.parameters.sides)

    def _refuse(self, outcome: Outcome, sides: Sequence[str]) -> None:
        self.get_logger().warning(f"no key points: {outcome.text}", throttle_duration_sec=2.0)
        for side in sides:
            self.health[side].refuse(outcome)

    def _report(self, side: str, alarms: list[Outcome]) -> Report:
        """Return how one jaw is seen."""
        return self.health[side].report(alarms, describe(self.feed, self.card, self.found.get(side)))

    def _now(self) -> int:
        return self.get_clock().now().nanoseconds


def main(args: Sequence[str] | None = None) -> int:
    """Run the node until Ctrl-C."""
    return ros.run_node("keypoint_detector", KeypointDetectorNode, args)


if __name__ == "__main__":
    sys.exit(main())
