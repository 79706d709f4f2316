"""Claims about the work that a key point detector leaves out: what stays the same, and how to have it all done."""

from dataclasses import replace

import numpy as np
import pytest
from keypoint_scene_fakes import CAMERA, SIDES, FakeFinder, bare_image, move_tip, picture, scene_of

from finforce.skipping import ALL, STILL, Skips
from finforce_keypoints.detector import KeypointDetector
from finforce_keypoints.geometry.stillness import LARGEST_SHIFT
from finforce_keypoints.settings import LOOK_EVERY, RULES, SEARCH_EVERY, SEARCHED, UNSEEN

PERIOD = 1.0 / 30.0
LEARNING = 50  # images until the jaws' places are learnt and known to be still
SPREAD = 0.3  # px, of the finder


class Seeker(FakeFinder):
    """Finds what it is asked for, unless it is hidden, and keeps what it was asked."""

    hidden = ()

    def find(self, image, expected):
        found = super().find(image, expected)
        return {side: finding for side, finding in found.items() if side in expected and side not in self.hidden}


class Watched:
    """A detector that is shown pictures as its node shows them."""

    def __init__(self, *off, is_told=True):
        scene, self.depth = scene_of("robot")
        self.finder = Seeker(scene.pixels(), np.random.default_rng(4), SPREAD)
        self.skips = Skips(RULES, off)
        skips = self.skips if is_told else None
        self.detector = KeypointDetector(self.finder, scene.jaws, scene.T_gripper_camera, skips=skips)
        self.number, self.looks = 0, 0

    def show(self, color, stamp=None):
        """Say what is found in a picture, whether it is looked at or not."""
        stamp = self.number * PERIOD if stamp is None else stamp
        self.number += 1
        found = self.detector.confirm(stamp, color, CAMERA)
        if found is None:
            self.looks += 1
            image = replace(bare_image(stamp, self.depth.astype(np.float32)), color=color)
            found = self.detector.detect(image)
        return found

    def rest(self, count=LEARNING):
        """Show still pictures."""
        return [self.show(picture(seed)) for seed in range(count)]

    @property
    def skipped(self):
        return self.skips.describe()[f"skipped: {STILL}"]


@pytest.fixture(scope="module")
def resting():
    """A detector with its rules and one without, that have seen the same still pictures."""
    watched, plain = Watched(), Watched(ALL)
    return watched, plain, watched.rest(), plain.rest()


def test_what_stands_still_is_not_looked_at_again(resting):
    watched, plain, _, _ = resting
    assert watched.looks < LEARNING == plain.looks
    assert watched.skipped == str(LEARNING - watched.looks) and plain.skipped == "off"


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
    assert all(pose is not None for pose in watched.finder.expected[-1].values())


def test_without_a_word_of_rules_every_image_is_looked_at():
    watched = Watched(is_told=False)
    watched.rest()
    assert watched.looks == LEARNING


@pytest.mark.parametrize(("off", "images"), [((), SEARCHED + 2), ((UNSEEN,), SEARCHED + 2 * SEARCH_EVERY)])
def test_a_jaw_that_is_not_in_view_is_looked_for_less_often_unless_told(off, images):
    watched, color = Watched(*off), picture(0)
    watched.finder.hidden = ("right",)
    for _ in range(SEARCHED + 2 * SEARCH_EVERY):
        assert set(watched.show(color)) == {"left"}
    assert sum("right" in asked for asked in watched.finder.expected) == images
    watched.finder.hidden = ()
    assert any("right" in watched.show(color) for _ in range(SEARCH_EVERY))


def test_a_detector_that_finds_nothing_at_all_asks_its_finder_less_often():
    watched, color = Watched(), picture(0)
    watched.finder.hidden = SIDES
    for _ in range(SEARCHED + 4 * SEARCH_EVERY):
        assert not watched.show(color)
    assert len(watched.finder.expected) == SEARCHED + 4
