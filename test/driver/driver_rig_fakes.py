"""The gripper driver on an emulated gripper, both in stepped time, with all that went over the bus."""

import sys
from pathlib import Path

from finforce_driver.can.bus import CanMessage
from finforce_driver.can.protocol import Reply, decode_move
from finforce_driver.emulator.adapter import EmulatedAdapter
from finforce_driver.emulator.faults import FaultyAdapter
from finforce_driver.emulator.firmware import EmulatedGripper
from finforce_driver.emulator.virtual import VirtualBus, VirtualClock
from finforce_driver.errors import CanMessageError
from finforce_driver.gripper import Gripper
from finforce_driver.settings import GripperSettings
from finforce_driver.state import Phase

VARIANTS = ("new", "old")
COUNT = 0.048 / 255  # [m]
sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "benchmarks"))  # for the oracle


class Later:
    """Does something once when its time has come."""

    def __init__(self, clock, time, action):
        self._clock, self._time, self._action = clock, time, action

    def step(self, _dt):
        if self._clock.now() >= self._time:
            self._time = float("inf")
            self._action()


class Rig:
    """A driver that has found its gripper; calibrated at once by the emulator's truth."""

    def __init__(self, variant="new", *, calibrated=True, found=True, latency=0.0005, node_id=0, **settings):
        self.clock = VirtualClock()
        self.emulated = EmulatedGripper(variant, node_id=node_id)
        self.emulated.calibrated = calibrated
        self.adapter = FaultyAdapter(EmulatedAdapter(self.emulated, latency=latency))
        self.bus = VirtualBus(self.adapter, self.clock)
        self.gripper = Gripper(self.bus, GripperSettings(**settings), self.clock)
        self.states = []
        self.gripper.listen(self.states.append)
        if found:
            self.wait_for(Phase.READY if calibrated else Phase.UNCALIBRATED)

    @property
    def state(self):
        return self.gripper.state

    def live(self, seconds):
        """Let time pass."""
        end = self.clock.now() + seconds
        while self.clock.now() < end - 1e-9:
            self.gripper.turn()

    def at(self, time, action):
        """Have something done at a time, whatever the driver is doing then."""
        self.clock.attach(Later(self.clock, time, action))

    def wait_for(self, *phases, patience=45.0):
        return self.gripper.wait(lambda state: state.phase in phases, patience)

    def arrive(self, opening, speed=0.1, force=None):
        """Move and return the state at the end."""
        self.gripper.move(opening, speed, force)
        return self.wait_for(Phase.READY, Phase.FAULT, Phase.UNCALIBRATED, Phase.DISCONNECTED)

    def sent(self, since=0.0):
        return [message for time, message in self.bus.sent if time >= since]

    def orders(self, since=0.0):
        """The 5-byte orders that were sent."""
        return [order for _, order in self.timed_orders(since)]

    def timed_orders(self, since=0.0):
        found = []
        for time, message in self.bus.sent:
            try:
                found += [(time, decode_move(message))] if time >= since else []
            except CanMessageError:
                continue
        return found

    def messages(self, command, since=0.0):
        return [message for message in self.sent(since) if message.id >> 1 & 0x3F == command]


def reply(**changes) -> Reply:
    """A reply of a calibrated gripper at rest, with changes."""
    parts = {"position": 100, "current_mA": 0, "activated": True, "action": True, "code": 3}
    flags = dict.fromkeys(("overheated", "watchdog", "estopped", "error"), False)
    return Reply(**{**parts, **flags, "calibrated": True, **changes})


def message_of(line: str) -> CanMessage:
    """The message of an SLCAN line."""
    remote = line[0] == "r"
    return CanMessage(id=int(line[1:4], 16), data=b"" if remote else bytes.fromhex(line[5:]), remote=remote)
