"""Claims about the emergency stop and its end."""

import pytest
from emulator_fakes import VARIANTS
from emulator_faults import FaultKind

from finforce_driver.can.protocol import Command, Flag
from finforce_driver.errors import GripperStateError
from finforce_driver.state import MoveOutcome, Phase
from finforce_sim.emulator.firmware import Fault

both_variants = pytest.mark.parametrize("variant", VARIANTS)
LATCHED = {Fault.ESTOP_COMMAND, Fault.ESTOP_FLAG}


def prepare(rig, what):
    """Bring the gripper into the middle of something."""
    if what == "moving":
        rig.gripper.move(0.0, 0.02)
    elif what == "stepping":
        rig.gripper.move(0.0, 0.002)
    elif what == "holding":
        rig.emulated.jaws.object_opening = 0.03
        rig.arrive(0.0)
    elif what == "calibrating":
        rig.gripper.calibrate()
    elif what == "uncalibrated":
        rig.emulated.reboot()
    rig.live(0.5)


@both_variants
@pytest.mark.parametrize("what", ["resting", "moving", "stepping", "holding", "calibrating", "uncalibrated"])
def test_a_stop_latches_at_once_and_no_motion_follows(rig, what):
    prepare(rig, what)
    begin = rig.clock.now()
    rig.gripper.estop()
    assert rig.state.estopped and rig.state.phase is Phase.FAULT
    rig.live(0.01)
    assert rig.emulated.faults >= LATCHED
    place = rig.emulated.jaws.opening
    rig.live(1.0)
    assert rig.emulated.jaws.opening == place
    assert not any(order.drives for order in rig.orders(begin))
    # repeated at most until the acknowledgement is believed
    assert 1 <= len(rig.orders(begin)) <= 3
    with pytest.raises(GripperStateError, match="clear the errors first"):
        rig.gripper.move(0.02)


@both_variants
def test_the_stops_messages_leave_before_estop_returns(rig):
    rig.gripper.estop()
    order, command = list(rig.bus.sent)[-2:]
    assert order[1].id == 0x07A and order[1].data[4] & Flag.ESTOP
    assert command[1].id == 0x000
    assert order[0] == command[0] == rig.clock.now()


@both_variants
def test_a_stop_aborts_the_move(rig):
    rig.gripper.move(0.0, 0.02)
    rig.live(0.2)
    rig.gripper.estop()
    assert rig.state.outcome is MoveOutcome.ABORTED


@both_variants
def test_the_stop_is_cleared_in_the_grippers_order(rig):
    rig.gripper.estop()
    rig.live(0.2)
    begin = rig.clock.now()
    rig.gripper.clear_errors()
    state = rig.wait_for(Phase.READY)
    commands = [message for message in rig.sent(begin) if not message.remote and (message.data or message.id != 0x07A)]
    assert [message.id for message in commands] == [0x07A, 0x002]
    assert commands[0].data[4] & 0xF0 == Flag.ACTIVATE
    assert (rig.emulated.faults, state.estopped) == (set(), False)


@both_variants
@pytest.mark.parametrize("kind", [FaultKind.LOST, FaultKind.REQUEST_LOST, FaultKind.BELL])
def test_a_stop_is_repeated_until_it_is_acknowledged(rig, kind):
    rig.gripper.move(0.0, 0.02)
    rig.live(0.2)
    rig.adapter.inject(kind, 5)
    begin = rig.clock.now()
    rig.gripper.estop()
    rig.live(1.0)
    assert rig.emulated.faults >= LATCHED
    assert not any(order.drives for order in rig.orders(begin))


@both_variants
def test_a_stop_without_a_link_is_sent_when_the_link_is_back(rig):
    rig.gripper.move(0.0, 0.005)
    rig.live(0.2)
    rig.adapter.inject(FaultKind.UNPLUGGED, duration=1.0)
    rig.gripper.estop()
    rig.live(0.5)
    assert rig.state.estopped and rig.state.phase is Phase.DISCONNECTED
    rig.live(2.0)
    assert rig.state.phase is Phase.FAULT
    assert rig.emulated.faults >= LATCHED


@both_variants
def test_a_stop_that_another_program_clears_is_sent_again(rig):
    rig.gripper.estop()
    rig.live(0.5)
    rig.emulated.protection.restart()
    rig.live(0.3)
    assert rig.emulated.faults >= LATCHED
    assert rig.state.estopped


@both_variants
def test_a_stop_outlives_a_restart_of_the_gripper(rig):
    rig.gripper.estop()
    rig.live(0.5)
    rig.emulated.reboot()
    rig.live(2.0)
    assert rig.emulated.faults >= LATCHED


@both_variants
def test_a_new_stop_ends_a_clearing(rig):
    rig.gripper.estop()
    rig.live(0.3)
    rig.gripper.clear_errors()
    rig.gripper.turn()
    rig.gripper.estop()
    rig.live(1.0)
    assert rig.state.estopped and rig.emulated.faults >= LATCHED


@both_variants
@pytest.mark.parametrize(
    "name, fault",
    [
        ("temperature", FaultKind.OVERHEATED),
        ("supply", FaultKind.SUPPLY),
        ("encoder", FaultKind.ENCODER),
        ("watchdog", FaultKind.WATCHDOG),
    ],
)
def test_faults_are_named_and_cleared(rig, name, fault):
    rig.gripper.move(0.0, 0.02)
    rig.live(0.3)
    rig.adapter.inject(fault, duration=0.2)
    rig.live(0.5)
    state = rig.state
    assert (state.phase, state.faults, state.outcome) == (Phase.FAULT, (name,), MoveOutcome.ABORTED)
    assert "clear the errors" in state.message
    assert not state.estopped
    rig.gripper.clear_errors()
    assert rig.wait_for(Phase.READY).faults == ()


@both_variants
def test_a_fault_that_persists_stays_a_fault(rig):
    rig.emulated.protection.voltage = 8.0
    rig.wait_for(Phase.FAULT)
    rig.gripper.clear_errors()
    rig.live(2.0)
    assert (rig.state.phase, rig.state.faults) == (Phase.FAULT, ("supply",))
    rig.emulated.protection.voltage = 24.0
    rig.gripper.clear_errors()
    rig.wait_for(Phase.READY)


@both_variants
def test_a_motor_that_was_never_calibrated_is_named(rig):
    rig.emulated.protection.motor_calibrated = False
    rig.wait_for(Phase.FAULT)
    rig.live(0.2)
    assert rig.state.faults == ("motor not calibrated",)


@both_variants
def test_clearing_without_a_fault_sends_nothing_since_it_would_let_go(rig):
    rig.emulated.jaws.object_opening = 0.03
    rig.arrive(0.0)
    begin = rig.clock.now()
    rig.gripper.clear_errors()
    rig.live(0.5)
    assert rig.messages(Command.CLEAR, begin) == [] and rig.orders(begin) == []
    assert rig.state.outcome is MoveOutcome.GRASPED


@both_variants
@pytest.mark.parametrize("kind", [FaultKind.LOST, FaultKind.REQUEST_LOST])
def test_clearing_survives_lost_messages(rig, kind):
    rig.gripper.estop()
    rig.live(0.3)
    rig.gripper.clear_errors()
    rig.adapter.inject(kind, 2)
    rig.wait_for(Phase.READY)
    rig.live(0.5)
    assert rig.emulated.faults == set()


@both_variants
def test_a_gripper_that_let_go_holds_nothing(rig):
    rig.arrive(0.048)
    rig.emulated.jaws.object_opening = 0.020
    assert rig.arrive(0.0, 0.03, 12.0).outcome is MoveOutcome.GRASPED
    rig.gripper.activate(False)
    rig.live(0.3)
    assert rig.state.outcome is MoveOutcome.NONE and "grasped" not in rig.state.message
