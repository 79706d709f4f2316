"""The node that plays a recording in real time, and its parameters."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from importlib import import_module
from itertools import groupby
from operator import attrgetter
from time import monotonic
from typing import Any

import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped, WrenchStamped
from rclpy.executors import Executor, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.signals import uninstall_signal_handlers
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import PointCloud2

from finforce.camera_topics import COLOR_TOPIC, relative
from finforce.gripper_frames import SIDES
from finforce.ros import node as ros
from finforce.settings import setting
from finforce_eval.replay.answers import ReplayLog
from finforce_eval.replay.playback import Playback, RawMessage, ReadAhead

# what is heard while messages are being sent waits its turn; nothing of it may be lost
HEARD = QoSProfile(depth=1000, reliability=ReliabilityPolicy.RELIABLE)


class PlayerNode(Node):
    """Publishes recorded messages in its own namespace, each when its time has come, and spins in between."""

    def __init__(self, name: str = "recording_player", **options: Any) -> None:
        super().__init__(name, **options)
        self._spinner = SingleThreadedExecutor(context=self.context)
        self._spinner.add_node(self)
        self._outputs: dict[str, Any] = {}
        self._clock_out: Any = None
        self._coming: ReadAhead | None = None

    def offer(self, messages: Playback) -> None:
        """Create a publisher for every topic, and begin to read; a type that is not installed is named and left out."""
        for topic, msgtype in messages.types.items():
            package, _, name = msgtype.split("/")
            try:
                kind = getattr(import_module(f"{package}.msg"), name)
            except ImportError:
                self.get_logger().warning(f"{topic} is not played: {msgtype} is not installed")
                continue
            self._outputs[topic] = self.create_publisher(kind, relative(topic), ros.RESULT)
        # what belongs to one image leaves at once
        portions = groupby(messages, key=attrgetter("time"))
        self._coming = ReadAhead((time, list(due)) for time, due in portions)

    def destroy_node(self) -> None:
        """End the node, and the reading of what was not played."""
        if self._coming is not None:
            self._coming.close()
        super().destroy_node()

    def has_listeners(self, topics: Iterable[str]) -> bool:
        """Say whether somebody else listens to each of the topics, whether they are played from here or not."""
        return all(self._count_others(topic) > 0 for topic in topics)

    def _count_others(self, topic: str) -> int:
        """Return how many listen to a topic other than this node."""
        name = self.resolve_topic_name(relative(topic))
        own = sum(subscription.topic_name == name for subscription in self.subscriptions)
        if topic in self._outputs:
            return self._outputs[topic].get_subscription_count() - own
        return self.count_subscribers(name) - own

    def wait_for(self, condition: Callable[[], bool], patience: float) -> bool:
        """Spin until a condition holds, for at most `patience` [s]; return whether it does."""
        deadline = monotonic() + patience
        while not condition():
            if monotonic() > deadline:
                return False
            self.spin_until(min(deadline, monotonic() + 0.05))
        return True

    def spin_until(self, due: float) -> None:
        """Answer callbacks until a time of the monotonic clock.

        Raises:
            KeyboardInterrupt: the process was told to end.
        """
        try:
            while (left := due - monotonic()) > 0.0:
                self._spinner.spin_once(timeout_sec=left)
        except Exception:
            if self.context.ok():
                raise
            # a signal has taken the context away, between two looks at it or under the executor's hands
            raise KeyboardInterrupt from None

    def play(
        self,
        messages: Playback,
        *,
        rate: float = 1.0,
        offset: int | None = None,
        sent: Callable[[RawMessage], Any] = lambda message: None,
    ) -> None:
        """Publish the messages that were offered, once, at their pace.

        Args:
            messages: in the order of their receipt.
            rate: speed; 1 as recorded.
            offset: added to every stamp [ns]; None keeps the stamps and publishes them on /clock.
            sent: called just before each message leaves.
        """
        first = messages.begin
        if offset is None:  # whoever waits for /clock is given the time before the first message needs it
            self._clock_out = self._clock_out or self.create_publisher(Clock, "/clock", ros.RESULT)
            self.wait_for(lambda: self._clock_out.get_subscription_count() > 0, 2.0)
            self._clock_out.publish(Clock(clock=ros.stamp_message(first)))
            self.spin_until(monotonic() + 0.2)
        began = monotonic()
        for time, due in self._coming:
            self.spin_until(began + (time - first) / (rate * ros.NANOSECONDS))
            if offset is None:
                self._clock_out.publish(Clock(clock=ros.stamp_message(time)))
            for message in due:
                self._publish(message, offset, sent)

    def _publish(self, message: RawMessage, offset: int | None, sent: Callable[[RawMessage], Any]) -> None:
        """Publish one message with its stamp moved by `offset` [ns]."""
        if message.topic in self._outputs:
            sent(message)
            data = message.data if offset is None else message.restamped(message.stamp + offset)
            self._outputs[message.topic].publish(data)

    def listen(self, sides: Iterable[str], log: ReplayLog, *, detector: bool = False) -> None:
        """Hand results to a log, with the time of their arrival; with those of the key point detector, if it runs."""

        def subscribe(kind: type, topic: str, take: Callable[[Any], Any]) -> None:
            self.create_subscription(kind, topic, take, HEARD)

        for side in sides:
            subscribe(WrenchStamped, f"{side}/wrench", lambda m, s=side: log.take_wrench(s, m, monotonic()))
            subscribe(WrenchStamped, f"{side}/wrench_stddev", lambda m, s=side: log.take_stddev(s, m))
            subscribe(PointCloud2, f"{side}/surface", lambda m, s=side: log.take_surface(s, m))
            subscribe(PointCloud2, f"{side}/contact", lambda m, s=side: log.take_contact(s, m))
            if detector:
                subscribe(PoseStamped, f"{side}/jaw_pose", lambda m, s=side: log.take_pose(s, m))
                subscribe(PointCloud2, f"{side}/keypoints", lambda m, s=side: log.take_keypoints(s, m, monotonic()))
        subscribe(WrenchStamped, "grasp_wrench", lambda m: log.take_grasp(m, monotonic()))
        subscribe(DiagnosticArray, "/diagnostics", log.take_diagnostics)


@contextmanager
def open_player(domain: int) -> Iterator[PlayerNode]:
    """Give a player on a DDS domain of its own; Ctrl-C and SIGTERM end the block.

    Args:
        domain: ROS_DOMAIN_ID.
    """
    context = rclpy.Context()
    rclpy.init(context=context, domain_id=domain, signal_handler_options=rclpy.SignalHandlerOptions.ALL)
    node = PlayerNode("finforce_replay", context=context)
    try:
        yield node
    finally:
        node.destroy_node()
        rclpy.try_shutdown(context=context)
        uninstall_signal_handlers()  # else SIGTERM would end nothing from here on


def find_awaited(types: Iterable[str], parameters: PlayerParameters) -> set[str]:
    """Return the topics for which somebody has to listen before a recording with some topics is played."""
    kinds = ("keypoints", "jaw_pose") if parameters.awaits_poses else ("keypoints",)
    if not parameters.awaits_images:
        return {topic for topic in types if topic.endswith(tuple(f"/{kind}" for kind in kinds))}
    if parameters.composed:
        return {COLOR_TOPIC}
    sides = [side for side in SIDES if any(topic.startswith(f"/{side}/") for topic in types)]
    return {COLOR_TOPIC, *(f"/{side}/{kind}" for side in sides for kind in kinds)}


def play_recording(node: PlayerNode, _: Executor) -> None:
    """Play the recording that the parameters name, once."""
    parameters = ros.declare_record(node, PlayerParameters)
    messages = Playback(parameters.bag)
    node.offer(messages)
    awaited = find_awaited(messages.types, parameters)
    if not node.wait_for(lambda: node.has_listeners(awaited), parameters.patience):
        node.get_logger().warning(f"no subscriber on one of {', '.join(awaited)}; playing anyway")
    node.play(messages, rate=parameters.rate)
    node.spin_until(monotonic() + 0.5)


def main() -> int:
    """Play a recording with its own stamps and /clock."""
    return ros.run_node("recording_player", PlayerNode, play_recording)


@dataclass(frozen=True, kw_only=True)
class PlayerParameters:
    """Parameters of the player; units stand in the metadata."""

    bag: str = setting("", "Recording: rosbag2 folder, .mcap or .db3")
    rate: float = setting(1.0, "Playback speed; 1 as recorded", "", 0.01, 100.0)
    awaits_poses: bool = setting(False, "Whether playing waits for listeners to the jaw poses, too")
    awaits_images: bool = setting(
        False, "Whether playing waits for listeners to images, and to the key points that they find"
    )
    composed: bool = setting(False, "Whether these listeners are one process")
    patience: float = setting(120.0, "Maximum wait for listeners, which compile first", "s", 0.0, 3600.0)
