"""Classic CAN messages and what carries them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
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
        """Refuses what no bus carries.

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
