"""Stamps of images in nanoseconds: what is fresh, what is new, and what belongs together."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

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

    @property
    def is_idle(self) -> bool:
        """Whether nothing happened in the last image that was answered."""
        return self._answered is not None

    def passes(self, stamp: int) -> bool:
        """Say whether an image [ns] may be passed over: one of its period was answered, and nothing happened then."""
        return self._answered == stamp // self._period

    def note(self, stamp: int, idle: bool) -> None:
        """Note that an image [ns] was answered, and whether nothing happened in it."""
        self._answered = stamp // self._period if idle else None

    def end(self) -> None:
        """Note that something happens."""
        self._answered = None


@dataclass(frozen=True, eq=False)
class Stamped:
    """Something and the stamp of its image [ns]."""

    stamp: int
    value: Any


class Synchronizer:
    """Keeps the newest entries of several streams and finds those that belong to one image.

    Args:
        streams: their names, each with the number of entries that are kept of it, None for all.
        tolerance: greatest distance between stamps that belong together [ns].
    """

    def __init__(self, streams: dict[str, int | None], tolerance: int = 0) -> None:
        self._streams: dict[str, deque[Stamped]] = {name: deque(maxlen=depth) for name, depth in streams.items()}
        self._tolerance = tolerance

    def reset(self, *streams: str) -> None:
        """Forget the entries of some streams, of all without a name."""
        for name in streams or self._streams:
            self._streams[name].clear()

    def belong(self, one: int, other: int) -> bool:
        """Return whether two stamps [ns] are those of one image."""
        return abs(one - other) <= self._tolerance

    def add(self, stream: str, stamp: int, value: Any) -> None:
        """Keep an entry of a stream, and forget its oldest where there are too many."""
        self._streams[stream].append(Stamped(stamp, value))

    def entries(self, stream: str) -> deque[Stamped]:
        """Return the entries of a stream in the order of their arrival."""
        return self._streams[stream]

    def nearest(self, stream: str, stamp: int) -> Stamped | None:
        """Return the entry of a stream that is nearest to a stamp [ns], the oldest of equals."""
        return min(self._streams[stream], key=lambda entry: abs(entry.stamp - stamp), default=None)

    def find(self, stream: str, stamp: int) -> Stamped | None:
        """Return the nearest entry of a stream to a stamp [ns], None where none belongs to it."""
        found = self.nearest(stream, stamp)
        return found if found is not None and self.belong(found.stamp, stamp) else None

    def take(self, stream: str, stamp: int) -> Stamped | None:
        """Return the entry that `find` finds, and forget it."""
        found = self.find(stream, stamp)
        if found is not None:
            self._streams[stream].remove(found)
        return found

    def newest_pair(self, stream: str, other: str) -> tuple[Stamped, Stamped] | None:
        """Return the newest entry of a stream that has one of another stream, with that one."""
        for entry in reversed(self._streams[stream]):
            found = self.find(other, entry.stamp)
            if found is not None:
                return entry, found
        return None


def find_nearest(times: NDArray[np.int64], stamps: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return for each of the stamps (n,) the index of the nearest of times (m,) in any order, the earlier of equals."""
    order = np.argsort(times, kind="stable")
    rising = times[order]
    after = np.clip(np.searchsorted(rising, stamps), 0, len(rising) - 1)
    before = np.maximum(after - 1, 0)
    return order[np.where(stamps - rising[before] <= rising[after] - stamps, before, after)]
