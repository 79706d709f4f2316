"""The key point detector node: images in, key points and poses of the jaws out."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from functools import partial
from time import monotonic, perf_counter
from typing import TYPE_CHECKING, Any

from numpy.typing import NDArray
from rcl_interfaces.msg import ParameterDescriptor
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.node import Node
from sensor_msgs.msg import CameraInfo, CompressedImage, Image

from finforce.errors import FinforceError
from finforce.health import Health, Outcome, Report
from finforce.messages import stamp_of
from finforce.processors import bind_caller
from finforce.ros import node as ros
from finforce.ros.pipeline import read_message
from finforce.ros.raw_image import read_image, read_picture
from finforce.skipping import IDLE, LATE, UNHEARD, Skips
from finforce.stamps import Idling, StampGate
from finforce_keypoints.build import BuiltDetector, build_detector
from finforce_keypoints.camera_feed import SECOND, RgbdFeed
from finforce_keypoints.detectors.dots import DotSettings
from finforce_keypoints.diagnostics import describe, outcome_of_keypoints, report_of_rest
from finforce_keypoints.images import ImagePair
from finforce_keypoints.parameters import NO_DEPTH, DetectorParameters, is_compressed, load_jaws
from finforce_keypoints.publishers import DetectorOutputs
from finforce_keypoints.settings import RULES, DetectorSettings

if TYPE_CHECKING:
    from finforce_keypoints.geometry.jaw_localizer import JawKeypoints

# an image is looked at before its depth has come where the node has waited so long for it [s]; otherwise the time is
# needed for those that are whole
LEISURE = 3e-3
STAMPED = 12  # bytes of a serialised message up to the end of its stamp


class DoorGroup(MutuallyExclusiveCallbackGroup):
    """Callbacks that are called while it is open; messages that come meanwhile wait, unread."""

    _is_open = True

    def open(self) -> None:
        """Have what waits read."""
        self._is_open = True

    def close(self) -> None:
        """Leave what comes unread."""
        self._is_open = False

    def can_execute(self, entity: Any) -> bool:
        """Say whether one may be called now."""
        return self._is_open and super().can_execute(entity)


class KeypointDetectorNode(Node):
    """Finds the key points of the jaws, image by image; publishes nothing of an image that it does not trust.

    Args:
        build: makes the detector from jaws, parameters, and the settings of detector and dots.
        stage: what the node is in a process of several.
        options: of `rclpy.node.Node`.

    Raises:
        FinforceError: a parameter, a jaw or the network cannot be used.
    """

    def __init__(
        self, build: Callable[..., BuiltDetector] = build_detector, stage: ros.Stage | None = None, **options: Any
    ) -> None:
        super().__init__("keypoint_detector", **options)
        self.parameters = parameters = ros.declare_record(self, DetectorParameters)
        settings = ros.declare_record(self, DetectorSettings, "detector")
        dots = ros.declare_record(self, DotSettings, "dots")
        jaws = load_jaws(parameters)
        names = next(iter(jaws.values())).keypoint_names
        said = ParameterDescriptor(description="what the rows of the clouds are", read_only=True)
        self.declare_parameter("keypoint_names", list(names), said, ignore_override=True)
        ros.name_unknown_parameters(self)
        self.skips = Skips(RULES, parameters.skip_off)
        ros.warn_first_start(self)
        self.detector, self.card = build(jaws, parameters, settings, dots, self.skips)
        self.feed = RgbdFeed(parameters)
        self.gate = StampGate(max_age=parameters.max_age, restart_gap=parameters.restart_gap)
        source, age = self.feed.source, parameters.max_age
        self.health = {side: Health(source=source, stale_after=age) for side in parameters.sides}
        self.found: Mapping[str, JawKeypoints] = {}
        self.rested, self.idling, self.info = float("-inf"), Idling(), b""
        self.busy = 0.0
        self.qos = ros.QosWatch(self, stage)
        self.out = DetectorOutputs(self.qos, parameters, names, self.card, self.skips)
        self.detector.warm_up()  # before images come: those that came meanwhile would be lost
        self._serve()
        self._subscribe()
        self.get_logger().info(f"jaws: {parameters.jaws}, ready, key points by {self.card.name}")

    def _serve(self) -> None:
        """Offer services and diagnostics."""
        ros.serve_trigger(self.qos, "~/reset", lambda: self._restart("reset by service"))
        for side in self.parameters.sides:
            report, period = partial(self._report, side), self.parameters.diagnostics_period
            ros.publish_diagnostics(self, self.qos, f"finforce: {side} key points", period, report)

    def _subscribe(self) -> None:
        """Create the subscriptions; images that a newer one overtook are passed over."""
        parameters = self.parameters
        self.qos.subscription(CameraInfo, parameters.info_topic, self._on_info, ros.SENSOR, raw=True)
        # as bytes: of an image that nobody looks at no more than the header is read
        self.depth_group = DoorGroup()
        if parameters.depth != NO_DEPTH:
            self.depths = ros.LargeSubscription(
                self.qos, Image, parameters.depth_topic, self._on_depth, raw=True, callback_group=self.depth_group
            )
        self.colors = {
            topic: ros.LargeSubscription(
                self.qos,
                CompressedImage if is_compressed(topic) else Image,
                topic,
                partial(self._on_color, topic),
                raw=True,
            )
            for topic in parameters.color_topics
        }

    def _on_info(self, data: bytes) -> None:
        """Keep the camera's intrinsics, which hardly ever change."""
        if (said := data[STAMPED:]) == self.info:
            return
        with self._refusals():
            self.feed.take_info(read_message(data, CameraInfo))
            self.info = said

    def _on_color(self, topic: str, data: bytes) -> None:
        """Take the newest colour image of the camera's topic."""
        began, superseded = perf_counter(), 0
        if self.skips.allows(LATE):
            data, superseded = ros.take_newest(self.colors[topic].current, data)
            self.skips.count(LATE, superseded)
        if not self.feed.listens(topic):
            return
        for health in self.health.values():
            health.source = self.feed.source
            health.arrive(superseded)
        with self._refusals():
            message = read_picture(data) if is_compressed(topic) else read_image(data)
            if not (self._rest() or self._confirm(message, began)):
                self.depth_group.open()  # what came meanwhile is read now
                pair = self.feed.take_color(topic, message)
                if pair is None:
                    self._begin(message, began)
                self._answer(pair, began)

    def _on_depth(self, data: bytes) -> None:
        """Take a depth image."""
        with self._refusals():
            self._answer(self.feed.take_depth(read_image(data)), perf_counter())

    def _rest(self) -> bool:
        """Say whether nobody listens, so that there is nothing to do."""
        if not self.skips.allows(UNHEARD) or self.out.are_heard:
            return False
        self.depth_group.close()
        self.rested = monotonic()
        self.skips.count(UNHEARD)
        return True

    def _confirm(self, message: Any, began: float) -> bool:
        """Publish the last key points again if a colour image shows that nothing has moved; say whether it did."""
        if self.feed.camera is None:
            return False
        stamp, color = stamp_of(message), self.feed.read_color(message)
        found = self.detector.confirm(SECOND * stamp, color, self.feed.camera)
        if found is None:
            return False
        self.depth_group.close()
        self.feed.pass_over()
        self.gate.enter(stamp, self._now())
        if self.skips.allows(IDLE) and self.idling.passes(stamp):
            self.skips.count(IDLE)
            return True
        self.found = found
        self._publish(stamp, color, began)
        self.idling.note(stamp, True)
        return True

    def _begin(self, message: Any, began: float) -> None:
        """Look for the key points in a colour image whose depth is on its way, as it came for those before."""
        if not self.feed.is_prompt or began < self.busy + LEISURE or self.feed.camera is None:
            return
        with suppress(FinforceError):  # what cannot be used is refused with its depth
            self.detector.begin(SECOND * stamp_of(message), self.feed.read_color(message), self.feed.camera)
        self.busy = perf_counter()

    def _answer(self, pair: ImagePair | None, began: float) -> None:
        """Find the key points of all jaws in an image that is whole."""
        if pair is None:
            return
        image = self.feed.decode(pair)
        if self.gate.enter(pair.stamp, self._now()):
            self._restart("the stamps went back: a new recording")
        self.found = {}  # until they are found again
        self.found = self.detector.detect(image)
        self._publish(pair.stamp, image.color, began)
        self.idling.note(pair.stamp, False)
        self.busy = perf_counter()

    def _publish(self, stamp: int, color: NDArray, began: float) -> None:
        """Publish the key points of an image, (h, w, 3), while they are fresh."""
        found = self.found
        self.gate.check_age(stamp, self._now())
        for side, health in self.health.items():
            outcome = outcome_of_keypoints(found.get(side), side, self.detector.warnings.get(side, ""))
            if side not in found:
                self._refuse(outcome, (side,))
                continue
            self.out.send_jaw(side, stamp, found[side])
            age = (self._now() - stamp) / ros.NANOSECONDS
            health.publish(outcome, latency=perf_counter() - began, age=age)
        self.out.send_annotated(stamp, color, found)

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
        known = describe(self.feed, self.card, self.found.get(side)) | self.skips.describe()
        report = self.health[side].report(alarms, known)
        if monotonic() - self.rested > self.parameters.max_age:
            return report
        return report_of_rest(alarms, report.values)

    def _now(self) -> int:
        return self.get_clock().now().nanoseconds


def main(args: Sequence[str] | None = None) -> int:
    """Run the node until Ctrl-C."""

    def build() -> KeypointDetectorNode:
        node = KeypointDetectorNode()
        bind_caller(node.parameters.threads)
        return node

    return ros.run_node("keypoint_detector", build, args)


if __name__ == "__main__":
    sys.exit(main())
