"""Claims about slow motion by stepped targets."""

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from finforce_driver.machine.move import LARGEST_LAG, Steps

COUNT_MM = 48.0 / 255


def follow(steps, until, service=0.001, start=0.0, place=None):
    """Serve steps until a time; yield time and target."""
    time = start
    while time < until:
        steps.advance(time, steps.position if place is None else place)
        yield time, steps.position
        time += service


@settings(max_examples=40)
@given(start=st.floats(0, 255), goal=st.integers(0, 255), rate=st.floats(1.0, 23.0))
def test_the_target_stays_within_half_a_count_of_the_ideal_ramp(start, goal, rate):
    steps = Steps(start=start, goal=goal, rate=rate, now=0.0)
    way = goal - start
    for time, target in follow(steps, abs(way) / rate + 1.0):
        ideal = start + (1 if way > 0 else -1) * min(rate * time, abs(way))
        # half a count of rounding, and a millisecond of service
        assert abs(target - ideal) <= 0.5 + rate * 0.001 + 1e-6
    assert steps.done


def test_a_millimetre_per_second_is_smooth_within_a_fifth_of_a_millimetre_at_poll_rate():
    steps = Steps(start=0.0, goal=255, rate=1.0 / COUNT_MM, now=0.0)
    errors = [abs(target * COUNT_MM - time) for time, target in follow(steps, 47.0, service=0.02)]
    assert max(errors) < 0.2


def test_the_target_goes_on_by_one_count_at_a_time_and_never_hurries():
    steps = Steps(start=0.0, goal=100, rate=10.0, now=0.0)
    changes = []
    for service in (0.001, 0.5, 0.001):  # a link that fails for half a second now and then
        begin = changes[-1][0] if changes else 0.0
        for time, target in follow(steps, begin + 2.0, service, begin):
            if not changes or target != changes[-1][1]:
                changes.append((time, target))
    pairs = list(zip(changes, changes[1:], strict=False))
    assert all(after[1] - before[1] == 1 for before, after in pairs)
    assert all(after[0] - before[0] >= 0.5 / 10.0 for before, after in pairs)


@pytest.mark.parametrize("way", [1, -1])
def test_the_target_waits_for_jaws_that_stay_behind(way):
    steps = Steps(start=100.0, goal=100 + 50 * way, rate=10.0, now=0.0)
    *_, (_, target) = follow(steps, 5.0, place=100.0)
    assert LARGEST_LAG < abs(target - 100) <= LARGEST_LAG + 1
    assert steps.waiting
    *_, (_, later) = follow(steps, 6.0, start=5.0, place=100.0 + 3 * way)
    assert abs(later - 100) > abs(target - 100)


def test_jaws_that_are_ahead_take_the_target_along():
    steps = Steps(start=155.0, goal=67, rate=5.0, now=0.0)
    *_, (_, target) = follow(steps, 0.5, place=105.0)
    assert target <= 105


@pytest.mark.parametrize("goal", [90, 110])
def test_a_new_goal_goes_on_from_the_present_place(goal):
    first = Steps(start=100.0, goal=200, rate=10.0, now=0.0)
    list(follow(first, 0.37))
    second = Steps(start=first.ramp(0.37), goal=goal, rate=5.0, now=0.37)
    assert second.position == first.position
    assert second.ramp(0.37) == pytest.approx(103.7, abs=0.02)  # a millisecond of service
    *_, (_, target) = follow(second, 4.0, start=0.37)
    assert target == goal
