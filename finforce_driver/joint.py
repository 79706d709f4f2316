"""A gripper that is a joint: the same calls and the same state as those of `Gripper`, over a commanded position.

A joint that keeps to no speed is led: setpoints go on at the speed that was asked for. It knows neither limpness nor a
calibration; an emergency stop holds it where it is, and refuses moves until it is cleared.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from threading import Event, RLock

from finforce_driver.errors import GripperStateError, TargetError
from finforce_driver.gripper import Clock, StateCondition, StateSource
from finforce_driver.machine.status_tracker import History
from finforce_driver.settings import GripperSettings, JointSettings, check_numbers, is_number
from finforce_driver.state import ABSENT, GripperState, MoveOutcome, Phase, describe

NEAR = 1.5  # steps within which the target is reached
STILL = 1e-3  # [m/s], below which the jaws do not move
STALL = 0.4  # [s] without motion, after which the jaws are stalled
SILENCE = 0.5  # [s] without a state after which the joint counts as disconnected
EXTRA_TIME = 2.0  # [s] beyond the travel's own time
TURN = 0.005  # [s] between two looks of one who waits
SendCommand = Callable[[float, float, float], None]


@dataclass(frozen=True, kw_only=True)
class _Ramp:
    """A move: opening to go to [m], speed [m/s], effort [N], and when [s] and where [m] it began."""

    target: float
    speed: float
    effort: float
    begun: float
    start: float

    def setpoint(self, now: float) -> float:
        """Return where the jaws are to be by now [m]."""
        reach = self.speed * (now - self.begun)
        return self.start + min(max(self.target - self.start, -reach), reach)

    @property
    def arrives(self) -> float:
        """The time at which the setpoint is at the target [s]."""
        return self.begun + abs(self.target - self.start) / self.speed


class JointGripper(StateSource):
    """A gripper over a joint's position.

    Args:
        send: sends position and velocity in the joint's own unit and effort [N], NaN: the joint's own; it must return
            at once.
        settings: stroke, offset and default speed.
        joint: relates the joint's value to the opening.
        clock: its time; the machine's own where none is given.

    Attributes:
        settings: the same.
        resolution: smallest step of the opening [m].
    """

    def __init__(
        self, send: SendCommand, settings: GripperSettings, joint: JointSettings, clock: Clock | None = None
    ) -> None:
        super().__init__(clock)
        self.settings, self.resolution = settings, joint.resolution
        self.state = GripperState(phase=Phase.PROBING, message=f"waiting for the first state of {joint.names[0]}")
        self._send, self._joint = send, joint
        self._history = History()  # of openings [m]
        self._stamp = -math.inf  # of the newest [s]
        self._ramp: _Ramp | None = None
        self._sent = -math.inf
        self._moved = -math.inf  # when the jaws were last seen to move [s]
        self._stopped = False
        self._outcome = MoveOutcome.NONE
        self._effort = math.nan
        self._lock = RLock()
        self._per_unit = settings.stroke / (joint.open - joint.closed)

    # What the joint says

    def take(self, position: float, stamp: float, effort: float = math.nan) -> None:
        """Take the joint's value at a time [s] of the gripper's clock, with its effort [N].

        Raises:
            TargetError: the value is no number.
        """
        if not is_number(position):
            raise TargetError(f"{self._joint.names[0]}: got {position!r}, expected a number")
        opening = self.settings.closed_opening + (position - self._joint.closed) * self._per_unit
        with self._lock:
            if stamp <= self._stamp:
                return
            self._history.add(stamp, opening)
            self._stamp, self._effort = stamp, effort
            self._judge(stamp)
            self._refresh()

    def tick(self) -> None:
        """Send the setpoint that is due, and notice silence."""
        now = self.clock.now()
        with self._lock:
            ramp = self._ramp
            due = now - self._sent >= 1.0 / self._joint.rate if self._joint.rate else False
            if ramp is not None and due and not self._stopped:
                self._command(ramp.setpoint(now), now)
                if now > ramp.arrives and self._outcome is not MoveOutcome.NONE:
                    self._ramp = None  # it stays at its last command
            if self.state.phase not in ABSENT and now - self._stamp > SILENCE:
                self._end(MoveOutcome.ABORTED)
                self._refresh()

    # What it is told

    def check_move(self, opening: float, speed: float | None = None, force: float | None = None) -> None:
        """Reject what `move` would reject in whatever state.

        Raises:
            TargetError: a value is no number or out of bounds.
        """
        check_numbers(opening=opening, speed=speed, force=force)
        self.settings.check_opening("opening", opening)
        if speed is not None and not 0.0 < speed <= self._joint.largest_speed:
            raise TargetError(f"speed: got {speed:g} m/s, expected above 0 to {self._joint.largest_speed:g} m/s")
        if force is not None and not force > 0.0:
            raise TargetError(f"force: got {force:g} N, expected above 0")

    def move(self, opening: float, speed: float | None = None, force: float | None = None) -> None:
        """Go to an opening [m], with a speed of it [m/s] and an effort [N], at most what the joint has.

        Raises:
            TargetError: a value is no number or out of bounds.
            GripperStateError: the joint is disconnected, or an emergency stop is latched.
        """
        self.check_move(opening, speed, force)
        with self._lock:
            self._require("move")
            if self._stopped:
                raise GripperStateError("move: an emergency stop is latched: clear the errors first")
            now, rate, largest = self.clock.now(), self._joint.rate, self._joint.largest_force
            self._ramp = _Ramp(
                target=float(opening),
                speed=self.settings.default_speed if speed is None else speed,
                effort=math.nan if force is None or not largest else min(float(force), largest),
                begun=now,
                start=self._history.last if self._ramp is None else self._ramp.setpoint(now),
            )
            self._outcome, self._moved = MoveOutcome.NONE, now
            self._command(self._ramp.setpoint(now + 1.0 / rate) if rate else opening, now)
            self._refresh()

    def hold(self) -> None:
        """Stop in place and hold there.

        Raises:
            GripperStateError: the joint is disconnected.
        """
        with self._lock:
            self._require("hold")
            self._hold()
            self._refresh()

    def estop(self) -> None:
        """Stop in place, and refuse moves until it is cleared; a joint does not go limp."""
        with self._lock:
            self._stopped = True
            if self._is_known:
                self._hold()
            self._refresh()

    def clear_errors(self) -> None:
        """End an emergency stop."""
        with self._lock:
            self._stopped = False
            self._refresh()

    def calibrate(self) -> None:
        """Refuse, by raising GripperStateError: a joint knows where it is."""
        raise GripperStateError("calibrate: this gripper is a joint, which knows where it is")

    def activate(self, on: bool) -> None:
        """Refuse to switch off what has no switch, by raising GripperStateError."""
        if not on:
            raise GripperStateError("activate: this gripper is a joint, which does not go limp")

    def release_power(self) -> None:
        """Refuse, by raising GripperStateError: a joint does not go limp."""
        self.activate(False)

    # As of a gripper

    def start(self) -> None:
        """Do nothing: it lives by what it is told."""

    def close(self) -> None:
        """Hold in place, where the joint is there, and end."""
        with self._lock:
            if self.state.phase is Phase.MOVING:
                self._hold()
            self._ended.set()

    def opening_at(self, time: float) -> float:
        """Return the opening [m] at a time of the last 5 s [s]; NaN where it is not known."""
        with self._lock:
            return self._history.position_at(time, 0.0)

    def _pass_time(self, condition: StateCondition, left: float) -> None:
        self.clock.wait(TURN, Event())

    @property
    def _is_known(self) -> bool:
        return self._stamp > -math.inf

    def _require(self, what: str) -> None:
        if self.state.phase in ABSENT:
            raise GripperStateError(f"{what}: no state of {self._joint.names[0]} comes ({self.state.message})")

    def _hold(self) -> None:
        self._end(MoveOutcome.REPLACED)
        self._command(self._history.last, self.clock.now())

    def _end(self, outcome: MoveOutcome) -> None:
        if self._ramp is not None and self._outcome is MoveOutcome.NONE:
            self._outcome = outcome
        self._ramp = None

    def _command(self, opening: float, now: float) -> None:
        """Send an opening [m] to the joint."""
        self._sent, ramp = now, self._ramp
        position = self._joint.closed + (opening - self.settings.closed_opening) / self._per_unit
        self._send(
            position,
            math.nan if ramp is None else ramp.speed / abs(self._per_unit),
            math.nan if ramp is None else ramp.effort,
        )

    def _judge(self, stamp: float) -> None:
        """Judge the move by a new state."""
        if abs(self._history.speed()) > STILL:
            self._moved = stamp
        ramp, opening = self._ramp, self._history.last
        if ramp is None or self._outcome is not MoveOutcome.NONE:
            return
        late = stamp - ramp.arrives
        if late > 0.0 and abs(opening - ramp.target) <= NEAR * self.resolution:
            self._outcome = MoveOutcome.REACHED
        elif late > STALL and stamp - self._moved > STALL:
            self._outcome = MoveOutcome.GRASPED if ramp.target < opening else MoveOutcome.BLOCKED
        elif late > EXTRA_TIME:
            self._outcome = MoveOutcome.TIMED_OUT

    def _refresh(self) -> None:
        """Make the state anew, and tell it."""
        if not self._is_known:
            self.state = replace(self.state, estopped=self._stopped)
            self._tell()
            return
        moving = self._ramp is not None and self._outcome is MoveOutcome.NONE
        phase = Phase.MOVING if moving else Phase.READY
        message = describe(phase, self._outcome, ())
        if self._stopped:
            phase = Phase.FAULT
            message = "emergency stop: the jaws hold; make the place safe, then clear the errors"
        if self.clock.now() - self._stamp > SILENCE:
            phase, message = Phase.DISCONNECTED, f"no state of {self._joint.names[0]} for {SILENCE:g} s"
        self.state = GripperState(
            phase=phase,
            stamp=self._stamp,
            opening=self._history.last,
            velocity=self._history.speed(),
            force=self._effort if self._joint.effort_is_force else math.nan,
            target=math.nan if self._ramp is None else self._ramp.target,
            at_target=self._outcome is MoveOutcome.REACHED,
            calibrated=True,
            activated=True,
            estopped=self._stopped,
            outcome=self._outcome,
            message=message,
        )
        self._tell()
