"""Claims about pictures that show that nothing has moved, and about those that do not."""

from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest
from keypoint_scene_fakes import CAMERA, SIDES, found_at, move_all, move_tip, picture

from finforce_keypoints.geometry.stillness import (
    JUDGED,
    LARGEST_CREEP,
    LARGEST_ERROR,
    LARGEST_SHIFT,
    LEAST_IMAGES,
    StillWatch,
)

PERIOD = 1.0 / 30.0


still = lru_cache(maxsize=20)(picture)
SETTLED = LEAST_IMAGES + 1  # images; the first one only says where the jaws are


def watch_of(images=SETTLED, rng=None, **options):
    """A watch that has seen jaws stand still."""
    watch = StillWatch()
    for number in range(images):
        watch.take(found_at(number * PERIOD, rng, **options), still(number), CAMERA)
    return watch


@pytest.fixture(scope="module")
def seen():
    """A picture of a still jaw, of one that went as far as is let pass, and of jaws that moved more."""
    far = 3.0 * LARGEST_SHIFT
    moves = {
        "none": move_all(0.0),
        "all": move_all(far),
        "back": move_all(-far),
        "tip": move_tip(far),
        "jump": move_tip(2e-3),
    }
    return {(name, side): picture(100, move, side=side) for name, move in moves.items() for side in SIDES}


def test_a_picture_of_jaws_that_stand_still_has_their_key_points_at_its_own_time(seen):
    found = watch_of().confirm(9.0, seen["none", "left"], CAMERA)
    assert set(found) == set(SIDES)
    assert all(jaw.stamp == 9.0 and jaw.valid.all() for jaw in found.values())


def test_the_key_points_are_the_mean_of_the_images_and_their_error_admits_the_shift(seen):
    rng, spread = np.random.default_rng(1), 1e-4
    found = watch_of(rng=rng, spread=spread).confirm(9.0, seen["none", "left"], CAMERA)
    for side, jaw in found_at(9.0).items():
        error = np.abs(found[side].points - jaw.points)
        assert error.max() < 5.0 * spread / np.sqrt(LEAST_IMAGES)  # 45 numbers: none beyond five deviations
        assert found[side].stddev == pytest.approx(np.hypot(2e-4, LARGEST_SHIFT))


@pytest.mark.parametrize("side", SIDES)
@pytest.mark.parametrize("move", ["all", "back", "tip", "jump"])
def test_a_motion_is_seen_on_the_very_picture_that_shows_it(seen, move, side):
    assert watch_of().confirm(9.0, seen[move, side], CAMERA) is None


@pytest.mark.parametrize("side", SIDES)
@pytest.mark.parametrize("shape", [move_all, move_tip])
def test_no_shift_beyond_the_bound_is_let_pass(side, shape):
    watch = watch_of()
    error = max(jaw._model.errors.max() for jaw in watch._jaws.values())
    bound = max(jaw.limits.max() for jaw in watch._jaws.values()) + 3.0 * error
    # the tip lies above the highest key point that is watched, by a tenth of the height at most
    ways = np.linspace(1.25, 4.0, 8) * bound
    assert bound < 2.5 * LARGEST_SHIFT
    assert not any(watch.confirm(9.0, picture(200 + n, shape(way), side=side), CAMERA) for n, way in enumerate(ways))


def test_a_creep_that_each_picture_lets_pass_is_seen_in_the_mean_of_some():
    creep = 0.5 * (LARGEST_CREEP + LARGEST_SHIFT)
    watch = watch_of()
    told = [watch.confirm(9.0, picture(300 + n, move_all(creep)), CAMERA) is not None for n in range(25)]
    assert told[0] and not any(told[-5:])


def test_noise_alone_seldom_wakes():
    watch = watch_of()
    told = [watch.confirm(9.0, picture(400 + n), CAMERA) is not None for n in range(30)]
    assert sum(told) >= 29


def test_light_is_no_motion():
    watch = watch_of()
    assert watch.confirm(9.0, picture(500, gain=1.06, offset=-5.0), CAMERA) is not None


def test_something_before_one_key_point_is_seen():
    watch, color = watch_of(), picture(600)
    column, row = np.rint(found_at(0.0)["right"].pixels[7]).astype(int)
    color[row - 3 : row + 4, column - 3 : column + 4] = 60
    assert watch.confirm(9.0, color, CAMERA) is None


def test_a_pattern_that_no_shift_explains_is_seen():
    watch, color = watch_of(), picture(601)
    column, row = np.rint(found_at(0.0)["left"].pixels[4]).astype(int)
    color[row - 3 : row + 4 : 2, column - 3 : column + 4 : 2] -= 25
    color[row - 2 : row + 4 : 2, column - 2 : column + 4 : 2] += 25
    assert watch.confirm(9.0, color, CAMERA) is None


def test_the_same_picture_to_the_bit_tells_nothing(seen):
    watch = watch_of()
    assert watch.confirm(9.0, seen["none", "left"], CAMERA) is not None
    assert watch.confirm(9.1, seen["none", "left"], CAMERA) is None


@pytest.mark.parametrize("name", ["tip", "jump"])
def test_one_picture_that_looks_moved_forgets_nothing(seen, name):
    watch, moved = watch_of(), seen[name, "left"]
    assert watch.confirm(8.0, moved, CAMERA) is None
    assert watch.take(found_at(8.0), moved, CAMERA)["left"].stamp == 8.0
    assert watch.confirm(9.0, seen["none", "left"], CAMERA) is not None


def test_after_two_pictures_that_look_moved_the_new_place_is_learnt():
    watch, move = watch_of(), move_tip(3.0 * LARGEST_SHIFT)
    for number in range(SETTLED):
        color = picture(700 + number, move)
        assert watch.confirm(8.0, color, CAMERA) is None
        watch.take(found_at(8.0), color, CAMERA)
    assert watch.confirm(9.0, picture(750, move), CAMERA) is not None
    assert watch.confirm(9.0, picture(751), CAMERA) is None


def test_a_full_look_believes_its_own_picture_not_the_one_before(seen):
    watch, found = watch_of(), found_at(9.0)
    assert watch.confirm(8.9, seen["none", "left"], CAMERA) is not None
    assert watch.take(found, seen["tip", "left"], CAMERA) is found


DIM = {"gain": 0.3, "offset": 80.0}  # contrast of a dark jaw in a dark grasp


@pytest.fixture(scope="module")
def dim():
    """A watch that has seen little contrast."""
    watch = StillWatch()
    for number in range(JUDGED + SETTLED):
        watch.take(found_at(number * PERIOD), picture(number, **DIM), CAMERA)
    return watch


def test_where_little_is_to_be_seen_more_is_looked_at(dim):
    watch = StillWatch()
    for number in range(JUDGED + 1):  # the first one only says where the jaws are
        watch.take(found_at(number * PERIOD), picture(number, **DIM), CAMERA)
    assert all(jaw.spots.pixels.shape[1] > 15 for jaw in watch._jaws.values())
    assert all(jaw._model.errors.max() <= LARGEST_ERROR for jaw in dim._jaws.values())
    assert dim.confirm(9.0, picture(800, **DIM), CAMERA) is not None
    assert watch_of()._jaws["left"].spots.pixels.shape[1] < 15


@pytest.mark.parametrize("side", SIDES)
@pytest.mark.parametrize("move", [move_all, move_tip])
def test_there_too_a_motion_is_seen_on_the_very_picture_that_shows_it(dim, side, move):
    bound = max((jaw.limits + 3.0 * jaw._model.errors).max() for jaw in dim._jaws.values())
    assert bound < 3.0 * LARGEST_SHIFT
    ways = (1.25 * bound, -1.25 * bound, 4.0 * bound)
    assert not any(dim.confirm(9.0, picture(810, move(way), side=side, **DIM), CAMERA) for way in ways)


def test_a_key_point_that_is_well_seen_may_go_no_farther_because_another_is_not(dim):
    limits = dim._jaws["left"].limits
    assert limits.min() == LARGEST_SHIFT < limits.max()


@pytest.mark.parametrize("images", [1, LEAST_IMAGES - 1])
def test_few_images_tell_nothing(seen, images):
    assert watch_of(images).confirm(9.0, seen["none", "left"], CAMERA) is None


def test_a_jaw_with_few_key_points_is_not_watched(seen):
    assert watch_of(hidden=7).confirm(9.0, seen["none", "left"], CAMERA) is not None
    assert watch_of(hidden=8).confirm(9.0, seen["none", "left"], CAMERA) is None


def test_another_camera_or_a_jaw_that_was_lost_begins_anew(seen):
    color = seen["none", "left"]
    assert watch_of().confirm(9.0, color, replace(CAMERA, fx=430.0)) is None
    watch = watch_of()
    watch.take({}, color, CAMERA)
    assert watch.confirm(9.0, color, CAMERA) is None


def test_a_full_look_at_jaws_that_stand_still_gives_the_mean(seen):
    rng = np.random.default_rng(2)
    watch, found = watch_of(rng=rng), found_at(9.0, rng)
    told = watch.take(found, seen["none", "left"], CAMERA)
    truth = found_at(9.0)["left"].points
    assert np.abs(told["left"].points - truth).mean() < 0.5 * np.abs(found["left"].points - truth).mean()
