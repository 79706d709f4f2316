"""Claims about the blocking grasp by force on the emulated gripper, in stepped time, with both firmware variants."""

import heapq
from itertools import count

import numpy as np
import pytest
from emulator_faults import FaultyAdapter, FaultyBus

from finforce_driver.errors import GraspError
from finforce_driver.grasp.force_monitor import ForceSample
from finforce_driver.grasp.session import hold_force
from finforce_driver.gripper import Gripper
from finforce_driver.settings import GraspGoal
from finforce_driver.state import GraspPhase, Phase
from finforce_sim.emulator.adapter import EmulatedAdapter
from finforce_sim.emulator.firmware import EmulatedGripper
from finforce_sim.emulator.virtual import VirtualBus, VirtualClock

STIFFNESS, WIDTH, LATENCY, NOISE = 1300.0, 0.025, 0.06, 0.05


def press(opening):
    return STIFFNESS * max(0.0, WIDTH - opening)


class Lab:
    """A calibrated gripper open before an object, and a camera that sees the elastic force."""

    def __init__(self, variant):
        self.emulated = EmulatedGripper(variant)
        self.clock = VirtualClock()
        self.adapter = FaultyAdapter(self.emulated)
        self.bus = FaultyBus(self.adapter, self.clock)
        self.gripper = Gripper(self.bus, clock=self.clock)
        self.gripper.wait(lambda state: state.phase is Phase.UNCALIBRATED, 5.0)
        self.gripper.calibrate()
        self.gripper.wait(lambda state: state.phase is Phase.READY, 40.0)
        self.gripper.move(WIDTH + 0.002, speed=0.1)
        self.gripper.wait(lambda state: state.phase is Phase.READY and state.at_target, 10.0)
        self.emulated.jaws.load = press
        self.blind = self.broken = False
        self.forces, self.actions = [], {}
        self._random = np.random.default_rng(1)
        self._next, self._queue, self._order = 0.0, [], count()
        self.begin = self.clock.now()
        self.clock.attach(self)

    def step(self, dt):
        now = self.clock.now()
        self.forces.append(press(self.emulated.jaws.opening))
        for when in [when for when in self.actions if now - self.begin > when]:
            self.actions.pop(when)(self)
        if now >= self._next:
            self._next = now + 1 / 30
            seen = abs(self.forces[-1] + NOISE * self._random.standard_normal())
            sample = ForceSample(stamp=now, arrived=now + LATENCY, force=seen)
            if not self.blind:
                heapq.heappush(self._queue, (now + LATENCY, next(self._order), sample))

    def take(self):
        if self.broken:
            raise RuntimeError("the source is broken")
        ready = []
        while self._queue and self._queue[0][0] <= self.clock.now():
            ready.append(heapq.heappop(self._queue)[2])
        return ready

    def grasp(self, force=2.0, seconds=8.0, **goal):
        end = self.begin + seconds
        return hold_force(
            self.gripper, self.take, GraspGoal(force=force, **goal), until=lambda status: self.clock.now() > end
        )

    def assert_stands(self):
        """The jaws stay where they are from now on."""
        self.clock.wait(0.05)
        for _ in range(10):
            self.gripper.turn()
        before = self.emulated.jaws.opening
        for _ in range(100):
            self.gripper.turn()
        assert self.emulated.jaws.opening == pytest.approx(before, abs=1e-4)  # half a step


@pytest.fixture(params=["new", "old"])
def lab(request):
    return Lab(request.param)


@pytest.mark.parametrize("force", [1.0, 5.0])
def test_force_is_reached_and_held_without_overshoot(lab, force):
    status = lab.grasp(force)
    assert status.phase is GraspPhase.HOLDING
    assert max(lab.forces) < force + 0.15  # what a chip that broke 0.43 N above its force would want
    assert lab.forces[-1] == pytest.approx(force, abs=STIFFNESS * lab.gripper.resolution)
    assert not lab.emulated.violations


def test_call_returns_when_the_force_is_held(lab):
    status = hold_force(lab.gripper, lab.take, GraspGoal(force=2.0))
    assert status.phase is GraspPhase.HOLDING
    assert lab.clock.now() - lab.begin < 4.0
    lab.assert_stands()


def test_silent_camera_ends_the_call_and_the_jaws_hold(lab):
    lab.actions[1.0] = lambda lab: setattr(lab, "blind", True)
    with pytest.raises(GraspError, match="old"):
        lab.grasp()
    assert lab.clock.now() - lab.begin < 1.0 + 0.25 + 0.1
    lab.assert_stands()
    assert lab.gripper.state.phase in (Phase.READY, Phase.MOVING)


def test_emergency_stop_ends_the_call(lab):
    lab.actions[1.0] = lambda lab: lab.gripper.estop()
    with pytest.raises(GraspError, match="emergency stop"):
        lab.grasp()
    last = lab.bus.sent[-1][0]
    assert lab.clock.now() - last < 0.1


def test_unplugged_adapter_ends_the_call(lab):
    lab.actions[1.0] = lambda lab: lab.adapter.unplug()
    with pytest.raises(GraspError, match="gripper|no reply"):
        lab.grasp()
    assert lab.clock.now() - lab.begin < 1.6


def test_error_of_the_source_leaves_the_jaws_holding(lab):
    lab.actions[1.0] = lambda lab: setattr(lab, "broken", True)
    with pytest.raises(RuntimeError, match="broken"):
        lab.grasp()
    lab.assert_stands()


def test_gripper_that_is_not_calibrated_is_not_moved():
    emulated, clock = EmulatedGripper(), VirtualClock()
    gripper = Gripper(VirtualBus(EmulatedAdapter(emulated), clock), clock=clock)
    gripper.wait(lambda state: state.phase is Phase.UNCALIBRATED, 5.0)
    before = emulated.jaws.opening
    with pytest.raises(GraspError, match="uncalibrated"):
        hold_force(gripper, list, GraspGoal(force=1.0))
    assert emulated.jaws.opening == before
