"""Claims about moves: where the jaws go, how fast, what stops them, and what is refused."""

import math

import pytest
from emulator_fakes import COUNT, VARIANTS

from finforce_driver.can.protocol import Flag
from finforce_driver.errors import GripperStateError, TargetError
from finforce_driver.state import MoveOutcome, Phase

GO = Flag.ACTIVATE | Flag.GO
both_variants = pytest.mark.parametrize("variant", VARIANTS)


@both_variants
@pytest.mark.parametrize("opening", [0.048, 0.030, 0.0292, 0.0101, 0.0])
def test_a_move_reaches_its_opening(rig, opening):
    rig.arrive(0.02)
    state = rig.arrive(opening)
    # closing to the end the stop comes first: "closed on nothing" says more than "reached"
    assert state.outcome in (MoveOutcome.REACHED, MoveOutcome.CLOSED_EMPTY)
    assert state.opening == pytest.approx(opening, abs=0.6 * COUNT)
    assert rig.emulated.jaws.opening == pytest.approx(opening, abs=COUNT)


@both_variants
def test_the_opening_that_is_told_is_the_true_one_throughout(rig):
    rig.gripper.move(0.01, 0.03)
    while rig.state.phase is Phase.MOVING:
        rig.gripper.turn()
        # half a count of truncation, and what the jaws go between two polls
        assert rig.state.opening == pytest.approx(rig.emulated.jaws.opening, abs=0.5 * COUNT + 0.03 * 0.025)


@both_variants
def test_one_order_is_sent_for_one_move(rig):
    rig.arrive(0.01, 0.03)
    rig.gripper.move(0.01, 0.03)
    rig.live(0.5)
    assert [order.position for order in rig.orders()] == [202]
    assert not rig.emulated.violations


@both_variants
def test_closing_on_an_object_grasps_it(rig):
    rig.emulated.jaws.object_opening = 0.025
    state = rig.arrive(0.0, 0.05, 20.0)
    assert (state.outcome, state.contact) == (MoveOutcome.GRASPED, "closing")
    assert state.opening == pytest.approx(0.025, abs=0.6 * COUNT)
    assert state.force == pytest.approx(20.0, rel=0.02)
    assert state.current < 0.0


@both_variants
def test_opening_against_a_wall_is_blocked(rig):
    rig.arrive(0.01)
    rig.emulated.jaws.wall_opening = 0.02
    state = rig.arrive(0.04)
    assert (state.outcome, state.contact) == (MoveOutcome.BLOCKED, "opening")
    assert state.current > 0.0


@both_variants
def test_closing_with_less_force_than_the_stop_needs_is_closed_on_nothing(rig):
    rig.emulated.jaws.object_opening = 0.0005
    assert rig.arrive(0.0).outcome is MoveOutcome.CLOSED_EMPTY


@both_variants
def test_an_object_that_vanishes_is_not_grasped_any_more(rig):
    rig.emulated.jaws.object_opening = 0.025
    rig.arrive(0.01, 0.05)
    rig.emulated.jaws.object_opening = None
    state = rig.gripper.wait(lambda state: state.outcome is not MoveOutcome.GRASPED, 1.0)
    assert state.contact == ""
    assert rig.wait_for(Phase.READY).outcome is MoveOutcome.REACHED


@both_variants
def test_a_slow_move_is_smooth_within_a_fifth_of_a_millimetre(rig):
    rig.arrive(0.02)
    begin = rig.clock.now()
    rig.gripper.move(0.012, 0.001)
    while rig.state.phase is Phase.MOVING:
        rig.gripper.turn()
        ideal = max(0.02 - 0.001 * (rig.clock.now() - begin), 0.012)
        # the jaws follow a step within 40 ms
        assert abs(rig.emulated.jaws.opening - ideal) < 0.0002
    assert rig.state.outcome is MoveOutcome.REACHED
    orders = rig.orders(begin)
    assert all(abs(after.position - before.position) == 1 for before, after in zip(orders, orders[1:], strict=False))
    assert {order.speed for order in orders} == {3}


@both_variants
def test_a_new_goal_of_a_slow_move_goes_on_without_a_jerk(rig):
    rig.arrive(0.03)
    rig.gripper.move(0.01, 0.002)
    rig.live(1.0)
    begin, place = rig.clock.now(), rig.emulated.jaws.opening
    for goal, speed in ((0.02, 0.002), (0.015, 0.001), (0.04, 0.002), (0.0, 0.002)):
        rig.gripper.move(goal, speed)
        rig.live(0.25)
        assert abs(rig.emulated.jaws.opening - place) < 0.002 * 0.25 + 1.5 * COUNT
        place = rig.emulated.jaws.opening
    steps = [order.position for order in rig.orders(begin)]
    assert max(abs(after - before) for before, after in zip(steps, steps[1:], strict=False)) == 1


@both_variants
def test_a_slow_move_grasps_and_follows_what_gives_way(rig):
    rig.emulated.jaws.object_opening = 0.025
    rig.arrive(0.027)
    state = rig.arrive(0.01, 0.002)
    assert state.outcome is MoveOutcome.GRASPED
    assert min(order.position for order in rig.orders()[-1:]) - rig.gripper.settings.counts_of(0.025) < 5.0
    rig.emulated.jaws.object_opening = 0.020
    begin = rig.clock.now()
    rig.gripper.wait(lambda _: rig.emulated.jaws.opening < 0.0205, 10.0)
    assert rig.clock.now() - begin > 0.7 * 0.0045 / 0.002


@both_variants
def test_a_blip_of_contact_is_no_grasp(rig):
    rig.gripper.move(0.0, 0.02)
    rig.live(0.1)
    for _ in range(20):
        rig.adapter.blip(0.02)
        rig.live(0.08)
        assert (rig.state.phase, rig.state.contact) == (Phase.MOVING, "")


@both_variants
def test_a_gripper_that_does_not_move_times_out(rig):
    rig.emulated.configured = False
    begin = rig.clock.now()
    state = rig.arrive(0.02)
    assert state.outcome is MoveOutcome.TIMED_OUT
    assert "configured as a gripper" in state.message
    assert 1.2 < rig.clock.now() - begin < 2.0


@both_variants
def test_switching_off_lets_go_and_refuses_moves(rig):
    rig.arrive(0.02)
    rig.gripper.activate(False)
    rig.live(0.1)
    assert not rig.state.activated
    with pytest.raises(GripperStateError, match="switched off: activate"):
        rig.gripper.move(0.01)
    rig.gripper.activate(True)
    rig.live(0.3)
    assert rig.state.activated
    assert rig.emulated.jaws.opening == pytest.approx(0.02, abs=1.1 * COUNT)
    assert rig.arrive(0.01).outcome is MoveOutcome.REACHED


BAD = [
    ((math.nan,), TargetError, "opening: got nan"),
    ((-0.001,), TargetError, "opening: got -0.001 m, expected 0 to 0.048 m"),
    ((0.02, math.nan), TargetError, "speed: got nan"),
    ((0.02, 0.0), TargetError, "speed: got 0 m/s"),
    ((0.02, 0.01, -5.0), TargetError, "force: got -5 N"),
    (("0.02",), TargetError, "opening: got '0.02', expected a number"),
    ((True,), TargetError, "opening: got True"),
]


@both_variants
@pytest.mark.parametrize("arguments, error, text", BAD)
def test_bad_input_is_refused_and_leaves_the_move_as_it_was(rig, arguments, error, text):
    rig.gripper.move(0.01, 0.02)
    rig.live(0.2)
    before = rig.orders()
    with pytest.raises(error, match=text):
        rig.gripper.move(*arguments)
    rig.live(0.2)
    assert rig.orders() == before
    assert (rig.state.phase, rig.state.target) == (Phase.MOVING, 0.01)


@both_variants
def test_velocity_is_that_of_the_opening(rig):
    speed = rig.gripper.settings.speed_of(rig.gripper.settings.speed_byte(0.0232))
    for goal, way in ((0.0, -1.0), (0.048, 1.0)):
        rig.gripper.move(goal, 0.0232)
        rig.live(0.5)
        # a count in a tenth of a second
        assert rig.state.velocity == pytest.approx(way * speed, abs=COUNT / 0.1)
