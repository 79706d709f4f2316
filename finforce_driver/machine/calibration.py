"""One calibration from the request to its end, which the gripper does not announce."""

from __future__ import annotations

from enum import Enum, auto

from finforce_driver.can.protocol import Reply

TIME_LIMIT = 35.0  # [s]: the firmware gives up after 30 s
BOOT_TIME = 3.0  # [s] after a reset
START_TIME = 1.0  # [s] in which the motor has to show that it runs
STARTS = 3
QUIET_CURRENT = 20  # [mA] that a motor at rest does not exceed
IDLE_CURRENT, IDLE_REPLIES, LEAST_TIME = 100, 10, 0.7  # [mA], replies and [s] after which it is over
OPENED, CLOSED = 3, 252  # [counts]
END_TIME = 0.5  # [s] in which the position has to follow the flag
NO_GRIPPER = (
    "the calibration is done, but the position does not follow: configure the controller as a gripper "
    "(#Gripper 1, #Save over UART)"
)
CALIBRATED_REPLIES = 2  # the first reply may carry a position of before


class CalibrationStep(Enum):
    """What is to be done next."""

    RESET = auto()  # an aborted calibration would be resumed half-way
    BOOT = auto()  # nothing is sent
    START = auto()
    WATCH = auto()
    DONE = auto()
    FAILED = auto()


class CalibrationRun:
    """Follows a calibration by its replies.

    Attributes:
        step: what is to be done next.
        reason: why it failed.

    Args:
        calibrated: the gripper is calibrated already, so that its flag says nothing about the end.
        reset: an earlier calibration was aborted.
    """

    def __init__(self, *, calibrated: bool, reset: bool) -> None:
        self.step = CalibrationStep.RESET if reset else CalibrationStep.START
        self.reason = ""
        self._was_calibrated = calibrated and not reset
        self._starts = 0
        self._begun = self._booted = 0.0
        self._place: int | None = None
        self._runs = self._moved = self._opened = self._closed = False
        self._idle = self._calibrated = 0
        self._ended: float | None = None

    @property
    def over(self) -> bool:
        """Whether it has ended, well or not."""
        return self.step in (CalibrationStep.DONE, CalibrationStep.FAILED)

    def reset(self, now: float) -> None:
        """Note that the reset is sent."""
        self._booted, self.step = now + BOOT_TIME, CalibrationStep.BOOT

    def quiet_until(self, now: float) -> float | None:
        """Return until when nothing is sent [s]; None when anything may be."""
        return self._booted if self.step is CalibrationStep.BOOT and now < self._booted else None

    def start(self, now: float) -> None:
        """Note that the calibration is sent."""
        self._starts += 1
        self._begun, self.step = now, CalibrationStep.WATCH
        self._place, self._runs, self._moved = None, False, False

    def fail(self, reason: str) -> None:
        """End it without success."""
        self.reason, self.step = reason, CalibrationStep.FAILED

    def take(self, reply: Reply, now: float) -> None:
        """Look at a believed reply that came at a time [s]."""
        if reply.error:
            self.fail("a fault ended the calibration")
        elif self.step is CalibrationStep.BOOT:
            self.step = CalibrationStep.START
        elif self.step is CalibrationStep.WATCH:
            self._watch(reply, now)

    def _watch(self, reply: Reply, now: float) -> None:
        """Look for the start, the end, and the time limit."""
        self._place = reply.position if self._place is None else self._place
        self._moved |= abs(reply.position - self._place) > 1
        self._runs |= self._moved or abs(reply.current_mA) > QUIET_CURRENT
        if self._was_calibrated and not reply.calibrated:
            self.fail("the gripper gave the calibration up, or was restarted")
        elif self._was_calibrated:
            self._look_for_end(reply, now)
        elif reply.calibrated:
            self._check_end(reply, now)
        if self.step is CalibrationStep.WATCH and not self._runs and now > self._begun + START_TIME:
            self._start_again()
        elif self.step is CalibrationStep.WATCH and now > self._begun + TIME_LIMIT:
            self.fail("no end stop was found in time: is something in the way, or the current too small?")

    def _start_again(self) -> None:
        """Send the calibration again, which the gripper evidently did not get, or give up."""
        if self._starts < STARTS:
            self.step = CalibrationStep.START
        else:
            self.fail("the calibration does not start: the motor draws no current; check its supply")

    def _look_for_end(self, reply: Reply, now: float) -> None:
        """Look for the end where the flag, which was set before, does not tell."""
        self._opened |= reply.position <= OPENED
        self._closed |= self._opened and reply.position >= CLOSED
        self._idle = self._idle + 1 if self._closed and abs(reply.current_mA) < IDLE_CURRENT else 0
        if self._idle >= IDLE_REPLIES and now > self._begun + LEAST_TIME:
            self.step = CalibrationStep.DONE

    def _check_end(self, reply: Reply, now: float) -> None:
        """Check what the flag tells: a controller that is no gripper moves, too, and keeps its position.

        The jaws end closed, but limp: what is soft between them opens them again.
        """
        self._ended = now if self._ended is None else self._ended
        self._calibrated = self._calibrated + 1 if self._moved or reply.position >= CLOSED else 0
        if self._calibrated >= CALIBRATED_REPLIES:
            self.step = CalibrationStep.DONE
        elif now > self._ended + END_TIME:
            self.fail(NO_GRIPPER)
