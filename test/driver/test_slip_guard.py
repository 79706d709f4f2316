"""A force that rises while the object slides: off by default, in bounded steps."""

import pytest

from finforce_driver.errors import TargetError
from finforce_driver.grasp.session import SlipGuard
from finforce_driver.settings import GraspSettings


def slide(guard, force, speed=0.006, images=60, rate=30.0, jaw="left"):
    """The force after an object has slid over a jaw for some images, and how often it rose."""
    rises = 0
    for number in range(images):
        wanted = guard.take(jaw, speed, number / rate, force)
        if wanted is not None:
            force, rises = wanted, rises + 1
    return force, rises


def begun(force=2.0, **settings):
    guard = SlipGuard(GraspSettings(**settings))
    guard.begin(force)
    return guard


def test_nothing_rises_unless_asked_for():
    assert slide(begun(), 2.0) == (2.0, 0)


def test_the_force_rises_by_steps_to_its_bound():
    force, rises = slide(begun(slip_raise=0.2), 2.0)
    assert force == pytest.approx(3.0)
    assert rises == 3


def test_the_limit_of_the_grasp_goes_first():
    assert slide(begun(7.0, slip_raise=0.5), 7.0)[0] == GraspSettings().force_limit


def test_slow_motion_and_single_images_raise_nothing():
    assert slide(begun(slip_raise=0.2), 2.0, speed=0.002) == (2.0, 0)
    guard = begun(slip_raise=0.2)
    assert all(guard.take("left", 0.01 if n % 3 else 0.0, n / 30.0, 2.0) is None for n in range(30))


def test_images_of_both_jaws_are_counted_apart():
    guard = begun(slip_raise=0.2)
    assert [guard.take(jaw, 0.01, n / 30.0, 2.0) for n in range(2) for jaw in ("left", "right")] == [None] * 4
    assert guard.take("left", 0.01, 2 / 30.0, 2.0) == pytest.approx(2.4)


def test_another_set_force_begins_anew():
    guard = begun(2.0, slip_raise=0.5)
    assert slide(guard, 2.0)[0] == pytest.approx(3.0)
    guard.begin(1.0)
    assert slide(guard, 1.0)[0] == pytest.approx(1.5)


def test_a_negative_rise_is_refused():
    with pytest.raises(TargetError, match="expected"):
        GraspSettings(slip_raise=-0.1)
