"""What the replies say of the gripper: which of them are believed, place, speed, faults and telemetry.

A digit that fell over on the serial line makes a valid reply that is wrong; it must never become a state. What goes on
from the last reply is believed at once, anything else when it repeats itself.
"""

from __future__ import annotations

import math
from bisect import bisect_left
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from statistics import median_low

from finforce_driver.can.protocol import (
    LARGEST_BYTE,
    LARGEST_CURRENT_MA,
    CanMessage,
    Command,
    ErrorReport,
    Flag,
    Move,
    Reply,
    decode_errors,
    decode_supply,
    decode_temperature,
)
from finforce_driver.settings import GripperSettings

KEPT = 5.0  # [s]
SPEED_SPAN = 0.1  # [s] over which the speed is taken: five replies at 50 Hz, against the steps of the position byte
LEAST_SPAN = 0.03  # [s]
LONGEST_GAP = 0.3  # [s] between two known places, after which everything may be otherwise; a poll at 5 Hz takes 0.2 s


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


CURRENT_STEP = 100.0  # [mA] that the current may change by between two replies without being doubted
CONFIRMING_STEP, CONFIRMING_RATE = 60.0, 5_000.0  # [mA], [mA/s] between two that confirm each other
CONFIRMATIONS = 3  # replies in a row that have to agree with the one that was doubted
MOST_DOUBTS = 16  # after which numbers are taken to differ for good, as by a noisy current
FAST_WAY = 3.0  # [counts] between two replies, beyond which none is believed by itself: the jaws may have stopped
FLAGS = ("activated", "action", "overheated", "watchdog", "estopped", "calibrated", "error", "code")


@dataclass(frozen=True, kw_only=True)
class Expectation:
    """How the position may change.

    Attributes:
        drift: present speed [counts/s], positive while closing.
        reach: greatest speed that is possible now [counts/s].
    """

    drift: float = 0.0
    reach: float = 2000.0


@dataclass(frozen=True, kw_only=True)
class TimedReply:
    """A reply and when it came [s]."""

    reply: Reply
    time: float


class ReplyFilter:
    """Passes on believed replies.

    Attributes:
        doubted: number of replies that were not believed at first.

    Args:
        longest_span: between two replies that can confirm each other [s].
    """

    def __init__(self, longest_span: float) -> None:
        self._longest_span = longest_span
        self.doubted = 0
        self._believed: TimedReply | None = None
        self._doubts: deque[TimedReply] = deque(maxlen=CONFIRMATIONS)
        self._unsettled = 0

    @property
    def doubtful(self) -> bool:
        """Whether a further reply is wanted at once."""
        return bool(self._doubts)

    @property
    def alarming(self) -> bool:
        """Whether a doubted reply, if it is true, changes what the gripper may be told."""
        if self._believed is None:
            return bool(self._doubts)
        standing = _standing(self._believed.reply)
        return any(_standing(doubt.reply) != standing for doubt in self._doubts)

    def forget(self) -> None:
        """Begin anew: the next reply goes on from nothing."""
        self._believed = None
        self._doubts.clear()
        self._unsettled = 0

    def take(self, sample: TimedReply, expected: Expectation) -> Reply | None:
        """Return what to believe after a reply: it, the middle of three where many disagree, or None for now."""
        if self._believed is not None and goes_on(self._believed, sample, expected):
            return self._believe(sample)
        self.doubted += 1
        if abs(sample.reply.current_mA) > LARGEST_CURRENT_MA:
            return None
        self._unsettled += 1
        run = [*self._doubts, sample]
        if len(run) > CONFIRMATIONS and len({_flags(item.reply) for item in run}) == 1:
            if all(self._agree(*pair, expected) for pair in zip(run, run[1:], strict=False)):
                return self._believe(sample)
            if self._unsettled > MOST_DOUBTS:
                return self._believe(TimedReply(reply=_middle(run), time=sample.time))
        self._doubts.append(sample)
        return None

    def _agree(self, first: TimedReply, second: TimedReply, expected: Expectation) -> bool:
        """Return whether the numbers of two replies can both be true."""
        span = second.time - first.time
        way = second.reply.position - first.reply.position
        rise = second.reply.current_mA - first.reply.current_mA
        return (
            span <= self._longest_span
            and abs(way) <= 1.0 + expected.reach * span
            and abs(rise) <= CONFIRMING_STEP + CONFIRMING_RATE * span
        )

    def _believe(self, sample: TimedReply) -> Reply:
        """Keep a sample and return its reply."""
        self._believed = sample
        self._doubts.clear()
        self._unsettled = 0
        return sample.reply


def goes_on(before: TimedReply, after: TimedReply, expected: Expectation) -> bool:
    """Return whether a reply needs no repetition: same flags, position as expected, hardly another current."""
    span = after.time - before.time
    way = expected.drift * span
    if abs(way) > FAST_WAY or span > LONGEST_GAP:
        return False
    # at rest nothing may change; in motion the truncation of both counts and of the speed adds up to some two
    tolerance = 1.0 + min(1.0, abs(way)) + 0.1 * abs(way) if expected.drift else 0.0
    return (
        _flags(before.reply) == _flags(after.reply)
        and abs(after.reply.position - before.reply.position - way) <= tolerance
        and abs(after.reply.current_mA - before.reply.current_mA) <= CURRENT_STEP
    )


def _flags(reply: Reply) -> tuple[int, ...]:
    """Return what of a reply has to be equal."""
    return tuple(getattr(reply, name) for name in FLAGS)


def _standing(reply: Reply) -> tuple[bool, ...]:
    """Return what of a reply decides on what the gripper may be told."""
    return reply.activated, reply.action, reply.calibrated, reply.error


def _middle(samples: list[TimedReply]) -> Reply:
    """Return the last reply with the middle ones of their numbers."""
    replies = [sample.reply for sample in samples]
    names = ("position", "current_mA")
    return replace(replies[-1], **{name: median_low([getattr(reply, name) for reply in replies]) for name in names})


LARGEST_STEP = {Command.TEMPERATURE: 3.0, Command.SUPPLY: 0.5}  # [deg C], [V] between two answers, without repetition
VALUES: dict[Command, tuple[str, Callable[[CanMessage], float | ErrorReport]]] = {
    Command.TEMPERATURE: ("temperature", decode_temperature),
    Command.SUPPLY: ("voltage", decode_supply),
    Command.ERRORS: ("errors", decode_errors),
}
ORDER = tuple(VALUES)
SILENCES = 3  # at the beginning, after which an adapter or firmware is taken not to know these requests
PATIENCE = 60.0  # [s] until it is asked again


class Telemetry:
    """Asks one question per period, round robin.

    Attributes:
        temperature: of the motor [deg C]; NaN unknown.
        voltage: of the supply [V]; NaN unknown.
        errors: what is latched; None unknown.

    Args:
        period: between two questions [s].
    """

    def __init__(self, period: float) -> None:
        self._period = period
        self.forget()

    def forget(self) -> None:
        """Begin anew."""
        self.temperature = self.voltage = math.nan
        self.errors: ErrorReport | None = None
        self._doubt: dict[Command, float | ErrorReport] = {}
        self._turn = self._silences = 0
        self._answered = False
        self._next_time = -math.inf

    def ask_errors(self, now: float) -> None:
        """Ask for the errors next: one has come or gone."""
        self.errors = None
        self._doubt.pop(Command.ERRORS, None)
        self._turn = ORDER.index(Command.ERRORS)
        if self._answered or self._silences < SILENCES:
            self._next_time = now

    @property
    def next_time(self) -> float:
        """When the next question is due [s]."""
        return self._next_time

    def question(self, now: float) -> Command | None:
        """Return what to ask now, None when nothing is due."""
        return ORDER[self._turn] if now >= self._next_time else None

    def miss(self, now: float) -> None:
        """Note that a question was not answered."""
        self._silences += 1
        unknown = self._silences >= SILENCES and not self._answered
        self._next_time = now + (PATIENCE if unknown else self._period)

    def take(self, command: Command, message: CanMessage, now: float) -> None:
        """Take an answer; one that is doubted is asked for again at once."""
        self._silences, self._answered = 0, True
        if self._believe(command, message):
            self._turn = (ORDER.index(command) + 1) % len(ORDER)
            self._next_time = now + self._period

    def _believe(self, command: Command, message: CanMessage) -> bool:
        """Keep a value that goes on from the last one or repeats itself; return whether it was kept."""
        name, decode = VALUES[command]
        value = decode(message)
        known = any(_goes_on(command, value, other) for other in (getattr(self, name), self._doubt.get(command)))
        self._doubt[command] = value
        if known:
            setattr(self, name, value)
            self._doubt.pop(command)
        return known


def _goes_on(command: Command, value: float | ErrorReport, other: float | ErrorReport | None) -> bool:
    """Return whether a value needs no repetition after another one."""
    if other is None or command is Command.ERRORS:
        return value == other
    return abs(value - other) <= LARGEST_STEP[command]
