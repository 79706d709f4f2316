"""Claims about cameras as users of comparable packages complain of them, by the public thread that tells of it."""

import re

import numpy as np
import pytest
from keypoint_node_fakes import COLOR, HEIGHT, WIDTH, camera_info, image_of

from finforce.camera import ImageError
from finforce.errors import ObservationError
from finforce.health import StampError, StampGate
from finforce_keypoints.errors import SyncError
from finforce_keypoints.images import COLOR as COLORS
from finforce_keypoints.images import RgbdFeed, check_image
from finforce_keypoints.parameters import DetectorParameters

PERIOD = 33_333_333  # ns


def feed_of(**parameters):
    feed = RgbdFeed(DetectorParameters(**parameters))
    feed.stream.take_info(camera_info())
    return feed


def color(number, **options):
    noise = np.random.default_rng(int(10 * number)).integers(90, 160, (HEIGHT, WIDTH, 3), dtype=np.uint8)
    return image_of(round(number * PERIOD), noise, "rgb8", **options)


def test_the_camera_info_of_the_depth_camera_beside_aligned_depth_is_named():
    """xArm-Developer/xarm_ros2 159."""
    feed, info = RgbdFeed(DetectorParameters()), camera_info()
    info.header.frame_id = "camera_depth_optical_frame"
    feed.stream.take_info(info)
    with pytest.raises(ObservationError, match="camera_color_optical_frame.*camera_depth_optical_frame"):
        feed.take_color(COLOR, color(1))
    feed = feed_of(depth="none")
    feed.stream.take_info(camera_info(WIDTH + 16, HEIGHT))
    (image,) = feed.take_color(COLOR, color(1))
    with pytest.raises(ImageError, match="camera_info"):
        check_image(image.value)


def test_without_an_aligned_topic_colour_alone_is_used_or_the_driver_option_is_named():
    """realsense-ros 3277."""
    feed = feed_of()
    whole = [image for number in range(1, 12) for image in feed.take_color(COLOR, color(number))]
    assert [round(image.stamp / PERIOD) for image in whole] == list(range(4, 12))
    feed = feed_of(depth="aligned")
    with pytest.raises(SyncError, match="align_depth.enable:=true"):
        for number in range(1, 12):
            feed.take_color(COLOR, color(number))


@pytest.mark.parametrize(
    ("times", "words"),
    [
        (range(16), "33.3 ms apart$"),
        ((0, 1, 2, 4, 5, 7, 8, 9, 10, 12, 13), "apart$"),  # some are lost
        ((0, 0.1, 0.2, 3, 3.1, 3.2, 6, 6.1, 6.2, 9, 9.1), "7 of 10 within 9.1 ms .* stamped on arrival"),
    ],
)
def test_late_images_under_fresh_stamps_are_told_by_their_bursts(times, words):
    """realsense-ros 1581."""
    feed = feed_of(depth="none")
    for number in times:
        feed.take_color(COLOR, color(1 + number))
    assert re.search(words, feed.arrivals[COLORS].rhythm)


def test_depth_that_is_zero_everywhere_counts_as_none():
    """librealsense 3070."""
    feed, had = feed_of(), []
    for number in range(1, 6):
        had += feed.take_depth(image_of(number * PERIOD, np.zeros((HEIGHT, WIDTH), np.uint16), "16UC1"))
        had += feed.take_color(COLOR, color(number))
    assert len(had) == 5 and all(image.value.depth is None for image in had)


def test_depth_of_another_size_is_named():
    """realsense-ros 3496: image_rect_raw of a D405 has the size of the depth stream."""
    feed = feed_of()
    feed.take_depth(image_of(PERIOD, np.full((HEIGHT, 2 * WIDTH), 120, np.uint16), "16UC1"))
    (image,) = feed.take_color(COLOR, color(1))
    with pytest.raises(ImageError, match="aligned to colour"):
        check_image(image.value)


def test_stamps_from_the_future_and_a_clock_that_has_not_begun_are_told_apart():
    """librealsense 13122 and rosbag2 1256."""
    gate = StampGate(max_age=0.2)
    with pytest.raises(StampError, match="clocks synchronised"):
        gate.enter(12 * 10**9, 10 * 10**9)
    with pytest.raises(StampError, match="without /clock"):
        gate.enter(12 * 10**9, 0)


def test_a_bag_that_is_played_again_begins_a_new_recording():
    """rtabmap_ros 1290."""
    gate = StampGate(max_age=0.2)
    assert not gate.enter(12 * 10**9, 12 * 10**9)
    assert gate.enter(10 * 10**9, 10 * 10**9)


def test_two_cameras_with_the_same_topics_do_not_mix():
    """realsense-ros 2001 and 3331: the second one's frame differs, or its images are another topic's."""
    feed = feed_of(depth="none")
    assert feed.take_color(COLOR, color(1))
    with pytest.raises(ObservationError, match="camera2_color_optical_frame"):
        feed.take_color(COLOR, color(2, frame="camera2_color_optical_frame"))
