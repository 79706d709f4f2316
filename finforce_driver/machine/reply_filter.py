"""Decides which replies are believed: what goes on from the last one at once, anything else when it repeats itself.

A digit that fell over on the serial line makes a valid reply that is wrong; it must never become a state. Knows neither
what the gripper was told nor what follows from its state.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, replace
from statistics import median_low

from finforce_driver.can.protocol import LARGEST_CURRENT_MA, Reply

CURRENT_STEP = 100.0  # [mA] that the current may change by between two replies without being doubted
CONFIRMING_STEP, CONFIRMING_RATE = 60.0, 5_000.0  # [mA], [mA/s] between two that confirm each other
CONFIRMATIONS = 3  # replies in a row that have to agree with the one that was doubted
MOST_DOUBTS = 16  # after which numbers are taken to differ for good, as by a noisy current
FAST_WAY = 3.0  # [counts] between two replies, beyond which none is believed by itself: the jaws may have stopped
LONGEST_GAP = 0.3  # [s] after which everything may be otherwise; a poll at 5 Hz takes 0.2 s
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
