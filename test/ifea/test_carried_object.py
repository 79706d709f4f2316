"""The motion of an object that only the jaws hold, and what its pose says of it."""

import numpy as np
import pytest

from finforce_ifea.filter.carried_object import CarriedObject

STDDEV = 0.5e-3
SHARES = np.array([1.0, 0.0])


def rates(by_depth: float, by_height: float) -> np.ndarray:
    """Return rates of a contact of one part whose traction ratio changes along the surface only."""
    found = np.zeros((2, 2, 3, 2))
    found[0, 0, 0] = by_depth, by_height
    return found


def press(heights: np.ndarray, depths: np.ndarray, by_depth: float = 100.0) -> CarriedObject:
    """Return an object that is pressed to depths (n,) [m] while its pose shows heights (n,) [m]."""
    carried = CarriedObject()
    for height, depth in zip(heights, depths, strict=True):
        carried.see(float(height), STDDEV)
        carried.follow(float(depth), 0.0, rates(by_depth, 1000.0), SHARES)
    return carried


DEPTHS = np.concatenate([np.zeros(60), np.linspace(0.0, 8e-3, 30)])


def shaken(heights: np.ndarray) -> np.ndarray:
    """Return heights (n,) [m] with the noise of a pose."""
    return heights + 0.05e-3 * np.random.default_rng(0).normal(size=len(heights))


def test_the_object_follows_the_ratio_of_the_rates():
    carried = press(np.full(90, 0.04), DEPTHS)
    assert carried.carried == pytest.approx(-8e-3 * 100.0 / 1000.0)
    for depth in np.linspace(8e-3, 0.0, 30):
        carried.follow(float(depth), 0.0, rates(100.0, 1000.0), SHARES)
    assert carried.carried == pytest.approx(0.0, abs=1e-12)


def test_a_change_of_the_balancing_traction_moves_the_object():
    carried = CarriedObject()
    carried.follow(1e-3, 0.1, rates(0.0, 1000.0), SHARES)
    carried.follow(2e-3, 0.3, rates(0.0, 1000.0), SHARES)
    assert carried.carried == pytest.approx(0.2e-3)


def test_an_object_that_moves_as_the_jaws_would_carry_it_is_likely_held_by_them_alone():
    assert press(shaken(0.04 - 0.1 * DEPTHS), DEPTHS).log_odds > 2.0


def test_an_object_that_stays_where_it_was_is_likely_held_by_something_else():
    assert press(shaken(np.full(90, 0.04)), DEPTHS).log_odds < -1.0


def test_a_motion_that_is_neither_hardly_counts():
    assert -1.0 < press(shaken(0.04 + 0.5 * DEPTHS), DEPTHS).log_odds <= 0.0


@pytest.mark.parametrize("by_depth", [0.0, 5.0])
def test_jaws_that_would_hardly_move_it_tell_little(by_depth):
    assert abs(press(shaken(np.full(90, 0.04)), DEPTHS, by_depth).log_odds) < 0.1


def test_a_stated_pose_tells_nothing():
    assert press(np.full(90, 0.04), DEPTHS).log_odds == 0.0


def test_motions_before_first_touch_do_not_count():
    approach = np.concatenate([np.linspace(0.06, 0.04, 20), np.full(40, 0.04), 0.04 - 0.1 * DEPTHS[60:]])
    assert press(shaken(approach), DEPTHS).log_odds > 2.0


def test_an_object_that_was_let_go_tells_nothing_until_it_is_touched_again():
    carried = press(shaken(0.04 - 0.1 * DEPTHS), DEPTHS)
    carried.leave()
    assert (carried.carried, carried.log_odds) == (0.0, 0.0)


def test_an_uncertain_pose_tells_less():
    sure, vague = press(shaken(0.04 - 0.1 * DEPTHS), DEPTHS), press(shaken(0.04 - 0.1 * DEPTHS), DEPTHS)
    vague.see(0.0392, 3e-3)
    assert 0.0 < vague.log_odds < 0.1 * sure.log_odds
