"""Where the jaws were in the last seconds: their speed now, their place then.

What the replies say of the gripper: the believed reply, place, speed, faults.
"""

from __future__ import annotations

import math
from bisect import bisect_left
from collections import deque

from finforce_driver.can.protocol import LARGEST_BYTE, Flag, Move, Reply
from finforce_driver.machine.reply_filter import Expectation, ReplyFilter, TimedReply
from finforce_driver.machine.telemetry import Telemetry
from finforce_driver.settings import GripperSettings

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


FASTEST = 2000.0  # [counts/s] that anything can move the jaws with; 80000 ticks/s are 1932
LONGEST_OUTLOOK = 0.05  # [s] for which the jaws are taken to go on as they did
REACH_MARGIN = 1.5  # of the commanded speed


class Knowledge:
    """Keeps what was believed.

    Attributes:
        reply: the last believed one; None before the first.
        stamp: when it came [s]; NaN before the first.
        half_calibrated: a calibration was cut short, the gripper's flag says nothing.
        telemetry: temperature, supply, errors.
        filter: what decides on belief.
        history: places over time [counts].

    Args:
        settings: of the gripper.
    """

    def __init__(self, settings: GripperSettings) -> None:
        self.half_calibrated = False
        self.telemetry = Telemetry(settings.telemetry_period)
        self.filter = ReplyFilter(settings.reply_timeout)
        self.history = History()
        self.reply: Reply | None = None
        self.stamp = math.nan
        self._contact_since = math.inf

    def forget(self) -> None:
        """Know nothing any more; only that a calibration was cut short does not heal by itself."""
        self.reply, self.stamp, self._contact_since = None, math.nan, math.inf
        self.telemetry.forget()
        self.filter.forget()
        self.history.forget()

    def restart_places(self) -> None:
        """Forget all places but the last one: they were told between other end stops."""
        self.history.forget()
        if self.reply is not None and self.reply.calibrated:
            self.history.add(self.stamp, estimate_place(self.reply, None))

    @property
    def calibrated(self) -> bool:
        """Whether the place means something."""
        return self.reply is not None and self.reply.calibrated and not self.half_calibrated

    @property
    def error(self) -> bool:
        """Whether a fault is latched."""
        return self.reply is not None and self.reply.error

    @property
    def driving(self) -> bool:
        """Whether the gripper's power stage moves or holds the jaws."""
        reply = self.reply
        return reply is not None and reply.activated and reply.action and not reply.error

    @property
    def contact_time(self) -> float:
        """Return for how long the gripper has told of contact [s]."""
        return max(0.0, self.stamp - self._contact_since)

    @property
    def place(self) -> float:
        """Return the best estimate of the last place [counts]; NaN unknown."""
        return self.history.last if self.calibrated else math.nan

    def place_now(self, now: float, target: float | None) -> float:
        """Return where the jaws are by now [counts], at the speed of the last replies and not beyond their target."""
        way = self.history.speed() * min(max(0.0, now - self.stamp), LONGEST_OUTLOOK)
        bound = LARGEST_BYTE * (way > 0.0) if target is None else target
        left = max(0.0, math.copysign(1.0, way) * (bound - self.place))
        return self.place + math.copysign(min(abs(way), left), way)

    def restart_contact(self) -> None:
        """Forget a contact: the gripper has another order."""
        self._contact_since = math.inf

    def take(self, reply: Reply, now: float, order: Move | None, speed: float) -> Reply | None:
        """Take a reply, and return what is believed after it; None: ask again.

        Args:
            reply: as it came.
            now: when [s].
            order: the gripper's, as far as it is known.
            speed: that the order allows [counts/s].
        """
        drift = self.history.speed()
        reach = FASTEST if order is None else max(REACH_MARGIN * speed, 2.0 * abs(drift))
        believed = self.filter.take(TimedReply(reply=reply, time=now), Expectation(drift=drift, reach=reach))
        if believed is None:
            return None
        self.reply, self.stamp = believed, now
        self._contact_since = min(self._contact_since, now) if believed.contact else math.inf
        if believed.calibrated:
            self.history.add(now, estimate_place(believed, order))
        else:
            self.history.forget()
        return believed

    def faults(self, stopped: bool) -> tuple[str, ...]:
        """Return the names of what is latched; `stopped`: an emergency stop of ours is among it."""
        reply, names = self.reply, []
        if reply is not None and reply.error:
            names = list(self.telemetry.errors.faults) if self.telemetry.errors else []
            bits = {"temperature": reply.overheated, "watchdog": reply.watchdog, "E-stop": reply.estopped}
            names += [name for name, present in bits.items() if present and name not in names]
        if stopped and "E-stop" not in names:
            names.append("E-stop")
        return tuple(names) or (("unknown",) if self.error else ())


def estimate_place(reply: Reply, order: Move | None) -> float:
    """Return where the jaws are [counts]: in the middle of what the truncated byte allows, or at the target."""
    if order is not None and order.flags & Flag.GO and reply.at_target and 0 <= order.position - reply.position <= 1:
        return float(order.position)
    return float(reply.position) if reply.position in (0, LARGEST_BYTE) else reply.position + 0.5
