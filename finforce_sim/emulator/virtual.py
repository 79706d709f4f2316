"""Stepped time, and a bus in it: a driver and an emulated gripper without threads and without waiting."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from threading import Event
from typing import Any

from finforce_driver.can.protocol import CanMessage
from finforce_driver.can.slcan import SlcanParser, encode_message
from finforce_driver.errors import LinkError
from finforce_driver.gripper import Clock
from finforce_sim.emulator.adapter import EmulatedAdapter

_STEP = 0.001  # [s]
_LEAST = 1e-6  # [s] that a wait takes: a rest of rounding would not move the clock, and be waited for for ever


class VirtualClock(Clock):
    """A clock that passes only while somebody waits, and then steps all that is attached."""

    def __init__(self, step: float = _STEP) -> None:
        """Make a clock at zero.

        Args:
            step: largest time between two steps of what is attached [s].
        """
        self._step = step
        self._now = 0.0
        self._attached: list[Any] = []

    def now(self) -> float:
        """Return the time [s]."""
        return self._now

    def attach(self, part: Any) -> None:
        """Call `step(dt)` of a part from now on, after those that were attached before."""
        self._attached.append(part)

    def wait(self, seconds: float, wake: Event | None = None) -> None:
        """Let `seconds` [s] pass, or less when `wake` is set meanwhile."""
        left = max(seconds, _LEAST) if seconds > 0.0 else 0.0
        while left > 1e-9 and not (wake is not None and wake.is_set()):
            dt = min(left, self._step)
            self.tick(dt)
            left -= dt

    def tick(self, dt: float) -> None:
        """Let `dt` [s] pass in one step."""
        self._now += dt
        for part in self._attached:
            part.step(dt)


class VirtualBus:
    """A bus through the bytes of an emulated adapter, in stepped time; receiving lets time pass.

    Attributes:
        sent: the last messages with their times [s].
    """

    def __init__(self, adapter: EmulatedAdapter, clock: VirtualClock) -> None:
        """Connect an adapter, which the clock steps from now on."""
        self.sent: deque[tuple[float, CanMessage]] = deque(maxlen=1000)
        self._adapter = adapter
        self._clock = clock
        self._parser = SlcanParser()
        self._waiting: deque[CanMessage] = deque()
        self._opened = False
        clock.attach(adapter)

    @property
    def counts(self) -> Mapping[str, int]:
        """Return what the parser counted."""
        return self._parser.counts

    @property
    def suspicion(self) -> str:
        """Return that nothing is wrong: no line lies between."""
        return ""

    def open(self) -> None:
        """Join the bus.

        Raises:
            LinkError: the adapter is unplugged.
        """
        if not self._adapter.plugged:
            raise LinkError("virtual adapter: it is unplugged, expected it to be there; plug it in")
        self._adapter.read()
        self._waiting.clear()
        self._parser.discard()
        self._adapter.write(b"C\rS8\rO\r")
        self._opened = True

    def close(self) -> None:
        """Leave the bus."""
        if self._opened and self._adapter.plugged:
            self._adapter.write(b"C\r")
        self._opened = False

    def send(self, message: CanMessage) -> None:
        """Hand a message to the adapter at once.

        Raises:
            LinkError: the bus is closed, or the adapter unplugged.
        """
        self._check()
        self.sent.append((self._clock.now(), message))
        self._adapter.write(encode_message(message))

    def receive(self, timeout: float) -> CanMessage | None:
        """Return the next message; time passes until it comes or `timeout` [s] is over.

        Raises:
            LinkError: the bus is closed, or the adapter unplugged.
        """
        end = self._clock.now() + timeout
        while True:
            self._check()
            self._waiting.extend(self._parser.feed(self._adapter.read()))
            if self._waiting:
                return self._waiting.popleft()
            left = end - self._clock.now()
            if left <= 1e-9:
                return None
            self._clock.tick(min(left, _STEP))

    def _check(self) -> None:
        if not self._opened:
            raise LinkError("virtual adapter: the bus is closed, expected it open; open it")
        if not self._adapter.plugged:
            raise LinkError("virtual adapter: it was unplugged, expected it to stay; plug it in and open the bus")
