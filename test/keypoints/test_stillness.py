"""Claims about pictures that show that nothing has moved, and about those that do not."""

from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest
from keypoint_scene_fakes import CAMERA, SIDES, found_at, move_all, move_tip, picture

from finforce_keypoints.geometry.stillness import LARGEST_CREEP, LARGEST_SHIFT, LEARNT, LOOK_EVERY, StillWatch
from finforce_keypoints.images import RgbdImage

PERIOD = 1.0 / 30.0
SOON = 1.0  # s, before an image has to be looked at in full


still = lru_cache(maxsize=20)(picture)


def shown(stamp, color, camera=CAMERA):
    return RgbdImage(stamp=stamp, color=color, depth=None, camera=camera)


def watch_of(images=LEARNT, rng=None, **options):
    """A watch that has seen jaws stand still."""
    watch = StillWatch()
    for number in range(images):
        watch.take(found_at(number * PERIOD, rng, **options), shown(number * PERIOD, still(number)))
    return watch


def confirm(watch, color, stamp=SOON):
    """What a watch says of a picture."""
    return watch.confirm(shown(stamp, color))


def bound_of(watch):
    """The shift [m] of any key point that is noticed but for one picture in a thousand."""
    return max((jaw.limits + 3.0 * jaw.errors).max() for jaw in watch.references.values())


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


def test_every_look_at_jaws_that_stand_still_refines_their_key_points(seen):
    """To the bit the same key points for seconds are those of a camera that hangs."""
    rng = np.random.default_rng(5)
    watch = watch_of(rng=rng)
    before = confirm(watch, seen["none", "left"])["left"].points
    looked = found_at(SOON + LOOK_EVERY, rng)
    watch.take(looked, shown(SOON + LOOK_EVERY, still(101)))
    after = confirm(watch, picture(102), 2.0 * SOON + LOOK_EVERY)["left"].points
    np.testing.assert_allclose(after - before, (looked["left"].points - before) / LEARNT, rtol=1e-6, atol=1e-12)
    assert (after != before).any()


def test_a_picture_of_jaws_that_stand_still_has_their_key_points_at_its_own_time(seen):
    found = confirm(watch_of(), seen["none", "left"])
    assert set(found) == set(SIDES)
    assert all(jaw.stamp == SOON and jaw.valid.all() for jaw in found.values())


def test_the_key_points_are_the_mean_of_the_images_and_their_error_admits_the_shift(seen):
    rng, spread = np.random.default_rng(1), 1e-4
    found = confirm(watch_of(rng=rng, spread=spread), seen["none", "left"])
    for side, jaw in found_at(SOON).items():
        error = np.abs(found[side].points - jaw.points)
        assert error.max() < 5.0 * spread / np.sqrt(LEARNT)  # 45 numbers: none beyond five deviations
        assert found[side].stddev == pytest.approx(np.hypot(2e-4, LARGEST_SHIFT))


@pytest.mark.parametrize("side", SIDES)
@pytest.mark.parametrize("move", ["all", "back", "tip", "jump"])
def test_a_motion_is_seen_on_the_very_picture_that_shows_it(seen, move, side):
    assert confirm(watch_of(), seen[move, side]) is None


@pytest.mark.parametrize("side", SIDES)
@pytest.mark.parametrize("shape", [move_all, move_tip])
def test_no_shift_beyond_the_bound_is_let_pass(side, shape):
    watch = watch_of()
    bound = bound_of(watch)
    # the tip lies above the highest key point that is watched, by a tenth of the height at most
    ways = np.linspace(1.25, 4.0, 8) * bound
    assert bound < 2.5 * LARGEST_SHIFT
    assert not any(confirm(watch, picture(200 + n, shape(way), side=side)) for n, way in enumerate(ways))


def test_a_creep_that_each_picture_lets_pass_is_seen_in_the_mean_of_some():
    creep = 0.5 * (LARGEST_CREEP + LARGEST_SHIFT)
    watch = watch_of()
    told = [confirm(watch, picture(300 + n, move_all(creep))) is not None for n in range(25)]
    assert told[0] and not any(told[-5:])


def test_noise_alone_seldom_wakes():
    watch = watch_of()
    told = [confirm(watch, picture(400 + n)) is not None for n in range(30)]
    assert sum(told) >= 29


def test_light_is_no_motion():
    watch = watch_of()
    assert confirm(watch, picture(500, gain=1.06, offset=-5.0)) is not None


def test_something_before_one_key_point_is_seen():
    watch, color = watch_of(), picture(600)
    column, row = np.rint(found_at(0.0)["right"].pixels[7]).astype(int)
    color[row - 3 : row + 4, column - 3 : column + 4] = 60
    assert confirm(watch, color) is None


def test_a_pattern_that_no_shift_explains_is_seen():
    watch, color = watch_of(), picture(601)
    column, row = np.rint(found_at(0.0)["left"].pixels[4]).astype(int)
    color[row - 3 : row + 4 : 2, column - 3 : column + 4 : 2] -= 25
    color[row - 2 : row + 4 : 2, column - 2 : column + 4 : 2] += 25
    assert confirm(watch, color) is None


def test_the_same_picture_to_the_bit_tells_nothing(seen):
    watch = watch_of()
    assert confirm(watch, seen["none", "left"]) is not None
    assert confirm(watch, seen["none", "left"]) is None


@pytest.mark.parametrize("name", ["tip", "jump"])
def test_one_picture_that_looks_moved_forgets_nothing(seen, name):
    watch, moved = watch_of(), seen[name, "left"]
    known = {side: reference.keypoints.points for side, reference in watch.references.items()}
    assert confirm(watch, moved) is None
    found = found_at(SOON, np.random.default_rng(6))
    assert watch.take(found, shown(SOON, moved)) is found
    told = confirm(watch, seen["none", "left"])
    assert all((told[side].points == points).all() for side, points in known.items())


def test_after_two_pictures_that_look_moved_the_new_place_is_learnt():
    watch, move = watch_of(), move_tip(3.0 * LARGEST_SHIFT)
    for number in range(LEARNT + 1):  # the first one may be a slip
        color = picture(700 + number, move)
        assert confirm(watch, color) is None
        watch.take(found_at(SOON), shown(SOON, color))
    assert confirm(watch, picture(750, move)) is not None
    assert confirm(watch, picture(751)) is None


DIM = {"gain": 0.3, "offset": 80.0}  # contrast of a dark jaw in a dark grasp


@pytest.fixture(scope="module")
def dim():
    """A watch that has seen little contrast."""
    watch = StillWatch()
    for number in range(LEARNT):
        watch.take(found_at(number * PERIOD), shown(number * PERIOD, picture(number, **DIM)))
    return watch


def test_where_little_is_to_be_seen_still_jaws_are_told_too(dim):
    assert confirm(dim, picture(800, **DIM)) is not None


def test_where_nothing_is_to_be_seen_every_picture_is_looked_at():
    watch = StillWatch()
    for number in range(2 * LEARNT):
        watch.take(found_at(number * PERIOD), shown(number * PERIOD, picture(number, gain=0.02, offset=90.0)))
    assert confirm(watch, picture(800, gain=0.02, offset=90.0)) is None


@pytest.mark.parametrize("side", SIDES)
@pytest.mark.parametrize("move", [move_all, move_tip])
def test_there_too_a_motion_is_seen_on_the_very_picture_that_shows_it(dim, side, move):
    bound = bound_of(dim)
    assert bound < 3.0 * LARGEST_SHIFT
    ways = (1.25 * bound, -1.25 * bound, 4.0 * bound)
    assert not any(confirm(dim, picture(810, move(way), side=side, **DIM)) for way in ways)


def test_a_key_point_that_is_well_seen_may_go_no_farther_because_another_is_not(dim):
    limits = dim.references["left"].limits
    assert limits.min() == LARGEST_SHIFT < limits.max()


def test_after_some_seconds_a_picture_is_looked_at_though_nothing_has_moved(seen):
    watch, looked = watch_of(), (LEARNT - 1) * PERIOD
    assert confirm(watch, seen["none", "left"], looked + 0.9 * LOOK_EVERY) is not None
    assert confirm(watch, picture(101), looked + 1.1 * LOOK_EVERY) is None


@pytest.mark.parametrize("images", [1, LEARNT - 1])
def test_few_images_tell_nothing(seen, images):
    assert confirm(watch_of(images), seen["none", "left"]) is None


def test_a_jaw_with_few_key_points_is_not_watched(seen):
    assert confirm(watch_of(hidden=7), seen["none", "left"]) is not None
    assert confirm(watch_of(hidden=8), seen["none", "left"]) is None


def test_another_camera_or_a_jaw_that_was_lost_begins_anew(seen):
    color = seen["none", "left"]
    assert watch_of().confirm(shown(SOON, color, replace(CAMERA, fx=430.0))) is None
    watch = watch_of()
    watch.take({}, shown(SOON, color))
    assert confirm(watch, color) is None


def test_a_full_look_at_jaws_that_stand_still_gives_the_mean(seen):
    rng = np.random.default_rng(2)
    watch, found = watch_of(rng=rng), found_at(SOON, rng)
    told = watch.take(found, shown(SOON, seen["none", "left"]))
    truth = found_at(SOON)["left"].points
    assert np.abs(told["left"].points - truth).mean() < 0.5 * np.abs(found["left"].points - truth).mean()
