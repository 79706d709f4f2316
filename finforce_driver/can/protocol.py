"""Classic CAN messages, what carries them, and the gripper's own to the bit: commands out, replies in.

Multi-byte values are big-endian, flags are counted from the highest bit.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import IntEnum, IntFlag
from typing import Protocol

from finforce_driver.errors import CanMessageError

LARGEST_ID = 0x7FF  # 11 bits; the gripper misreads longer ones
LARGEST_DATA = 8


@dataclass(frozen=True, kw_only=True)
class CanMessage:
    """One CAN 2.0A message.

    Attributes:
        id: identifier of 11 bits.
        data: 0 to 8 bytes; none in a remote message.
        remote: whether it asks for a message instead of being one.
    """

    id: int
    data: bytes = b""
    remote: bool = False

    def __post_init__(self) -> None:
        """Refuse what no bus carries.

        Raises:
            CanMessageError: identifier or length is out of range, or a remote message has data.
        """
        if not 0 <= self.id <= LARGEST_ID:
            raise CanMessageError(f"CAN identifier {self.id:#x}: expected 0 to {LARGEST_ID:#x}, 11 bits")
        if len(self.data) > LARGEST_DATA:
            raise CanMessageError(f"CAN message with {len(self.data)} bytes: expected at most {LARGEST_DATA}")
        if self.remote and self.data:
            raise CanMessageError(f"remote CAN message with {len(self.data)} bytes: expected none")


class Bus(Protocol):
    """What carries messages; opened and closed again and again."""

    def open(self) -> None:
        """Open the port and join the bus.

        Raises:
            LinkError: the port is absent, busy or may not be opened.
        """

    def close(self) -> None:
        """Leave the bus and close the port, also one that is gone; never raises."""

    def send(self, message: CanMessage) -> None:
        """Put a message on the way; may be called from any thread.

        Raises:
            LinkError: the port is closed or gone.
        """

    def receive(self, timeout: float) -> CanMessage | None:
        """Return the next message, None when none came within `timeout` [s].

        Raises:
            LinkError: the port is closed or gone.
        """

    @property
    def counts(self) -> Mapping[str, int]:
        """What happened since the bus was made, by name: messages, lines that were no messages, refusals (BELL)."""

    @property
    def suspicion(self) -> str:
        """What seems wrong with the link, in a sentence of advice; "" when nothing does."""


LARGEST_NODE = 15
LARGEST_BYTE = 255
LARGEST_CURRENT_MA = 2800  # ceiling of the power stage
AT_TARGET = 3
CONTACT = (1, 2)  # which of them means closing depends on the firmware: the current's sign tells


class Command(IntEnum):
    """What a message is about."""

    ESTOP = 0
    CLEAR = 1
    HEARTBEAT = 9
    PING = 10
    SET_NODE = 11
    IDLE = 12
    SAVE = 13
    RESET = 14
    WATCHDOG = 15
    TEMPERATURE = 23
    SUPPLY = 24
    INFO = 25
    ERRORS = 26
    CURRENT = 27
    ENCODER = 28
    HEARTBEAT_PERIOD = 30
    REPLY = 60
    MOVE = 61
    CALIBRATE = 62


class Flag(IntFlag):
    """Bits of the last byte of a move."""

    ACTIVATE = 0x80
    GO = 0x40
    ESTOP = 0x20
    OFF = 0x00


FREE_FLAGS = 0x0F  # without meaning, but a message that differs in them is a new command


@dataclass(frozen=True, kw_only=True)
class Address:
    """The three parts of an identifier: node 0 to 15, command 0 to 63, and whether the sender is in error."""

    node: int
    command: int
    error: bool


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

    def __post_init__(self) -> None:
        """Refuse what the gripper would misread: it checks nothing itself.

        Raises:
            CanMessageError: a value is out of range.
        """
        for name, low, high in (
            ("position", 0, LARGEST_BYTE),
            ("speed", 0, LARGEST_BYTE),
            ("current_mA", 1, LARGEST_CURRENT_MA),
            ("flags", 0, LARGEST_BYTE),
        ):
            if not low <= getattr(self, name) <= high:
                raise CanMessageError(f"{name} of a move is {getattr(self, name)}; expected {low} to {high}")

    @property
    def drives(self) -> bool:
        """Whether the gripper would move by it."""
        return bool(self.flags & Flag.ACTIVATE and self.flags & Flag.GO and not self.flags & Flag.ESTOP)


@dataclass(frozen=True, kw_only=True)
class Reply:
    """The content of a reply 60.

    Attributes:
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
        """What the reply says of faults."""
        return self.error, self.overheated, self.watchdog, self.estopped

    @property
    def contact(self) -> bool:
        """Whether the motor pushes without getting on."""
        return self.code in CONTACT

    @property
    def at_target(self) -> bool:
        """Whether the gripper takes itself to be where it was sent."""
        return self.code == AT_TARGET


@dataclass(frozen=True, kw_only=True)
class ErrorReport:
    """The answer to command 26: names of the latched faults, and whether the motor was ever calibrated."""

    faults: tuple[str, ...]
    motor_calibrated: bool


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
MOTOR_CALIBRATED, WATCHDOG = 0x80, 0x20  # of byte 1


def identifier(node: int, command: int, error: bool = False) -> int:
    """Return the identifier (node << 7) | (command << 1) | error.

    Raises:
        CanMessageError: the node is not 0 to 15 or the command not 0 to 63.
    """
    if not 0 <= node <= LARGEST_NODE:
        raise CanMessageError(f"CAN node {node}: expected 0 to {LARGEST_NODE}")
    if not 0 <= command <= 63:
        raise CanMessageError(f"command {command}: expected 0 to 63")
    return node << 7 | int(command) << 1 | int(error)


def split_identifier(id: int) -> Address:
    """Return the parts of an identifier."""
    return Address(node=id >> 7 & 0xF, command=id >> 1 & 0x3F, error=bool(id & 1))


def encode_poll(node: int) -> CanMessage:
    """Return the empty command 61, which changes nothing and is always answered."""
    return CanMessage(id=identifier(node, Command.MOVE))


def encode_move(node: int, move: Move) -> CanMessage:
    """Return a 5-byte command 61."""
    current = move.current_mA.to_bytes(2, "big")
    return CanMessage(id=identifier(node, Command.MOVE), data=bytes((move.position, move.speed, *current, move.flags)))


def encode_command(node: int, command: Command) -> CanMessage:
    """Return a command without content; none of them is answered."""
    return CanMessage(id=identifier(node, command))


def encode_watchdog(node: int, seconds: float) -> list[CanMessage]:
    """Return what sets the gripper's watchdog [s], 0 for none: in the form of newer firmware and in that of older.

    Each takes the form that it knows and ignores the other one; neither is answered.
    """
    data = round(1e3 * seconds).to_bytes(4, "big", signed=True)
    return [CanMessage(id=identifier(node, Command.WATCHDOG), data=form) for form in (data + b"\x00", data)]


def encode_request(node: int, command: Command) -> CanMessage:
    """Return the remote message that asks for a value; the answer has the same command."""
    return CanMessage(id=identifier(node, command), remote=True)


def decode_move(message: CanMessage) -> Move:
    """Return the content of a 5-byte command 61, of whichever master.

    Raises:
        CanMessageError: it is no such message, or a value is out of range.
    """
    data = _content(message, Command.MOVE, 5)
    return Move(position=data[0], speed=data[1], current_mA=_signed(data[2:4]), flags=data[4])


def decode_reply(message: CanMessage) -> Reply:
    """Return the content of a reply 60.

    Raises:
        CanMessageError: it is none.
    """
    data = _content(message, Command.REPLY, 4)
    status = data[3]
    return Reply(
        position=data[0],
        current_mA=_signed(data[1:3]),
        activated=bool(status & 0x80),
        action=bool(status & 0x40),
        code=status >> 5 & 1 | (status >> 4 & 1) << 1,  # low bit first on the wire
        overheated=bool(status & 0x08),
        watchdog=bool(status & 0x04),
        estopped=bool(status & 0x02),
        calibrated=bool(status & 0x01),
        error=split_identifier(message.id).error,
    )


def decode_temperature(message: CanMessage) -> float:
    """Return the temperature of the motor [deg C].

    Raises:
        CanMessageError: it is no answer to command 23.
    """
    return float(_signed(_content(message, Command.TEMPERATURE, 2)))


def decode_supply(message: CanMessage) -> float:
    """Return the voltage of the supply [V].

    Raises:
        CanMessageError: it is no answer to command 24.
    """
    return 1e-3 * int.from_bytes(_content(message, Command.SUPPLY, 2), "big")


def decode_encoder(message: CanMessage) -> int:
    """Return the count of the motor's encoder [ticks], of all its turns since the start; 16384 are a turn.

    Raises:
        CanMessageError: it is no answer to command 28.
    """
    return _signed(_content(message, Command.ENCODER, 8)[:4])


def decode_errors(message: CanMessage) -> ErrorReport:
    """Return what is latched; no name beside a fault means the E-stop of a command 61.

    Raises:
        CanMessageError: it is no answer to command 26.
    """
    first, second = _content(message, Command.ERRORS, 2)
    names = [name for bit, name in FAULT_BITS if first & bit]
    if second & WATCHDOG:
        names.append("watchdog")
    if not second & MOTOR_CALIBRATED:
        names.append("motor not calibrated")
    return ErrorReport(faults=tuple(names), motor_calibrated=bool(second & MOTOR_CALIBRATED))


def _content(message: CanMessage, command: Command, length: int) -> bytes:
    """Return the data of a message that has to be of a command and of a length."""
    got = split_identifier(message.id).command
    if got != command or message.remote or len(message.data) != length:
        kind = "remote message" if message.remote else f"message of {len(message.data)} bytes"
        raise CanMessageError(f"{kind} of command {got}: expected {length} bytes of command {command:d}")
    return message.data


def _signed(data: bytes) -> int:
    """Return a signed number."""
    return int.from_bytes(data, "big", signed=True)
