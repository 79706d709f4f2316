"""Procedures of several messages: an emergency stop, the clearing of errors, a calibration."""

from __future__ import annotations

import math
from enum import Enum, auto

from finforce_driver.can.protocol import CanMessage, Command, Reply, decode_encoder
from finforce_driver.settings import OPENING_PER_TICK, GripperSettings

REPEAT = 0.02  # [s] between two tries
TRIES = 3  # after which the error bit alone is believed: another fault may hide the stop's own bit


class EmergencyStop:
    """Asked for once, it is sent until acknowledged and sent again when it vanishes without having been cleared.

    Attributes:
        active: anything but standing still is forbidden.
        pending: it was asked for, and is not acknowledged yet.
    """

    def __init__(self) -> None:
        self.active = self.pending = False
        self._next_time = 0.0
        self._tries = 0

    def demand(self) -> None:
        """Stop, whatever happened before; what is on its way already is not sent anew."""
        if not self.pending:
            self.active = self.pending = True
            self._next_time, self._tries = 0.0, 0

    def due(self, now: float) -> bool:
        """Return whether its messages are to be sent now, and count that as done."""
        if not self.pending or now < self._next_time:
            return False
        self._next_time = now + REPEAT
        self._tries += 1
        return True

    def rest(self) -> None:
        """Send it no more: it is being cleared."""
        self.pending = False

    def end(self) -> None:
        """Forget it: it was cleared."""
        self.active = False

    def take(self, reply: Reply) -> None:
        """Compare with what the gripper says while nothing is being cleared."""
        if self.pending:
            self.pending = not (reply.estopped or (reply.error and self._tries >= TRIES))
        elif self.active and not reply.error:
            self.demand()


class Step(Enum):
    """The next step of a recovery or a calibration."""

    UNFLAG = auto()  # an order without the stop's flag: the flag latches the fault again every 0.2 ms
    CLEAR = auto()
    RESET = auto()  # an aborted calibration would be resumed half-way
    BOOT = auto()  # nothing is sent
    START = auto()
    WATCH = auto()
    DONE = auto()
    FAILED = auto()

    @property
    def over(self) -> bool:
        """True if nothing more is to be done."""
        return self in (Step.DONE, Step.FAILED)


CHECK_TIME = 0.2  # [s] in which the error has to go
SETTLE = 0.005  # [s] in which the control loop may latch again what persists


class Recovery:
    """One attempt to clear the errors, with repetitions for messages that are lost.

    Attributes:
        step: next step.

    Args:
        unflag: an emergency stop is among what is latched.
    """

    def __init__(self, *, unflag: bool) -> None:
        self.step = self._first = Step.UNFLAG if unflag else Step.CLEAR
        self._cleared = 0.0
        self._tries = 1

    def unflagged(self) -> None:
        """Note that the order without the flag was answered."""
        if self.step is Step.UNFLAG:
            self.step = Step.CLEAR

    def clear(self, now: float) -> Command:
        """Return the command that clears, which counts as sent."""
        self._cleared, self.step = now, Step.WATCH
        return Command.CLEAR

    def take(self, reply: Reply) -> None:
        """Look at a believed reply."""
        if self.step is not Step.WATCH or reply.time < self._cleared + SETTLE:
            return
        if not reply.error:
            # the flag's fault shows again within a control cycle: this reply is later than that
            self.step = Step.DONE
        elif reply.time > self._cleared + CHECK_TIME:
            self.step = self._first if self._tries < TRIES else Step.FAILED
            self._tries += 1


STROKE_TOLERANCE = 0.04  # share by which the travelled stroke may differ from that of the settings
TIME_LIMIT = 35.0  # [s]: the firmware gives up after 30 s
BOOT_TIME = 3.0  # [s] after a reset
START_TIME = 1.0  # [s] in which the motor has to show that it runs
STARTS = 3
QUIET_CURRENT = 20  # [mA] that a motor at rest does not exceed
# A calibration is over after this time and so many replies in a row at rest.
IDLE_CURRENT = 100  # [mA]
IDLE_REPLIES = 10  # replies
LEAST_TIME = 0.7  # [s]
OPENED = 3  # [counts]
CLOSED = 252  # [counts]
END_TIME = 0.5  # [s] in which the position has to follow the flag
NO_GRIPPER = (
    "the calibration is done, but the position does not follow: configure the controller as a gripper "
    "(#Gripper 1, #Save over UART)"
)
CALIBRATED_REPLIES = 2  # the first reply may carry an old position
UNCHECKED = "calibrated; whether the whole stroke was travelled is unknown: the gripper does not report its encoder"
FASTEST = 16000.0  # [ticks/s] of a calibrating gripper, 14150 at most
JITTER = 60  # [ticks] by which a count may differ from the last one in addition to that
SILENCES = 3  # questions without any answer after which there is none to be had


class Travel:
    """The travel of the motor during a calibration, by the counts of its encoder.

    A count is believed when it continues the last one: a digit that was corrupted on the line is a count, too.

    Attributes:
        answers: counts that came.

    Args:
        settings: stroke, and how often is asked.
    """

    def __init__(self, settings: GripperSettings) -> None:
        self._settings = settings
        self._period = 1.0 / settings.poll_rate
        self.answers = self._silences = 0
        self._next_time = 0.0
        self._last: tuple[float, int] | None = None
        self._believed: float | None = None  # time of the newest believed count
        self._low = self._high = 0
        self._gap = 0.0

    @property
    def next_time(self) -> float:
        """The time of the next question to the encoder [s]; infinite where it never answers."""
        return self._next_time if self.answers or self._silences < SILENCES else math.inf

    def ask(self, now: float) -> None:
        """Note that the encoder is asked."""
        self._next_time = now + self._period

    def miss(self, _: float) -> None:
        """Note that no answer came."""
        self._silences += 1

    def take(self, message: CanMessage, now: float) -> None:
        """Take an answer that came at a time [s]."""
        self.answers += 1
        ticks, last = decode_encoder(message), self._last
        self._last = (now, ticks)
        if last is None or abs(ticks - last[1]) > FASTEST * (now - last[0]) + JITTER:
            return
        if self._believed is None:
            self._low = self._high = ticks
        else:
            self._gap = max(self._gap, now - max(self._believed, last[0]))
        self._low, self._high = min(self._low, ticks), max(self._high, ticks)
        self._believed = now

    def has_seen(self, time: float) -> bool:
        """Return whether a count was believed after a time [s], or none is to be had."""
        return self.next_time == math.inf or (self._believed is not None and self._believed > time)

    def find_fault(self) -> str:
        """Return what is wrong with the travel; empty where nothing is."""
        if not self.answers:
            return ""
        settings, travel = self._settings, OPENING_PER_TICK * (self._high - self._low)
        # between two counts the jaws may have gone on to a stop and come back
        unseen = 0.5 * OPENING_PER_TICK * FASTEST * max(0.0, self._gap - 1.5 * self._period)
        least, most = (settings.stroke * (1.0 + sign * STROKE_TOLERANCE) for sign in (-1.0, 1.0))
        words = f"the jaws travelled {1e3 * travel:.1f} mm of the stroke of {1e3 * settings.stroke:.1f} mm"
        if travel > most:
            return f"{words}: is gripper.stroke wrong, or does the pinion slip?"
        if travel + unseen < least:
            return f"{words}: is something between them? Take it out, then calibrate again"
        if travel < least:
            return f"{words}, and too many replies were lost to be sure: calibrate again"
        return ""


class CalibrationRun:
    """Follows a calibration by its replies.

    Attributes:
        step: next step.
        reason: why it failed, or a remark on its success.
        travel: of the jaws.

    Args:
        settings: of the gripper.
        calibrated: the gripper is calibrated already, so that its flag says nothing about the end.
        reset: an earlier calibration was aborted.
    """

    def __init__(self, settings: GripperSettings, *, calibrated: bool, reset: bool) -> None:
        self._settings = settings
        self.travel = Travel(settings)
        self.step = Step.RESET if reset else Step.START
        self.reason = ""
        self._was_calibrated = calibrated and not reset
        self._starts = 0
        self._begun = self._booted = 0.0
        self._first: int | None = None  # position
        self._runs = self._moved = self._opened = self._closed = False
        self._idle = self._calibrated = 0
        self._ended: float | None = None

    def reset(self, now: float) -> Command:
        """Return the command that resets the gripper, which counts as sent."""
        self._booted, self.step = now + BOOT_TIME, Step.BOOT
        return Command.RESET

    def quiet_until(self, now: float) -> float | None:
        """Return until when nothing is sent [s]; None when anything may be."""
        return self._booted if self.step is Step.BOOT and now < self._booted else None

    def start(self, now: float) -> Command:
        """Return the command that calibrates, which counts as sent."""
        self._starts += 1
        self._begun, self.step = now, Step.WATCH
        self._first, self._runs, self._moved = None, False, False
        self.travel = Travel(self._settings)
        return Command.CALIBRATE

    def take(self, reply: Reply) -> None:
        """Look at a believed reply."""
        if reply.error:
            self._fail("a fault ended the calibration")
        elif self.step is Step.BOOT:
            self.step = Step.START
        elif self.step is Step.WATCH:
            self._watch(reply)

    def _fail(self, reason: str) -> None:
        self.reason, self.step = reason, Step.FAILED

    def _watch(self, reply: Reply) -> None:
        """Look for the start, the end, and the time limit."""
        now = reply.time
        self._first = reply.position if self._first is None else self._first
        self._moved |= abs(reply.position - self._first) > 1
        self._runs |= self._moved or abs(reply.current_mA) > QUIET_CURRENT
        if self._was_calibrated and not reply.calibrated:
            self._fail("the gripper gave the calibration up, or was restarted")
        elif self._was_calibrated:
            self._look_for_end(reply)
        elif reply.calibrated:
            self._check_end(reply)
        if self.step is Step.WATCH and not self._runs and now > self._begun + START_TIME:
            if self._starts < STARTS:
                self.step = Step.START  # the gripper evidently did not get it
            else:
                self._fail("the calibration does not start: the motor draws no current; check its supply")
        elif self.step is Step.WATCH and now > self._begun + TIME_LIMIT:
            self._fail("no end stop was found in time: is something in the way, or the current too small?")

    def _look_for_end(self, reply: Reply) -> None:
        """Look for the end where the flag, which was set before, does not tell."""
        self._opened |= reply.position <= OPENED
        self._closed |= self._opened and reply.position >= CLOSED
        self._idle = self._idle + 1 if self._closed and abs(reply.current_mA) < IDLE_CURRENT else 0
        if self._idle >= IDLE_REPLIES and reply.time > self._begun + LEAST_TIME:
            self._end()

    def _check_end(self, reply: Reply) -> None:
        """Check what the flag tells: a controller that is no gripper moves, too, and keeps its position.

        The jaws end closed, but limp: what is soft between them opens them again.
        """
        self._ended = reply.time if self._ended is None else self._ended
        late = reply.time > self._ended + END_TIME
        self._calibrated = self._calibrated + 1 if self._moved or reply.position >= CLOSED else 0
        if self._calibrated >= CALIBRATED_REPLIES and (late or self.travel.has_seen(self._ended)):
            self._end()
        elif self._calibrated < CALIBRATED_REPLIES and late:
            self._fail(NO_GRIPPER)

    def _end(self) -> None:
        """End it, well if the jaws went from stop to stop."""
        if fault := self.travel.find_fault():
            self._fail(fault)
        else:
            self.step = Step.DONE
            self.reason = "" if self.travel.answers else UNCHECKED
