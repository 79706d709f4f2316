"""Claims about orders: when they leave, when they wait, and what hold sends."""

import pytest
from emulator_fakes import COUNT, VARIANTS, Rig
from emulator_faults import FaultKind

from finforce_driver.can.protocol import Command, Flag
from finforce_driver.state import MoveOutcome, Phase

GO = Flag.ACTIVATE | Flag.GO
both_variants = pytest.mark.parametrize("variant", VARIANTS)


@both_variants
def test_hold_stops_the_jaws_where_they_are(rig):
    rig.gripper.move(0.0, 0.02)
    rig.live(1.0)
    place = rig.emulated.jaws.opening
    rig.gripper.hold()
    rig.live(0.3)
    assert (rig.state.phase, rig.state.outcome) == (Phase.READY, MoveOutcome.REPLACED)
    assert rig.emulated.jaws.opening == pytest.approx(place, abs=0.02 * 0.03 + COUNT)
    assert rig.emulated.order.current_mA == 500


@both_variants
def test_hold_changes_nothing_for_jaws_that_hold(rig):
    rig.emulated.jaws.object_opening = 0.025
    rig.arrive(0.0, 0.05, 20.0)
    begin = rig.clock.now()
    rig.gripper.hold()
    rig.live(0.3)
    assert rig.orders(begin) == []
    assert rig.state.force == pytest.approx(20.0, rel=0.02)


@both_variants
def test_hold_does_not_power_limp_jaws(rig):
    rig.arrive(0.02)
    rig.gripper.release_power()
    rig.gripper.hold()
    rig.live(0.3)
    assert rig.orders()[-1].flags & GO == Flag.ACTIVATE
    assert not rig.emulated.order.action


@both_variants
def test_an_order_after_an_interruption_differs_from_the_same_one_before(rig):
    rig.arrive(0.02)
    rig.gripper.estop()
    rig.wait_for(Phase.FAULT)
    rig.gripper.clear_errors()
    rig.wait_for(Phase.READY)
    rig.arrive(0.02)
    first, second = (order for order in rig.orders() if order.drives)
    assert (first.position, first.speed, first.current_mA) == (second.position, second.speed, second.current_mA)
    assert first.flags != second.flags
    assert rig.emulated.violations["stale latch"] == 0


@pytest.mark.parametrize("kind", [FaultKind.LOST, FaultKind.REQUEST_LOST, FaultKind.TRUNCATED])
@both_variants
def test_an_order_whose_reply_is_lost_is_sent_again(rig, kind):
    rig.live(0.005)
    rig.adapter.inject(kind)
    state = rig.arrive(0.02)
    assert state.outcome is MoveOutcome.REACHED
    assert [order.position for order in rig.orders()] == [149, 149]


@both_variants
def test_a_late_reply_shifts_nothing(rig):
    rig.gripper.move(0.0, 0.05)
    rig.live(0.1)
    for _ in range(6):
        rig.adapter.inject(FaultKind.LATE)
        for _ in range(10):
            rig.gripper.turn()
        age = rig.clock.now() - rig.state.stamp
        assert rig.state.opening - rig.emulated.jaws.opening < 0.05 * (age + 0.055) + COUNT


@both_variants
def test_hold_after_a_gap_does_not_bring_the_jaws_back(rig):
    rig.arrive(0.045)
    rig.gripper.move(0.0, 0.1)
    rig.live(0.1)
    rig.adapter.inject(FaultKind.LOST, 4)
    rig.live(0.16)
    place = rig.emulated.jaws.opening
    rig.gripper.hold()
    rig.live(0.5)
    assert rig.emulated.jaws.opening < place + COUNT
    assert rig.emulated.jaws.opening > 0.005
    assert rig.state.phase is Phase.READY


@both_variants
def test_hold_aims_at_where_the_jaws_are_by_now(rig):
    rig.gripper.move(0.0, 0.1)
    rig.live(0.2)
    rig.clock.wait(0.018)
    begin, place = rig.clock.now(), rig.gripper.settings.counts_of(rig.emulated.jaws.opening)
    rig.gripper.hold()
    rig.live(0.1)
    # 0.1 m/s are 10 counts in the 18 ms that the last reply is old
    assert [order.position for order in rig.orders(begin)] == [pytest.approx(place, abs=3)]


@both_variants
def test_an_order_waits_until_requests_and_replies_are_in_step(rig):
    rig.live(0.5)
    rig.adapter.inject(FaultKind.LOST)
    turn = 0.0
    while turn < 0.049:  # until one has waited for its reply in vain
        begin = rig.clock.now()
        rig.gripper.turn()
        turn = rig.clock.now() - begin
    begin = rig.clock.now()
    rig.gripper.move(0.02, 0.1)
    rig.live(0.1)
    messages = rig.sent(begin)
    assert messages[0].remote
    assert len(rig.orders(begin)) == 1


@both_variants
def test_an_order_waits_for_a_link_that_gets_into_step_by_a_pause(variant):
    rig = Rig(variant, reply_timeout=0.005)
    send = rig.bus.send
    rig.bus.send = lambda message: None if message.remote else send(message)
    rig.adapter.inject(FaultKind.LOST)
    begin = rig.clock.now() + 0.02  # a reply and two markers were waited for, the last reply is still new
    rig.at(begin, lambda: rig.gripper.move(0.02, 0.1))
    rig.live(0.8)
    assert rig.sent(begin)[0].data == b""
    assert len(rig.orders(begin)) == 1


@both_variants
def test_an_order_waits_while_a_reply_is_in_doubt(variant):
    rig = Rig(variant, latency=0.0)
    rig.emulated.calibrated = False
    count = len(rig.messages(Command.MOVE))
    while len(rig.messages(Command.MOVE)) == count:
        rig.gripper.turn()
    assert rig.state.phase is Phase.READY  # not believed yet
    rig.gripper.move(0.02, 0.1)
    rig.live(0.3)
    assert rig.state.phase is Phase.UNCALIBRATED
    assert rig.orders() == []


@both_variants
def test_an_order_does_not_leave_on_the_word_of_an_old_reply(rig):
    rig.clock.wait(0.3)  # something stopped the driver
    begin = rig.clock.now()
    rig.gripper.move(0.02, 0.1)
    rig.live(0.1)
    messages = rig.sent(begin)
    assert messages[0].data == b""
    assert len(rig.orders(begin)) == 1
