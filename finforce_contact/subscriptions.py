"""The topics that a contact estimator reads, and who takes what comes on them."""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from functools import partial
from importlib import import_module
from typing import Any, Protocol

from finforce.errors import MissingDependencyError
from finforce.ros import node as ros
from finforce.skipping import LATE, Skips
from finforce_contact.parameters import ContactParameters
from finforce_contact.session import ContactSession

CAMERA = "/camera/camera"
WAITING = ros.QoSProfile(depth=20, reliability=ros.ReliabilityPolicy.BEST_EFFORT)  # a tenth of a second, and more


class Handlers(Protocol):
    """What a node does with messages, each time guarded against what may be wrong with them.

    Attributes:
        camera_group: callback group of the images, which wait for each other.
        skips: rules of what need not be done.
    """

    camera_group: Any
    skips: Skips

    def on_object(self, message: Any) -> None:
        """Use the object's pose that a message holds."""

    async def on_image(self, take: Callable[[Any], Any], image: Any) -> None:
        """Use the object's pose that `take` finds with an image."""

    def on_jaw_pose(self, side: str, data: bytes) -> None:
        """Use the pose of a jaw, a message that was not read yet."""

    def on_jaw(self, side: str, kind: type, take: Callable[[str, Any], list[Any]], data: bytes) -> None:
        """Use what `take` makes of a message of a jaw's solver, which was not read yet."""


class JawInputs:
    """The subscriptions to what a jaw's solver says, which come and go.

    Args:
        qos: makes subscriptions and watches them.
        side: of the jaw.
        session: takes the messages.
        handlers: guards that.
    """

    def __init__(self, qos: ros.QosWatch, side: str, session: ContactSession, handlers: Handlers) -> None:
        self._qos = qos
        self._topics = [
            (kind, f"{side}/{name}", partial(handlers.on_jaw, side, kind, take))
            for kind, name, take in (
                (ros.WrenchStamped, "wrench", session.take_wrench),
                (ros.PointCloud2, "surface", session.take_surface),
            )
        ]
        self._made: list[Any] = []

    @property
    def are_open(self) -> bool:
        """Whether the jaw's solver is listened to."""
        return bool(self._made)

    def open(self) -> None:
        """Listen to the jaw's solver from now on."""
        if not self._made:
            # as bytes: of an image that is passed over no more than the stamp is read
            self._made = [self._qos.subscription(*topic, ros.SENSOR, raw=True) for topic in self._topics]

    def close(self) -> None:
        """Listen no more."""
        while self._made:
            self._qos.node.destroy_subscription(self._made.pop())


def subscribe(
    qos: ros.QosWatch, parameters: ContactParameters, session: ContactSession, handlers: Handlers
) -> dict[str, JawInputs]:
    """Subscribe to all that the parameters ask for; return what comes of the jaws' solvers, by side.

    Raises:
        MissingDependencyError: a message type is not installed.
    """
    if parameters.tracks:
        _subscribe_camera(qos, session, handlers)
    elif parameters.pose_source == "topic":
        qos.subscription(ros.PoseStamped, "object_pose", handlers.on_object, ros.SENSOR)
    else:
        qos.subscription(detections_type(), "object_detections", handlers.on_object, ros.SENSOR)
    jaws = {side: JawInputs(qos, side, session, handlers) for side in parameters.sides}
    for side, inputs in jaws.items():
        inputs.open()
        qos.subscription(ros.PoseStamped, f"{side}/jaw_pose", partial(handlers.on_jaw_pose, side), WAITING, raw=True)
    return jaws


def _subscribe_camera(qos: ros.QosWatch, session: ContactSession, handlers: Handlers) -> None:
    """Subscribe to the images in which the object is found; an image that a newer one overtook is passed over."""
    take_info, group = partial(handlers.on_image, session.take_camera), handlers.camera_group
    qos.subscription(ros.CameraInfo, f"{CAMERA}/color/camera_info", take_info, ros.SENSOR, callback_group=group)
    for topic, take in (
        ("object_mask", session.take_mask),
        (f"{CAMERA}/aligned_depth_to_color/image_raw", session.take_depth),
    ):
        _subscribe_newest(qos, topic, partial(handlers.on_image, take), handlers)


def _subscribe_newest(
    qos: ros.QosWatch, topic: str, take: Callable[[Any], Awaitable[None]], handlers: Handlers
) -> None:
    """Subscribe to the newest of the images on a topic."""
    skips = handlers.skips

    async def on_image(message: Any) -> None:
        if skips.allows(LATE):
            message, late = ros.take_newest(images.current, message)
            skips.count(LATE, late)
        await take(message)

    images = ros.LargeSubscription(qos, ros.Image, topic, on_image, callback_group=handlers.camera_group)


def detections_type() -> type:
    """Return vision_msgs/Detection3DArray; raises MissingDependencyError where vision_msgs is not installed."""
    try:
        return import_module("vision_msgs.msg").Detection3DArray
    except ImportError as error:
        hint = "source ROS 2 and apt install ros-jazzy-vision-msgs, or have poses sent as PoseStamped"
        raise MissingDependencyError(f"pose_source detections needs vision_msgs: {hint} ({error})") from error
