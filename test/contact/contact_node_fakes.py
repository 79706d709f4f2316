"""A contact estimator node on a probe's domain, and the messages that it is fed."""

from pathlib import Path
from time import time_ns

import numpy as np
from geometry_msgs.msg import PoseStamped
from rclpy.parameter import Parameter
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import Header
from std_srvs.srv import Trigger

import finforce_eval
from finforce.ros import node as ros
from finforce.transforms import quaternion_from_pose
from finforce_contact.node import ContactEstimatorNode

MESH = str(Path(finforce_eval.__file__).parent / "data" / "objects" / "cylinder_25.stl")
RADIUS = 0.0125
CAMERA = "camera_color_optical_frame"
SECOND = 1_000_000_000
# the camera looks along the jaw's -y, its x along the jaw's x, from 0.2 m
T_CAMERA_JAW = np.array([[1.0, 0, 0, -0.03], [0, 0, -1.0, 0.04], [0, 1.0, 0, 0.2], [0, 0, 0, 1.0]])


def cylinder_before_jaw(gap=0.001, height=0.04):
    """T_jaw_object of a cylinder along y with a gap [m] to the inner surface at a height [m]."""
    T = np.eye(4)
    T[:3, 3] = 0.014 + RADIUS + gap, 0.0, height
    return T


def start_contact_estimator(probe, **parameters):
    """Add a contact estimator to the probe's executor; of the shipped cylinder unless told otherwise."""
    # a loaded machine is late: neither is an image old then, nor a node silent
    given = {"object_mesh": MESH, "diagnostics_period": 0.1, "max_age": 3.0, "camera_frame": CAMERA, **parameters}
    overrides = [Parameter(name, value=value) for name, value in given.items()]
    node = ContactEstimatorNode(context=probe.context, parameter_overrides=overrides)
    probe.spinner.add_node(node)
    return node


def header(stamp, frame):
    return Header(stamp=ros.stamp_message(stamp), frame_id=frame)


def pose(stamp, T, frame=CAMERA):
    return ros.pose_message(header(stamp, frame), [*T[:3, 3], *quaternion_from_pose(T)])


class ContactBench:
    """Speaks to a contact estimator of one jaw and hears its contacts and outlines."""

    def __init__(self, probe, side="left", **parameters):
        self.probe, self.side = probe, side
        self.node = start_contact_estimator(probe, **{"jaws": side, **parameters})
        for topic in (f"{side}/contact", f"{side}/object_outline"):
            probe.hear(topic, PointCloud2)
        self.jaw_out = probe.speak(f"{side}/jaw_pose", PoseStamped)
        self.object_out = probe.speak("object_pose", PoseStamped)
        probe.connected(self.jaw_out)
        probe.connected(self.object_out, 1 if self.node.parameters.pose_source == "topic" else 0)
        probe.wait_for(lambda: self.node.out.contact[side].get_subscription_count() == 1)
        probe.wait_for(lambda: self.node.out.outline[side].get_subscription_count() == 1)

    @property
    def contacts(self):
        return self.probe.got[f"{self.side}/contact"]

    @property
    def outlines(self):
        return self.probe.got[f"{self.side}/object_outline"]

    def image(self, T_jaw_object, stamp=None):
        """Send the poses of one image and return its stamp."""
        stamp = time_ns() if stamp is None else stamp
        self.object_out.publish(pose(stamp, T_CAMERA_JAW @ T_jaw_object))
        self.probe.spin(0.02)
        self.jaw_out.publish(pose(stamp, T_CAMERA_JAW))
        return stamp

    def wait_for_contacts(self, count=1):
        self.probe.wait_for(lambda: len(self.contacts) >= count)
        return self.contacts[-1]

    def diagnosis(self, level=None, word=""):
        return diagnosis(self.probe, f"{self.side} contact", level, word)


def diagnosis(probe, name, level=None, word=""):
    """Wait for a status of this name at a level, with a word in its message."""
    found = []

    def matches():
        states = [s for array in probe.got["/diagnostics"] for s in array.status if name in s.name]
        found[:] = [s for s in states if (level is None or s.level[0] == level) and word in s.message]
        return bool(found)

    probe.wait_for(matches)
    return found[-1]


def call(probe, name):
    client = probe.create_client(Trigger, name)
    probe.wait_for(client.service_is_ready)
    future = client.call_async(Trigger.Request())
    probe.wait_for(future.done, 60.0)
    return future.result()
