"""Claims about openings, speeds and forces in the gripper's units."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from finforce_driver.errors import TargetError
from finforce_driver.settings import SLOWEST_BYTE, GripperSettings

SCALE = GripperSettings()
FINGERS = GripperSettings(closed_opening=0.012, stroke=0.04)
# the maker's table: speed byte, ticks per second, speed of the opening [mm/s]
SPEEDS = {3: 4.5, 10: 14.6, 20: 29.0, 30: 43.5, 40: 57.9, 50: 72.3, 100: 144.5, 128: 184.9, 200: 288.8, 255: 368.2}


@pytest.mark.parametrize("scale", [SCALE, FINGERS])
def test_every_position_comes_back(scale):
    assert [scale.position_of(scale.opening_of(position)) for position in range(256)] == list(range(256))


def test_positions_of_the_makers_table():
    assert [SCALE.position_of(1e-3 * opening) for opening in (0, 12, 24, 36, 48)] == [255, 191, 128, 64, 0]


def test_openings_are_between_the_faces_of_the_jaws():
    assert FINGERS.opening_of(255) == pytest.approx(0.012)
    assert FINGERS.largest_opening == pytest.approx(0.052)


@pytest.mark.parametrize("byte", SPEEDS)
def test_speeds_of_the_makers_table(byte):
    assert 1e3 * SCALE.speed_of(byte) == pytest.approx(SPEEDS[byte], abs=0.051)  # rounded to 0.1 there


@pytest.mark.parametrize("byte", range(3, 256))
def test_every_speed_comes_back(byte):
    assert SCALE.speed_byte(SCALE.speed_of(byte)) == byte


@given(st.floats(1e-5, 0.36))
def test_no_byte_is_faster_than_asked_for_but_the_slowest(speed):
    byte = SCALE.speed_byte(speed)
    assert SCALE.speed_of(byte) <= max(speed * (1 + 1e-9), SCALE.speed_of(SLOWEST_BYTE))
    assert SCALE.speed_of(byte + 1) > speed


def test_a_speed_beyond_the_gripper_is_its_fastest():
    assert SCALE.speed_byte(0.5) == 255


def test_a_speed_in_another_unit_is_refused():
    with pytest.raises(TargetError, match=r"speed: got 20 m/s, expected 1e-05 to 0.368 m/s"):
        SCALE.speed_byte(20.0)


def test_forces_follow_the_makers_curve():
    assert SCALE.current_of(0.0477 * 500) == 500
    assert SCALE.force_of(0.5) == pytest.approx(23.85)


@pytest.mark.parametrize("opening", [math.nan, math.inf, -math.inf, -1e-6, 0.0480001])
def test_openings_out_of_reach_are_refused(opening):
    with pytest.raises(TargetError, match="opening: got .* expected 0 to 0.048 m"):
        SCALE.position_of(opening)


@pytest.mark.parametrize("speed", [math.nan, math.inf, 0.0, -0.01, 1e-6])
def test_speeds_that_are_none_are_refused(speed):
    with pytest.raises(TargetError, match="speed: got"):
        SCALE.speed_byte(speed)


@pytest.mark.parametrize("force", [math.nan, math.inf, 0.0, -10.0, 7.0, 62.1])
def test_forces_out_of_the_range_of_the_current_are_refused(force):
    with pytest.raises(TargetError, match="force: got .* expected 7.16 to 62 N"):
        SCALE.current_of(force)
