"""The state of the gripper by its replies: plausibility, position, speed, faults and telemetry.

A digit that was corrupted on the serial line makes a valid reply that is wrong; it must never become a state. What
continues the last reply is believed at once, anything else when it repeats itself.
"""

from __future__ import annotations

import math
from bisect import bisect_left
from collections import deque
from collections.abc import Callable
from dataclasses import replace
from statistics import median_low

from finforce_driver.can.protocol import (
    LARGEST_BYTE,
    LARGEST_CURRENT_MA,
    CanMessage,
    Command,
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
LONGEST_GAP = 0.3  # [s] between two known positions, after which everything may differ; a poll at 5 Hz takes 0.2 s


class History:
    """Positions over time, the newest last, in whichever unit."""

    def __init__(self) -> None:
        self._times: deque[float] = deque()
        self._positions: deque[float] = deque()

    @property
    def last(self) -> float:
        """The newest position; NaN without one."""
        return self._positions[-1] if self._positions else math.nan

    def add(self, time: float, position: float) -> None:
        """Keep a position at a time [s] that is not before the last one."""
        self._times.append(time)
        self._positions.append(position)
        while self._times[0] < time - KEPT:
            self._times.popleft()
            self._positions.popleft()

    def clear(self) -> None:
        """Drop everything."""
        self._times.clear()
        self._positions.clear()

    def speed(self) -> float:
        """Return the change of position per second over the last tenth of a second; 0 when too little is known."""
        if not self._times:
            return 0.0
        first = bisect_left(self._times, self._times[-1] - SPEED_SPAN)
        span = self._times[-1] - self._times[first]
        return (self._positions[-1] - self._positions[first]) / span if span >= LEAST_SPAN else 0.0

    def position_at(self, time: float, validity: float) -> float:
        """Return the position at a time [s], interpolated between its neighbours.

        Args:
            time: asked for.
            validity: time after the newest position for which that one still holds [s].

        Returns:
            The position; NaN before the first one, beyond `validity`, and within gaps that are too long.
        """
        times, positions = self._times, self._positions
        if not times or not times[0] <= time <= times[-1] + validity:
            return math.nan
        after = bisect_left(times, time)
        if after == len(times):
            return positions[-1]
        if times[after] == time:
            return positions[after]
        gap = times[after] - times[after - 1]
        if gap > LONGEST_GAP:
            return math.nan
        share = (time - times[after - 1]) / gap
        return positions[after - 1] + share * (positions[after] - positions[after - 1])


FASTEST = 2000.0  # [counts/s] that anything can move the jaws with; 80000 ticks/s are 1932
LONGEST_OUTLOOK = 0.05  # [s] for which the jaws are assumed to keep their speed
REACH_MARGIN = 1.5  # of the commanded speed


class StatusTracker:
    """Tracks the status of one gripper by its plausible replies.

    Attributes:
        reply: the last plausible reply; None before the first.
        calibration_problem: reason for which the gripper's calibration flag is not trusted; empty if it is.
        power_off: True if a fault, a calibration or a stop has switched the power stage off, whatever the reply echoes.
        telemetry: temperature, supply, errors.
        filter: rejects implausible replies.
        history: positions over time [counts].

    Args:
        settings: of the gripper.
    """

    def __init__(self, settings: GripperSettings) -> None:
        self.calibration_problem = ""
        self.power_off = False
        self.telemetry = Telemetry(settings.telemetry_period)
        self.filter = ReplyFilter(settings.reply_timeout)
        self.history = History()
        self.reply: Reply | None = None
        self._contact_since = math.inf

    def forget(self) -> None:
        """Forget everything but an invalid calibration and a power stage that is off."""
        self.reply, self._contact_since = None, math.inf
        self.telemetry.forget()
        self.filter.forget()
        self.history.clear()

    def restart_history(self) -> None:
        """Forget all positions but the last one: they were told between other end stops."""
        self.history.clear()
        if self.reply is not None and self.reply.calibrated:
            self.history.add(self.stamp, estimate_position(self.reply, None))

    @property
    def stamp(self) -> float:
        """The time of the last believed reply [s]; NaN before the first."""
        return math.nan if self.reply is None else self.reply.time

    @property
    def calibrated(self) -> bool:
        """True if the position means something."""
        return self.reply is not None and self.reply.calibrated and not self.calibration_problem

    @property
    def error(self) -> bool:
        """True if a fault is latched."""
        return self.reply is not None and self.reply.error

    @property
    def driving(self) -> bool:
        """True if the gripper's power stage moves or holds the jaws."""
        return self.reply is not None and self.reply.driving and not self.power_off

    @property
    def contact_time(self) -> float:
        """Time for which the gripper has reported contact [s]."""
        return max(0.0, self.stamp - self._contact_since)

    @property
    def position(self) -> float:
        """The best estimate of the last position [counts], between whichever end stops the gripper has; NaN unknown."""
        return self.history.last

    def position_now(self, now: float, target: float | None) -> float:
        """Return where the jaws are by now [counts], at the speed of the last replies and not beyond their target."""
        travel = self.history.speed() * min(max(0.0, now - self.stamp), LONGEST_OUTLOOK)
        bound = LARGEST_BYTE * (travel > 0.0) if target is None else target
        left = max(0.0, math.copysign(1.0, travel) * (bound - self.position))
        return self.position + math.copysign(min(abs(travel), left), travel)

    def restart_contact(self) -> None:
        """Forget a contact: the gripper has another order."""
        self._contact_since = math.inf

    def take(self, reply: Reply, order: Move | None, speed: float) -> Reply | None:
        """Take a reply, and return what is believed after it; None: ask again.

        Args:
            reply: as it came.
            order: the gripper's, as far as it is known.
            speed: that the order allows [counts/s].
        """
        drift = self.history.speed()
        reach = FASTEST if order is None else max(REACH_MARGIN * speed, 2.0 * abs(drift))
        believed = self.filter.take(reply, drift, reach)
        if believed is None:
            return None
        self.reply = believed
        self._contact_since = min(self._contact_since, reply.time) if believed.contact else math.inf
        if believed.calibrated:
            self.history.add(reply.time, estimate_position(believed, order))
        else:
            self.history.clear()
        return believed

    def faults(self, stopped: bool) -> tuple[str, ...]:
        """Return the names of what is latched; `stopped`: an emergency stop of ours is among it."""
        reply, names = self.reply, []
        if reply is not None and reply.error:
            names = list(self.telemetry.errors or ())
            bits = {"temperature": reply.overheated, "watchdog": reply.watchdog, "E-stop": reply.estopped}
            names += [name for name, present in bits.items() if present and name not in names]
        if stopped and "E-stop" not in names:
            names.append("E-stop")
        return tuple(names) or (("unknown",) if self.error else ())


def estimate_position(reply: Reply, order: Move | None) -> float:
    """Return where the jaws are [counts]: in the middle of what the truncated byte allows, or at the target."""
    if order is not None and order.action and reply.at_target and 0 <= order.position - reply.position <= 1:
        return float(order.position)
    return float(reply.position) if reply.position in (0, LARGEST_BYTE) else reply.position + 0.5


CURRENT_STEP = 100.0  # [mA] that the current may change by between two replies without a confirmation
CONFIRMING_STEP = 60.0  # [mA], between two replies that confirm each other
CONFIRMING_RATE = 5_000.0  # [mA/s], in addition
CONFIRMATIONS = 3  # replies in a row that have to agree with the first one
MOST_UNCONFIRMED = 16  # after which numbers are taken to differ for good, as by a noisy current
FAST_TRAVEL = 3.0  # [counts] between two replies, beyond which each is confirmed: the jaws may have stopped


class ReplyFilter:
    """Passes on believed replies.

    Attributes:
        rejected: number of replies that were not believed at first.

    Args:
        longest_span: between two replies that can confirm each other [s].
    """

    def __init__(self, longest_span: float) -> None:
        self._longest_span = longest_span
        self.rejected = 0
        self._believed: Reply | None = None
        self._candidates: deque[Reply] = deque(maxlen=CONFIRMATIONS)
        self._unconfirmed = 0

    @property
    def wants_reply(self) -> bool:
        """True if a further reply is wanted at once."""
        return bool(self._candidates)

    @property
    def alarming(self) -> bool:
        """True if an unconfirmed reply, if it is true, changes what the gripper may be told."""
        if self._believed is None:
            return bool(self._candidates)
        status = _drive_status(self._believed)
        return any(_drive_status(reply) != status for reply in self._candidates)

    def forget(self) -> None:
        """Begin anew: the next reply continues nothing."""
        self._believed = None
        self._candidates.clear()
        self._unconfirmed = 0

    def take(self, reply: Reply, drift: float, reach: float) -> Reply | None:
        """Return what to believe after a reply: it, the median of several that disagree, or None for now.

        Args:
            reply: as it came.
            drift: present speed [counts/s], positive while closing.
            reach: greatest speed that is possible now [counts/s].
        """
        if self._believed is not None and continues(self._believed, reply, drift):
            return self._believe(reply)
        self.rejected += 1
        if abs(reply.current_mA) > LARGEST_CURRENT_MA:
            return None
        self._unconfirmed += 1
        run = [*self._candidates, reply]
        if len(run) > CONFIRMATIONS and all(_flags(item) == _flags(reply) for item in run):
            if all(self._agree(*pair, reach) for pair in zip(run, run[1:], strict=False)):
                return self._believe(reply)
            if self._unconfirmed > MOST_UNCONFIRMED:
                names = ("position", "current_mA")
                return self._believe(
                    replace(reply, **{name: median_low([getattr(item, name) for item in run]) for name in names})
                )
        self._candidates.append(reply)
        return None

    def _agree(self, first: Reply, second: Reply, reach: float) -> bool:
        """Return whether the numbers of two replies can both be true."""
        span = second.time - first.time
        return (
            span <= self._longest_span
            and abs(second.position - first.position) <= 1.0 + reach * span
            and abs(second.current_mA - first.current_mA) <= CONFIRMING_STEP + CONFIRMING_RATE * span
        )

    def _believe(self, reply: Reply) -> Reply:
        self._believed = reply
        self._candidates.clear()
        self._unconfirmed = 0
        return reply


def continues(before: Reply, after: Reply, drift: float) -> bool:
    """Return whether a reply needs no repetition: same flags, position as expected, hardly another current."""
    span = after.time - before.time
    travel = drift * span
    if abs(travel) > FAST_TRAVEL or span > LONGEST_GAP:
        return False
    # at rest nothing may change; in motion the truncation of both counts and of the speed adds up to some two
    tolerance = 1.0 + min(1.0, abs(travel)) + 0.1 * abs(travel) if drift else 0.0
    return (
        _flags(before) == _flags(after)
        and abs(after.position - before.position - travel) <= tolerance
        and abs(after.current_mA - before.current_mA) <= CURRENT_STEP
    )


def _flags(reply: Reply) -> tuple[int, ...]:
    """Return what has to be equal in replies that confirm each other."""
    return (*_drive_status(reply), *reply.faults, reply.code)


def _drive_status(reply: Reply) -> tuple[bool, ...]:
    """Return what decides on what the gripper may be told."""
    return reply.activated, reply.action, reply.calibrated, reply.error


LARGEST_STEP = {Command.TEMPERATURE: 3.0, Command.SUPPLY: 0.5}  # [deg C], [V] between two answers, without repetition
Value = float | tuple[str, ...]
VALUES: dict[Command, tuple[str, Callable[[CanMessage], Value]]] = {
    Command.TEMPERATURE: ("temperature", decode_temperature),
    Command.SUPPLY: ("voltage", decode_supply),
    Command.ERRORS: ("errors", decode_errors),
}
ORDER = tuple(VALUES)
SILENCES = 3  # at the beginning, after which an adapter or firmware is taken not to know these requests
RETRY_PERIOD = 60.0  # [s] until it is asked again


class Telemetry:
    """Asks one question per period, round robin.

    Attributes:
        temperature: of the motor [deg C]; NaN unknown.
        voltage: of the supply [V]; NaN unknown.
        errors: names of what is latched; None unknown.
        next_time: when the next question is due [s].

    Args:
        period: between two questions [s].
    """

    def __init__(self, period: float) -> None:
        self._period = period
        self.forget()

    def forget(self) -> None:
        """Begin anew."""
        self.temperature = self.voltage = math.nan
        self.errors: tuple[str, ...] | None = None
        self._unconfirmed: dict[Command, Value] = {}
        self._turn = self._silences = 0
        self._answered = False
        self.next_time = -math.inf

    def ask_errors(self, now: float) -> None:
        """Ask for the errors next: one has come or gone."""
        self.errors = None
        self._unconfirmed.pop(Command.ERRORS, None)
        self._turn = ORDER.index(Command.ERRORS)
        if self._answered or self._silences < SILENCES:
            self.next_time = now

    def question(self, now: float) -> Command | None:
        """Return what to ask now, None when nothing is due."""
        return ORDER[self._turn] if now >= self.next_time else None

    def miss(self, now: float) -> None:
        """Note that a question was not answered."""
        self._silences += 1
        unknown = self._silences >= SILENCES and not self._answered
        self.next_time = now + (RETRY_PERIOD if unknown else self._period)

    def take(self, message: CanMessage, now: float) -> None:
        """Take an answer; it is asked for again at once unless it continues the last one or repeats itself."""
        self._silences, self._answered = 0, True
        command = Command(message.command)
        name, decode = VALUES[command]
        value = decode(message)
        if not any(_is_close(command, value, other) for other in (getattr(self, name), self._unconfirmed.get(command))):
            self._unconfirmed[command] = value
            return
        setattr(self, name, value)
        self._unconfirmed.pop(command, None)
        self._turn = (ORDER.index(command) + 1) % len(ORDER)
        self.next_time = now + self._period


def _is_close(command: Command, value: Value, other: Value | None) -> bool:
    if other is None or command is Command.ERRORS:
        return value == other
    return abs(value - other) <= LARGEST_STEP[command]
