from threading import Event

import pytest
from emulator_fakes import VARIANTS
from emulator_faults import FaultKind, FaultyAdapter, FaultyBus

from finforce_driver.can.protocol import CanMessage
from finforce_driver.errors import LinkError
from finforce_sim.emulator.firmware import EmulatedGripper
from finforce_sim.emulator.virtual import VirtualClock

POLL = CanMessage(id=0x07A)
REPLY = CanMessage(id=0x078, data=bytes.fromhex("00000030"))


class Setup:
    def __init__(self, variant="new", **named):
        self.gripper = EmulatedGripper(variant)
        self.adapter = FaultyAdapter(self.gripper, **named)
        self.clock = VirtualClock()
        self.bus = FaultyBus(self.adapter, self.clock)


@pytest.fixture(params=VARIANTS)
def setup(request):
    made = Setup(request.param)
    made.bus.open()
    return made


@pytest.mark.parametrize("ack_mode", ["none", "lawicel"])
@pytest.mark.parametrize("latency", [0.0, 0.0005, 0.02])
def test_reply_comes_after_the_latency_and_time_passes_for_no_longer(ack_mode, latency):
    setup = Setup(ack_mode=ack_mode, latency=latency)
    setup.bus.open()
    setup.bus.send(POLL)
    assert setup.bus.receive(0.05) == REPLY
    assert setup.clock.now() == pytest.approx(latency, abs=0.001)  # one step


def test_without_a_reply_the_whole_timeout_passes(setup):
    assert setup.bus.receive(0.05) is None
    assert setup.clock.now() == pytest.approx(0.05, abs=1e-9)
    assert setup.gripper.now == pytest.approx(0.05, abs=1e-9)


def test_messages_that_came_together_are_returned_one_by_one(setup):
    setup.adapter.inject(FaultKind.DOUBLED)
    setup.bus.send(POLL)
    assert setup.bus.receive(0.05) == REPLY
    before = setup.clock.now()
    assert setup.bus.receive(0.05) == REPLY and setup.clock.now() == before


def test_waiting_ends_when_woken(setup):
    wake = Event()

    class Waker:
        def step(self, dt):
            if setup.clock.now() >= 0.02:
                wake.set()

    setup.clock.attach(Waker())
    setup.clock.wait(1.0, wake)
    assert setup.clock.now() == pytest.approx(0.02, abs=1e-9)
    setup.clock.wait(1.0, wake)
    assert setup.clock.now() == pytest.approx(0.02, abs=1e-9)


def test_closed_bus_takes_nothing(setup):
    setup.bus.close()
    setup.bus.close()
    with pytest.raises(LinkError, match="expected open"):
        setup.bus.send(POLL)
    with pytest.raises(LinkError, match="expected open"):
        setup.bus.receive(0.1)


def test_unplugging_is_felt_at_once_and_overcome_by_opening_again(setup):
    setup.adapter.inject(FaultKind.UNPLUGGED, duration=0.1)
    with pytest.raises(LinkError, match="unplugged"):
        setup.bus.send(POLL)
    with pytest.raises(LinkError, match="unplugged"):
        setup.bus.receive(0.1)
    setup.bus.close()
    with pytest.raises(LinkError, match="plug it in"):
        setup.bus.open()
    setup.clock.wait(0.11)
    setup.bus.open()
    setup.bus.send(POLL)
    assert setup.bus.receive(0.05) == REPLY


def test_unplugging_is_felt_while_waiting(setup):
    class Puller:
        def step(self, dt):
            if setup.clock.now() >= 0.02 and setup.adapter.plugged:
                setup.adapter.unplug()

    setup.clock.attach(Puller())
    with pytest.raises(LinkError, match="unplugged"):
        setup.bus.receive(1.0)
    assert setup.clock.now() == pytest.approx(0.02, abs=1e-9)


def test_half_a_line_from_before_does_not_spoil_the_first_reply(setup):
    setup.adapter._output.append((0.0, b"t0784"))
    assert setup.bus.receive(0.001) is None
    setup.bus.close()
    setup.bus.open()
    setup.bus.send(POLL)
    assert setup.bus.receive(0.05) == REPLY


def test_messages_from_before_are_forgotten_when_the_bus_is_opened_again(setup):
    setup.adapter.inject(FaultKind.DOUBLED)
    setup.bus.send(POLL)
    assert setup.bus.receive(0.05) == REPLY
    setup.bus.close()
    setup.bus.open()
    assert setup.bus.receive(0.05) is None


def test_what_was_sent_is_kept_with_its_time(setup):
    setup.clock.wait(0.25)
    setup.bus.send(POLL)
    ((time, message),) = setup.bus.sent
    assert message == POLL and time == pytest.approx(0.25, abs=1e-9)
    assert setup.bus.counts["messages"] == 0
    setup.bus.receive(0.05)
    assert setup.bus.counts["messages"] == 1


def test_a_wait_for_a_rest_of_rounding_ends():
    clock = VirtualClock()
    clock.wait(0.5)
    before = clock.now()
    clock.wait(1e-18)
    assert before < clock.now() < before + 1e-5
