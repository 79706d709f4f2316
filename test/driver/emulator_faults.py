"""What can go wrong on the way to a gripper and in it, injected by name or by a seeded plan."""

from __future__ import annotations

import math
import re
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from enum import Enum
from random import Random
from typing import Any

from finforce_driver.can.protocol import CanMessage, Command
from finforce_driver.errors import LinkError
from finforce_sim.emulator.adapter import EmulatedAdapter
from finforce_sim.emulator.control import VARIANTS
from finforce_sim.emulator.firmware import EmulatedGripper, Fault
from finforce_sim.emulator.virtual import VirtualBus

Pieces = list[tuple[float, bytes]]  # delays after the piece before [s], and what then comes

_DIGITS = b"0123456789ABCDEF"


def _split(line: bytes, random: Random) -> Pieces:
    """Return the line in two pieces, up to 20 ms apart."""
    cut = random.randrange(1, len(line))
    return [(0.0, line[:cut]), (random.uniform(0.001, 0.02), line[cut:])]


def _litter(line: bytes, random: Random) -> Pieces:
    """Return the line after random bytes, of which at least one is no ASCII."""
    return [(0.0, random.randbytes(random.randrange(1, 40)) + b"\xff" + random.choice((b"", b"\r")) + line)]


def _truncate(line: bytes, random: Random) -> Pieces:
    """Return the beginning of the line, with or without its end."""
    return [(0.0, line[: random.randrange(1, len(line) - 1)] + random.choice((b"", b"\r")))]


def _change_length(line: bytes, random: Random) -> Pieces:
    """Return a sound line of another number of data bytes."""
    length = random.choice([size for size in range(9) if size != int(line[4:5])])
    data = (line[5:-1] + b"00" * 8)[: 2 * length]
    return [(0.0, line[:4] + b"%d" % length + data + b"\r")]


def _intersperse_foreign(line: bytes, random: Random) -> Pieces:
    """Return the line after the reply of another node."""
    node = int(line[1:4], 16) >> 7
    other = random.choice([number for number in range(16) if number != node])
    return [(0.0, b"t%03X4%s\r" % (other << 7 | 0x78, random.randbytes(4).hex().upper().encode()) + line)]


def _flip(line: bytes, random: Random) -> Pieces:
    """Return the line with one hex digit turned into another one: a sound line that lies."""
    place = random.randrange(1, len(line) - 1)
    digit = random.choice([digit for digit in _DIGITS if digit != line[place]])
    return [(0.0, line[:place] + bytes([digit]) + line[place + 1 :])]


def _set_stale_code(line: bytes, _random: Random) -> Pieces:
    """Return a reply whose object code says at position, as it can right after a command."""
    if len(line) < 14:
        return [(0.0, line)]
    return [(0.0, line[:11] + b"%02X" % (int(line[11:13], 16) | 0x30) + line[13:])]


_LINE = re.compile(rb"[^\r\a]*[\r\a]")  # of the adapter
_COMMAND = re.compile(rb"[^\r]*\r|[^\r]+")  # of the host
_MESSAGE_LINES = (b"t", b"r")


class FaultKind(Enum):
    """What can be injected: the first ones spoil lines of the adapter, the others happen on the bus or the gripper."""

    LOST = "lost"
    LATE = "late"
    DOUBLED = "doubled"
    BELL = "bell"
    SPLIT = "split"
    GARBAGE = "garbage"
    TRUNCATED = "truncated"
    WRONG_LENGTH = "wrong length"
    FOREIGN = "foreign node"
    HEARTBEAT = "heartbeat"
    FLIPPED = "flipped digit"
    STALE_CODE = "stale code"
    REQUEST_LOST = "request lost"
    BLIP = "contact blip"
    REBOOT = "reboot"
    OVERHEATED = "overheated"
    SUPPLY = "supply"
    ENCODER = "encoder"
    WATCHDOG = "watchdog"
    SLIPPING = "calibration time-out"
    STUCK = "stuck position"
    UNPLUGGED = "unplugged"
    OTHER_MASTER = "other master"


LINE_FAULTS: dict[FaultKind, Callable[[bytes, Random], Pieces]] = {
    FaultKind.LOST: lambda line, random: [],
    FaultKind.LATE: lambda line, random: [(random.uniform(0.005, 0.12), line)],  # longer than drivers wait
    FaultKind.DOUBLED: lambda line, random: [(0.0, line + line)],
    FaultKind.BELL: lambda line, random: [(0.0, b"\a" + line)],
    FaultKind.SPLIT: _split,
    FaultKind.GARBAGE: _litter,
    FaultKind.TRUNCATED: _truncate,
    FaultKind.WRONG_LENGTH: _change_length,
    FaultKind.FOREIGN: _intersperse_foreign,
    FaultKind.HEARTBEAT: lambda line, random: [(0.0, b"t%03X0\r" % (int(line[1:4], 16) & 0x780 | 0x12) + line)],
    FaultKind.FLIPPED: _flip,
    FaultKind.STALE_CODE: _set_stale_code,
}


@dataclass(frozen=True, kw_only=True)
class PlannedFault:
    """One fault to come.

    Attributes:
        time: when it is injected, on the adapter's clock [s].
        kind: what it is.
        count: lines that it spoils in a row, for the kinds that spoil lines.
        duration: for which it lasts, for the kinds that end again [s].
    """

    time: float
    kind: FaultKind
    count: int = 1
    duration: float = 0.5


def draw_plan(
    seed: int, count: int, period: float, kinds: Sequence[FaultKind] = tuple(FaultKind)
) -> list[PlannedFault]:
    """Return `count` random faults, one in each `period` [s], the same ones for the same seed."""
    random = Random(seed)
    return [
        PlannedFault(
            time=(index + random.random()) * period,
            kind=random.choice(kinds),
            count=random.choice((1, 1, 1, 2, 3, 8)),
            duration=random.uniform(0.05, 1.0),
        )
        for index in range(count)
    ]


class FaultyAdapter(EmulatedAdapter):
    """An adapter with faults: those of a plan as time passes, and those injected at once.

    Attributes:
        injected: all faults so far with their times [s].
    """

    def __init__(
        self,
        gripper: EmulatedGripper,
        plan: Sequence[PlannedFault] = (),
        seed: int = 0,
        **options: Any,
    ) -> None:
        """Make an adapter.

        Args:
            gripper: on the bus.
            plan: faults to come.
            seed: of the details: where a line is cut, which digit flips.
            options: of `EmulatedAdapter`.
        """
        self._spoiled: deque[tuple[float, bytes]] = deque()
        self.plugged, self._blip_until, self._blip_current = True, 0.0, 0
        super().__init__(gripper, **options)
        self.injected: list[PlannedFault] = []
        self._plan = deque(sorted(plan, key=lambda fault: fault.time))
        self._random = Random(seed)
        self._armed: deque[FaultKind] = deque()
        self._requests_to_lose = 0
        self._lasting: dict[FaultKind, tuple[float, Callable[[], None]]] = {}
        self._happenings: dict[FaultKind, Callable[[PlannedFault], None]] = {
            FaultKind.REQUEST_LOST: self._lose_requests,
            FaultKind.BLIP: lambda _fault: self.blip(),
            FaultKind.REBOOT: lambda _fault: gripper.reboot(),
            FaultKind.OVERHEATED: lambda fault: self._hold(fault, gripper.protection, "temperature", 91.0),
            FaultKind.SUPPLY: lambda fault: self._hold(fault, gripper.protection, "voltage", 8.2),
            FaultKind.ENCODER: lambda fault: self._hold(fault, gripper.protection, "magnet", False),
            FaultKind.WATCHDOG: lambda _fault: gripper.faults.add(Fault.WATCHDOG),
            FaultKind.SLIPPING: lambda fault: self._hold(fault, gripper.jaws, "slips", True),
            FaultKind.STUCK: lambda fault: self._hold(fault, gripper, "configured", False),
            FaultKind.UNPLUGGED: self._unplug,
            FaultKind.OTHER_MASTER: self._command_otherwise,
        }

    @property
    def has_output(self) -> bool:
        """Whether bytes wait for the host."""
        return bool(self._spoiled) or super().has_output

    def inject(self, kind: FaultKind, count: int = 1, duration: float = 0.5) -> None:
        """Inject a fault at once, or into the next lines.

        Args:
            kind: what happens.
            count: lines that it spoils in a row.
            duration: after which it ends [s], where it ends by itself.
        """
        fault = PlannedFault(time=self.now, kind=kind, count=count, duration=duration)
        self.injected.append(fault)
        if kind in LINE_FAULTS:
            self._armed.extend([kind] * count)
        else:
            self._happenings[kind](fault)

    def heal(self) -> None:
        """End all that lasts and disarm the rest; what the gripper has latched stays latched."""
        self._armed.clear()
        self._requests_to_lose = 0
        self._end_lasting(math.inf)

    def unplug(self) -> None:
        """Take the adapter off the host; its channel is closed, and the gripper keeps its own supply."""
        self._spoiled.clear()
        self.plugged, self._opened, self._rate, self._line = False, False, "", bytearray()
        self._output.clear()

    def replug(self) -> None:
        """Plug the adapter in again; it is closed."""
        self.plugged = True

    def put_on_bus(self, message: CanMessage) -> None:
        """Let another participant of the bus send a message: the gripper answers it, the host sees both."""
        for each in (message, *self.gripper.handle(message)):
            self.deliver(each)

    def blip(self, duration: float = 0.01) -> None:
        """Report contact with a high current for some time [s], as can happen at the start of a move."""
        gripper = self.gripper
        closes = gripper.endpoints.target(gripper.order.position) < gripper.jaws.encoder
        self._blip_current = int((-0.9 if closes else 0.9) * abs(gripper.order.current_mA))
        self._blip_until = self.now + duration

    @property
    def reported_current(self) -> int:
        """The current as it is reported [mA]."""
        return self._blip_current if self.now < self._blip_until - 1e-9 else self.gripper.reported_current

    def deliver(self, message: CanMessage) -> None:
        """Send a message to the host; during a blip with its current, and a reply with its code of contact."""
        if self.now < self._blip_until - 1e-9 and message.command in (Command.REPLY, Command.CURRENT):
            data, variant = message.data, VARIANTS[self.gripper.variant]
            code = variant.closing_code if self._blip_current < 0 else variant.opening_code
            status = bytes(byte & ~0x30 | 0x20 * (code & 1) | 0x10 * (code >> 1) for byte in data[3:])
            current = self._blip_current.to_bytes(2, "big", signed=True)
            message = replace(message, data=data[: len(data) // 4] + current + status)
        super().deliver(message)

    def write(self, data: bytes) -> None:
        """Take bytes from the host, whole lines of which may get lost."""
        if not self.plugged:
            return
        if not self._requests_to_lose:
            super().write(data)
            return
        for line in _COMMAND.findall(data):
            if self._requests_to_lose and line[:1] in _MESSAGE_LINES:
                self._requests_to_lose -= 1
            else:
                super().write(line)

    def read(self) -> bytes:
        """Return the bytes for the host that are due."""
        data = super().read()
        if self._armed or self._spoiled:
            for line in _LINE.findall(data):
                self._spoil(line)
            data = b""
            while self._spoiled and self._spoiled[0][0] <= self.now + 1e-9:
                data += self._spoiled.popleft()[1]
        return data

    def step(self, dt: float) -> None:
        """Let `dt` [s] pass, inject what the plan holds and end what lasted long enough."""
        super().step(dt)
        now = self.now
        while self._plan and self._plan[0].time <= now:
            fault = self._plan.popleft()
            self.inject(fault.kind, fault.count, fault.duration)
        if self._lasting:
            self._end_lasting(now)

    def _spoil(self, line: bytes) -> None:
        """Queue a line, spoiled if a fault is armed and the line is a message; later ones wait for it."""
        pieces: Pieces = [(0.0, line)]
        if self._armed and line[:1] in _MESSAGE_LINES:
            pieces = LINE_FAULTS[self._armed.popleft()](line, self._random)
        time = self.now
        for delay, data in pieces:
            time += delay
            self._spoiled.append((time, data))

    def _hold(self, fault: PlannedFault, owner: object, name: str, value: object) -> None:
        """Set an attribute for the duration of a fault."""
        before = getattr(owner, name)
        setattr(owner, name, value)
        self._end_later(fault, lambda: setattr(owner, name, before))

    def _end_later(self, fault: PlannedFault, end: Callable[[], None]) -> None:
        """Plan the end of a fault; one that lasts already lasts longer, and ends as it would have."""
        until = self.now + fault.duration
        if fault.kind in self._lasting:
            earlier, end = self._lasting[fault.kind]
            until = max(until, earlier)
        self._lasting[fault.kind] = (until, end)

    def _end_lasting(self, now: float) -> None:
        for kind in [kind for kind, (until, _) in self._lasting.items() if until <= now]:
            _, end = self._lasting.pop(kind)
            end()

    def _lose_requests(self, fault: PlannedFault) -> None:
        self._requests_to_lose += fault.count

    def _unplug(self, fault: PlannedFault) -> None:
        self.unplug()
        self._end_later(fault, self.replug)

    def _command_otherwise(self, _fault: PlannedFault) -> None:
        """Let another master move, stop, clear, calibrate or switch off the gripper."""
        node = self.gripper.node_id << 7
        position = self._random.randrange(256)
        commands = [
            CanMessage(id=node | 0x7A, data=bytes([position, 50, 0x01, 0xF4, 0xC0])),
            CanMessage(id=node | 0x7A, data=bytes([position, 50, 0x01, 0xF4, 0x00])),
            CanMessage(id=node | 0x00),
            CanMessage(id=node | 0x02),
            CanMessage(id=node | 0x18),
            CanMessage(id=node | 0x7C),
        ]
        self.put_on_bus(self._random.choice(commands))


class FaultyBus(VirtualBus):
    """A virtual bus that notices when its adapter is unplugged."""

    def _opened(self) -> FaultyAdapter:
        adapter = super()._opened()
        if not adapter.plugged:
            raise LinkError(f"{self._name}: it was unplugged, expected it to stay; plug it in and open the bus")
        return adapter

    def _connect(self) -> FaultyAdapter:
        if not self._adapter.plugged:
            raise LinkError(f"{self._name}: it is unplugged, expected it to be there; plug it in")
        return super()._connect()
