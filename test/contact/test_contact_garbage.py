"""Claims about the nodes after garbage on every topic: they live, say what was wrong, and good data serve again."""

from time import time_ns

import numpy as np
import pytest
from contact_node_fakes import SECOND, T_CAMERA_JAW, ContactBench, cylinder_before_jaw, header, pose
from geometry_msgs.msg import PoseStamped
from sensor_msgs.msg import PointCloud2, PointField

from finforce.health import Level
from finforce.ros import node as ros
from finforce_ifea.jaw.jaw import load_jaw

NAN, INF, HOUR = float("nan"), float("inf"), 3600 * SECOND
VERTICES = load_jaw("bench").build_mesh("default").nodes


def surface(vertices, stamp=None, frame="left_jaw"):
    stamp = time_ns() if stamp is None else stamp
    return ros.cloud_message(header(stamp, frame), ros.xyz_columns(vertices))


def truncated():
    cloud = surface(VERTICES)
    cloud.data = cloud.data[:100]
    return cloud


def without_fields():
    cloud = surface(VERTICES)
    cloud.fields = [PointField(name="intensity", offset=0, datatype=7, count=1)]
    return cloud


def posed(field, value, stamp=None):
    message = pose(time_ns() if stamp is None else stamp, T_CAMERA_JAW @ cylinder_before_jaw())
    part, name = field.split(".")
    setattr(getattr(message.pose, part), name, value)
    return message


BAD_POSES = {
    "nan": lambda: posed("position.x", NAN),
    "inf": lambda: posed("position.z", INF),
    "norm": lambda: posed("orientation.w", 3.0),
    "nan turn": lambda: posed("orientation.y", NAN),
    "empty": PoseStamped,
    "other frame": lambda: pose(time_ns(), np.eye(4), "base_link"),
    "an hour ahead": lambda: pose(time_ns() + HOUR, T_CAMERA_JAW @ cylinder_before_jaw()),
    "an hour ago": lambda: pose(time_ns() - HOUR, T_CAMERA_JAW @ cylinder_before_jaw()),
}
BAD_SURFACES = {
    "short": lambda: surface(VERTICES[:-1]),
    "none": lambda: surface(np.zeros((0, 3))),
    "nan": lambda: surface(VERTICES * NAN),
    "millimetres": lambda: surface(1e3 * VERTICES),
    "other frame": lambda: surface(VERTICES, frame="right_jaw"),
    "truncated": truncated,
    "without fields": without_fields,
    "empty": PointCloud2,
    "an hour ahead": lambda: surface(VERTICES, time_ns() + HOUR),
    "an hour ago": lambda: surface(VERTICES, time_ns() - HOUR),
}


def test_garbage_on_every_topic_is_survived_and_good_data_serve_again(probe):
    bench = ContactBench(probe, **{"contact.mode": "paper"})
    surfaces = probe.speak("left/surface", PointCloud2)
    probe.connected(surfaces)
    bench.image(cylinder_before_jaw())
    bench.wait_for_contacts()
    outs = (
        (bench.object_out, BAD_POSES),
        (bench.jaw_out, BAD_POSES),
        (surfaces, BAD_SURFACES),
    )
    refused = 0
    for out, makers in outs:
        for name, make in makers.items():
            out.publish(make())
            probe.spin(0.02)
            refused += 1
            assert all(cloud.width < 2 for cloud in bench.contacts), name
    bench.diagnosis(level=Level.ERROR)
    known = len(bench.contacts)
    probe.spin(0.25)  # longer than the greatest age of a surface
    bench.image(cylinder_before_jaw())
    cloud = bench.wait_for_contacts(known + 1)
    assert cloud.width == 1
    counts = bench.node.health["left"]._refused
    # a surface of long ago and one without rows say nothing wrong
    assert sum(counts.values()) >= refused - 2, counts


@pytest.mark.parametrize("which", ["object", "surface"])
def test_a_stamp_ahead_of_the_clock_keeps_no_later_one_out(probe, which):
    bench = ContactBench(probe, **{"contact.mode": "paper"})
    bench.image(cylinder_before_jaw())
    bench.wait_for_contacts()
    if which == "object":
        bench.object_out.publish(BAD_POSES["an hour ahead"]())
    else:
        out = probe.speak("left/surface", PointCloud2)
        probe.connected(out)
        out.publish(BAD_SURFACES["an hour ahead"]())
    bench.diagnosis(level=Level.ERROR, word="ahead of the node's clock")
    bench.image(cylinder_before_jaw())
    assert bench.wait_for_contacts(2).width > 0
    latest = bench.node.session.pose
    assert abs(latest.stamp - 1e-9 * time_ns()) < 60.0
