"""Messages of topics as they come, unread, without a node that stays."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from importlib import import_module
from time import monotonic
from typing import NamedTuple

import rclpy
from rclpy.executors import SingleThreadedExecutor

from finforce.ros.node import SENSOR

Heard = Mapping[str, list[bytes]]


class Listening(NamedTuple):
    """Serialised messages by topic, and the types of all topics that somebody published meanwhile."""

    heard: Heard
    published: Mapping[str, tuple[str, ...]]


def listen(
    types: Mapping[str, str], enough: Callable[[Heard], bool], patience: float, domain: int | None = None
) -> Listening:
    """Listen to topics until enough has come, or for some time.

    Args:
        types: of the topics, as `sensor_msgs/msg/Image`.
        enough: says whether what came is enough.
        patience: the longest time [s].
        domain: ROS_DOMAIN_ID; None for that of the environment.
    """
    heard: dict[str, list[bytes]] = {topic: [] for topic in types}
    context = rclpy.Context()
    rclpy.init(context=context, domain_id=domain)
    try:
        node, executor = rclpy.create_node("listening", context=context), SingleThreadedExecutor(context=context)
        executor.add_node(node)
        for topic, name in types.items():
            package, _, kind = name.split("/")
            node.create_subscription(
                getattr(import_module(f"{package}.msg"), kind), topic, heard[topic].append, SENSOR, raw=True
            )
        deadline = monotonic() + patience
        while not enough(heard) and monotonic() < deadline:
            executor.spin_once(timeout_sec=0.1)
        there = {name: tuple(kinds) for name, kinds in node.get_topic_names_and_types() if node.count_publishers(name)}
        executor.shutdown()
        node.destroy_node()
    finally:
        rclpy.try_shutdown(context=context)
    return Listening(heard, there)
