"""Claims about messages that are none: each costs itself, the node goes on, and its memory stays what it was."""

import os
import random
import struct
from array import array
from contextlib import suppress
from functools import partial
from pathlib import Path

import pytest
from contact_node_fakes import ContactBench, cylinder_before_jaw, start_contact_estimator
from geometry_msgs.msg import PoseStamped, WrenchStamped
from keypoint_node_fakes import start_detector
from node_fakes import keypoint_cloud, start_solver
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.serialization import deserialize_message, serialize_message
from sensor_msgs.msg import CameraInfo, Image, PointCloud2
from std_msgs.msg import Header

from finforce.health import UNHEARD, Level
from finforce.ros.topics import STEADY

CAMERA = "/camera/camera"
TOPICS = {
    "/left/keypoints": PointCloud2,
    "/left/contact": PointCloud2,
    "/left/object_outline": PointCloud2,
    "/right/wrench": WrenchStamped,
    "/left/jaw_pose": PoseStamped,
    "/object_pose": PoseStamped,
    f"{CAMERA}/color/image_raw": Image,
    f"{CAMERA}/aligned_depth_to_color/image_raw": Image,
    f"{CAMERA}/color/camera_info": CameraInfo,
}
START = {"contact_height": float("nan")}  # contacts come by topic


def mutate(good, number, rng):
    """Bytes that were a message: cut off, changed, lengths of two thousand millions, anything, nothing."""
    data = bytearray(good)
    kind = number % 5
    if kind == 0:
        return bytes(data[: rng.randrange(len(data))])
    if kind == 1:
        for _ in range(6):
            data[rng.randrange(len(data))] = rng.randrange(256)
        return bytes(data)
    if kind == 2:
        place = rng.randrange(4, len(data) - 4) // 4 * 4
        struct.pack_into("<I", data, place, rng.choice((0x7FFFFFFF, 0xFFFFFFFF, 1 << 20)))
        return bytes(data)
    return rng.randbytes(rng.randrange(60)) if kind == 3 else b""


def good_bytes(kind):
    if kind is PointCloud2:
        return bytes(serialize_message(keypoint_cloud()))
    if kind is Image:
        return bytes(serialize_message(Image(height=4, width=4, encoding="rgb8", step=12, data=bytes(48))))
    return bytes(serialize_message(kind()))


@pytest.mark.parametrize("topic", TOPICS)
def test_bytes_that_are_no_message_cost_themselves(probe, topic):
    start_solver(probe, peer="right", **START)
    start_contact_estimator(probe)
    start_detector(probe, skip_off=[UNHEARD])
    kind, rng = TOPICS[topic], random.Random(topic)
    publisher = probe.create_publisher(kind, topic, QoSProfile(depth=20, reliability=ReliabilityPolicy.RELIABLE))
    probe.connected(publisher)
    good = good_bytes(kind)
    for number in range(200):
        publisher.publish(mutate(good, number, rng))
        probe.spin(0.001)
    probe.spin(0.2)
    before = len(probe.got["/diagnostics"])
    probe.wait_for(lambda: len(probe.got["/diagnostics"]) >= before + 3)  # all nodes still speak


def test_images_that_announce_more_than_they_hold_are_refused(probe):
    node, refused = start_detector(probe), []
    node.reject = lambda outcome, *sides: refused.append(outcome.text)
    probe.hear("/left/keypoints", PointCloud2)
    probe.wait_for(lambda: node.stage.is_needed)
    seen = Header(frame_id="camera_color_optical_frame")
    info = CameraInfo(header=seen, width=20_000, height=20_000, k=[9e9, 0.0, 1e4, 0.0, 9e9, 1e4, 0.0, 0.0, 1.0])
    node._on_info(info)
    assert len(refused) == 1 and "20000x20000" in refused[0]
    k = [430.0, 0.0, 320.0, 0.0, 430.0, 240.0, 0.0, 0.0, 1.0]
    sane = CameraInfo(header=seen, width=640, height=480, k=k)
    node._on_info(sane)
    huge = Image(header=seen, height=20_000, width=20_000, encoding="rgb8", step=60_000, data=bytes(12))
    with_step = Image(header=seen, height=2**31, width=2**31, encoding="16UC1", step=2**32 - 1, data=bytes(12))
    for message in (huge, with_step):
        node._on_color(f"{CAMERA}/color/image_raw", message)
        node._on_depth("depth", message)
    assert len(refused) >= 3, refused
    assert all("20000" in text or "4294967295" in text or "bytes" in text or "encoding" in text for text in refused), (
        refused
    )


def test_a_mesh_that_is_a_pipe_is_not_waited_for(probe, tmp_path):
    pipe = tmp_path / "object.stl"
    os.mkfifo(pipe)
    bench = ContactBench(probe, object_mesh=str(pipe))
    bench.image(cylinder_before_jaw())
    bench.diagnosis(level=Level.ERROR, word="there is no such file")


def feed(callback, data, kind):
    """Call back with the message in bytes, where there is one."""
    with suppress(Exception):  # of the middleware, which has its own classes
        message = deserialize_message(data, kind)
        callback(message)


def memory():
    """Resident memory of this process [bytes]."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * 4096


def test_memory_of_giant_images_is_released(probe):
    start_detector(probe, skip_off=[UNHEARD])
    publisher = probe.create_publisher(Image, f"{CAMERA}/color/image_raw", STEADY)
    probe.connected(publisher)
    before = memory()
    for _ in range(4):
        publisher.publish(
            Image(height=4000, width=4000, encoding="rgb8", step=12_000, data=array("B", bytes(48_000_000)))
        )
        probe.spin(0.3)
    probe.wait_for(lambda: memory() - before < 40e6)


@pytest.mark.parametrize("sides", ["left"])
def test_memory_after_many_bad_messages_is_what_it_was(probe, sides):
    solver, contact, detector = start_solver(probe, **START), start_contact_estimator(probe), start_detector(probe)
    rng, good = random.Random(1), good_bytes(PointCloud2)
    pose, image = good_bytes(PoseStamped), good_bytes(Image)

    def send(count):
        for number in range(count):
            feed(solver._on_keypoints, mutate(good, number, rng), PointCloud2)
            feed(partial(contact._on_jaw_pose, sides), mutate(pose, number, rng), PoseStamped)
            feed(partial(detector._on_color, f"{CAMERA}/color/image_raw"), mutate(image, number, rng), Image)
            feed(detector._on_depth, mutate(image, number, rng), Image)

    send(1000)
    before = memory()
    send(2000)
    assert memory() - before < 5e5
