"""Emulated grippers under test: hosts, adapters and drivers, in stepped and in real time."""

import itertools
import os
import select
import tty
from collections.abc import Callable
from pathlib import Path
from time import monotonic

from driver_node_fakes import call, start_driver, wrench
from emulator_faults import FaultyAdapter, FaultyBus
from geometry_msgs.msg import WrenchStamped
from sensor_msgs.msg import JointState
from std_srvs.srv import Trigger

from finforce_driver.can.protocol import Bus, CanMessage, Command, Reply, decode_move
from finforce_driver.can.slcan import decode_line, encode_message
from finforce_driver.gripper import Gripper
from finforce_driver.settings import GripperSettings
from finforce_driver.state import Phase
from finforce_sim.emulator.adapter import EmulatedAdapter
from finforce_sim.emulator.firmware import EmulatedGripper
from finforce_sim.emulator.pty_port import PtyPort
from finforce_sim.emulator.virtual import VirtualClock

VARIANTS = ("new", "old")
CLEAR, ESTOP, IDLE, RESET, CALIBRATE = "t0020", "t0000", "t0180", "t01C0", "t07C0"


class Host:
    """CanMessages in, messages out, in the gripper's own time."""

    def __init__(self, *arguments, **named):
        self.gripper = EmulatedGripper(*arguments, **named)

    def ask(self, line: str) -> list[str]:
        """Return the answers to a line of SLCAN, as such lines, a message's way of 0.2 ms later or not at all."""
        return [encode_message(answer)[:-1].decode() for answer in self.gripper.handle(decode_line(line.encode()))]

    def tell(self, *lines: str) -> None:
        """Send lines that nothing answers, a step apart."""
        for line in lines:
            assert self.ask(line) == []
            self.gripper.step()

    def poll(self) -> bytes:
        """Return the data of a reply to an empty request."""
        self.gripper.step()
        return self.gripper.handle(CanMessage(id=self.gripper.node_id << 7 | 0x7A))[0].data

    def order(self, position=0, speed=50, current=500, flags=0xC0) -> bytes:
        """Send five bytes and return the data of the reply."""
        data = bytes([position, speed]) + current.to_bytes(2, "big", signed=True) + bytes([flags])
        self.gripper.step()
        return self.gripper.handle(CanMessage(id=self.gripper.node_id << 7 | 0x7A, data=data))[0].data

    def wait(self, seconds: float) -> None:
        self.gripper.step(seconds)

    def calibrate(self) -> None:
        self.tell(CALIBRATE)
        self.wait(4.0)
        assert self.poll()[3] & 1


def calibrated_host(variant="new", **named) -> Host:
    """Return a host of a gripper that was calibrated on empty jaws and then got its object."""
    load, opening = named.pop("load", None), named.pop("object_opening", None)
    host = Host(variant, **named)
    host.calibrate()
    host.order(0, 255, 500)
    host.wait(1.0)
    host.gripper.jaws.load, host.gripper.jaws.object_opening = load, opening
    return host


def current_of(reply: bytes) -> int:
    """Return the current in a reply [mA]."""
    return int.from_bytes(reply[1:3], "big", signed=True)


def code_of(reply: bytes) -> int:
    """Return the wire bits of the object code in a reply."""
    return reply[3] & 0x30


class LineHost:
    """Bytes in, bytes out, through an emulated adapter."""

    def __init__(self, ack_mode="none", opened=True):
        self.adapter = FaultyAdapter(EmulatedGripper(), ack_mode=ack_mode, latency=0.0)
        if opened:
            self.say(b"C\rS8\rO\r")

    def say(self, data: bytes) -> bytes:
        """Return what the adapter says within a millisecond."""
        self.adapter.write(data)
        self.adapter.step(0.001)
        return self.adapter.read()


POLL = CanMessage(id=0x07A)
REPLY = CanMessage(id=0x078, data=bytes.fromhex("800000C1"))
REPLY_LINE = b"t0784800000C1\r"
LONG = 5.0  # [s] far beyond what anything here takes; nothing is measured with it
ENOUGH = 5.0  # [s] what was written on one side is there on the other at once; a machine under load may take its time


class FakeAdapter:
    """The adapter's end of a port; `link` is what the driver opens, and stays when the adapter is plugged in again."""

    def __init__(self, folder: Path) -> None:
        self.link = str(folder / "ttyFAKE")
        self._ends = ()
        self.plug()

    def plug(self) -> None:
        """Appear as a port."""
        master, slave = os.openpty()
        tty.setraw(slave)
        self._ends = (master, slave)
        os.symlink(os.ttyname(slave), self.link)

    def unplug(self) -> None:
        """Disappear, also under a driver that has the port open."""
        if self._ends:
            os.unlink(self.link)
            for end in self._ends:
                os.close(end)
            self._ends = ()

    def write(self, data: bytes) -> None:
        """Send bytes to the driver."""
        os.write(self._ends[0], data)

    def write_and_wait(self, data: bytes) -> None:
        """Send bytes to a driver that has not opened the port, and wait until they are there."""
        self.write(data)
        assert select.select([self._ends[1]], [], [], ENOUGH)[0]

    def read(self, ending: bytes = b"\r", least: int = 1) -> bytes:
        """Return what the driver sent, waiting until it ends so and has `least` bytes."""
        data = b""
        while not (data.endswith(ending) and len(data) >= least) and self._ready(ENOUGH):
            data += os.read(self._ends[0], 4096)
        return data

    def read_rest(self) -> bytes:
        """Return what the driver sent and nobody read yet."""
        data = b""
        while self._ready(0.0):
            data += os.read(self._ends[0], 4096)
        return data

    def _ready(self, timeout: float) -> bool:
        return bool(select.select([self._ends[0]], [], [], timeout)[0])


def receive_until(bus: Bus, condition: Callable[[], bool]) -> list[CanMessage]:
    """Return the messages that come until a condition holds; what is written here may take its time to be there."""
    end, messages = monotonic() + ENOUGH, []
    while not condition() and monotonic() < end:
        message = bus.receive(0.01)
        messages += [] if message is None else [message]
    assert condition()
    return messages


COUNT = 0.048 / 255  # [m]


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
        self.adapter = FaultyAdapter(self.emulated, latency=latency)
        self.bus = FaultyBus(self.adapter, self.clock)
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
        return [
            (time, decode_move(message))
            for time, message in self.bus.sent
            if time >= since and message.command == Command.MOVE and message.data
        ]

    def messages(self, command, since=0.0):
        return [message for message in self.sent(since) if message.id >> 1 & 0x3F == command]


def reply(**changes) -> Reply:
    """A reply of a calibrated gripper at rest, with changes."""
    parts = {"time": 0.0, "position": 100, "current_mA": 0, "activated": True, "action": True, "code": 3}
    flags = dict.fromkeys(("overheated", "watchdog", "estopped", "error"), False)
    return Reply(**{**parts, **flags, "calibrated": True, **changes})


def message_of(line: str) -> CanMessage:
    """The message of an SLCAN line."""
    remote = line[0] == "r"
    return CanMessage(id=int(line[1:4], 16), data=b"" if remote else bytes.fromhex(line[5:]), remote=remote)


# a machine that is busy with other things stops the emulation for a while, too
PATIENT = {"gripper.reply_timeout": 0.5, "grasp.stale_after": 1.0, "max_age": 1.0, "grasp.force_timeout": 5.0}


class GarbledAdapter(EmulatedAdapter):
    """An adapter whose serial line runs at another speed than the host's: both sides take bytes for others."""

    GARBLED = bytes(0x80 | (byte * 5 & 0x7F) for byte in range(256))

    def write(self, data):
        super().write(data.translate(self.GARBLED))

    def read(self):
        return super().read().translate(self.GARBLED)


class Bench:
    """An emulated gripper, its port, the driver node on it, and a probe that listens to both."""

    def __init__(self, probe, variant="new", *, calibrated=True, open_port=True, garbled=False, **parameters):
        self.probe = probe
        self.gripper = EmulatedGripper(variant)
        self.gripper.calibrated = calibrated
        self.port = PtyPort((GarbledAdapter if garbled else FaultyAdapter)(self.gripper))
        if open_port:
            self.port.open()
        port = self.port.path or "/dev/no_such_port"
        self.node = start_driver(probe, **{"port": port, **PATIENT, **parameters})
        self.joints = probe.got["joint_states"]
        self.command = probe.speak("/gripper_driver/command", JointState)
        probe.connected(self.command)

    def close(self):
        self.node.destroy_node()
        self.port.close()

    def call(self, name, kind=Trigger, request=None, patience=10.0):
        return call(self.probe, kind, name, request, patience)

    def wait_for_joints(self, count=1):
        """Wait for new joint states."""
        have = len(self.joints)
        self.probe.wait_for(lambda: len(self.joints) >= have + count)

    def move(self, opening, **fields):
        self.command.publish(JointState(position=[opening], **fields))

    def diagnosis(self, level, word):
        found = []

        def matches():
            states = [s for array in self.probe.got["/diagnostics"][-3:] for s in array.status]
            found[:] = [s for s in states if s.level[0] == level and word in s.message]
            return bool(found)

        self.probe.wait_for(matches)
        return found[-1]


class Fingers:
    """Soft fingers on an object, and the camera that sees their force 30 times a second."""

    STIFFNESS, TOUCH = 800.0, 0.0465  # N per m of opening; m

    def __init__(self, bench):
        self.bench = bench
        bench.gripper.jaws.load = self.force
        self.out = bench.probe.speak("grasp_wrench", WrenchStamped)
        bench.probe.connected(self.out)
        self.ripple = itertools.cycle((0.0, 1e-6, 2e-6))  # no camera sees the same to the last digit
        self.timer = bench.probe.create_timer(
            1.0 / 30.0, lambda: self.out.publish(wrench(self.present + next(self.ripple)))
        )

    def force(self, opening):
        return self.STIFFNESS * max(0.0, self.TOUCH - opening)

    @property
    def present(self):
        return self.force(self.bench.gripper.jaws.opening)
