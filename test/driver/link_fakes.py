"""A serial adapter on a real pseudo terminal, played by the test step by step."""

import os
import select
import tty
from collections.abc import Callable
from pathlib import Path
from time import monotonic

from finforce_driver.can.bus import Bus, CanMessage

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
