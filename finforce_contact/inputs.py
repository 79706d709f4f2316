"""The topics that a contact estimator reads, and who takes what comes on them; decides nothing about it."""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from functools import partial
from importlib import import_module
from typing import Any, Protocol

import finforce_ros as ros
from finforce_contact.parameters import ContactParameters
from finforce_contact.session import ContactSession
from finforce_ifea.errors import MissingDependencyError

CAMERA = "/camera/camera"


class Handlers(Protocol):
    """What a node does with messages, each time guarded against what may be wrong with them.

    Attributes:
        camera_group: callback group of the images, which wait for each other.
    """

    camera_group: Any

    def on_object(self, message: Any) -> None:
        """Use the object's pose that a message holds."""

    async def on_image(self, take: Callable[[Any], Any], image: Any) -> None:
        """Use the object's pose that `take` finds with an image."""

    def on_jaw_pose(self, side: str, message: Any) -> None:
        """Use the pose of a jaw."""

    def on_jaw(self, side: str, take: Callable[[str, Any], list[Any]], message: Any) -> None:
        """Use what `take` makes of a message of a jaw's solver."""


def subscribe(qos: ros.QosWatch, parameters: ContactParameters, session: ContactSession, handlers: Handlers) -> None:
    """Subscribe to all that the parameters ask for.

    Raises:
        MissingDependencyError: a message type is not installed.
    """
    if parameters.tracks:
        _subscribe_camera(qos, session, handlers)
    elif parameters.pose_source == "topic":
        qos.subscription(ros.PoseStamped, "object_pose", handlers.on_object, ros.SENSOR)
    else:
        qos.subscription(detections_type(), "object_detections", handlers.on_object, ros.SENSOR)
    for side in parameters.sides:
        for kind, name, take in (
            (ros.WrenchStamped, "wrench", partial(handlers.on_jaw, side, session.take_wrench)),
            (ros.PointCloud2, "surface", partial(handlers.on_jaw, side, session.take_surface)),
            (ros.PoseStamped, "jaw_pose", partial(handlers.on_jaw_pose, side)),
        ):
            qos.subscription(kind, f"{side}/{name}", take, ros.SENSOR)


def _subscribe_camera(qos: ros.QosWatch, session: ContactSession, handlers: Handlers) -> None:
    """Subscribe to the images in which the object is found; an image that a newer one overtook is passed over."""
    take_info, group = partial(handlers.on_image, session.take_camera), handlers.camera_group
    qos.subscription(ros.CameraInfo, f"{CAMERA}/color/camera_info", take_info, ros.SENSOR, callback_group=group)
    for topic, take in (
        ("object_mask", session.take_mask),
        (f"{CAMERA}/aligned_depth_to_color/image_raw", session.take_depth),
    ):
        _subscribe_newest(qos, topic, partial(handlers.on_image, take), group)


def _subscribe_newest(qos: ros.QosWatch, topic: str, take: Callable[[Any], Awaitable[None]], group: Any) -> None:
    """Subscribe to the newest of the images on a topic."""

    async def on_image(message: Any) -> None:
        await take(ros.take_newest(images.current, message)[0])

    images = ros.LargeSubscription(qos, ros.Image, topic, on_image, callback_group=group)


def detections_type() -> type:
    """Return vision_msgs/Detection3DArray; raises MissingDependencyError where vision_msgs is not installed."""
    try:
        return import_module("vision_msgs.msg").Detection3DArray
    except ImportError as error:
        hint = "source ROS 2 and apt install ros-jazzy-vision-msgs, or have poses sent as PoseStamped"
        raise MissingDependencyError(f"pose_source detections needs vision_msgs: {hint} ({error})") from error
