"""One move: where to, how, and what became of it; knows no frames."""

from __future__ import annotations

import math
from dataclasses import dataclass

from finforce_driver.protocol import Reply
from finforce_driver.state import Outcome
from finforce_driver.steps import LARGEST_LAG, Steps
from finforce_driver.units import Pace
from finforce_driver.verdict import MoveWatch

LOOSE_TIME = 0.1  # [s] without contact after which what was grasped is taken to be gone
PRESSING = (Outcome.GRASPED, Outcome.BLOCKED)


@dataclass(frozen=True, kw_only=True)
class Goal:
    """What was asked for.

    Attributes:
        opening: to be reached [m].
        position: the same [counts].
        pace: how fast.
        current_mA: limit [mA].
    """

    opening: float
    position: int
    pace: Pace
    current_mA: int


class MoveJob:
    """Carries out a goal; one that stalls goes on pressing, and on moving when what it presses on gives way.

    Attributes:
        goal: what was asked for.
        outcome: what became of it; NONE while it is under way.
        sent: an order of it has left.

    Args:
        goal: the same.
        start: where the target or the jaws are now [counts].
        rate: speed [counts/s].
        now: time [s].
    """

    def __init__(self, goal: Goal, *, start: float, rate: float, now: float) -> None:
        self.goal = goal
        self.outcome = Outcome.NONE
        self._rate = rate
        self.steps = Steps(start=start, goal=goal.position, rate=rate, now=now) if goal.pace.stepped else None
        allowed = 2.0 / rate if self.steps else abs(goal.position - start) / rate
        closing = goal.position > start
        self.watch = MoveWatch(position=goal.position, closing=closing, allowed=allowed, now=now)
        self._begun = self._pressed = now
        self.sent = False

    @property
    def position(self) -> int:
        """Where the gripper is to be sent now [counts]."""
        return self.steps.position if self.steps else self.goal.position

    @property
    def next_time(self) -> float:
        """When the target goes on [s]; infinite when it does not."""
        return self.steps.next_time if self.steps and not self.steps.done and self.stepping else math.inf

    @property
    def stepping(self) -> bool:
        """Whether the target may go on: under way, or pressing on something that may give way."""
        return self.outcome is Outcome.NONE or self.outcome in PRESSING

    def advance(self, now: float, place: float, stamp: float) -> None:
        """Let the target go on when it is due.

        Args:
            now: time [s].
            place: of the jaws [counts].
            stamp: when they were there [s].
        """
        if self.steps is None or not self.stepping or stamp <= self._begun:
            return
        if not self.sent and abs(self.steps.position - place) > LARGEST_LAG:
            # the link failed meanwhile, and the jaws are not where they were thought to be
            self.steps = Steps(start=place, goal=self.goal.position, rate=self._rate, now=now)
        before = self.steps.position
        self.steps.advance(now, place)
        if self.steps.position != before:
            self.watch.delay(now)

    def send(self, now: float) -> None:
        """Note that its order was sent."""
        self.sent = True
        self.watch.send(now)

    def take(self, reply: Reply, now: float) -> None:
        """Judge by a believed reply."""
        if self.outcome is Outcome.NONE:
            final = self.steps is None or self.steps.done
            self.outcome = self.watch.take(reply, now, final)
            self._pressed = now
        elif self.outcome in PRESSING:
            self._pressed = now if reply.contact else self._pressed
            if now - self._pressed > LOOSE_TIME:
                self.outcome = Outcome.NONE
                self.watch.delay(now)
