"""Claims about what a key point detector node leaves out, and that it says so."""

from dataclasses import replace
from time import time_ns

import numpy as np
import pytest
from keypoint_node_fakes import JAW, MILLISECOND, CameraBench, FakeKeypoints, camera_info, start_detector
from sensor_msgs.msg import CameraInfo, Image, PointCloud2

from finforce.health import IDLE, STILL, UNHEARD, Level
from finforce.messages import stamp_of

PERIOD = 100 * MILLISECOND  # of the answers while nothing moves


def counted(bench, rule):
    """How often a rule has saved its work."""
    return bench.node.skips.describe()[f"skipped: {rule}"]


def next_period():
    """The stamp of an image that begins a period, within reach of the clock."""
    return time_ns() // PERIOD * PERIOD


def test_without_a_listener_images_are_not_even_taken_and_with_the_first_they_are(probe):
    bench = CameraBench(probe, heard=False, skip_off=[UNHEARD])
    watched = {sub.topic_name for sub in bench.node.subscriptions if sub.msg_type is Image}
    assert len(watched) == 3
    probe.spinner.remove_node(bench.node)
    bench.node.destroy_node()
    node = start_detector(probe)

    def taken():
        return {sub.topic_name for sub in node.subscriptions if sub.msg_type is Image}

    assert not taken()
    bench.node = node
    probe.got["/diagnostics"].clear()
    bench.diagnosis(level=Level.OK, word="idle: no subscriber")
    listener = probe.hear("left/keypoints", PointCloud2)
    probe.wait_for(lambda: taken() == watched)
    probe.connected(bench.color_out)
    probe.connected(bench.depth_out)
    bench.send_info()
    bench.shoot()
    probe.wait_for(lambda: bench.clouds())
    probe.destroy_subscription(listener)
    probe.wait_for(lambda: not taken())


def test_the_camera_is_heard_until_it_is_known_and_then_while_somebody_listens(probe):
    node = start_detector(probe)
    out = probe.speak(node.parameters.info_topic, CameraInfo)

    def infos():
        return [sub for sub in node.subscriptions if sub.msg_type is CameraInfo]

    probe.connected(out)
    probe.spin(0.5)
    assert infos()
    out.publish(camera_info())
    probe.wait_for(lambda: node.feed.stream.camera and not infos())
    probe.hear("left/keypoints", PointCloud2)
    probe.wait_for(infos)


def test_a_node_that_is_told_to_looks_at_images_that_nobody_asks_for(probe):
    bench = CameraBench(probe, heard=False, skip_off=[UNHEARD])
    bench.shoot()
    probe.wait_for(lambda: bench.node.detector.images)
    assert counted(bench, UNHEARD) == "off"


def test_an_image_in_which_nothing_moved_is_answered_with_its_own_stamp_and_counted(probe):
    bench = CameraBench(probe, max_age=2.0)
    bench.node.detector.was_still = True
    stamps = [next_period() + number * PERIOD for number in (-1, 0)]
    for stamp in stamps:
        bench.shoot(stamp)
    bench.wait_for_clouds(2)
    bench.wait_for_clouds(2, "right")
    assert [stamp_of(cloud) for cloud in bench.clouds()] == stamps
    assert [stamp_of(pose) for pose in bench.poses("right")] == stamps
    first, second = (np.frombuffer(cloud.data, dtype=np.uint8) for cloud in bench.clouds())
    assert np.array_equal(first, second) and counted(bench, STILL) == "2"


def test_other_key_points_are_sent_at_once(probe):
    bench = CameraBench(probe, max_age=2.0, skip_off=[IDLE])
    bench.node.detector.was_still = True
    bench.shoot(next_period())
    bench.wait_for_clouds()
    bench.node.detector.answer["left"] = replace(FakeKeypoints(), points=JAW.keypoints + 1e-3)
    bench.shoot(next_period() + 1)
    bench.wait_for_clouds(2)
    first, second = (np.frombuffer(cloud.data, dtype=np.uint8) for cloud in bench.clouds())
    assert not np.array_equal(first, second)


@pytest.mark.parametrize(("off", "answered"), [([""], 1), ([IDLE], 3)])
def test_while_nothing_moves_one_image_of_a_period_is_answered_unless_told(probe, off, answered):
    bench = CameraBench(probe, max_age=2.0, skip_off=off)
    bench.node.detector.was_still = True
    begin = next_period() - PERIOD
    for number in range(3):
        bench.shoot(begin + number * 33 * MILLISECOND)
    bench.shoot(begin + PERIOD)
    bench.wait_for_clouds(answered + 1)
    assert len(bench.clouds()) == answered + 1


def test_the_image_that_shows_a_motion_is_answered_at_once(probe):
    bench = CameraBench(probe, max_age=2.0)
    bench.node.detector.was_still = True
    begin = next_period() - 2 * PERIOD
    for number in range(3):
        bench.shoot(begin + number)
    assert len(bench.clouds()) == 1
    bench.node.detector.was_still = False
    bench.shoot(begin + 3)
    probe.wait_for(lambda: stamp_of(bench.clouds()[-1]) == begin + 3)


def test_of_images_that_came_together_the_newest_is_answered(probe):
    bench = CameraBench(probe, max_age=5.0)
    stamps = [time_ns() + number * MILLISECOND for number in range(4)]
    bench.burst(stamps)
    bench.wait_for_clouds()
    probe.spin(0.3)
    assert [stamp_of(cloud) for cloud in bench.clouds()] == stamps[-1:]
