"""Claims about other programs on the bus."""

import pytest
from emulator_fakes import VARIANTS, Rig

from finforce_driver.can.protocol import CanMessage
from finforce_driver.errors import GripperStateError
from finforce_driver.state import MoveOutcome, Phase
from finforce_sim.emulator.control import Mode

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
    begin, before = rig.clock.now(), rig.emulated.jaws.opening
    rig.adapter.put_on_bus(ELSEWHERE)
    rig.live(2.0)
    assert rig.state.outcome is MoveOutcome.ABORTED
    assert (rig.state.phase, rig.state.calibrated) == (Phase.LOST, False)
    assert "another program commands this gripper" in rig.state.message
    assert rig.state.counts["foreign commands"] == 1
    (stop,) = rig.orders(begin)
    assert rig.emulated.jaws.opening == pytest.approx(0.048 * (1 - stop.position / 255), abs=4e-4)
    assert abs(rig.emulated.jaws.opening - before) < 0.001


@both_variants
def test_an_order_of_another_program_that_is_not_seen_is_found_by_its_effect(rig):
    before = rig.emulated.jaws.opening
    rig.emulated.handle(ELSEWHERE)  # through another adapter
    rig.live(2.0)
    begin = rig.clock.now()
    assert rig.state.phase is Phase.LOST
    assert "the jaws leave the way that they were ordered to go" in rig.state.message
    assert abs(rig.emulated.jaws.opening - before) < 0.006
    rig.live(1.0)
    assert rig.orders(begin) == []


@both_variants
def test_a_gripper_that_another_program_switched_off_stays_off(rig):
    rig.emulated.handle(OFF)
    rig.live(2.0)
    begin = rig.clock.now()
    assert "does not follow its last command" in rig.state.message
    assert (rig.state.phase, rig.state.activated) == (Phase.READY, False)
    rig.live(1.0)
    assert rig.orders(begin) == []


@both_variants
def test_a_gripper_that_another_program_moved_works_again_after_a_calibration(rig):
    rig.adapter.put_on_bus(ELSEWHERE)
    rig.live(0.5)
    with pytest.raises(GripperStateError, match="where the jaws are is not known: calibrate first"):
        rig.gripper.move(0.01)
    rig.gripper.calibrate()
    rig.wait_for(Phase.READY)
    assert rig.arrive(0.01).outcome is MoveOutcome.REACHED
    assert "another program" not in rig.state.message


@both_variants
def test_two_drivers_that_stop_each_other_come_to_rest(rig):
    rig.adapter.put_on_bus(ELSEWHERE)
    rig.live(0.5)
    begin = rig.clock.now()
    rig.adapter.put_on_bus(ELSEWHERE)
    rig.live(0.5)
    assert rig.orders(begin) == []
    assert rig.state.counts["foreign commands"] == 2


@both_variants
def test_a_calibration_that_nobody_ordered_is_not_believed(rig):
    rig.emulated.calibrated = False
    rig.wait_for(Phase.UNCALIBRATED)
    rig.emulated.calibrated = True
    rig.wait_for(Phase.LOST, patience=1.0)
    assert "not by this driver" in rig.state.message


@both_variants
def test_a_motor_that_runs_while_it_should_sleep_is_noticed(rig):
    rig.gripper.calibrate()
    rig.wait_for(Phase.READY)
    rig.emulated.handle(CanMessage(id=0x07C))
    rig.live(0.5)
    assert rig.state.phase is Phase.LOST
    assert rig.emulated.mode is not Mode.CALIBRATE


@both_variants
def test_a_calibration_that_another_program_cuts_short_is_not_trusted(rig):
    rig.gripper.calibrate()
    rig.live(0.3)
    rig.adapter.put_on_bus(ELSEWHERE)
    rig.live(0.1)
    assert rig.state.phase is Phase.LOST


@both_variants
@pytest.mark.parametrize("id", [0x000, 0x002, 0x018])
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
