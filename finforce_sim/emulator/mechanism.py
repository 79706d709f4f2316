"""An emulated gripper's motor, racks and jaws: motion, current, what they press on, step by step."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable

STEP = 0.001  # [s]
TURN = 16384  # ticks of the encoder
STOP_OPEN = 10329  # [ticks], of the motor at the open end stop
STOP_CLOSED = -229  # [ticks], of the motor at the closed end stop
STROKE = 0.048  # [m] of the opening between them; closed jaws touch
FORCE_PER_CURRENT = 47.7  # [N/A]
_PER_TICK = STROKE / (STOP_OPEN - STOP_CLOSED)
_CURRENT_LAG = 0.02  # [s]
_FREE_CURRENT = 60.0  # [mA] that moves the unloaded jaws, at most a fifth of the limit
_HOLD_SPEED = 80_000.0  # [ticks/s] of the drive's own position control
_FILTER_STEPS = 4  # of the velocity reading: 20 samples of 0.2 ms
_GIVE_WAY = 20.0  # [ticks] in one step, by which a load that is too strong pushes the jaws open
_BISECTIONS = 30


class Jaws:
    """The moving parts, with the truth about them.

    The opening grows with the motor's angle, STROKE * (ticks - STOP_CLOSED) / (STOP_OPEN - STOP_CLOSED).

    Attributes:
        ticks: true angle of the motor [ticks], not forgotten in a reset.
        current: of the motor [mA], positive when it drives open.
        object_opening: at which a rigid object stops closing jaws [m]; None without one.
        wall_opening: at which something outside stops opening jaws [m]; None without it.
        load: elastic grip force [N] by opening [m]; None without one.
        slips: the motor turns through at a stop, so that its current never tells of it.
    """

    def __init__(self) -> None:
        self.object_opening: float | None = None
        self.wall_opening: float | None = None
        self.load: Callable[[float], float] | None = None
        self.slips = False
        self._blend = 1.0 - math.exp(-STEP / _CURRENT_LAG)
        self.ticks = float(STOP_OPEN)
        self.current = 0.0
        self.reset_encoder()

    @property
    def opening(self) -> float:
        """Return the true opening between the undeformed inner faces [m]."""
        return (self.ticks - STOP_CLOSED) * _PER_TICK

    @property
    def force(self) -> float:
        """Return the true elastic grip force [N]; zero without a load."""
        return self._force_at(self.ticks)

    @property
    def encoder(self) -> int:
        """Return the encoder's count [ticks]."""
        return self._counts[-1]

    @property
    def velocity(self) -> float:
        """Return the filtered reading of the speed [ticks/s], positive while opening, in steps of 250 ticks/s."""
        return (self._counts[-1] - self._counts[0]) / (_FILTER_STEPS * STEP)

    def ticks_at(self, opening: float) -> float:
        """Return the motor's angle [ticks] at an opening [m]."""
        return opening / _PER_TICK + STOP_CLOSED

    def reset_encoder(self) -> None:
        """Forget whole turns, as the encoder does without power."""
        self._offset = -TURN * math.floor(math.floor(self.ticks) / TURN)
        self._counts = deque([self._count()] * (_FILTER_STEPS + 1), maxlen=_FILTER_STEPS + 1)

    def drive(self, velocity: float, limit: float, reach: float = math.inf) -> None:
        """Go on for one step under velocity control.

        Args:
            velocity: wanted [ticks/s], positive to open.
            limit: of the current [mA].
            reach: longest way [ticks].
        """
        wanted = math.copysign(min(abs(velocity) * STEP, reach), velocity)
        moved = self._move(wanted, limit)
        if abs(moved) < 0.5 * abs(wanted) and not self.slips:
            self._settle_current(math.copysign(limit, velocity))
            return
        free = min(_FREE_CURRENT, 0.2 * limit)
        pressing = -min(self._current_for(self.force), limit) if self.load is not None else 0.0
        self._settle_current(pressing if -pressing > free else math.copysign(free, velocity))

    def hold(self, count: int, limit: float) -> None:
        """Go on for one step under position control towards an encoder count, with a current limit [mA]."""
        error = count - self._offset - self.ticks
        if abs(error) > 1e-6:
            self.drive(math.copysign(_HOLD_SPEED, error), limit, abs(error))
            return
        self._move(0.0, limit)
        self._settle_current(-min(self._current_for(self.force), limit))

    def rest(self) -> None:
        """Go on for one step without power."""
        if self.load is not None:
            self._give_way(0.0)
        self._settle_current(0.0)
        self._counts.append(self._count())

    def _move(self, way: float, limit: float) -> float:
        """Go `way` [ticks] or as far as stops, object and load let a current [mA] go; return the way gone."""
        before = self.ticks
        capacity = 1e-3 * max(limit, 0.0) * FORCE_PER_CURRENT
        if self.load is not None and self._force_at(before) > capacity * (1.0 + 1e-6) + 1e-9:
            self._give_way(capacity)
        elif limit > 0.0:
            low, high = self._bounds()
            self.ticks = min(max(before + way, min(low, before)), max(high, before))
            if self.load is not None and way < 0.0 and self._force_at(self.ticks) > capacity:
                self.ticks = self._balance(self.ticks, before, capacity)
        self._counts.append(self._count())
        return self.ticks - before

    def _bounds(self) -> tuple[float, float]:
        low, high = float(STOP_CLOSED), float(STOP_OPEN)
        if self.object_opening is not None:
            low = max(low, self.ticks_at(self.object_opening))
        if self.wall_opening is not None:
            high = min(high, self.ticks_at(self.wall_opening))
        return low, high

    def _give_way(self, capacity: float) -> None:
        """Let a load that is stronger than `capacity` [N] push the jaws open for one step."""
        if self._force_at(self.ticks) <= capacity:
            return
        wider = min(self.ticks + _GIVE_WAY, float(STOP_OPEN))
        self.ticks = wider if self._force_at(wider) > capacity else self._balance(self.ticks, wider, capacity)

    def _balance(self, narrow: float, wide: float, capacity: float) -> float:
        """Return where between two angles [ticks] the load falls to `capacity` [N]."""
        for _ in range(_BISECTIONS):
            middle = 0.5 * (narrow + wide)
            if self._force_at(middle) > capacity:
                narrow = middle
            else:
                wide = middle
        return wide

    def _force_at(self, ticks: float) -> float:
        return 0.0 if self.load is None else float(self.load((ticks - STOP_CLOSED) * _PER_TICK))

    def _current_for(self, force: float) -> float:
        return 1000.0 * force / FORCE_PER_CURRENT

    def _settle_current(self, goal: float) -> None:
        self.current += (goal - self.current) * self._blend

    def _count(self) -> int:
        return math.floor(self.ticks + 1e-9) + self._offset
