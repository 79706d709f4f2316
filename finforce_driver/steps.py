"""Motion slower than the gripper's speed byte allows: its target goes on by one count at a time; knows no frames."""

from __future__ import annotations

LARGEST_LAG = 3.5  # [counts] that the jaws may stay behind the target: more means that something is in the way
LAG_PAUSE = 0.02  # [s] until a target that waits for the jaws is looked at again


class Steps:
    """A target on its way to another one, at a speed.

    The ideal ramp is the target between the counts; it is rounded, hence half a count off at most. The target waits
    for jaws that stay behind, and a late step delays the ramp: it never hurries.

    Attributes:
        position: present target [counts].
        goal: where it goes [counts].
        next_time: when it is due to go on [s].

    Args:
        start: where the ramp begins [counts]; a fraction is kept.
        goal: where it ends [counts].
        rate: speed [counts/s].
        now: time [s].
    """

    def __init__(self, *, start: float, goal: int, rate: float, now: float) -> None:
        self.goal = goal
        self._period = 1.0 / rate
        self._way = 1 if goal > start else -1
        self.position = round(start)
        self.next_time = now + self._until_step(start)
        self.waiting = False

    @property
    def done(self) -> bool:
        """Whether the target has arrived."""
        return self.position == self.goal

    def ramp(self, now: float) -> float:
        """Return the ideal target at a time [counts]."""
        if self.done:
            return float(self.goal)
        ahead = (self.next_time - now) / self._period
        place = self.position + self._way * (0.5 - ahead)
        return min(max(place, self.position - 0.5), self.position + 0.5)

    def advance(self, now: float, place: float) -> None:
        """Go on by one count when it is due and the jaws have followed.

        Args:
            now: time [s].
            place: of the jaws [counts].
        """
        if self.done or now < self.next_time:
            return
        lag = self._way * (self.position - place)
        if lag < -LARGEST_LAG:  # the jaws are ahead: the ramp began at a place where they have not been
            self.position = round(place)
        self.waiting = lag > LARGEST_LAG
        if self.waiting:
            self.next_time = now + LAG_PAUSE
            return
        self.position += self._way
        self.next_time = max(self.next_time, now - 0.5 * self._period) + self._period

    def _until_step(self, start: float) -> float:
        """Return the time from the start to the first step [s]."""
        return self._period * max(0.0, self._way * (self.position - start) + 0.5)
