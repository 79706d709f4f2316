"""Where the jaws were in the last seconds: their speed now, their place then; knows no gripper."""

from __future__ import annotations

import math
from bisect import bisect_left
from collections import deque

KEPT = 5.0  # [s]
SPEED_SPAN = 0.1  # [s] over which the speed is taken: five replies at 50 Hz, against the steps of the position byte
LEAST_SPAN = 0.03  # [s]
LONGEST_GAP = 0.3  # [s] that may be bridged between two known places


class History:
    """Places over time, the newest last."""

    def __init__(self) -> None:
        self._times: deque[float] = deque()
        self._places: deque[float] = deque()

    @property
    def last(self) -> float:
        """The newest place; NaN without one."""
        return self._places[-1] if self._places else math.nan

    def add(self, time: float, place: float) -> None:
        """Keep a place at a time [s] that is not before the last one."""
        self._times.append(time)
        self._places.append(place)
        while self._times[0] < time - KEPT:
            self._times.popleft()
            self._places.popleft()

    def forget(self) -> None:
        """Drop everything."""
        self._times.clear()
        self._places.clear()

    def speed(self) -> float:
        """Return the change of place per second over the last tenth of a second; 0 when too little is known."""
        if not self._times:
            return 0.0
        last = self._times[-1]
        first = self._first_within(last - SPEED_SPAN)
        span = last - self._times[first]
        return (self._places[-1] - self._places[first]) / span if span >= LEAST_SPAN else 0.0

    def place_at(self, time: float, reach: float) -> float:
        """Return the place at a time [s], between its neighbours on a line.

        Args:
            time: asked for.
            reach: how long after the newest place that one still stands [s].

        Returns:
            The place; NaN before the first one, beyond `reach`, and within gaps that are too long.
        """
        times = list(self._times)
        if not times or not times[0] <= time <= times[-1] + reach:
            return math.nan
        after = bisect_left(times, time)
        if after == len(times):
            return self._places[-1]
        if times[after] == time:
            return self._places[after]
        gap = times[after] - times[after - 1]
        if gap > LONGEST_GAP:
            return math.nan
        share = (time - times[after - 1]) / gap
        return self._places[after - 1] + share * (self._places[after] - self._places[after - 1])

    def _first_within(self, begin: float) -> int:
        """Return the index of the first place at or after a time, looked for from the newest."""
        index = len(self._times) - 1
        while index > 0 and self._times[index - 1] >= begin:
            index -= 1
        return index
