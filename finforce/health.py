"""The health of a node: images answered, rates, latencies, rejections, and the level that follows."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from enum import IntEnum
from math import inf
from time import monotonic

import numpy as np

from finforce.errors import FinforceError
from finforce.messages import NANOSECONDS

RULES = UNHEARD, IDLE, STILL = ("nobody subscribes", "idle image", "nothing moved")  # by which work is skipped
ALL = "all"


class StampError(FinforceError, ValueError):
    """A stamp repeats, goes back or lies ahead of the clock."""


class StaleError(FinforceError, ValueError):
    """The data are older than what may be published."""


_RESTART = 1 * NANOSECONDS  # by which stamps go back where a new recording begins; late images are nearer


class StampGate:
    """Lets a sample through once, in order, and only while it is fresh.

    Args:
        max_age: greatest age of a sample [s]; a stamp may lie as far ahead of the clock.
    """

    def __init__(self, max_age: float) -> None:
        self.limit(max_age)
        self._last: int | None = None

    def limit(self, max_age: float) -> None:
        """Change the greatest age of a sample [s]."""
        self._max_age = round(max_age * NANOSECONDS)

    def enter(self, stamp: int, now: int) -> bool:
        """Admit a sample and return whether a new recording begins with it.

        Args:
            stamp: image time [ns].
            now: the node's clock [ns].

        Raises:
            StaleError: the sample is too old.
            StampError: the stamp repeats, goes back by less than a second or lies ahead of the clock.
        """
        self.check_age(stamp, now)
        back = 0 if self._last is None else self._last - stamp
        if self._last is not None and 0 <= back <= _RESTART:
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


_PERIOD = NANOSECONDS // 10  # of the answers while nothing happens, counted from stamp 0


class Idling:
    """Passes images over while nothing happens: of every tenth of a second one is answered, in every node the same."""

    def __init__(self) -> None:
        self._answered: int | None = None

    @property
    def is_idle(self) -> bool:
        """True if nothing happened in the last image that was answered."""
        return self._answered is not None

    def passes(self, stamp: int) -> bool:
        """Say whether an image [ns] may be passed over: one of its period was answered, and nothing happened then."""
        return self._answered == stamp // _PERIOD

    def note(self, stamp: int, idle: bool) -> None:
        """Note that an image [ns] was answered, and whether nothing happened in it."""
        self._answered = stamp // _PERIOD if idle else None

    def end(self) -> None:
        """Note that something happens."""
        self._answered = None


class Level(IntEnum):
    """The levels of diagnostic_msgs/DiagnosticStatus."""

    OK = 0
    WARN = 1
    ERROR = 2
    STALE = 3


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """The outcome of one message: its level, one word to count it by, one sentence."""

    level: Level
    reason: str
    text: str

    @classmethod
    def of_error(cls, error: FinforceError) -> Outcome:
        """Return the outcome of a refused message, counted by the name of the error's class."""
        level = Level.STALE if isinstance(error, StaleError) else Level.ERROR
        return cls(level=level, reason=type(error).__name__.removesuffix("Error").lower(), text=str(error))


@dataclass(frozen=True, kw_only=True)
class Report:
    """The state of a node as it is shown: level, sentence and named values."""

    level: Level
    message: str
    values: Mapping[str, str] = field(default_factory=dict)


_WINDOW = 512  # messages that rates and latencies are taken over


class Health:
    """Keeps the last outcomes of a node and says how it is.

    Attributes:
        source: the topic that drives the node.
        times: names of the latency and of the age of a message.

    Args:
        source: the same, as far as it is known at the start.
        stale_after: silence after which the node is stale [s].
    """

    times = ("callback to published", "image to published")

    def __init__(self, *, source: str, stale_after: float) -> None:
        self.source = source
        self._stale_after = stale_after
        self._arrivals: deque[float] = deque(maxlen=_WINDOW)
        self._latency: deque[float] = deque(maxlen=_WINDOW)
        self._age: deque[float] = deque(maxlen=_WINDOW)
        self._refused: Counter[str] = Counter()
        # the last of each kind: however many are refused between two reports
        self._recent: dict[tuple[Level, str], Outcome] = {}
        self._last: Outcome | None = None
        self._arrived = self._published = 0
        self._resumed = -inf

    def resume(self) -> None:
        """Note that nothing was to arrive so far."""
        self._resumed = monotonic()

    def arrive(self, source: str = "") -> None:
        """Count a message that arrived, and keep where it came from."""
        self.source = source or self.source
        self._arrived += 1
        self._arrivals.append(monotonic())

    def publish(self, outcome: Outcome, *, latency: float, age: float) -> None:
        """Count a published result: time since its callback began and age of its data [s]."""
        self._published += 1
        self._latency.append(latency)
        self._age.append(age)
        self._last = outcome

    def refuse(self, outcome: Outcome) -> None:
        """Count a message of which nothing was published."""
        self._refused[outcome.reason] += 1
        self._recent[outcome.level, outcome.reason] = outcome
        self._last = outcome

    def report(
        self, alarms: Sequence[Outcome] = (), values: Mapping[str, str] | None = None, unheard: str = ""
    ) -> Report:
        """Return the state now, and what was refused since the last report.

        An error goes before the silence that may follow from it; a refusal turns OK into WARN.

        Args:
            alarms: standing faults, beside the messages'.
            values: further values to be shown.
            unheard: the answers that the node does not make because nobody subscribes to them.
        """
        level, text = (Level.OK, f"idle: no subscriber on the {unheard}") if unheard else self._state()
        troubles = [*alarms, *(() if unheard else self._recent.values())]
        if any(trouble.level == Level.ERROR for trouble in troubles):
            level = Level.ERROR
        elif troubles:
            level = max(level, Level.WARN)
        reasons = {trouble.reason: trouble.text for trouble in troubles}
        message = "; ".join(dict.fromkeys([*reasons.values(), text]))
        self._recent.clear()
        return Report(level=level, message=message, values={**self._figures(), **(values or {})})

    def _state(self) -> tuple[Level, str]:
        """Return level and sentence from the messages alone."""
        if not self._arrivals or self._last is None:
            return Level.STALE, f"nothing has arrived on {self.source}"
        silence = monotonic() - max(self._arrivals[-1], self._resumed)
        if silence > self._stale_after:
            return Level.STALE, f"nothing has arrived on {self.source} for {silence:.1f} s"
        return self._last.level, self._last.text

    def _figures(self) -> dict[str, str]:
        """Return rate, latencies and counts as text."""
        times = [time for time in self._arrivals if monotonic() - time < 5.0]
        rate = (len(times) - 1) / (times[-1] - times[0]) if len(times) > 1 else 0.0
        latency, age = self.times
        return {
            "rate [Hz]": f"{rate:.1f}",
            **_percentiles(latency, self._latency),
            **_percentiles(age, self._age),
            "arrived": str(self._arrived),
            "published": str(self._published),
            "refused": ", ".join(f"{count} {reason}" for reason, count in self._refused.most_common()) or "none",
        }


def _percentiles(name: str, seconds: Sequence[float]) -> dict[str, str]:
    """Return two percentiles of times [s] as text in milliseconds."""
    percents = (50, 95)
    found = [f"{1e3 * time:.2f}" for time in np.percentile(seconds, percents)] if seconds else ("-", "-")
    return {f"{name} p{percent} [ms]": text for percent, text in zip(percents, found, strict=True)}


class SkippingError(FinforceError):
    """A rule that is to be switched off does not exist."""


class Skips:
    """Work that a scene does not need: which rules may be applied, and how often each was.

    Args:
        off: names of rules that are not to be applied; "all" for none of them.

    Raises:
        SkippingError: a name in `off` is no rule.
    """

    def __init__(self, off: Collection[str] = ()) -> None:
        unknown = sorted(set(off) - {*RULES, ALL, ""})
        if unknown:
            raise SkippingError(f"skip_off: there is no rule {unknown[0]!r}; expected {', '.join(RULES)} or {ALL}")
        self._off = frozenset(RULES if ALL in off else off)
        self._counts: Counter[str] = Counter()

    def allows(self, rule: str) -> bool:
        """Say whether a rule may be applied."""
        return rule not in self._off

    def count(self, rule: str, times: int = 1) -> None:
        """Note that a rule has saved its work."""
        self._counts[rule] += times

    def describe(self) -> dict[str, str]:
        """Return, for the diagnostics, how often each rule saved its work, or that it is off."""
        return {f"skipped: {rule}": str(self._counts[rule]) if self.allows(rule) else "off" for rule in RULES}
