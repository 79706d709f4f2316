"""Classic CAN frames and what carries them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol

from finforce_driver.errors import FrameError

LARGEST_ID = 0x7FF  # 11 bits; the gripper misreads longer ones
LARGEST_DATA = 8


@dataclass(frozen=True, kw_only=True)
class Frame:
    """One CAN 2.0A frame.

    Attributes:
        id: identifier of 11 bits.
        data: 0 to 8 bytes; none in a remote frame.
        remote: whether it asks for a frame instead of being one.
    """

    id: int
    data: bytes = b""
    remote: bool = False

    def __post_init__(self) -> None:
        """Refuses what no bus carries.

        Raises:
            FrameError: identifier or length is out of range, or a remote frame has data.
        """
        if not 0 <= self.id <= LARGEST_ID:
            raise FrameError(f"CAN identifier {self.id:#x}: expected 0 to {LARGEST_ID:#x}, 11 bits")
        if len(self.data) > LARGEST_DATA:
            raise FrameError(f"CAN frame with {len(self.data)} bytes: expected at most {LARGEST_DATA}")
        if self.remote and self.data:
            raise FrameError(f"remote CAN frame with {len(self.data)} bytes: expected none")


class Bus(Protocol):
    """What carries frames; opened and closed again and again."""

    def open(self) -> None:
        """Open the port and join the bus.

        Raises:
            LinkError: the port is absent, busy or may not be opened.
        """

    def close(self) -> None:
        """Leave the bus and close the port, also one that is gone; never raises."""

    def send(self, frame: Frame) -> None:
        """Put a frame on the way; may be called from any thread.

        Raises:
            LinkError: the port is closed or gone.
        """

    def receive(self, timeout: float) -> Frame | None:
        """Return the next frame, None when none came within `timeout` [s].

        Raises:
            LinkError: the port is closed or gone.
        """

    @property
    def counts(self) -> Mapping[str, int]:
        """What happened since the bus was made, by name: frames, lines that were no frames, refusals (BELL)."""

    @property
    def suspicion(self) -> str:
        """What seems wrong with the link, in a sentence of advice; "" when nothing does."""
