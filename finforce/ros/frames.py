"""Frames of /tf, by tf2_ros, which every robot has and wheels have not."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from geometry_msgs.msg import TransformStamped
from numpy.typing import NDArray
from rclpy.time import Time

from finforce.messages import pose_from_transform, stamp_of
from finforce.transforms import pose_numbers

if TYPE_CHECKING:
    from rclpy.node import Node


class Frames:
    """Finds and sends transforms; without tf2_ros there are none.

    Args:
        node: that listens and sends.
    """

    def __init__(self, node: Node) -> None:
        self._node, self._buffer, self._broadcaster = node, None, None
        try:
            self._tf2: Any = import_module("tf2_ros")
        except ImportError:
            self._tf2 = None

    def listen(self) -> bool:
        """Begin to listen to /tf; return whether that is possible."""
        if self._tf2 is not None:
            self._buffer = self._tf2.Buffer()
            self._listener = self._tf2.TransformListener(self._buffer, self._node)
        return self._tf2 is not None

    def find(self, target: str, source: str) -> NDArray | None:
        """Return the newest T_target_source (4, 4); None where /tf does not connect them.

        Raises:
            PoseError: The transform of /tf is no pose.
        """
        found = self.find_stamped(target, source)
        return None if found is None else found[0]

    def find_stamped(self, target: str, source: str) -> tuple[NDArray, int] | None:
        """Return the same with its stamp [ns], 0 for frames that never move; see `find`."""
        if self._buffer is None:
            return None
        try:
            found = self._buffer.lookup_transform(target, source, Time())
        except self._tf2.TransformException:
            return None
        return pose_from_transform(found.transform), stamp_of(found)

    def send(self, header: Any, child: str, T: NDArray) -> None:
        """Send the pose (4, 4) of a frame in that of a header."""
        if self._tf2 is None:
            return
        self._broadcaster = self._broadcaster or self._tf2.TransformBroadcaster(self._node)
        message = TransformStamped(header=header, child_frame_id=child)
        place, turn = message.transform.translation, message.transform.rotation
        place.x, place.y, place.z, turn.x, turn.y, turn.z, turn.w = pose_numbers(T)
        self._broadcaster.sendTransform(message)
