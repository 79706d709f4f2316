"""Whether the jaws are loaded, and which measured forces may be believed."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from statistics import median

from finforce_driver.errors import GraspError
from finforce_driver.grasp.force_model import ForceModel
from finforce_driver.grasp.settings import GraspSettings

_LARGEST_OFFSET = 0.2  # [N] that an unloaded estimate may show
_CONFIRMED = 2  # images in a row that make an onset, or a jump
_EMPTY = 3  # images in a row without force after which the object is gone


@dataclass(frozen=True, kw_only=True)
class LocatedForce:
    """A force and where it belongs.

    Attributes:
        force: [N].
        stamp: time of the image [s].
        opening: at that time [m].
        way_stddev: standard deviation of the way since the last force that was no passing one [m].
        resting: the jaws rested at their target.
        passing: from a way between two rests, whose ends say more than it does.
    """

    force: float
    stamp: float
    opening: float
    way_stddev: float = 0.0
    resting: bool = False
    passing: bool = False


class LoadWatch:
    """Tells contact from offset, and jumps that motion does not explain from forces.

    Args:
        settings: limits and expectations.
        onset_force: above what is seen without load, it says that something presses [N].

    Attributes:
        model: of force over opening, in use once loaded.
        loaded: whether something presses.
        doubtful: whether the newest force was set aside as a possible jump.
        force: the newest that was believed [N]; NaN before the first.
        opening: that belongs to it [m].
        resting: whether the jaws rested then.
        peak: the largest while loaded [N].
    """

    def __init__(self, settings: GraspSettings, onset_force: float) -> None:
        self._settings, self._onset_force = settings, onset_force
        self.model = ForceModel(stiffness=settings.largest_stiffness, noise=settings.noise)
        self.loaded = self.doubtful = self.resting = False
        self.force = self.opening = math.nan
        self.peak = 0.0
        self._idle: deque[float] = deque([0.0], maxlen=15)
        self._above = self._doubts = self._empty = 0

    @property
    def pressing(self) -> float:
        """The force that has to be reckoned with [N]: the model's, before contact the measured one."""
        return self.model.force if self.loaded else self.force

    @property
    def onset(self) -> float:
        """Force [N] above which the jaws are loaded: the offset without load, and the onset force."""
        return min(median(self._idle), _LARGEST_OFFSET) + self._onset_force

    def take(self, sample: LocatedForce, touching: bool) -> None:
        """Take the force of a later image.

        Args:
            sample: force, time and opening.
            touching: the jaws are said to touch, so that one image makes an onset.

        Raises:
            GraspError: the force is above the limit, a jump was confirmed, or the object is gone.
        """
        self.doubtful = self._is_jump(sample)
        if self.doubtful:
            return
        if sample.force > self._settings.force_limit:
            raise GraspError(
                f"the force is {sample.force:.2f} N, above the limit of {self._settings.force_limit:g} N: the jaws hold"
            )
        self.force, self.opening, self.resting = sample.force, sample.opening, sample.resting
        if not self.loaded:
            self._watch_onset(sample, touching)
            return
        if not sample.passing:
            self.model.update(sample.opening, sample.force, sample.stamp, sample.way_stddev)
        self._check_presence(sample.force)
        self.peak = max(self.peak, sample.force)

    def _watch_onset(self, sample: LocatedForce, touching: bool) -> None:
        """Begin the model with the first of the images that show a load."""
        if sample.force <= self.onset:
            self._above = 0
            self._idle.append(sample.force)
            return
        self._above += 1
        if self._above == 1:
            self.model.begin(sample.opening, sample.force, sample.stamp)
        else:
            self.model.update(sample.opening, sample.force, sample.stamp, sample.way_stddev)
        self.loaded = touching or self._above >= _CONFIRMED

    def _is_jump(self, sample: LocatedForce) -> bool:
        """Whether neither motion nor noise explains a force.

        Raises:
            GraspError: that is so in two images in a row.
        """
        if math.isnan(self.force):
            return False
        beyond = self._surprise(sample)
        if abs(beyond) <= self._settings.jump:
            self._doubts = 0
            return False
        self._doubts += 1
        if self._doubts >= _CONFIRMED:
            verb = "jumped to" if beyond > 0.0 else "fell to"
            raise GraspError(
                f"the force {verb} {sample.force:.2f} N from {self.force:.2f} N, which no motion of the jaws explains: "
                "did the object slip, break or get pushed?"
            )
        return True

    def _surprise(self, sample: LocatedForce) -> float:
        """Return by how much a force differs from what may be expected [N], signed."""
        if self.loaded:
            return self.model.surprise(sample.opening, sample.force)
        # where contact began between the two images is not known: any force up to the greatest stiffness may be
        reach = self._settings.largest_stiffness * max(0.0, self.opening - sample.opening)
        return max(0.0, sample.force - self.force - reach)

    def _check_presence(self, force: float) -> None:
        """Refuse to press on after the force has gone.

        Raises:
            GraspError: several images in a row show none, after there was one.
        """
        self._empty = self._empty + 1 if force < 0.5 * self.onset < 0.25 * self.peak else 0
        if self._empty >= _EMPTY:
            raise GraspError(
                f"the force of {self.peak:.2f} N has gone: the object slipped out or broke; open, look, and grasp anew"
            )
