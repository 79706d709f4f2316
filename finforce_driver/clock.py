"""The time that a driver lives by, the machine's own or one that a test steps, and stamps of messages on it."""

from __future__ import annotations

from threading import Event
from time import monotonic
from typing import Protocol

from finforce.stamps import NANOSECONDS, StampError, StampGate


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


class MessageTimes:
    """Translates between a node's clock and the gripper's by what both show at the same moment.

    Args:
        clock: the gripper's.
        sources: names of what sends messages, each in the order of its stamps.
        max_age: greatest age of a message, and greatest time that its stamp may lie ahead [s].
        restart_gap: by which the stamps of a source may go back, because they begin anew [s].
    """

    def __init__(self, clock: Clock, sources: tuple[str, ...], *, max_age: float, restart_gap: float) -> None:
        self._clock = clock
        self._gates = {name: StampGate(max_age=max_age, restart_gap=restart_gap) for name in sources}

    def enter(self, source: str, stamp: int, now: int) -> float:
        """Return the stamp [ns] of a fresh message of a source on the gripper's clock [s].

        Args:
            source: its name.
            stamp: of the message [ns].
            now: the node's clock [ns].

        Raises:
            StaleError: the message is too old.
            StampError: the stamp repeats, goes back or lies ahead of the clock.
        """
        self._gates[source].enter(stamp, now)
        return self._clock.now() - (now - stamp) / NANOSECONDS

    def to_stamp(self, time: float, now: int) -> int:
        """Return a time of the gripper's clock [s] as a stamp [ns], with `now` of the node's clock [ns].

        Raises:
            StampError: the node's clock does not go yet.
        """
        stamp = now - round((self._clock.now() - time) * NANOSECONDS)
        if stamp < 0:
            raise StampError(f"the node's clock stands at {now / NANOSECONDS:g} s: use_sim_time without /clock?")
        return stamp
