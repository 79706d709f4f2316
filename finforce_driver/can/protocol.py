"""Classic CAN messages, what carries them, and the gripper's own to the bit: commands out, replies in.

Identifiers are (node << 7) | (command << 1) | error. Multi-byte values are big-endian.
"""

from __future__ import annotations

import struct
from abc import ABC, abstractmethod
from collections import Counter, deque
from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum
from threading import Lock
from time import monotonic
from typing import Any

from finforce_driver.errors import LinkError, TargetError

LARGEST_ID = 0x7FF  # 11 bits; the gripper misreads longer ones
LARGEST_DATA = 8


@dataclass(frozen=True, kw_only=True)
class CanMessage:
    """One CAN 2.0A message.

    Attributes:
        id: identifier of 11 bits.
        data: 0 to 8 bytes; none in a remote message.
        remote: True if it asks for a message instead of being one.
    """

    id: int
    data: bytes = b""
    remote: bool = False

    @property
    def node(self) -> int:
        """Node of the gripper, 0 to 15."""
        return self.id >> 7 & 0xF

    @property
    def command(self) -> int:
        """Command of the gripper, 0 to 63."""
        return self.id >> 1 & 0x3F


class Bus(ABC):
    """A carrier of messages; opened and closed again and again.

    `send` may be called from any thread while another one waits in `receive`.

    Args:
        name: of the port, for errors.
    """

    def __init__(self, name: str) -> None:
        self._name = name
        self._port: Any = None
        self._messages: deque[CanMessage] = deque()
        self._counts: Counter[str] = Counter()
        self._reading, self._writing = Lock(), Lock()

    def open(self) -> None:
        """Open the port and join the bus; one that is open is opened anew.

        Raises:
            LinkError: the port is absent, busy or may not be opened.
            MissingDependencyError: the library for it is not installed.
        """
        self.close()
        with self._reading, self._writing:
            self._port = self._connect()
            self._counts["opened"] += 1

    def close(self) -> None:
        """Leave the bus and close the port, also one that is gone; a `receive` under way ends first. Never raises."""
        with self._reading, self._writing:
            if self._port is not None:
                self._disconnect(self._port)
            self._port = None
            self._messages.clear()

    def send(self, message: CanMessage) -> None:
        """Put a message on the way.

        Raises:
            LinkError: the port is closed or gone, or takes nothing.
        """
        with self._writing:
            self._write(self._opened(), message)
            self._counts["sent"] += 1

    def receive(self, timeout: float) -> CanMessage | None:
        """Return the next message as soon as it is there, None when none came within `timeout` [s].

        Raises:
            LinkError: the port is closed or gone.
        """
        end = monotonic() + timeout
        with self._reading:
            while not self._messages:
                left = max(0.0, end - monotonic())
                self._messages.extend(self._read(self._opened(), left))
                if not self._messages and left == 0.0:
                    return None
            return self._messages.popleft()

    @property
    def counts(self) -> Counter[str]:
        """Events since the bus was made: `opened`, `sent`, `messages`, and what was received that is none."""
        return self._counts.copy()

    @property
    def suspicion(self) -> str:
        """The likely fault of the link, in a sentence of advice; empty without one."""
        return ""

    def _opened(self) -> Any:
        if self._port is None:
            raise LinkError(f"{self._name} is not open: expected open() first")
        return self._port

    @abstractmethod
    def _connect(self) -> Any:
        """Return the port, opened; raises as `open`."""

    @abstractmethod
    def _disconnect(self, port: Any) -> None:
        """Leave the bus and close a port in whichever state, without raising."""

    @abstractmethod
    def _write(self, port: Any, message: CanMessage) -> None:
        """Put a message on the way, whole, at once; raises as `send`."""

    @abstractmethod
    def _read(self, port: Any, timeout: float) -> Sequence[CanMessage]:
        """Return what has come as soon as something is there, nothing after `timeout` [s]; raises as `receive`."""


LARGEST_NODE = 15
LARGEST_BYTE = 255
LARGEST_CURRENT_MA = 2800  # ceiling of the power stage
AT_TARGET = 3
CONTACT = (1, 2)  # which of them means closing depends on the firmware: the current's sign tells


class Command(IntEnum):
    """The purpose of a message."""

    ESTOP = 0
    CLEAR = 1
    HEARTBEAT = 9
    PING = 10
    IDLE = 12
    RESET = 14
    WATCHDOG = 15
    TEMPERATURE = 23
    SUPPLY = 24
    ERRORS = 26
    CURRENT = 27
    ENCODER = 28
    REPLY = 60
    MOVE = 61
    CALIBRATE = 62


class Flag(IntEnum):
    """Bits of the last byte of a move."""

    ACTIVATE = 0x80
    GO = 0x40
    ESTOP = 0x20
    OFF = 0x00


FREE_FLAGS = 0x0F  # without meaning, but a message that differs in them is a new command
_MOVE, _REPLY = struct.Struct(">BBhB"), struct.Struct(">BhB")


@dataclass(frozen=True, kw_only=True)
class Move:
    """The content of a 5-byte command 61.

    Attributes:
        position: 0 open to 255 closed.
        speed: 0 to 255, linear in 40 to 80000 encoder ticks per second.
        current_mA: current limit [mA].
        flags: of `Flag`, and the free ones.
    """

    position: int
    speed: int
    current_mA: int
    flags: int

    @property
    def activated(self) -> bool:
        """True if the power stage may move the jaws."""
        return bool(self.flags & Flag.ACTIVATE)

    @property
    def action(self) -> bool:
        """True if it orders a motion to the position."""
        return bool(self.flags & Flag.GO)

    @property
    def estop(self) -> bool:
        """True if it asks for an emergency stop."""
        return bool(self.flags & Flag.ESTOP)

    @property
    def drives(self) -> bool:
        """True if the gripper would move by it."""
        return self.activated and self.action and not self.estop


@dataclass(frozen=True, kw_only=True)
class Reply:
    """The content of a reply 60.

    Attributes:
        time: when it came [s].
        position: 0 open to 255 closed, truncated; without meaning while not calibrated.
        current_mA: of the motor [mA], negative when it drives closed.
        activated: echo of the last 5-byte command.
        action: echo of the last 5-byte command.
        code: 0 moving, 1 or 2 contact, 3 at the target.
        overheated: over-temperature is latched.
        watchdog: the watchdog is latched.
        estopped: the E-stop of a command 61 is latched; that of command 0 shows in `error` alone.
        calibrated: the end stops are known.
        error: any fault is latched.
    """

    time: float
    position: int
    current_mA: int
    activated: bool
    action: bool
    code: int
    overheated: bool
    watchdog: bool
    estopped: bool
    calibrated: bool
    error: bool

    @property
    def faults(self) -> tuple[bool, ...]:
        """The faults in the reply."""
        return self.error, self.overheated, self.watchdog, self.estopped

    @property
    def driving(self) -> bool:
        """True if the power stage moves or holds the jaws."""
        return self.activated and self.action and not self.error

    @property
    def contact(self) -> bool:
        """True if the motor pushes without getting on."""
        return self.code in CONTACT

    @property
    def at_target(self) -> bool:
        """True if the gripper takes itself to be where it was sent."""
        return self.code == AT_TARGET


# bit of byte 0 of the error state; 0x80 says only that there is a fault
FAULT_BITS = (
    (0x40, "temperature"),
    (0x20, "encoder"),
    (0x10, "supply"),
    (0x08, "driver"),
    (0x04, "velocity"),
    (0x02, "current"),
    (0x01, "E-stop"),
)
MOTOR_CALIBRATED = 0x80  # bit of byte 1
WATCHDOG = 0x20  # bit of byte 1


def encode(node: int, command: int, data: bytes = b"", *, remote: bool = False) -> CanMessage:
    """Return a message of the host to a gripper; a remote one asks for a value, which comes with the same command.

    An empty command 61 changes nothing and is always answered; no other command with or without data is.
    """
    return CanMessage(id=node << 7 | command << 1, data=data, remote=remote)


def encode_move(node: int, move: Move) -> CanMessage:
    """Return a 5-byte command 61.

    Raises:
        TargetError: a value is out of range; the gripper checks nothing itself.
    """
    for name, low, high in (
        ("position", 0, LARGEST_BYTE),
        ("speed", 0, LARGEST_BYTE),
        ("current_mA", 1, LARGEST_CURRENT_MA),
        ("flags", 0, LARGEST_BYTE),
    ):
        if not low <= getattr(move, name) <= high:
            raise TargetError(f"{name} of a move: got {getattr(move, name)}, expected {low} to {high}")
    return encode(node, Command.MOVE, _MOVE.pack(move.position, move.speed, move.current_mA, move.flags))


def encode_watchdog(node: int, seconds: float) -> list[CanMessage]:
    """Return what sets the gripper's watchdog [s], 0 for none: in the form of newer firmware and in that of older.

    Each takes the form that it knows and ignores the other one; neither is answered.
    """
    data = struct.pack(">i", round(1e3 * seconds))
    return [encode(node, Command.WATCHDOG, form) for form in (data + b"\x00", data)]


def decode_move(message: CanMessage) -> Move:
    """Return the content of a 5-byte command 61, of whichever master."""
    position, speed, current, flags = _MOVE.unpack(message.data)
    return Move(position=position, speed=speed, current_mA=current, flags=flags)


def decode_reply(message: CanMessage, time: float) -> Reply:
    """Return the content of a reply 60 that came at a time [s]."""
    position, current, status = _REPLY.unpack(message.data)
    return Reply(
        time=time,
        position=position,
        current_mA=current,
        activated=bool(status & 0x80),
        action=bool(status & 0x40),
        code=status >> 5 & 1 | (status >> 4 & 1) << 1,  # low bit first on the wire
        overheated=bool(status & 0x08),
        watchdog=bool(status & 0x04),
        estopped=bool(status & 0x02),
        calibrated=bool(status & 0x01),
        error=bool(message.id & 1),
    )


def decode_temperature(message: CanMessage) -> float:
    """Return the temperature of the motor [deg C] in an answer to command 23."""
    return float(struct.unpack(">h", message.data)[0])


def decode_supply(message: CanMessage) -> float:
    """Return the voltage of the supply [V] in an answer to command 24."""
    return 1e-3 * struct.unpack(">H", message.data)[0]


def decode_encoder(message: CanMessage) -> int:
    """Return the count of the motor's encoder [ticks], 16384 a turn, in an answer to command 28."""
    return struct.unpack_from(">i", message.data)[0]


def decode_errors(message: CanMessage) -> tuple[str, ...]:
    """Return the names of the faults in an answer to command 26; none of a fault is the E-stop of a command 61."""
    first, second = message.data
    names = [name for bit, name in FAULT_BITS if first & bit]
    names += ["watchdog"] * bool(second & WATCHDOG) + ["motor not calibrated"] * (not second & MOTOR_CALIBRATED)
    return tuple(names)
