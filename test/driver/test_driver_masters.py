"""Claims about other programs on the bus."""

import pytest
from emulator_fakes import VARIANTS, Rig

from finforce_driver.can.protocol import CanMessage
from finforce_driver.state import MoveOutcome, Phase

both_variants = pytest.mark.parametrize("variant", VARIANTS)
ELSEWHERE = CanMessage(id=0x07A, data=bytes([60, 50, 0x01, 0xF4, 0xC0]))
OFF = CanMessage(id=0x07A, data=bytes([60, 50, 0x01, 0xF4, 0x00]))


@pytest.fixture
def rig(variant):
    rig = Rig(variant)
    rig.arrive(0.02)
    return rig


@both_variants
def test_an_order_of_another_program_that_is_seen_ends_our_move(rig):
    rig.gripper.move(0.0, 0.01)
    rig.live(0.3)
    begin = rig.clock.now()
    rig.adapter.put_on_bus(ELSEWHERE)
    rig.live(2.0)
    assert rig.state.outcome is MoveOutcome.ABORTED
    assert "another program commands this gripper" in rig.state.message
    assert rig.state.counts["foreign commands"] == 1
    assert rig.orders(begin) == []


@both_variants
@pytest.mark.parametrize("order", [ELSEWHERE, OFF])
def test_an_order_of_another_program_that_is_not_seen_is_found_by_its_effect(rig, order):
    rig.emulated.handle(order)  # through another adapter
    rig.live(2.0)
    begin = rig.clock.now()
    assert "does not do what it was told last" in rig.state.message
    rig.live(1.0)
    assert rig.orders(begin) == []


@both_variants
def test_a_new_move_takes_the_gripper_back(rig):
    rig.adapter.put_on_bus(ELSEWHERE)
    rig.live(0.5)
    assert rig.arrive(0.01).outcome is MoveOutcome.REACHED
    assert "another program" not in rig.state.message


@both_variants
def test_a_calibration_that_another_program_cuts_short_is_not_trusted(rig):
    rig.gripper.calibrate()
    rig.live(0.3)
    rig.adapter.put_on_bus(ELSEWHERE)
    rig.live(0.1)
    assert rig.state.phase is Phase.UNCALIBRATED


@both_variants
@pytest.mark.parametrize("id", [0x000, 0x002, 0x018, 0x07C])
def test_other_commands_of_another_program_are_told(rig, id):
    rig.adapter.put_on_bus(CanMessage(id=id))
    rig.live(0.05)
    assert rig.state.counts["foreign commands"] == 1
    assert "another program" in rig.state.message or rig.state.estopped


@both_variants
def test_messages_of_other_nodes_change_nothing(rig):
    before = rig.state
    for id in (0x0F8, 0x0FA, 0x7F9):
        rig.adapter.put_on_bus(CanMessage(id=id, data=b"\x10\x00\x00\xd1"))
    rig.live(0.5)
    assert rig.state.counts["messages of other nodes"] == 3
    assert (rig.state.opening, rig.state.phase, rig.state.message) == (before.opening, before.phase, before.message)


@both_variants
def test_an_adapter_that_gives_our_messages_back_is_no_other_program(rig):
    send = rig.bus.send

    def echo(message):
        rig.adapter.deliver(message)
        send(message)

    rig.bus.send = echo
    assert rig.arrive(0.01).outcome is MoveOutcome.REACHED
    assert "foreign commands" not in rig.state.counts


@both_variants
def test_jaws_that_are_pulled_away_from_their_target_are_no_sign_of_another_program(rig):
    rig.emulated.jaws.load = lambda opening: 60.0  # more than the current limit gives
    rig.live(0.05)
    assert rig.emulated.jaws.opening > 0.021
    rig.live(1.0)
    assert "foreign commands" not in rig.state.counts
    assert rig.state.outcome is MoveOutcome.REACHED
    assert rig.state.opening == pytest.approx(rig.emulated.jaws.opening, abs=2e-4)
