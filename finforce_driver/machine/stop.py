"""An emergency stop until the gripper says that it stands, and until what is latched is cleared."""

from __future__ import annotations

from enum import Enum, auto

from finforce_driver.can.protocol import Reply

REPEAT = 0.02  # [s] between two tries
TRIES = 3  # after which the error bit alone is believed: another fault may hide the stop's own bit


class StopStage(Enum):
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
        self.stage = StopStage.NONE
        self._next_time = 0.0
        self._tries = 0

    @property
    def active(self) -> bool:
        """Whether anything but standing still is forbidden."""
        return self.stage is not StopStage.NONE

    def demand(self) -> None:
        """Stop, whatever happened before; what is on its way already is not sent anew."""
        if self.stage is not StopStage.WANTED:
            self.stage, self._next_time, self._tries = StopStage.WANTED, 0.0, 0

    def due(self, now: float) -> bool:
        """Return whether its messages are to be sent now, and count that as done."""
        if self.stage is not StopStage.WANTED or now < self._next_time:
            return False
        self._next_time = now + REPEAT
        self._tries += 1
        return True

    def begin_clearing(self) -> None:
        """Note that it is being cleared."""
        if self.active:
            self.stage = StopStage.CLEARING

    def end_clearing(self, cleared: bool) -> None:
        """Note how the clearing ended, unless a new stop came between."""
        if self.stage is StopStage.CLEARING:
            self.stage = StopStage.NONE if cleared else StopStage.LATCHED

    def take(self, reply: Reply) -> None:
        """Compare with what the gripper says."""
        if self.stage is StopStage.WANTED and (reply.estopped or (reply.error and self._tries >= TRIES)):
            self.stage = StopStage.LATCHED
        elif self.stage is StopStage.LATCHED and not reply.error:
            self.demand()


CHECK_TIME = 0.2  # [s] in which the error has to go
SETTLE = 0.005  # [s] in which the control loop may latch again what persists


class RecoveryStep(Enum):
    """What is to be done next."""

    UNFLAG = auto()  # an order without the stop's flag: the flag latches the fault again every 0.2 ms
    CLEAR = auto()
    LOOK = auto()
    DONE = auto()
    FAILED = auto()


class Recovery:
    """One attempt to clear the errors, with repetitions for messages that are lost.

    Attributes:
        step: what is to be done next.

    Args:
        unflag: an emergency stop is among what is latched.
    """

    def __init__(self, *, unflag: bool) -> None:
        self._first = RecoveryStep.UNFLAG if unflag else RecoveryStep.CLEAR
        self.step = self._first
        self._cleared = 0.0
        self._tries = 1

    @property
    def over(self) -> bool:
        """Whether nothing more is to be done."""
        return self.step in (RecoveryStep.DONE, RecoveryStep.FAILED)

    def unflagged(self) -> None:
        """Note that the order without the flag was answered."""
        if self.step is RecoveryStep.UNFLAG:
            self.step = RecoveryStep.CLEAR

    def clear(self, now: float) -> None:
        """Note that the clearing is sent."""
        self._cleared, self.step = now, RecoveryStep.LOOK

    def take(self, reply: Reply, now: float) -> None:
        """Look at a reply that came at a time [s]."""
        if self.step is not RecoveryStep.LOOK or now < self._cleared + SETTLE:
            return
        if not reply.error:
            # the flag's fault shows again within a control cycle: this reply is later than that
            self.step = RecoveryStep.DONE
        elif now > self._cleared + CHECK_TIME:
            self.step = self._first if self._tries < TRIES else RecoveryStep.FAILED
            self._tries += 1
