"""The topics of a running camera into a recording, for as many images as are wanted."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

from finforce.errors import MissingDependencyError
from finforce.messages import read_stamp
from finforce_eval.errors import RecordingError
from finforce_eval.recordings.images import CAMERA_INFO, COMPRESSED, IMAGE
from finforce_eval.recordings.writer import Entry, MessageFactory, write_entries
from finforce_keypoints.parameters import COLOR_TOPIC, DEPTH_TOPIC, INFO_TOPIC, is_compressed

PATIENCE = 15.0  # [s] after which no more is waited for
MORE = 2  # images beyond those wanted, whose depth may not have come


class CameraTopics(NamedTuple):
    """Where a camera publishes; depth is not waited for, and may be empty."""

    color: str = COLOR_TOPIC
    info: str = INFO_TOPIC
    depth: str = DEPTH_TOPIC

    @property
    def types(self) -> dict[str, str]:
        """What each topic carries."""
        color = COMPRESSED if is_compressed(self.color) else IMAGE
        return {self.color: color, self.info: CAMERA_INFO} | ({self.depth: IMAGE} if self.depth else {})


def record_camera(topics: CameraTopics, count: int, folder: Path, domain: int | None = None) -> Path:
    """Listen to a camera until `count` images have come, and write them as a rosbag2 folder under usual names.

    Args:
        topics: where it publishes.
        count: of images.
        folder: a new one.
        domain: ROS_DOMAIN_ID; None for that of the environment.

    Raises:
        RecordingError: images or intrinsics do not come; the message says which topics do.
        MissingDependencyError: ROS is not there.
    """
    try:
        from finforce.ros.listening import listen
    except ImportError as error:
        raise MissingDependencyError(f"listening to topics needs ROS 2: {error}") from error
    wanted = count + MORE
    heard, published = listen(
        topics.types, lambda heard: len(heard[topics.color]) >= wanted and heard[topics.info], PATIENCE, domain
    )
    if not heard[topics.info] or len(heard[topics.color]) < count:
        there = ", ".join(name for name, types in published.items() if {IMAGE, COMPRESSED} & set(types))
        raise RecordingError(
            f"{len(heard[topics.color])} images on {topics.color} and {len(heard[topics.info])} camera_info on "
            f"{topics.info}; expected {count} and 1 within {PATIENCE:g} s; "
            f"images are published on {there or 'no topic at all'}"
        )
    color = COLOR_TOPIC + ("/compressed" if is_compressed(topics.color) else "")
    usual = {topics.color: color, topics.info: INFO_TOPIC, topics.depth: DEPTH_TOPIC}
    factory, types = MessageFactory(), topics.types
    entries = [
        Entry(read_stamp(data), usual[topic], types[topic], factory.typestore.deserialize_cdr(data, types[topic]))
        for topic, messages in heard.items()
        for data in (messages[-1:] if topic == topics.info else messages)
    ]
    return write_entries(sorted(entries, key=lambda entry: entry.stamp), folder, factory)
