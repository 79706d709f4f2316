"""A running system from outside, without the `ros2` command: messages of a topic, diagnostics of the nodes."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from importlib import import_module
from time import monotonic
from typing import Any, NamedTuple

import numpy as np
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.exceptions import NameValidationException
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.validate_topic_name import validate_topic_name
from sensor_msgs.msg import PointCloud2

from finforce.errors import MissingDependencyError, SilentTopicError, suggest
from finforce.health import Level, Report
from finforce.messages import decode_columns
from finforce.ros.topics import RESULT, SENSOR
from finforce.ros.transport import describe_domain

DISCOVERY = 5.0  # [s] in which a publisher is found
PATIENCE = 5.0  # [s] of silence after which it is noted
LONGEST = 32  # elements of a sequence that are shown
DIGITS = 7  # of a number, as single precision has
Heard = Mapping[str, list[bytes]]


@contextmanager
def open_listener(domain: int | None = None) -> Iterator[tuple[Node, SingleThreadedExecutor]]:
    """Give a node of its own context, and the executor that spins it, within a `with` block.

    Args:
        domain: ROS_DOMAIN_ID; None for that of the environment.

    Raises:
        SilentTopicError: there can be no such domain.
    """
    if wrong := describe_domain(os.environ.get("ROS_DOMAIN_ID", "") if domain is None else str(domain)):
        raise SilentTopicError(wrong)
    context = rclpy.Context()
    rclpy.init(context=context, domain_id=domain)
    try:
        node, executor = rclpy.create_node("listening", context=context), SingleThreadedExecutor(context=context)
        executor.add_node(node)
        yield node, executor
        executor.shutdown()
        node.destroy_node()
    finally:
        rclpy.try_shutdown(context=context)


def load_type(name: str) -> Any:
    """Return the class of a message type such as `sensor_msgs/msg/Image`.

    Raises:
        MissingDependencyError: its package is not installed.
    """
    package, _, kind = name.split("/")
    try:
        return getattr(import_module(f"{package}.msg"), kind)
    except ImportError as error:
        raise MissingDependencyError(f"messages of type {name} need the package {package} of ROS 2") from error


def published_topics(node: Node) -> dict[str, tuple[str, ...]]:
    """Return the topics that somebody publishes, with their types."""
    return {name: tuple(kinds) for name, kinds in node.get_topic_names_and_types() if node.count_publishers(name)}


class Listening(NamedTuple):
    """Serialised messages by topic, and the types of all topics that somebody published meanwhile."""

    heard: Heard
    published: Mapping[str, tuple[str, ...]]


def listen(
    types: Mapping[str, str], enough: Callable[[Heard], bool], timeout: float, domain: int | None = None
) -> Listening:
    """Listen to topics until enough has come, or for some time.

    Args:
        types: of the topics, as `sensor_msgs/msg/Image`.
        enough: says whether what came is enough.
        timeout: the longest time [s].
        domain: ROS_DOMAIN_ID; None for that of the environment.
    """
    heard: dict[str, list[bytes]] = {topic: [] for topic in types}
    with open_listener(domain) as (node, executor):
        for topic, name in types.items():
            node.create_subscription(load_type(name), topic, heard[topic].append, SENSOR, raw=True)
        deadline = monotonic() + timeout
        while not enough(heard) and monotonic() < deadline:
            executor.spin_once(timeout_sec=0.1)
        return Listening(heard, published_topics(node))


def iter_messages(topic: str, note: Callable[[str], Any], *, domain: int | None = None) -> Iterator[Any]:
    """Yield the messages of a topic as they come, in the quality of service of its publishers.

    Args:
        topic: its name; a relative one is in the root namespace.
        note: called with a sentence when nothing has come for a while.
        domain: ROS_DOMAIN_ID; None for that of the environment.

    Raises:
        SilentTopicError: nobody publishes it.
        MissingDependencyError: its type is unknown here.
    """
    with open_listener(domain) as (node, executor):
        topic = _await_publisher(node, executor, topic)
        ends, came = node.get_publishers_info_by_topic(topic), []
        reliable = all(end.qos_profile.reliability == ReliabilityPolicy.RELIABLE for end in ends)
        latched = all(end.qos_profile.durability == DurabilityPolicy.TRANSIENT_LOCAL for end in ends)
        quality = QoSProfile(
            depth=10,
            reliability=ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT,
            durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE,
        )
        node.create_subscription(load_type(ends[0].topic_type), topic, came.append, quality)
        last = monotonic()
        while True:
            executor.spin_once(timeout_sec=0.1)
            if came:
                last = monotonic()
                yield came.pop()
            elif monotonic() - last > PATIENCE:
                last = monotonic()
                names = {end.node_name for end in node.get_publishers_info_by_topic(topic)} or {"nobody any more"}
                note(f"no message on {topic} for {PATIENCE:g} s; published by {' and '.join(sorted(names))}")


def _await_publisher(node: Node, executor: SingleThreadedExecutor, topic: str, hint: str = "") -> str:
    """Return the full name of a topic once somebody publishes it; the hint is for a system that does not."""
    try:
        validate_topic_name(topic)
    except (NameValidationException, ValueError) as error:
        raise SilentTopicError(f"{topic!r} cannot be a topic, expected a name such as /grasp_wrench") from error
    topic, end = node.resolve_topic_name(topic), monotonic() + DISCOVERY
    while not node.count_publishers(topic):
        if monotonic() > end:
            there = published_topics(node).keys() - {"/rosout", "/parameter_events"}
            told = hint or suggest(topic, sorted(there)) if there else f"nor any other topic; {_ask_system(node)}"
            raise SilentTopicError(f"nobody publishes {topic}; {told}")
        executor.spin_once(timeout_sec=0.1)
    return topic


def _ask_system(node: Node) -> str:
    domain = node.context.get_domain_id()
    return f"is a system running, with ROS_DOMAIN_ID={domain}? finforce launch or pipeline starts one"


def describe_message(message: Any) -> dict[str, Any]:
    """Return a message as plain values by field; of a cloud its columns, of a long sequence the first elements."""
    plain = {name: _plain(getattr(message, name)) for name in message.get_fields_and_field_types()}
    if isinstance(message, PointCloud2):
        columns = decode_columns(message, [field.name for field in message.fields])
        kept = {name: plain[name] for name in ("header", "height", "width")}
        return kept | {name: _plain(values) for name, values in columns.items()}
    return plain


def _plain(value: Any) -> Any:
    """Return a value of a message as what YAML can hold."""
    if hasattr(value, "get_fields_and_field_types"):
        return describe_message(value)
    if isinstance(value, bytes) and len(value) == 1:
        return value[0]
    if isinstance(value, (float, np.floating)):
        return float(f"{value:.{DIGITS}g}")
    if isinstance(value, np.integer):
        return int(value)
    if isinstance(value, (bool, int, str)):
        return value
    shown = [_plain(element) for element in value[:LONGEST]]
    return shown if len(value) <= LONGEST else [*shown, f"... {len(value)} in all"]


@dataclass(frozen=True, kw_only=True)
class NodeStatus:
    """The newest diagnostics of a node.

    Attributes:
        report: level, sentence and values.
        age: time since it came [s].
    """

    report: Report
    age: float


def iter_statuses(period: float, *, domain: int | None = None) -> Iterator[Mapping[str, NodeStatus]]:
    """Yield the newest diagnostics of every node, by its name, once every `period` [s].

    Raises:
        SilentTopicError: nobody publishes any.
    """
    with open_listener(domain) as (node, executor):
        came: dict[str, tuple[float, Report]] = {}

        def take(array: DiagnosticArray) -> None:
            for status in array.status:
                values = {entry.key: entry.value for entry in status.values}
                report = Report(level=Level(status.level[0]), message=status.message, values=values)
                came[status.name] = monotonic(), report

        node.create_subscription(DiagnosticArray, "/diagnostics", take, RESULT)
        _await_publisher(node, executor, "/diagnostics", "nodes that are starting publish none yet: try again")
        while True:
            end = monotonic() + period
            while (left := end - monotonic()) > 0.0:
                executor.spin_once(timeout_sec=left)
            now = monotonic()
            yield {name: NodeStatus(report=report, age=now - then) for name, (then, report) in sorted(came.items())}
