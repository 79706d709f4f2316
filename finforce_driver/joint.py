"""A gripper that is a joint: the same calls and the same state as those of `Gripper`, over a commanded position.

A joint that keeps to no speed is led: setpoints go on at the speed that was asked for. It knows neither limpness nor a
calibration; an emergency stop holds it where it is, and refuses moves until it is cleared.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from threading import Event, RLock

from finforce.settings import check_bounds, setting
from finforce_driver.clock import Clock, MonotonicClock
from finforce_driver.errors import GripperStateError, GripperTimeoutError, TargetError
from finforce_driver.machine.knowledge import History
from finforce_driver.settings import GripperSettings, check_numbers, is_number
from finforce_driver.state import GripperState, MoveOutcome, Phase


@dataclass(frozen=True, kw_only=True)
class JointSettings:
    """How a joint's value goes with the opening, and how it follows its commands; units stand in the metadata.

    The opening is linear between the two ends: `gripper.closed_opening` at `closed`, that and `gripper.stroke` at
    `open`.
    """

    names: tuple[str, ...] = setting(("gripper_joint",), "Names of the commanded joints; the first is read")
    closed: float = setting(0.0, "Joint value of the closed gripper, in the joint's unit", "", -1e4, 1e4)
    open: float = setting(1.0, "Joint value of the open gripper, in the joint's unit", "", -1e4, 1e4)
    resolution: float = setting(0.0002, "Smallest step of the opening that the joint follows", "m", 1e-6, 0.01)
    rate: float = setting(
        25.0, "Rate of setpoints on the way; 0: one command, the joint keeps the speed itself", "Hz", 0.0, 500.0
    )
    largest_speed: float = setting(0.1, "Maximum speed of the opening", "m/s", 1e-4, 2.0)
    largest_force: float = setting(0.0, "Maximum effort of a command; 0: the joint takes none", "N", 0.0, 1000.0)
    effort_is_force: bool = setting(
        False, "Whether the joint's effort is its grip force [N], as a check of the camera's", ""
    )

    def __post_init__(self) -> None:
        """Refuse what no joint is.

        Raises:
            TargetError: a value is out of bounds, there is no joint, or both ends are the same.
        """
        check_bounds(self, TargetError)
        if not self.names or not all(self.names) or len(set(self.names)) != len(self.names):
            raise TargetError(f"joint.names: got {self.names!r}, expected one name or more, each once")
        if self.closed == self.open:
            raise TargetError(f"joint.closed and joint.open: both are {self.open:g}, expected two values")


Listener = Callable[[GripperState], None]
NEAR = 1.5  # steps within which the target is reached
STILL, STALL = 1e-3, 0.4  # [m/s], and [s] without motion after which the jaws are stalled
SILENCE = 0.5  # [s] without a state after which the joint counts as away
PATIENCE = 2.0  # [s] beyond the way's time
TURN = 0.005  # [s] between two looks of one who waits


@dataclass(frozen=True, kw_only=True)
class JointCommand:
    """What is sent to the joint.

    Attributes:
        position: in the joint's own unit.
        velocity: of the joint, positive; NaN: its own.
        effort: greatest [N]; NaN: its own.
    """

    position: float
    velocity: float = math.nan
    effort: float = math.nan


@dataclass(kw_only=True)
class _Way:
    """A move: opening to go to [m], speed [m/s], effort [N], when it began and will be over [s]."""

    target: float
    speed: float
    effort: float
    begun: float
    start: float

    def setpoint(self, now: float) -> float:
        """Return where it is to be by now [m]."""
        reach = self.speed * (now - self.begun)
        return self.start + min(max(self.target - self.start, -reach), reach)

    @property
    def arrives(self) -> float:
        """When the setpoint is at the target [s]."""
        return self.begun + abs(self.target - self.start) / self.speed


class JointGripper:
    """A gripper over a joint's position.

    Args:
        send: sends a command to the joint; it must return at once.
        settings: stroke, offset and default speed.
        joint: how the joint's value goes with the opening.
        clock: what it lives by; the machine's own where none is given.

    Attributes:
        settings: the same.
        clock: the same.
        resolution: smallest step of the opening [m].
        state: what is known now.
    """

    def __init__(
        self,
        send: Callable[[JointCommand], None],
        settings: GripperSettings,
        joint: JointSettings,
        clock: Clock | None = None,
    ) -> None:
        self.settings, self.clock, self.resolution = settings, clock or MonotonicClock(), joint.resolution
        self.state = GripperState(phase=Phase.PROBING, message=f"waiting for the first state of {joint.names[0]}")
        self._send, self._joint = send, joint
        self._listeners: list[Listener] = []
        self._history = History()  # of openings [m]
        self._stamp = -math.inf  # of the newest [s]
        self._way: _Way | None = None
        self._sent = -math.inf
        self._moved = -math.inf  # when the jaws were last seen to move [s]
        self._stopped = self._closed = False
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
        self._tell()

    def tick(self) -> None:
        """Send the setpoint that is due, and notice silence."""
        now = self.clock.now()
        with self._lock:
            due = now - self._sent >= 1.0 / self._joint.rate if self._joint.rate else False
            if self._way is not None and due and not self._stopped:
                self._command(self._way.setpoint(now), now)
                if now > self._way.arrives and self._outcome is not MoveOutcome.NONE:
                    self._way = None  # it stays at its last command
            silent = self.state.phase not in (Phase.PROBING, Phase.DISCONNECTED)
            silent &= now - self._stamp > SILENCE
            if silent:
                self._end(MoveOutcome.ABORTED)
                self._refresh()
        if silent:
            self._tell()

    # What it is told

    def check_move(self, opening: float, speed: float | None = None, force: float | None = None) -> None:
        """Refuse what `move` would refuse in whatever state.

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
            GripperStateError: the joint is away, or an emergency stop is latched.
        """
        self.check_move(opening, speed, force)
        with self._lock:
            self._require("move")
            now = self.clock.now()
            start = self._history.last if self._way is None else self._way.setpoint(now)
            largest = self._joint.largest_force
            effort = math.nan if force is None or not largest else min(float(force), largest)
            pace = self.settings.default_speed if speed is None else speed
            self._way = _Way(target=float(opening), speed=pace, effort=effort, begun=now, start=start)
            self._outcome, self._moved = MoveOutcome.NONE, now
            self._command(opening if not self._joint.rate else self._way.setpoint(now + 1.0 / self._joint.rate), now)
            self._refresh()
        self._tell()

    def hold(self) -> None:
        """Stop in place and hold there.

        Raises:
            GripperStateError: the joint is away.
        """
        with self._lock:
            self._require("hold", stopped=True)
            self._hold()
            self._refresh()
        self._tell()

    def estop(self) -> None:
        """Stop in place, and refuse moves until it is cleared; a joint does not go limp."""
        with self._lock:
            self._stopped = True
            if self._is_known:
                self._hold()
            self._refresh()
        self._tell()

    def clear_errors(self) -> None:
        """End an emergency stop."""
        with self._lock:
            self._stopped = False
            self._refresh()
        self._tell()

    def calibrate(self) -> None:
        """Refuse: a joint knows where it is.

        Raises:
            GripperStateError: always.
        """
        raise GripperStateError("calibrate: this gripper is a joint, which knows where it is")

    def activate(self, on: bool) -> None:
        """Refuse to switch off what has no switch.

        Raises:
            GripperStateError: it was to be switched off.
        """
        if not on:
            raise GripperStateError("activate: this gripper is a joint, which does not go limp")

    def release_power(self) -> None:
        """Refuse: a joint does not go limp.

        Raises:
            GripperStateError: always.
        """
        self.activate(False)

    # As of a gripper

    def start(self) -> None:
        """Nothing: it lives by what it is told."""

    def close(self) -> None:
        """Hold in place, where the joint is there, and end."""
        with self._lock:
            if self.state.phase is Phase.MOVING:
                self._hold()
            self._closed = True

    def listen(self, callback: Listener) -> Callable[[], None]:
        """Have a function called with the state after every state of the joint; return what ends it."""
        self._listeners.append(callback)
        return lambda: self._listeners.remove(callback) if callback in self._listeners else None

    def opening_at(self, time: float) -> float:
        """Return the opening [m] at a time of the last 5 s [s]; NaN where it is not known."""
        with self._lock:
            return self._history.place_at(time, 0.0)

    def wait(self, condition: Callable[[GripperState], bool], timeout: float) -> GripperState:
        """Return the first state that fulfils a condition.

        Raises:
            GripperTimeoutError: none did within `timeout` [s].
            GripperStateError: the gripper was closed meanwhile.
        """
        deadline, wake = self.clock.now() + timeout, Event()
        while not condition(state := self.state):
            if self._closed:
                raise GripperStateError("wait: the driver of the gripper has ended; start it again")
            if self.clock.now() >= deadline:
                words = f"not within {timeout:g} s: the gripper is {state.phase.value}: {state.message}"
                raise GripperTimeoutError(words)
            self.clock.wait(TURN, wake)
        return state

    # Within

    @property
    def _is_known(self) -> bool:
        return self._stamp > -math.inf

    def _require(self, what: str, *, stopped: bool = False) -> None:
        if self.state.phase in (Phase.PROBING, Phase.DISCONNECTED):
            raise GripperStateError(f"{what}: no state of {self._joint.names[0]} comes ({self.state.message})")
        if self._stopped and not stopped:
            raise GripperStateError(f"{what}: an emergency stop is latched: clear the errors first")

    def _hold(self) -> None:
        self._end(MoveOutcome.REPLACED)
        self._command(self._history.last, self.clock.now())

    def _end(self, outcome: MoveOutcome) -> None:
        if self._way is not None and self._outcome is MoveOutcome.NONE:
            self._outcome = outcome
        self._way = None

    def _command(self, opening: float, now: float) -> None:
        """Send an opening [m] to the joint."""
        self._sent, way = now, self._way
        rate = 1.0 / abs(self._per_unit)
        self._send(
            JointCommand(
                position=self._joint.closed + (opening - self.settings.closed_opening) / self._per_unit,
                velocity=math.nan if way is None else rate * way.speed,
                effort=math.nan if way is None else way.effort,
            )
        )

    def _judge(self, stamp: float) -> None:
        """Judge the move by a new state."""
        if abs(self._history.speed()) > STILL:
            self._moved = stamp
        way, opening = self._way, self._history.last
        if way is not None and self._outcome is MoveOutcome.NONE:
            over = stamp > way.arrives
            if over and abs(opening - way.target) <= NEAR * self.resolution:
                self._outcome = MoveOutcome.REACHED
            elif over and stamp - self._moved > STALL and stamp - way.arrives > STALL:
                closes = way.target < opening
                self._outcome = MoveOutcome.GRASPED if closes else MoveOutcome.BLOCKED
            elif stamp > way.arrives + PATIENCE:
                self._outcome = MoveOutcome.TIMED_OUT
        self._refresh()

    def _refresh(self) -> None:
        """Make the state anew."""
        if not self._is_known:
            self.state = replace(self.state, estopped=self._stopped)
            return
        away = self.clock.now() - self._stamp > SILENCE
        moving = self._way is not None and self._outcome is MoveOutcome.NONE
        phase = Phase.MOVING if moving else Phase.READY
        phase = Phase.FAULT if self._stopped else phase
        words = {MoveOutcome.GRASPED: "something is grasped", MoveOutcome.BLOCKED: "something blocks the opening jaws"}
        message = words.get(
            self._outcome, self._outcome.value if self._outcome is not MoveOutcome.NONE else phase.value
        )
        if self._stopped:
            message = "emergency stop: the jaws hold; make the place safe, then clear the errors"
        if away:
            phase, message = Phase.DISCONNECTED, f"no state of {self._joint.names[0]} for {SILENCE:g} s"
        self.state = GripperState(
            phase=phase,
            stamp=self._stamp,
            opening=self._history.last,
            velocity=self._history.speed(),
            force=self._effort if self._joint.effort_is_force else math.nan,
            target=math.nan if self._way is None else self._way.target,
            at_target=self._outcome is MoveOutcome.REACHED,
            calibrated=True,
            activated=True,
            estopped=self._stopped,
            outcome=self._outcome,
            message=message,
        )

    def _tell(self) -> None:
        for listener in tuple(self._listeners):
            listener(self.state)
