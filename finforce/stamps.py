"""Stamps of images in nanoseconds: what is fresh, what is new, and what belongs together."""

from __future__ import annotations

from collections import deque

from finforce.errors import FinforceError

NANOSECONDS = 1_000_000_000  # in a second
SECOND = 1e-9  # a nanosecond [s]


class StampError(FinforceError, ValueError):
    """A stamp repeats, goes back or lies ahead of the clock."""


class StaleError(FinforceError, ValueError):
    """The data are older than what may be published."""


class StampGate:
    """Lets a sample through once, in order, and only while it is fresh.

    Args:
        max_age: greatest age of a sample [s]; a stamp may lie as far ahead of the clock.
        restart_gap: a stamp that goes back by more than this begins a new recording [s].
    """

    def __init__(self, *, max_age: float, restart_gap: float) -> None:
        self._max_age = round(max_age * NANOSECONDS)
        self._restart_gap = round(restart_gap * NANOSECONDS)
        self._last: int | None = None

    def enter(self, stamp: int, now: int) -> bool:
        """Admit a sample and return whether a new recording begins with it.

        Args:
            stamp: image time [ns].
            now: the node's clock [ns].

        Raises:
            StaleError: the sample is too old.
            StampError: the stamp repeats, goes back by less than `restart_gap` or lies ahead of the clock.
        """
        self.check_age(stamp, now)
        back = 0 if self._last is None else self._last - stamp
        if self._last is not None and 0 <= back <= self._restart_gap:
            verb = f"go back by {back / NANOSECONDS:.3f} s" if back else "stand still"
            raise StampError(f"the stamps {verb} at {stamp / NANOSECONDS:.3f} s")
        self._last = stamp
        return back > 0

    def check_age(self, stamp: int, now: int) -> None:
        """Refuse a sample that is too old, or ahead of the clock.

        Raises:
            StaleError: too old.
            StampError: ahead of the clock by more than the greatest age.
        """
        age, limit = (now - stamp) / NANOSECONDS, self._max_age / NANOSECONDS
        if now - stamp > self._max_age:
            hint = "; a recording needs /clock and use_sim_time" if age > 3600.0 else ""
            raise StaleError(f"the data are {age:.3f} s old; at most {limit:g} s are allowed{hint}")
        if stamp - now > self._max_age:
            hint = "use_sim_time without /clock?" if now == 0 else "are the clocks synchronised?"
            raise StampError(f"the stamp lies {-age:.3f} s ahead of the node's clock; {hint}")


class Idling:
    """Passes images over while nothing happens: of every period one is answered, in every node the same.

    Args:
        period: of the answers [s]; an image is the first one of a period, counted from stamp 0.
    """

    def __init__(self, period: float = 0.1) -> None:
        self._period = round(period * NANOSECONDS)
        self._answered: int | None = None
        self._ages: deque[int] = deque(maxlen=2)

    @property
    def is_idle(self) -> bool:
        """Whether nothing happened in the last image that was answered."""
        return self._answered is not None

    def passes(self, stamp: int) -> bool:
        """Say whether an image [ns] may be passed over: one of its period was answered, and nothing happened then."""
        return self._answered == stamp // self._period

    def spare_time(self, now: int) -> float:
        """Return for how long [s] from `now` [ns] no image will come that has to be answered.

        That which begins the next period takes as long to come as the quicker one of the last two answered.
        """
        if self._answered is None or not self._ages:
            return 0.0
        left = (self._answered + 1) * self._period + min(self._ages) - now
        return min(max(left, 0), self._period) / NANOSECONDS

    def note(self, stamp: int, idle: bool, now: int | None = None) -> None:
        """Note that an image [ns] was answered, whether nothing happened in it, and when [ns] for `spare_time`."""
        self._answered = stamp // self._period if idle else None
        if now is not None:
            self._ages.append(now - stamp)

    def end(self) -> None:
        """Note that something happens."""
        self._answered = None
