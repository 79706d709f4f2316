"""Where the jaws were told to go, and where they were at the time of an image."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

from finforce_driver.can.protocol import LARGEST_BYTE
from finforce_driver.errors import GraspError
from finforce_driver.state import GripperState

# A command waits for its turn on the bus, the jaws come to rest, and the driver may step them one by one.
SETTLING = 0.08  # [s]
_NEAR = 2.0  # steps between target and reported opening at rest: the byte is truncated, and flickers by one
_SMALL = 2.5  # steps: fewer are not planned anew on the way
_POWERED_AFTER = 0.3  # [s] of the first command, which switches the power stage on
_LATE = 1.0  # [s] after which jaws that have not come do not follow
# A byte says the opening to a step; between two bytes it is interpolated. At rest the jaws are within 4 ticks.
_MOVING_STDDEV, _RESTING_STDDEV = 0.35, 0.1  # [steps]


@dataclass(frozen=True, kw_only=True)
class JawPlace:
    """An opening [m] on the scale of the commands, and whether the jaws rested there, at their target."""

    opening: float
    resting: bool


class JawHistory:
    """The gripper's steps, the last command, and the openings that follow from it.

    At rest the commanded opening says more than the reported byte, which is truncated and flickers.

    Args:
        resolution: a step of the gripper [m].
        closed_opening: of the closed gripper [m].

    Attributes:
        closed: the same.
        widest: opening at the last step [m].
        target: commanded opening [m]; NaN before the first command.
        speed: commanded [m/s].
        stepping: the last command was a few steps from rest, whose effect is to be seen at rest again.
    """

    def __init__(self, *, resolution: float, closed_opening: float) -> None:
        self.resolution = resolution
        self.closed, self.widest = closed_opening, closed_opening + LARGEST_BYTE * resolution
        self.target = math.nan
        self.speed = 0.0
        self.stepping = False
        self._arrives = math.inf
        self._powered_from = math.inf

    def snap(self, opening: float) -> float:
        """Return the nearest step [m] that is not more closed than `opening` [m]."""
        return self.closed + math.ceil((opening - self.closed) / self.resolution - 1e-6) * self.resolution

    def nearest(self, opening: float) -> float:
        """Return the step [m] nearest to a reported opening [m]."""
        return self.snap(opening - 0.5 * self.resolution)

    def command(self, target: float, speed: float, now: float, here: JawPlace) -> None:
        """Remember a command and when the jaws, now at `here`, will have followed it."""
        self.stepping = here.resting and abs(target - here.opening) < _SMALL * self.resolution
        if math.isnan(self.target):
            self._powered_from = now + _POWERED_AFTER
        self.target, self.speed = target, speed
        self._arrives = now + abs(target - here.opening) / speed + SETTLING

    def check_power(self, state: GripperState) -> None:
        """Refuse jaws that have gone limp since the first command.

        Raises:
            GraspError: the power stage is off.
        """
        if state.stamp > self._powered_from and not state.activated:
            raise GraspError("the gripper's power stage is off: did somebody else switch it off?")

    def rests_at(self, stamp: float, reported: float) -> bool:
        """Whether the jaws stood at their target at the time `stamp` [s], when `reported` [m] was their opening."""
        return stamp >= self._arrives and abs(reported - self.target) <= _NEAR * self.resolution

    def is_late(self, now: float, reported: float) -> bool:
        """Whether the jaws should have been at their target for long and are not there."""
        return now > self._arrives + _LATE and abs(reported - self.target) > (_NEAR + 1.0) * self.resolution

    def locate(self, stamp: float, state: GripperState, opening_at: Callable[[float], float]) -> JawPlace:
        """Return where the jaws were at a past time [s]; NaN when it is not known."""
        reported = state.opening if stamp >= state.stamp else opening_at(stamp)
        if self.rests_at(stamp, reported):
            return JawPlace(opening=self.target, resting=True)
        return JawPlace(opening=reported, resting=False)

    def way_stddev(self, before: JawPlace, after: JawPlace) -> float:
        """Return the standard deviation of the way between two places [m]."""
        if before == after:
            return 0.0
        is_exact = before.resting and after.resting
        return (_RESTING_STDDEV if is_exact else _MOVING_STDDEV) * self.resolution
