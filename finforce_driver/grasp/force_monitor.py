"""Plausibility of a camera's forces, load of the jaws, and the slope of the force over the opening.

Between two images the opening changes by d (closing: d > 0) and the force by k d, where neither stays what it was:
fingers relax, contact spreads. A Kalman filter follows both,

    F <- F + k d,   k <- k,   Q_FF = drift^2 dt + (k s_d)^2,   Q_kk = growth^2 |d|,

with the variance s_d^2 of d, and measures F with a noise that it learns from its innovations.
"""

from __future__ import annotations

import math
from collections import Counter, deque
from dataclasses import dataclass
from statistics import median

from finforce_driver.errors import BackOffError, GraspError
from finforce_driver.settings import GraspSettings

NOISE = 0.05  # [N], standard deviation of a force that is expected at first
_JUMP = 1.0  # [N] between two images, beyond what motion and noise explain
_LARGEST_OFFSET = 0.2  # [N] that an unloaded estimate may show
_CONFIRMED = 2  # images in a row that make an onset, or a jump
_FROZEN = 4  # images in a row with the same force to the last digit
_FROZEN_WAY = 0.4e-3  # [m], closed meanwhile, from which on the force counts as frozen
_EMPTY = 3  # images in a row without force after which the object is gone


@dataclass(frozen=True, kw_only=True)
class ForceSample:
    """The grasp force of one image.

    Attributes:
        stamp: time of the image [s], on the driver's clock.
        arrived: when the force was there [s], on the same clock.
        force: [N].
        stddev: of the force, as its source states it [N]; 0 where it states none.
    """

    stamp: float
    arrived: float
    force: float
    stddev: float = 0.0


@dataclass(frozen=True, kw_only=True)
class TouchSample:
    """Return True if the jaws are reported to touch in the image at `stamp` [s], on the driver's clock."""

    stamp: float
    touching: bool


@dataclass(frozen=True, kw_only=True)
class JawPosition:
    """An opening [m] on the scale of the commands, and whether the jaws rested there, at their target."""

    opening: float
    resting: bool


class ForceMonitor:
    """Detects contact, and rejects jumps of the force that motion does not explain.

    Args:
        settings: limits and expectations.
        onset_force: force above the unloaded level from which something presses [N].

    Attributes:
        model: of force over opening, in use once loaded.
        loaded: True if something presses.
        suspect: True if the newest force was rejected as a possible jump.
        force: the newest plausible one [N]; NaN before the first.
        opening: of the jaws at that force [m].
        resting: True if the jaws rested then.
        peak: the largest while loaded [N].
        stddev: of that force, as its source states it [N].
    """

    def __init__(self, settings: GraspSettings, onset_force: float) -> None:
        self._settings, self._onset_force = settings, onset_force
        self.model = ForceModel(stiffness=settings.largest_stiffness, noise=NOISE)
        self.loaded = self.suspect = self.resting = False
        self.force = self.opening = math.nan
        self.peak = self._peak = self.stddev = 0.0  # the second one since the jaws last opened
        self._idle: deque[float] = deque([0.0], maxlen=15)
        self._above = self._jumps = self._empty = self._same = 0
        self._last = self._last_opening = math.nan

    @property
    def pressing(self) -> float:
        """The force that has to be reckoned with [N]: the model's, before contact the measured one."""
        return self.model.force if self.loaded else self.force

    @property
    def onset(self) -> float:
        """Force [N] above which the jaws are loaded: the offset without load, and the onset force."""
        return min(median(self._idle), _LARGEST_OFFSET) + self._onset_force

    def take(
        self,
        sample: ForceSample,
        jaws: JawPosition,
        *,
        travel_stddev: float = 0.0,
        passing: bool = False,
        touching: bool = False,
    ) -> None:
        """Take the force of a later image.

        Args:
            sample: the force.
            jaws: where they were at its image.
            travel_stddev: standard deviation of the travel since the last force that was no passing one [m].
            passing: taken between two rests, which say more than it does.
            touching: the jaws are reported to touch, so that one image makes an onset.

        Raises:
            GraspError: the force is above the limit or frozen, a jump was confirmed, or the object is gone.
        """
        self._check_life(sample.force, jaws.opening)
        self.suspect = self._is_jump(sample.force, jaws.opening)
        if self.suspect:
            return
        if sample.force > self._settings.force_limit:
            raise GraspError(
                f"the force is {sample.force:.2f} N, above the limit of {self._settings.force_limit:g} N: the jaws hold"
            )
        if jaws.opening > self.opening:
            self._peak = 0.0
        self.force, self.opening, self.resting = sample.force, jaws.opening, jaws.resting
        self.stddev = sample.stddev
        if not self.loaded:
            self._watch_onset(sample, jaws, travel_stddev, touching)
            return
        if not passing:
            self.model.update(jaws.opening, sample.force, sample.stamp, travel_stddev)
        self._check_presence(sample.force)
        self.peak, self._peak = max(self.peak, sample.force), max(self._peak, sample.force)

    def _watch_onset(self, sample: ForceSample, jaws: JawPosition, travel_stddev: float, touching: bool) -> None:
        """Begin the model with the first of the images that show a load."""
        if sample.force <= self.onset:
            self._above = 0
            self._idle.append(sample.force)
            return
        self._above += 1
        if self._above == 1:
            self.model.begin(jaws.opening, sample.force, sample.stamp)
        else:
            self.model.update(jaws.opening, sample.force, sample.stamp, travel_stddev)
        self.loaded = touching or self._above >= _CONFIRMED

    def _is_jump(self, force: float, opening: float) -> bool:
        """Return True if neither motion nor noise explains a force.

        Raises:
            BackOffError: that is so in two images in a row, and the jaws have just touched something.
            GraspError: likewise, later.
        """
        if math.isnan(self.force):
            return False
        beyond = self._excess(force, opening)
        if abs(beyond) <= _JUMP:
            self._jumps = 0
            return False
        self._jumps += 1
        if self._jumps >= _CONFIRMED and not self.loaded and opening < self.opening:
            bound = f"{1e-3 * self._settings.largest_stiffness:g} N/mm (largest_stiffness)"
            raise BackOffError(
                f"the force rose to {force:.2f} N at the first touch, more than {bound} explain: is "
                "something stiffer than that between the jaws? They back off"
            )
        if self._jumps >= _CONFIRMED:
            verb = "jumped to" if beyond > 0.0 else "fell to"
            raise GraspError(
                f"the force {verb} {force:.2f} N from {self.force:.2f} N, which no motion of the jaws explains: "
                "did the object slip, break or get pushed?"
            )
        return True

    def _excess(self, force: float, opening: float) -> float:
        """Return by how much a force differs from what may be expected [N], signed."""
        if self.loaded:
            excess = self.model.excess(opening, force)
            # jaws that open may let go of something stiffer than was learnt
            return excess if excess > 0.0 or opening <= self.opening else 0.0
        # where contact began between the two images is not known: any force up to the greatest stiffness may be
        reach = self._settings.largest_stiffness * max(0.0, self.opening - opening)
        return max(0.0, force - self.force - reach)

    def _check_life(self, force: float, opening: float) -> None:
        """Refuse a force that stays the same while the jaws close; none at all always does.

        Raises:
            GraspError: several images in a row have the same force to the last digit.
        """
        if force != self._last or force <= 0.0:
            self._same, self._last, self._last_opening = 0, force, opening
            return
        self._same += 1
        # below the onset an offset may be the same for ever
        if force > self.onset and self._same >= _FROZEN - 1 and self._last_opening - opening > _FROZEN_WAY:
            raise GraspError(
                f"the force is {force} N to the last digit in {self._same + 1} images, although the jaws close: "
                "is the estimator frozen?"
            )

    def _check_presence(self, force: float) -> None:
        """Refuse to press on after the force has gone.

        Raises:
            GraspError: several images in a row show none, after there was one.
        """
        self._empty = self._empty + 1 if force < 0.5 * self.onset < 0.25 * self._peak else 0
        if self._empty >= _EMPTY:
            raise GraspError(
                f"the force of {self._peak:.2f} N has gone: the object slipped out or broke; open, look, grasp again"
            )


_AHEAD = 0.005  # [s] that a stamp may lie ahead of its arrival: the two clocks are read one after the other
_PERIOD = 1.0 / 30.0  # [s] of a D405, until it is measured
_LATENCY = 0.1  # [s] until it is measured
_SOONEST = 0.1  # of the median latency: a pipeline that others have left alone becomes several times as fast
_KNOWN = 8  # samples after which the latency is known


class ForceFilter:
    """Admits each sample once, in order and with plausible times; measures latency and period.

    Args:
        stale_after: age of an image after which it is not admitted [s].

    Attributes:
        stamp: of the newest admitted image with a force [s]; NaN before the first.
        touch: the newest report on touching; None before the first.
        touched_since: time of the first image of those in a row that show touching [s]; NaN while none does.
        rejected: samples that were not admitted, by reason.
        last_rejection: why the newest force was not, with what would help; empty once one is.
    """

    def __init__(self, stale_after: float) -> None:
        self._stale_after = stale_after
        self.stamp = math.nan
        self.touch: TouchSample | None = None
        self.touched_since = math.nan
        self.rejected: Counter[str] = Counter()
        self.last_rejection = ""
        self._latencies: deque[float] = deque(maxlen=31)
        self._periods: deque[float] = deque(maxlen=31)

    @property
    def heard(self) -> bool:
        """True if any force was admitted."""
        return not math.isnan(self.stamp)

    def touching(self, now: float) -> bool | None:
        """Return whether the newest fresh report says that the jaws touch; None without one."""
        fresh = self.touch is not None and now - self.touch.stamp <= self._stale_after
        return self.touch.touching if fresh else None

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
        reason = self._find_fault(sample)
        if reason:
            self.reject(reason, f"{reason}, {sample.arrived - sample.stamp:.2f} s after its image")
            return False
        self.last_rejection = ""
        if self.heard:
            self._periods.append(sample.stamp - self.stamp)
        self._latencies.append(sample.arrived - sample.stamp)
        self.stamp = sample.stamp
        return True

    def reject(self, reason: str, words: str) -> None:
        """Count a force that cannot be used, and keep why."""
        self.rejected[reason] += 1
        self.last_rejection = words

    def check_silence(self, now: float, started: float, timeout: float) -> None:
        """Refuse to go on without fresh data of the camera.

        Before the first force a report on touching will do: an estimator that waits for its first contact has none yet.

        Args:
            now: time [s].
            started: when the grasp began [s].
            timeout: maximum wait for a force once the jaws touch [s]; twice as long before.

        Raises:
            GraspError: forces have become stale, or did not come when they were due.
        """
        cause = f"those that came were rejected, the last one as {self.last_rejection}" if self.last_rejection else ""
        if self.heard:
            if self.age(now) > self._stale_after:
                raise GraspError(
                    f"the newest force is {self.age(now):.2f} s old, at most {self._stale_after:g} s are allowed: "
                    + (cause or "is the camera there, and the solver sure of itself?")
                )
            return
        if now - self.touched_since > timeout:
            words = f"the jaws are reported to touch, but no force came for {now - self.touched_since:.2f} s"
            raise GraspError(f"{words}: {cause}" if cause else words)
        heard = max(started, self.touch.stamp if self.touch else started)
        if now - heard > 2.0 * timeout:
            raise GraspError(
                f"no force came for {now - heard:.2f} s: "
                + (cause or "is the camera there, are the solvers tared (30 unloaded images)?")
            )

    def admit_touch(self, sample: TouchSample, now: float) -> bool:
        """Take a report on touching if it is newer than the last one and fresh."""
        newest = self.touch is None or sample.stamp > self.touch.stamp
        if not (newest and -_AHEAD <= now - sample.stamp <= self._stale_after):
            self.rejected["touch out of time"] += 1
            return False
        self.touch = sample
        if not sample.touching:
            self.touched_since = math.nan
        elif math.isnan(self.touched_since):
            self.touched_since = sample.stamp
        return True

    def _find_fault(self, sample: ForceSample) -> str:
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
        if len(self._latencies) >= _KNOWN and latency < _SOONEST * self.latency:
            return "sooner than can be"
        return ""


LEAST_STIFFNESS = 50.0  # [N/m] a jaw that gives way more than this holds nothing

# Fingers of TPU lose up to 0.3 N/s just after a press of 5 N; half of that per sqrt(s) follows them within 0.3 s.
_DRIFT = 0.15  # [N/sqrt(s)]
# A finger stiffens from 0.4 to 1.3 N/mm within 5 mm.
_GROWTH = 9e3  # [N/m per sqrt(m)], 0.28 N/mm after one millimetre
_NOISE_MEMORY = 0.05  # share of a new innovation
_LEAST_NOISE = 0.02  # [N]
_LARGEST_NOISE = 0.25  # [N]


class ForceModel:
    """The force of the fingers at the opening of the newest image, and its slope over the opening.

    Args:
        stiffness: expected at first [N/m], better too large than too small.
        noise: standard deviation of the force expected at first [N].

    Attributes:
        force: [N] at `opening`.
        stiffness: change of the force per metre of closing [N/m].
        noise: standard deviation of one measured force [N], as learnt.
        opening: of the newest image [m]; NaN before the first.
    """

    def __init__(self, *, stiffness: float, noise: float) -> None:
        self.force = self.stamp = self.opening = math.nan
        self.stiffness = stiffness
        self._noise_variance = noise**2
        self._force_variance = noise**2
        self._stiffness_variance = (0.5 * stiffness) ** 2
        self._covariance = 0.0

    @property
    def noise(self) -> float:
        """Standard deviation of one measured force [N]."""
        return math.sqrt(self._noise_variance)

    @property
    def force_stddev(self) -> float:
        """Standard deviation of `force` [N]."""
        return math.sqrt(self._force_variance)

    @property
    def stiffness_stddev(self) -> float:
        """Standard deviation of `stiffness` [N/m]."""
        return math.sqrt(self._stiffness_variance)

    @property
    def safe_stiffness(self) -> float:
        """A stiffness that is hardly exceeded from here on [N/m]: two deviations and a tenth more."""
        return 1.1 * self.stiffness + 2.0 * self.stiffness_stddev

    @property
    def likely_stiffness(self) -> float:
        """A stiffness that a single step hardly exceeds [N/m]: a quarter of a deviation and a twentieth more."""
        return 1.05 * self.stiffness + 0.25 * self.stiffness_stddev

    def begin(self, opening: float, force: float, stamp: float) -> None:
        """Start from the force [N] of an image at `stamp` [s] and its opening [m]."""
        self.opening, self.force, self.stamp = opening, force, stamp
        self._force_variance = self._noise_variance

    def predict(self, opening: float) -> float:
        """Return the force [N] at another opening [m], never below zero."""
        return max(0.0, self.force + self.stiffness * (self.opening - opening))

    def excess(self, opening: float, force: float) -> float:
        """Return by how much a force [N] differs from the predicted one beyond four standard deviations [N], signed."""
        travel = self.opening - opening
        spread = self._force_variance + travel**2 * self._stiffness_variance + self._noise_variance
        beyond = force - self.predict(opening)
        return math.copysign(max(0.0, abs(beyond) - 4.0 * math.sqrt(spread)), beyond)

    def update(self, opening: float, force: float, stamp: float, travel_stddev: float) -> None:
        """Take the force [N] of a later image at `stamp` [s].

        Args:
            opening: at the time of the image [m].
            force: measured [N].
            stamp: time of the image [s].
            travel_stddev: standard deviation of the change of the opening since the last image [m].
        """
        travel, dt = self.opening - opening, max(0.0, stamp - self.stamp)
        forces, mixed, stiffnesses = self._force_variance, self._covariance, self._stiffness_variance
        forces += (
            2.0 * travel * mixed + travel**2 * stiffnesses + _DRIFT**2 * dt + (self.stiffness * travel_stddev) ** 2
        )
        mixed += travel * stiffnesses
        stiffnesses += _GROWTH**2 * abs(travel)
        innovation = force - (self.force + self.stiffness * travel)
        # what the innovation leaves beyond its expected variance
        seen = min(max(innovation**2 - forces, _LEAST_NOISE**2), _LARGEST_NOISE**2)
        self._noise_variance += _NOISE_MEMORY * (seen - self._noise_variance)
        total = forces + self._noise_variance
        self.force += self.stiffness * travel + forces / total * innovation
        self.stiffness = max(LEAST_STIFFNESS, self.stiffness + mixed / total * innovation)
        self._stiffness_variance = stiffnesses - mixed**2 / total
        self._covariance = mixed * (1.0 - forces / total)
        self._force_variance = forces * (1.0 - forces / total)
        self.opening, self.stamp = opening, stamp
