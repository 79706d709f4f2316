"""Claims about images that must not become key points: nothing leaves, the diagnostics say why, and life goes on."""

from time import time_ns

import numpy as np
import pytest
from keypoint_node_fakes import FRAME, HEIGHT, MILLISECOND, OLD_COLOR, TOPICS, WIDTH, CameraBench, camera_info
from sensor_msgs.msg import Image

import finforce_keypoints.images as images
from finforce.camera import EQUIDISTANT
from finforce.health import Level
from finforce.messages import camera_from_info, same_camera
from finforce_keypoints.images import FROZEN_AFTER

PERIOD = 33 * MILLISECOND


def recovers(bench):
    """Whole images of the right kind are used again."""
    bench.shoot()
    bench.wait_for_clouds()


def test_colour_without_any_depth_is_refused(probe):
    bench = CameraBench(probe, depth="aligned")
    first = time_ns()
    for k in range(8):
        bench.color(first + k * PERIOD)
    bench.refused(f"no depth image on {TOPICS.depth_topic}", Level.ERROR)
    recovers(bench)


def test_depth_that_never_has_the_stamp_of_a_colour_image_is_refused(probe):
    bench = CameraBench(probe, depth="aligned", sync_tolerance=0.008)
    first = time_ns()
    for k in range(8):
        bench.depth(first + k * PERIOD - 12 * MILLISECOND)
        bench.color(first + k * PERIOD)
    bench.refused("12.0 ms away", Level.ERROR)
    recovers(bench)


def test_depth_that_comes_too_late_is_refused(probe):
    bench = CameraBench(probe, max_age=0.1)
    stamp = time_ns()
    bench.color(stamp)
    probe.spin(0.15)
    bench.depth(stamp)
    bench.refused("s old", Level.STALE)
    recovers(bench)


def test_key_points_that_took_too_long_to_find_are_not_published(probe):
    bench = CameraBench(probe, max_age=0.1)
    bench.node.detector.delay = 0.15
    bench.shoot()
    bench.refused("s old", Level.STALE)
    bench.node.detector.delay = 0.0
    recovers(bench)


def test_without_camera_info_there_are_no_key_points(probe):
    bench = CameraBench(probe, info=False)
    bench.shoot()
    bench.refused(f"no camera_info on {TOPICS.info_topic}", Level.ERROR)
    bench.send_info()
    recovers(bench)


def test_camera_info_of_another_size_is_refused(probe):
    bench = CameraBench(probe, info=False)
    bench.send_info(width=2 * WIDTH, height=2 * HEIGHT)
    bench.shoot()
    bench.refused("camera_info", Level.ERROR)
    bench.send_info()
    recovers(bench)


@pytest.mark.parametrize(
    ("changes", "word"),
    [
        ({"distortion_model": "mirror ball"}, "mirror ball"),
        ({"k": [0.0] * 9}, "focal"),
        ({"k": [1e300, 0.0, 32.0, 0.0, 1e300, 24.0, 0.0, 0.0, 1.0]}, "focal lengths in proportion"),
        ({"k": [60.0, 2.0, 32.0, 0.0, 60.0, 24.0, 0.0, 0.0, 1.0]}, "skew"),
    ],
)
def test_camera_info_that_no_camera_has_is_refused(probe, changes, word):
    bench = CameraBench(probe, info=False)
    message = camera_info()
    for name, value in changes.items():
        setattr(message, name, value)
    bench.info_out.publish(message)
    probe.spin(0.05)
    bench.shoot()
    bench.refused(word, Level.ERROR)
    bench.send_info()
    recovers(bench)


@pytest.mark.parametrize("kind", ["Inverse Brown Conrady", "Brown Conrady", "None"])
def test_a_lens_of_librealsense_is_that_of_its_driver(kind):
    expected = camera_from_info(camera_info(), FRAME)
    assert same_camera(camera_from_info(camera_info(distortion_model=kind), FRAME), expected)
    assert camera_from_info(camera_info(distortion_model="Kannala Brandt4", d=[0.1] * 4), FRAME).model == EQUIDISTANT


def test_depth_of_another_size_is_refused(probe):
    bench = CameraBench(probe)
    bench.shoot(depth=np.full((HEIGHT // 2, WIDTH), 120, dtype=np.uint16))
    bench.refused("aligned to colour", Level.ERROR)
    recovers(bench)


def test_a_depth_image_without_any_depth_is_refused(probe):
    bench = CameraBench(probe, depth="aligned")
    bench.shoot(depth=np.zeros((HEIGHT, WIDTH), dtype=np.uint16))
    bench.refused("the depth image is empty", Level.ERROR)
    recovers(bench)


@pytest.mark.parametrize(
    ("stream", "shape", "kind", "encoding"),
    [
        ("color", (HEIGHT, WIDTH, 2), np.uint8, "nv24"),
        ("color", (HEIGHT, WIDTH), np.uint8, "bayer_rggb16"),
        ("depth", (HEIGHT, WIDTH), np.uint16, "8UC2"),
        ("depth", (HEIGHT, WIDTH), np.float64, "64FC1"),
    ],
)
def test_an_unknown_encoding_is_named(probe, stream, shape, kind, encoding):
    bench = CameraBench(probe)
    stamp = time_ns()
    for name in ("color", "depth"):
        given = {"picture": np.full(shape, 120, dtype=kind), "encoding": encoding} if name == stream else {}
        getattr(bench, name)(stamp, **given)
    bench.refused(encoding, Level.ERROR)
    recovers(bench)


@pytest.mark.parametrize("stream", ["color", "depth"])
def test_an_image_in_another_frame_is_refused(probe, stream):
    bench = CameraBench(probe)
    stamp = time_ns()
    for name in ("color", "depth"):
        getattr(bench, name)(stamp, **({"frame": "camera_depth_optical_frame"} if name == stream else {}))
    bench.refused("camera_depth_optical_frame", Level.ERROR)
    recovers(bench)


def test_an_image_whose_bytes_are_cut_short_is_refused(probe):
    bench = CameraBench(probe)
    stamp = time_ns()
    bench.depth(stamp)
    bench.color(stamp, np.full((HEIGHT, WIDTH), 120, dtype=np.uint8))  # a third of rgb8
    bench.refused("bytes", Level.ERROR)
    recovers(bench)


def test_a_black_frame_is_refused(probe):
    bench = CameraBench(probe)
    bench.shoot(color=np.zeros((HEIGHT, WIDTH, 3), dtype=np.uint8))
    bench.refused("black image", Level.ERROR)
    recovers(bench)


def test_a_frozen_camera_is_noticed_and_silent(probe):
    bench = CameraBench(probe)
    still = bench.picture()
    for _ in range(5):
        bench.shoot(color=still)
    bench.diagnosis(level=Level.ERROR, word="frozen camera")
    assert len(bench.clouds()) == FROZEN_AFTER
    bench.shoot()
    bench.wait_for_clouds(FROZEN_AFTER + 1)


def test_a_stamp_that_stands_still_is_refused(probe):
    bench = CameraBench(probe)
    stamp = bench.shoot()
    bench.wait_for_clouds()
    bench.shoot(stamp)
    bench.diagnosis(level=Level.ERROR, word="stand still")
    assert len(bench.clouds()) == 1


@pytest.mark.parametrize(("away", "word"), [(-5_000, "s old"), (5_000, "ahead")])
def test_a_stamp_far_from_now_is_refused_and_spoils_nothing(probe, away, word):
    bench = CameraBench(probe)
    bench.shoot(time_ns() + away * MILLISECOND)
    bench.diagnosis(word=word)
    assert not bench.clouds()
    recovers(bench)


def test_a_camera_that_falls_silent_is_noticed(probe):
    bench = CameraBench(probe, max_age=0.5)
    recovers(bench)
    bench.diagnosis(level=Level.STALE, word="nothing has arrived")
    assert len(bench.clouds()) == 1


def test_a_camera_that_never_speaks_is_named(probe):
    bench = CameraBench(probe)
    bench.diagnosis(level=Level.STALE, word=TOPICS.color_topics[0])


def speaks_on_another_topic(probe):
    """A camera that was heard, and has the other name from now on."""
    bench = CameraBench(probe, max_age=0.5)
    recovers(bench)
    bench.color_out = probe.speak(OLD_COLOR, Image)
    probe.connected(bench.color_out)
    return bench


def test_a_camera_that_restarts_under_the_other_name_is_heard_and_named(probe, monkeypatch):
    monkeypatch.setattr(images, "SILENCE", 0.0)
    bench = speaks_on_another_topic(probe)
    bench.shoot()
    bench.wait_for_clouds(2)
    state = bench.diagnosis(level=Level.STALE, word=f"nothing has arrived on {OLD_COLOR}")
    assert {entry.key: entry.value for entry in state.values}["colour images"] == OLD_COLOR


def test_images_of_the_topic_that_is_not_listened_to_hide_no_silence(probe, monkeypatch):
    monkeypatch.setattr(images, "SILENCE", 1e9)
    bench = speaks_on_another_topic(probe)
    probe.got["/diagnostics"].clear()
    for _ in range(35):  # more than max_age
        bench.color(time_ns())
    bench.diagnosis(level=Level.STALE, word=f"nothing has arrived on {TOPICS.color_topics[0]}")
    assert len(bench.clouds()) == 1
