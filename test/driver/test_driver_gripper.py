"""Claims about the gripper as a program uses it."""

import math
import threading
import time

import pytest
from emulator_fakes import COUNT, VARIANTS, Rig
from emulator_faults import FaultKind

from finforce_driver.can.protocol import Flag
from finforce_driver.can.slcan import SerialBus
from finforce_driver.errors import GripperTimeoutError, TargetError
from finforce_driver.gripper import Gripper
from finforce_driver.settings import GripperSettings
from finforce_driver.state import MoveOutcome, Phase
from finforce_sim.emulator.adapter import EmulatedAdapter
from finforce_sim.emulator.firmware import EmulatedGripper
from finforce_sim.emulator.pty_port import PtyPort

both_variants = pytest.mark.parametrize("variant", VARIANTS)


@pytest.fixture
def rig():
    return Rig()


def test_waiting_ends_with_the_state_or_with_what_is_wrong(rig):
    rig.gripper.move(0.0, 0.01)
    assert rig.gripper.wait(lambda state: state.opening < 0.04, 5.0).opening < 0.04
    with pytest.raises(GripperTimeoutError, match="not within 0.1 s: the gripper is moving"):
        rig.gripper.wait(lambda state: state.phase is Phase.READY, 0.1)


def test_every_believed_reply_and_change_of_phase_is_told_once(rig):
    count = len(rig.states)
    rig.live(1.0)
    told = rig.states[count:]
    assert len({state.stamp for state in told}) == len(told) == pytest.approx(50, abs=2)


def test_a_listener_that_fails_or_has_ended_disturbs_nobody(rig):
    def fail(_):
        raise ValueError

    heard = []
    end, other = rig.gripper.listen(fail), rig.gripper.listen(heard.append)
    rig.live(0.1)
    end()
    other()
    count = len(heard)
    rig.live(0.1)
    assert count >= 4 and len(heard) == count
    assert rig.state.phase is Phase.READY


def test_past_openings_are_known_for_five_seconds(rig):
    truth = []
    rig.gripper.move(0.0, 0.008)
    for _ in range(300):
        rig.gripper.turn()
        truth.append((rig.clock.now(), rig.emulated.jaws.opening))
    for when, opening in truth[20::7]:
        if when <= rig.state.stamp and when > rig.clock.now() - 5.0:
            assert rig.gripper.opening_at(when) == pytest.approx(opening, abs=0.8 * COUNT)
    rig.live(6.0)
    assert math.isnan(rig.gripper.opening_at(truth[20][0]))
    assert math.isnan(rig.gripper.opening_at(rig.clock.now() + 1.0))
    assert rig.gripper.opening_at(rig.clock.now()) == pytest.approx(rig.state.opening)


def test_an_opening_within_a_long_silence_is_unknown(rig):
    rig.live(1.0)
    before = rig.clock.now()
    rig.adapter.inject(FaultKind.LOST, 9)
    rig.live(1.5)
    assert math.isnan(rig.gripper.opening_at(before + 0.2))
    assert not math.isnan(rig.gripper.opening_at(before - 0.1))


@both_variants
def test_a_move_that_meets_something_holds_it_with_the_current_of_its_force(variant):
    rig = Rig(variant)
    rig.emulated.jaws.object_opening = 0.03
    state = rig.arrive(0.0, 0.05, 10.0)
    assert state.outcome is MoveOutcome.GRASPED
    assert state.force == pytest.approx(10.0, rel=0.03)
    assert rig.emulated.order.current_mA == 210


@pytest.mark.parametrize("force", [3.0, 80.0, math.nan, -10.0])
def test_forces_that_the_current_cannot_give_move_nothing(rig, force):
    with pytest.raises(TargetError, match="force"):
        rig.gripper.move(0.0, force=force)
    assert rig.orders() == []


@pytest.mark.parametrize("release", [False, True])
def test_the_end_of_the_driver_leaves_the_gripper_as_it_is_told_to(release):
    rig = Rig(release_on_stop=release)
    rig.gripper.move(0.0, 0.02)
    rig.live(0.5)
    rig.gripper.close()
    place, order = rig.emulated.jaws.opening, rig.emulated.order
    assert order.flags & (Flag.ACTIVATE | Flag.GO) == (0 if release else Flag.ACTIVATE | Flag.GO)
    rig.clock.wait(1.0)
    assert rig.emulated.jaws.opening == pytest.approx(place, abs=2 * COUNT)
    assert rig.state.phase is Phase.DISCONNECTED


def test_a_gripper_that_is_commanded_by_threads_in_real_time():
    emulated = EmulatedGripper()
    emulated.calibrated = True
    settings = GripperSettings(poll_rate=200.0, reply_timeout=0.5)
    with PtyPort(EmulatedAdapter(emulated)) as port, Gripper(SerialBus(port.path), settings) as gripper:
        gripper.wait(lambda state: state.phase is Phase.READY, 10.0)
        gripper.move(0.03, 0.1)
        state = gripper.wait(lambda state: state.phase is Phase.READY, 10.0)
        assert state.outcome is MoveOutcome.REACHED
        assert emulated.jaws.opening == pytest.approx(0.03, abs=COUNT)
        gripper.estop()
        gripper.wait(lambda _: len(emulated.faults) == 2, 10.0)


class SlowBus:
    """A bus on which the order that drives takes until it is let go, and that keeps what was written."""

    def __init__(self, rig):
        self._rig, self._send = rig, rig.bus.send
        self.written, self.begun, self.go_on = [], threading.Event(), threading.Event()

    def send(self, message):
        if len(message.data) == 5 and message.data[4] & 0xE0 == 0xC0:
            self.begun.set()
            self.go_on.wait(10.0)
        self.written.append(message)
        self._send(message)


def test_no_order_leaves_after_a_stop_that_another_thread_demands_meanwhile(rig):
    slow = SlowBus(rig)
    rig.bus.send = slow.send
    rig.gripper.move(0.0, 0.02)
    loop = threading.Thread(target=rig.live, args=(0.3,))
    loop.start()
    assert slow.begun.wait(10.0)
    stop = threading.Thread(target=rig.gripper.estop)
    stop.start()
    time.sleep(0.02)  # the stop waits for the write that is under way
    slow.go_on.set()
    loop.join()
    stop.join()
    driving = [
        index for index, message in enumerate(slow.written) if len(message.data) == 5 and message.data[4] & 0x20 == 0
    ]
    stopping = [
        index for index, message in enumerate(slow.written) if len(message.data) == 5 and message.data[4] & 0x20
    ]
    assert len(driving) == 1
    assert driving[0] < min(stopping)
