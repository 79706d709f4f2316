"""The time that a driver lives by: the machine's own, or one that a test steps."""

from __future__ import annotations

from threading import Event
from time import monotonic
from typing import Protocol


class Clock(Protocol):
    """Tells the time and waits."""

    def now(self) -> float:
        """Return the time [s]; it never goes back."""

    def wait(self, seconds: float, wake: Event) -> None:
        """Return after `seconds` [s], or as soon as `wake` is set."""


class MonotonicClock:
    """The clock of the machine."""

    def now(self) -> float:
        """Return the time since some moment [s]."""
        return monotonic()

    def wait(self, seconds: float, wake: Event) -> None:
        """Sleep, or be woken."""
        if seconds > 0.0:
            wake.wait(seconds)
