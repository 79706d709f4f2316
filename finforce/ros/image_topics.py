"""Subscriptions to images, raw or compressed, as image_transport has them."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

from sensor_msgs.msg import CompressedImage, Image

from finforce.camera_topics import COMPRESSED, COMPRESSED_COLOR, ENDS, RAW
from finforce.ros.topics import STEADY_CLOCK, Stage

_LOOKED_FOR = 0.5  # [s] between looks at who publishes


def subscribe_to_images(
    stage: Stage,
    topic: str,
    take: Callable[[str, Any], Any],
    transport: str,
    end: str = COMPRESSED_COLOR,
    **options: Any,
) -> None:
    """Subscribe to the images of a topic.

    Args:
        stage: of the node.
        topic: of raw images; one that ends as compressed images do is subscribed to whatever the transport.
        take: takes the name of the topic and a message.
        transport: raw, compressed, or auto: raw, and compressed where nobody publishes raw ones.
        end: of the topic of compressed images.
        options: of the subscription, as its callback group.
    """
    node = stage.node
    packed = topic if topic.endswith(ENDS) else node.resolve_topic_name(topic) + end

    def subscribe(kind: type, name: str) -> None:
        stage.large_subscription(kind, name, partial(take, name), **options)

    if topic.endswith(ENDS) or transport == COMPRESSED:
        subscribe(CompressedImage, packed)
        return
    subscribe(Image, topic)
    if transport == RAW:
        return

    def look() -> None:
        if node.count_publishers(topic):
            timer.cancel()
        elif node.count_publishers(packed):
            timer.cancel()
            node.get_logger().info(f"no publisher on {topic}: using {packed}")
            subscribe(CompressedImage, packed)

    timer = node.create_timer(_LOOKED_FOR, look, clock=STEADY_CLOCK)
