"""Claims about the noise over pictures that are shown again."""

import numpy as np
import pytest

from finforce_sim.sensor import DENSITY, Flicker

PICTURE = np.random.default_rng(1).integers(0, 60000, 20000).astype(np.uint16)


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_no_picture_is_shown_twice_and_none_drifts_away(dtype):
    flicker, shown = Flicker(3), set()
    picture = PICTURE.astype(dtype)
    numbers = picture.copy()
    for _ in range(200):
        flicker.lay(numbers, 7)
        shown.add(numbers.tobytes())
        away = np.abs(numbers.astype(int) - picture.astype(int))
        assert away.max() == 1
        # of the numbers above one, which are nearly all
        assert away.mean() == pytest.approx(DENSITY, rel=0.5)
    assert len(shown) > 190  # of 4096 beginnings some come twice


def test_what_says_nothing_goes_on_saying_nothing():
    numbers = np.zeros(5000, np.uint16)
    Flicker(0).lay(numbers, 1)
    assert not numbers.any()


def test_pictures_of_different_names_do_not_undo_each_other():
    flicker = Flicker(5)
    first, second = PICTURE.copy(), PICTURE.copy()
    for _ in range(5):
        flicker.lay(first, 1)
        flicker.lay(second, 2)
    for numbers in (first, second):
        assert np.abs(numbers.astype(int) - PICTURE.astype(int)).max() == 1
