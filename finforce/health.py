"""How a node is doing: rates, latencies, rejections, skipped work and the level that follows."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from enum import IntEnum
from time import monotonic

import numpy as np

from finforce.errors import FinforceError
from finforce.stamps import StaleError

RULES = UNHEARD, IDLE, STILL = ("nobody subscribes", "idle image", "nothing moved")  # by which work is skipped
ALL = "all"


class Level(IntEnum):
    """The levels of diagnostic_msgs/DiagnosticStatus."""

    OK = 0
    WARN = 1
    ERROR = 2
    STALE = 3


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """What became of one message: its level, one word to count it by, one sentence."""

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


class Health:
    """Keeps the last outcomes of a node and says how it is.

    Attributes:
        source: the topic that drives the node.

    Args:
        source: the same, as far as it is known at the start.
        stale_after: silence after which the node is stale [s].
        window: number of messages that rates and latencies are taken over.
    """

    def __init__(self, *, source: str, stale_after: float, window: int = 512) -> None:
        self.source = source
        self._stale_after = stale_after
        self._arrivals: deque[float] = deque(maxlen=window)
        self._latency: deque[float] = deque(maxlen=window)
        self._age: deque[float] = deque(maxlen=window)
        self._refused: Counter[str] = Counter()
        # the last of each kind: however many are refused between two reports
        self._recent: dict[tuple[Level, str], Outcome] = {}
        self._last: Outcome | None = None
        self._arrived = self._published = 0

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

    def report(self, alarms: Sequence[Outcome] = (), values: Mapping[str, str] | None = None) -> Report:
        """Return the state now, and what was refused since the last report.

        An error goes before the silence that may follow from it; a refusal turns OK into WARN.

        Args:
            alarms: standing faults, beside the messages'.
            values: further values to be shown.
        """
        level, text = self._state()
        troubles = [*alarms, *self._recent.values()]
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
        silence = monotonic() - self._arrivals[-1]
        if silence > self._stale_after:
            return Level.STALE, f"nothing has arrived on {self.source} for {silence:.1f} s"
        return self._last.level, self._last.text

    def _figures(self) -> dict[str, str]:
        """Return rate, latencies and counts as text."""
        times = [time for time in self._arrivals if monotonic() - time < 5.0]
        rate = (len(times) - 1) / (times[-1] - times[0]) if len(times) > 1 else 0.0
        return {
            "rate [Hz]": f"{rate:.1f}",
            "callback to published p50 [ms]": _percentile(self._latency, 50),
            "callback to published p95 [ms]": _percentile(self._latency, 95),
            "image to published p50 [ms]": _percentile(self._age, 50),
            "image to published p95 [ms]": _percentile(self._age, 95),
            "arrived": str(self._arrived),
            "published": str(self._published),
            "refused": _counts(self._refused),
        }


def _percentile(seconds: Sequence[float], percent: float) -> str:
    """Return a percentile of times [s] as text in milliseconds."""
    return f"{1e3 * float(np.percentile(seconds, percent)):.2f}" if len(seconds) else "-"


def _counts(counter: Counter[str]) -> str:
    """Return counts as text, the most frequent first."""
    return ", ".join(f"{count} {reason}" for reason, count in counter.most_common() if count) or "none"


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
