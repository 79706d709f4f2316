"""Clears what is latched, in the gripper's order: stop flag off, clear, look; knows no link."""

from __future__ import annotations

from enum import Enum, auto

from finforce_driver.protocol import Reply

CHECK_TIME = 0.2  # [s] in which the error has to go
SETTLE = 0.005  # [s] in which the control loop may latch again what persists
TRIES = 3


class RecoveryStep(Enum):
    """What is to be done next."""

    UNFLAG = auto()  # an order without the stop's flag: the flag latches the fault again every 0.2 ms
    CLEAR = auto()
    LOOK = auto()
    DONE = auto()
    FAILED = auto()


class Recovery:
    """One attempt to clear the errors, with repetitions for frames that are lost.

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
