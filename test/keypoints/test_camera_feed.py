"""Claims about which of several colour topics is the camera's; no ROS runs."""

from dataclasses import dataclass, field

import numpy as np
import pytest
from keypoint_node_fakes import COLOR, HEIGHT, OLD_COLOR, WIDTH, camera_info, image_of

from finforce_keypoints.camera_feed import SILENCE, RgbdFeed
from finforce_keypoints.errors import FrozenImageError
from finforce_keypoints.parameters import DetectorParameters

PERIOD = 0.03  # s


@dataclass
class Camera:
    """Feeds images of one topic at a time, on a clock of its own."""

    now: float = 0.0
    rng: np.random.Generator = field(default_factory=lambda: np.random.default_rng(0))

    def __post_init__(self):
        self.feed = RgbdFeed(DetectorParameters(), lambda: self.now)
        self.feed.take_info(camera_info())

    def shoot(self, topic, picture=None):
        """Whether an image of a topic became a whole one."""
        self.now += PERIOD
        stamp = round(1e9 * self.now)
        if picture is None:
            picture = self.rng.integers(90, 160, (HEIGHT, WIDTH, 3), dtype=np.uint8)
        self.feed.take_depth(image_of(stamp, np.full((HEIGHT, WIDTH), 120, dtype=np.uint16), "16UC1"))
        pair = self.feed.take_color(topic, image_of(stamp, picture, "rgb8"))
        return pair is not None and self.feed.decode(pair).stamp > 0.0


def test_a_camera_that_comes_back_under_the_other_name_is_taken_after_a_silence():
    camera = Camera()
    assert camera.feed.source == f"{COLOR} or {OLD_COLOR}"
    assert camera.shoot(COLOR) and camera.feed.source == COLOR
    camera.now += SILENCE + PERIOD
    assert camera.shoot(OLD_COLOR) and camera.feed.source == OLD_COLOR
    assert not camera.shoot(COLOR)
    camera.now += SILENCE + PERIOD
    assert camera.shoot(COLOR)


def test_while_one_topic_speaks_the_other_is_not_listened_to_however_long():
    camera = Camera()
    for _ in range(round(3 * SILENCE / PERIOD)):
        assert camera.shoot(COLOR) and not camera.shoot(OLD_COLOR)


def test_images_of_the_old_topic_are_not_held_against_the_new_one():
    camera = Camera()
    still = camera.rng.integers(90, 160, (HEIGHT, WIDTH, 3), dtype=np.uint8)
    for _ in range(2):
        camera.shoot(COLOR, still)
    camera.now += SILENCE + PERIOD
    for _ in range(2):
        assert camera.shoot(OLD_COLOR, still)
    with pytest.raises(FrozenImageError):
        for _ in range(3):
            camera.shoot(OLD_COLOR, still)
