"""Forces and touches as a camera sends them: which may be believed, how late and how often."""

from __future__ import annotations

import math
from collections import Counter, deque
from dataclasses import dataclass
from statistics import median

_AHEAD = 0.005  # [s] that a stamp may lie ahead of its arrival: the two clocks are read one after the other
_PERIOD = 1.0 / 30.0  # [s] of a D405, until it is measured
_LATENCY = 0.1  # [s] until it is measured
_KNOWN = 8  # samples after which the latency is known


@dataclass(frozen=True, kw_only=True)
class ForceSample:
    """The grasp force of one image.

    Attributes:
        stamp: time of the image [s], on the driver's clock.
        arrived: when the force was there [s], on the same clock.
        force: [N].
    """

    stamp: float
    arrived: float
    force: float


@dataclass(frozen=True, kw_only=True)
class TouchSample:
    """Whether the jaws were said to touch in the image at `stamp` [s], on the driver's clock."""

    stamp: float
    touching: bool


class ForceFeed:
    """Admits samples once, in order and with times that can be; measures latency and period.

    Args:
        stale_after: age of an image after which it is not admitted [s].

    Attributes:
        stamp: of the newest admitted image with a force [s]; NaN before the first.
        touch: the newest word on touching; None before the first.
        touched_since: time of the first image of those in a row that show touching [s]; NaN while none does.
        refused: samples that were not admitted, by reason.
    """

    def __init__(self, stale_after: float) -> None:
        self._stale_after = stale_after
        self.stamp = math.nan
        self.touch: TouchSample | None = None
        self.touched_since = math.nan
        self.refused: Counter[str] = Counter()
        self._latencies: deque[float] = deque(maxlen=31)
        self._periods: deque[float] = deque(maxlen=31)

    @property
    def heard(self) -> bool:
        """Whether any force was admitted."""
        return not math.isnan(self.stamp)

    def is_touching(self, now: float) -> bool:
        """Whether the newest fresh word says that the jaws touch."""
        return self.touch is not None and self.touch.touching and now - self.touch.stamp <= self._stale_after

    @property
    def latency(self) -> float:
        """Median time from image to arrival [s]."""
        return median(self._latencies) if self._latencies else _LATENCY

    @property
    def period(self) -> float:
        """Median time between images with a force [s]."""
        return median(self._periods) if self._periods else _PERIOD

    def age(self, now: float) -> float:
        """Return the age of the newest image with a force [s]; infinite before the first."""
        return now - self.stamp if self.heard else math.inf

    def admit(self, sample: ForceSample) -> bool:
        """Take a force if its times can be; otherwise count why not."""
        reason = self._doubt(sample)
        if reason:
            self.refused[reason] += 1
            return False
        if self.heard:
            self._periods.append(sample.stamp - self.stamp)
        self._latencies.append(sample.arrived - sample.stamp)
        self.stamp = sample.stamp
        return True

    def admit_touch(self, sample: TouchSample, now: float) -> bool:
        """Take a word on touching if it is newer than the last one and fresh."""
        newest = self.touch is None or sample.stamp > self.touch.stamp
        if not (newest and -_AHEAD <= now - sample.stamp <= self._stale_after):
            self.refused["touch out of time"] += 1
            return False
        self.touch = sample
        if not sample.touching:
            self.touched_since = math.nan
        elif math.isnan(self.touched_since):
            self.touched_since = sample.stamp
        return True

    def _doubt(self, sample: ForceSample) -> str:
        """Return why the times of a sample cannot be; empty when they can."""
        latency = sample.arrived - sample.stamp
        if not math.isfinite(latency):
            return "no time"
        if latency < -_AHEAD:
            return "from the future"
        if latency > self._stale_after:
            return "too old"
        if self.heard and sample.stamp <= self.stamp:
            return "out of order"
        # a clock that was set makes images seem newer than they are, and jaws farther than they were
        if len(self._latencies) >= _KNOWN and latency < 0.25 * self.latency:
            return "sooner than can be"
        return ""
