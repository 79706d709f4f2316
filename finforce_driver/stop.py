"""An emergency stop until the gripper says that it stands, and until it is cleared; knows no link."""

from __future__ import annotations

from enum import Enum

from finforce_driver.protocol import Reply

REPEAT = 0.02  # [s] between two tries
TRIES = 3  # after which the error bit alone is believed: another fault may hide the stop's own bit


class Stage(Enum):
    """How far an emergency stop has come."""

    NONE = 0
    WANTED = 1  # asked for, not acknowledged
    LATCHED = 2
    CLEARING = 3


class EmergencyStop:
    """Asked for once, it is sent until acknowledged and sent again when it vanishes without having been cleared.

    Attributes:
        stage: how far it has come.
    """

    def __init__(self) -> None:
        self.stage = Stage.NONE
        self._next_time = 0.0
        self._tries = 0

    @property
    def active(self) -> bool:
        """Whether anything but standing still is forbidden."""
        return self.stage is not Stage.NONE

    def demand(self) -> None:
        """Stop, whatever happened before; what is on its way already is not sent anew."""
        if self.stage is not Stage.WANTED:
            self.stage, self._next_time, self._tries = Stage.WANTED, 0.0, 0

    def due(self, now: float) -> bool:
        """Return whether its frames are to be sent now, and count that as done."""
        if self.stage is not Stage.WANTED or now < self._next_time:
            return False
        self._next_time = now + REPEAT
        self._tries += 1
        return True

    def begin_clearing(self) -> None:
        """Note that it is being cleared."""
        if self.active:
            self.stage = Stage.CLEARING

    def end_clearing(self, cleared: bool) -> None:
        """Note how the clearing ended, unless a new stop came between."""
        if self.stage is Stage.CLEARING:
            self.stage = Stage.NONE if cleared else Stage.LATCHED

    def take(self, reply: Reply) -> None:
        """Compare with what the gripper says."""
        if self.stage is Stage.WANTED and (reply.estopped or (reply.error and self._tries >= TRIES)):
            self.stage = Stage.LATCHED
        elif self.stage is Stage.LATCHED and not reply.error:
            self.demand()
