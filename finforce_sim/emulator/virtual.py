"""Stepped time, and a bus in it: a driver and an emulated gripper without threads and without waiting."""

from __future__ import annotations

from collections import Counter, deque
from threading import Event
from typing import Any

from finforce_driver.can.protocol import Bus, CanMessage
from finforce_driver.can.slcan import SlcanParser, encode_message
from finforce_driver.gripper import Clock
from finforce_sim.emulator.adapter import EmulatedAdapter

_STEP = 0.001  # [s]
_LEAST = 1e-6  # [s] that a wait takes: a rest of rounding would not move the clock, and be waited for for ever


class VirtualClock(Clock):
    """A clock that passes only while somebody waits, and then steps all that is attached."""

    def __init__(self) -> None:
        """Make a clock at zero."""
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
            dt = min(left, _STEP)
            self.tick(dt)
            left -= dt

    def tick(self, dt: float) -> None:
        """Let `dt` [s] pass in one step."""
        self._now += dt
        for part in self._attached:
            part.step(dt)


class VirtualBus(Bus):
    """A bus through the bytes of an emulated adapter, in stepped time; receiving lets time pass.

    Attributes:
        sent: the last messages with their times [s].
    """

    def __init__(self, adapter: EmulatedAdapter, clock: VirtualClock) -> None:
        """Connect an adapter, which the clock steps from now on."""
        super().__init__("virtual adapter")
        self.sent: deque[tuple[float, CanMessage]] = deque(maxlen=1000)
        self._adapter = adapter
        self._clock = clock
        self._parser = SlcanParser()
        clock.attach(adapter)

    @property
    def counts(self) -> Counter[str]:
        """Return what the parser counted."""
        return self._parser.counts.copy()

    def receive(self, timeout: float) -> CanMessage | None:
        """Return the next message; time passes until it comes or `timeout` [s] is over.

        Raises:
            LinkError: the bus is closed.
        """
        end = self._clock.now() + timeout
        while True:
            self._messages.extend(self._read(self._opened(), 0.0))
            if self._messages:
                return self._messages.popleft()
            left = end - self._clock.now()
            if left <= 1e-9:
                return None
            self._clock.tick(min(left, _STEP))

    def _connect(self) -> EmulatedAdapter:
        self._adapter.read()
        self._parser.discard()
        self._adapter.write(b"C\rS8\rO\r")
        return self._adapter

    def _disconnect(self, port: EmulatedAdapter) -> None:
        port.write(b"C\r")

    def _write(self, port: EmulatedAdapter, message: CanMessage) -> None:
        self.sent.append((self._clock.now(), message))
        port.write(encode_message(message))

    def _read(self, port: EmulatedAdapter, timeout: float) -> list[CanMessage]:
        return self._parser.feed(port.read())
