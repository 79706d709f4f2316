"""Claims about the work that a key point detector leaves out: what stays the same, and how to have it all done."""

from dataclasses import replace

import numpy as np
import pytest
from keypoint_scene_fakes import SIDES, FakePixelDetector, bare_image, move_tip, picture, scene_of

from finforce_keypoints.detector import KeypointDetector
from finforce_keypoints.geometry.stillness import LARGEST_SHIFT, LOOK_EVERY
from finforce_keypoints.parameters import DetectorSettings

PERIOD = 1.0 / 30.0
LEARNING = 50  # images until the jaws' places are learnt and known to be still
SPREAD = 0.3  # px, of the pixel_detector


class Watched:
    """A detector that is shown pictures as its node shows them."""

    def __init__(self, rests=True):
        scene, self.depth = scene_of("robot")
        self.pixel_detector = FakePixelDetector(scene.pixels(), np.random.default_rng(4), SPREAD)
        self.detector = KeypointDetector(
            self.pixel_detector, scene.jaws, scene.T_gripper_camera, DetectorSettings(), rests=rests
        )
        self.number = 0

    def show(self, color, stamp=None):
        """Say what is found in a picture, whether it is looked at or not."""
        stamp = self.number * PERIOD if stamp is None else stamp
        self.number += 1
        return self.detector.detect(replace(bare_image(stamp, self.depth.astype(np.float32)), color=color))

    def rest(self, count=LEARNING):
        """Show still pictures."""
        return [self.show(picture(seed)) for seed in range(count)]

    @property
    def looks(self):
        return len(self.pixel_detector.expected)


@pytest.fixture(scope="module")
def resting():
    """A detector that rests and one that does not, that have seen the same still pictures."""
    watched, plain = Watched(), Watched(rests=False)
    return watched, plain, watched.rest(), plain.rest()


def test_what_stands_still_is_not_looked_at_again(resting):
    watched, plain, _, _ = resting
    assert watched.looks < LEARNING == plain.looks
    assert watched.detector.counts["still"] == LEARNING - watched.looks and watched.detector.was_still
    assert not plain.detector.was_still


def test_key_points_are_the_same_within_their_noise_with_rules_and_without(resting):
    _, _, told, plain = resting
    scene, _ = scene_of("robot")
    for side in SIDES:
        truth = scene.keypoints(side)[:-1]
        own, each = (np.array([image[side].points - truth for image in some[-10:]]) for some in (told, plain))
        allowed = LARGEST_SHIFT + np.abs(each).max(axis=(0, 1))  # the mean of images errs no more than one of them
        assert (np.abs(own).max(axis=(0, 1)) <= allowed).all()
        assert np.linalg.norm(own, axis=2).mean() < np.linalg.norm(each, axis=2).mean()
        assert all(image[side].valid.all() for image in told[-10:])


def test_an_image_is_looked_at_when_a_jaw_has_moved_in_it():
    watched = Watched()
    watched.rest()
    looks = watched.looks
    watched.show(picture(90, move_tip(4.0 * LARGEST_SHIFT)))
    assert watched.looks == looks + 1


def test_after_some_seconds_an_image_is_looked_at_though_nothing_has_moved():
    watched = Watched()
    watched.rest()
    looks, last = watched.looks, watched.number * PERIOD
    watched.show(picture(91), last + 0.5 * LOOK_EVERY)
    assert watched.looks == looks
    watched.show(picture(92), last + LOOK_EVERY + PERIOD)
    assert watched.looks == looks + 1


def test_a_jaw_that_rested_long_is_not_lost():
    watched = Watched()
    watched.rest()
    for number in range(40):
        watched.show(picture(100 + number % 8))
    found = watched.show(picture(93, move_tip(1e-3)))
    assert set(found) == set(SIDES)
    assert all(pose is not None for pose in watched.pixel_detector.expected[-1].values())


def test_an_image_that_was_looked_at_before_its_depth_came_is_found_the_same():
    ahead, at_once = Watched(), Watched()
    for seed in range(LEARNING):
        color, stamp = picture(seed), seed * PERIOD
        ahead.detector.detect_color(replace(bare_image(stamp, None), color=color))
        looks = ahead.looks
        found, expected = ahead.show(color), at_once.show(color)
        assert ahead.looks == looks == at_once.looks  # nothing was left to look at
        assert ahead.detector.was_still == at_once.detector.was_still
        for side in SIDES:
            np.testing.assert_array_equal(found[side].points, expected[side].points)


def test_an_image_that_is_not_younger_than_the_last_one_is_not_looked_at():
    watched = Watched()
    watched.show(picture(0), 1.0)
    watched.detector.detect_color(replace(bare_image(0.5, None), color=picture(1)))
    assert watched.looks == 1
