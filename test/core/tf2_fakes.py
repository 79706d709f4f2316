"""A tf2_ros that remembers, for nodes that look frames up."""

import sys
from types import ModuleType, SimpleNamespace

from geometry_msgs.msg import TransformStamped
from rclpy.time import Time
from std_msgs.msg import Header

from finforce.transforms import pose_numbers


class TransformError(Exception):
    pass


def install(monkeypatch):
    """Return transforms by target and source that a tf2_ros gives away, all of one "stamp" [ns].

    What is sent to it is kept under "sent".
    """
    known, tf2 = {"sent": [], "stamp": 0}, ModuleType("tf2_ros")

    class Buffer:
        def lookup_transform(self, target, source, time):
            if (target, source) not in known:
                raise TransformError(f"{target} and {source} are not connected")
            found = TransformStamped(header=Header(stamp=Time(nanoseconds=known["stamp"]).to_msg()))
            place, turn = found.transform.translation, found.transform.rotation
            place.x, place.y, place.z, turn.x, turn.y, turn.z, turn.w = pose_numbers(known[target, source])
            return found

    tf2.Buffer, tf2.TransformException = Buffer, TransformError
    tf2.TransformListener = lambda buffer, node: None
    tf2.TransformBroadcaster = lambda node: SimpleNamespace(sendTransform=known["sent"].append)
    monkeypatch.setitem(sys.modules, "tf2_ros", tf2)
    return known
