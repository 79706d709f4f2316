"""Claims about silence, lost links and what is told of them."""

import math

import pytest
from emulator_fakes import VARIANTS, Rig
from emulator_faults import FaultKind

from finforce_driver.can.protocol import Command
from finforce_driver.errors import GripperStateError, LinkError
from finforce_driver.gripper import Gripper
from finforce_driver.settings import GripperSettings
from finforce_driver.state import MoveOutcome, Phase
from finforce_sim.emulator.virtual import VirtualBus

both_variants = pytest.mark.parametrize("variant", VARIANTS)


@both_variants
def test_an_unplugged_adapter_is_told_at_once_and_found_again(rig):
    rig.gripper.move(0.0, 0.02)
    rig.live(0.3)
    rig.adapter.inject(FaultKind.UNPLUGGED, duration=3.0)
    rig.live(0.05)
    state = rig.state
    assert (state.phase, state.outcome) == (Phase.DISCONNECTED, MoveOutcome.ABORTED)
    assert "unplugged" in state.message
    assert math.isnan(state.opening) and math.isnan(state.stamp)
    begin = rig.clock.now()
    state = rig.wait_for(Phase.READY)
    assert rig.clock.now() - begin < 3.0 + 2.0
    assert state.opening == pytest.approx(rig.emulated.jaws.opening, abs=2e-4)
    assert "unplugged" not in state.message
    rig.live(1.0)
    assert rig.orders(begin) == []


def test_the_port_is_tried_again_after_growing_pauses():
    rig = Rig(found=False)
    rig.adapter.unplug()
    tries = []
    opened = rig.bus.open
    rig.bus.open = lambda: (tries.append(rig.clock.now()), opened())
    rig.live(30.0)
    pauses = [after - before for before, after in zip(tries, tries[1:], strict=False)]
    assert pauses[:5] == pytest.approx([0.5, 1.0, 2.0, 4.0, 5.0], abs=0.01)
    assert max(pauses) < 5.1
    assert "unplugged" in rig.state.message


def test_a_port_that_cannot_be_opened_says_why():
    rig = Rig(found=False)

    def refuse():
        raise LinkError("there is no port '/dev/ttyACM7': ports here: none")

    rig.bus.open = refuse
    rig.live(1.0)
    assert rig.state.message == "there is no port '/dev/ttyACM7': ports here: none"
    with pytest.raises(GripperStateError, match="no gripper answers.*ttyACM7"):
        rig.gripper.move(0.02)


def test_an_unexpected_error_of_the_bus_does_not_end_the_driver():
    rig = Rig()
    receive, rig.bus.receive = rig.bus.receive, lambda timeout: 1 / 0
    rig.live(0.1)
    assert "ZeroDivisionError" in rig.state.message
    rig.bus.receive = receive
    assert rig.wait_for(Phase.READY).message == "ready"


@both_variants
def test_silence_is_told_within_a_third_of_a_second_and_the_port_opened_anew(rig):
    rig.live(1.0)
    rig.emulated.handle = lambda message: []
    begin = rig.clock.now()
    state = rig.wait_for(Phase.DISCONNECTED)
    assert rig.clock.now() - begin < 0.35
    assert "check its 24 V" in state.message and "node_id" in state.message
    opened = []
    rig.bus.open, real = lambda: (opened.append(rig.clock.now()), real()), rig.bus.open
    rig.live(3.0)
    assert opened


def test_a_gripper_that_never_answered_is_told_after_a_second():
    rig = Rig(found=False)
    rig.emulated.handle = lambda message: []
    rig.live(0.5)
    assert rig.state.phase is Phase.PROBING
    rig.live(1.0)
    assert rig.state.phase is Phase.DISCONNECTED
    assert "check its 24 V" in rig.state.message


def test_a_wrong_node_id_is_named():
    rig = Rig(found=False, node_id=3)
    rig.live(6.0)
    assert "does at node 3: set node_id to 3" in rig.state.message
    assert rig.orders() == []
    assert all(message.remote or message.id == 0x07A for message in rig.sent())


@both_variants
def test_a_gripper_at_another_node_is_driven_there(variant):
    rig = Rig(variant, node_id=7, calibrated=False, found=False)
    rig = Rig(variant, node_id=0)
    assert rig.arrive(0.02).outcome is MoveOutcome.REACHED


@both_variants
def test_a_restart_of_the_gripper_ends_the_move_and_nothing_is_sent_after_it(rig):
    rig.gripper.move(0.0, 0.02)
    rig.live(0.3)
    begin = rig.clock.now()
    rig.adapter.inject(FaultKind.REBOOT)
    state = rig.wait_for(Phase.UNCALIBRATED)
    assert state.outcome is MoveOutcome.ABORTED
    assert "restarted: calibrate it" in state.message
    rig.live(2.0)
    assert math.isnan(rig.state.opening)
    assert rig.orders(begin) == [] and rig.messages(Command.CALIBRATE) == []


@both_variants
def test_an_order_that_could_not_leave_before_the_silence_never_leaves(rig):
    rig.adapter.inject(FaultKind.REQUEST_LOST, 12)
    rig.live(0.06)
    rig.gripper.move(0.0, 0.02)
    rig.live(3.0)
    place = rig.emulated.jaws.opening
    assert rig.state.phase is Phase.READY
    assert place == pytest.approx(0.048) or rig.state.outcome is not MoveOutcome.ABORTED


@both_variants
def test_an_adapter_without_remote_messages_does(rig):
    send = rig.bus.send
    rig.bus.send = lambda message: None if message.remote else send(message)
    for _ in range(5):
        rig.adapter.inject(FaultKind.LOST)
        rig.live(0.5)
        assert rig.state.phase is Phase.READY
    assert rig.arrive(0.01).outcome is MoveOutcome.REACHED
    assert math.isnan(rig.state.temperature) or rig.state.temperature == 26.0


@both_variants
def test_temperature_and_voltage_are_told(rig):
    rig.live(8.0)
    assert (rig.state.temperature, rig.state.voltage) == (26.0, pytest.approx(24.0))
    rig.emulated.protection.temperature, rig.emulated.protection.voltage = 61.0, 21.5
    rig.live(4.0)
    assert (rig.state.temperature, rig.state.voltage) == (61.0, pytest.approx(21.5))


@pytest.mark.parametrize("rate", [5.0, 50.0, 200.0])
def test_the_poll_rate_is_held_without_loss(rate):
    rig = Rig(poll_rate=rate, telemetry_period=3600.0)
    begin, count = rig.clock.now(), len(rig.states)
    rig.live(10.0)
    stamps = {state.stamp for state in rig.states[count:]}
    assert len(stamps) / (rig.clock.now() - begin) == pytest.approx(rate, rel=0.01)
    assert rig.state.counts.get("lost replies", 0) == 0


def test_lost_replies_are_counted():
    rig = Rig()
    rig.adapter.inject(FaultKind.LOST, 3)
    rig.live(1.0)
    assert rig.state.counts["lost replies"] == 3


def test_what_the_link_suspects_goes_before_general_advice(monkeypatch):
    rig = Rig(found=False)
    rig.adapter.inject(FaultKind.LOST, count=10_000)
    monkeypatch.setattr(type(rig.bus), "suspicion", "only garbage comes: wrong adapter speed?")
    rig.live(3.0)
    assert "wrong adapter speed?" in rig.state.message
    monkeypatch.setattr(type(rig.bus), "suspicion", "")
    other = Rig(found=False)
    other.adapter.inject(FaultKind.LOST, count=10_000)
    other.live(3.0)
    assert "check its 24 V" in other.state.message and "baud_rate" in other.state.message


def test_who_waits_for_a_gripper_that_was_closed_hears_of_it():
    rig = Rig()
    rig.gripper.close()
    with pytest.raises(GripperStateError, match="has ended"):
        rig.gripper.wait(lambda state: state.phase is Phase.MOVING, 5.0)


def states_since(rig, begin):
    return [state for state in rig.states if state.stamp >= begin]


@both_variants
def test_jaws_that_went_on_moving_without_a_link_are_held_and_never_said_to_be_ready(rig):
    rig.arrive(0.048)
    rig.gripper.move(0.0, 0.016)
    rig.live(0.3)
    rig.adapter.inject(FaultKind.UNPLUGGED, duration=0.3)
    begin = rig.clock.now()
    moved, ready = [], []
    last = rig.emulated.jaws.opening
    for _ in range(400):
        rig.live(0.01)
        moved.append(abs(rig.emulated.jaws.opening - last) > 2e-5)
        ready.append(rig.state.phase is Phase.READY)
        last = rig.emulated.jaws.opening
    assert any(moved) and not moved[-1]
    assert not any(was and is_ready for was, is_ready in zip(moved, ready, strict=True))
    assert rig.emulated.jaws.opening > 0.010  # it had 37 mm to go
    assert rig.state.phase is Phase.READY and "they are held" in rig.state.message
    assert rig.state.opening == pytest.approx(rig.emulated.jaws.opening, abs=2e-4)
    assert len(states_since(rig, begin)) > 10


@both_variants
def test_a_driver_that_is_started_anew_holds_what_the_last_one_left_moving(rig):
    rig.arrive(0.048)
    rig.gripper.move(0.0, 0.016)
    rig.live(0.5)
    again = Gripper(VirtualBus(rig.adapter, rig.clock), GripperSettings(), rig.clock)
    phases = set()
    for _ in range(60):
        again.turn()
        if again.state.phase is Phase.MOVING:
            phases.add("moving")
        moving = rig.emulated.jaws.opening
        again.turn()
        assert again.state.phase is not Phase.READY or abs(rig.emulated.jaws.opening - moving) < 5e-4
    again.wait(lambda state: state.phase is Phase.READY, 5.0)
    assert phases == {"moving"} and rig.emulated.jaws.opening > 0.010


@both_variants
def test_what_is_held_is_not_let_go_when_the_link_comes_back(rig):
    rig.arrive(0.048)
    rig.emulated.jaws.object_opening = 0.020
    rig.gripper.move(0.0, 0.03, 12.0)
    rig.live(3.0)
    before = rig.state.force
    rig.adapter.inject(FaultKind.UNPLUGGED, duration=0.3)
    begin = rig.clock.now()
    rig.live(0.2)
    rig.wait_for(Phase.READY)
    rig.live(1.0)
    assert rig.orders(begin) == []
    assert rig.state.force == pytest.approx(before, rel=0.1) and before > 8.0
