"""The gripper as a program uses it: commands that return at once, a state that is always there.

    with Gripper(build_bus("/dev/ttyACM0")) as gripper:
        gripper.wait(lambda state: state.phase is Phase.UNCALIBRATED, 3.0)  # READY, if it is calibrated already
        gripper.calibrate()
        gripper.wait(lambda state: state.phase is Phase.READY, 40.0)
        gripper.move(0.010, speed=0.005, force=10.0)

Without `start` nothing runs by itself: every `turn` is one cycle, and `wait` makes the turns, which is how it lives in
stepped time.
"""

from __future__ import annotations

import secrets
from collections.abc import Callable
from threading import Condition, Event, Thread

from finforce_driver.can.bus import Bus
from finforce_driver.clock import Clock, MonotonicClock
from finforce_driver.errors import GraspError, GripperStateError, GripperTimeoutError
from finforce_driver.machine.loop import GripperLoop
from finforce_driver.machine.machine import GripperMachine
from finforce_driver.settings import GripperSettings
from finforce_driver.state import GripperState, MoveOutcome, Phase
from finforce_driver.units import GripperScale

Listener = Callable[[GripperState], None]
StateCondition = Callable[[GripperState], bool]
JOIN_TIMEOUT = 2.0  # [s], for a cycle under way: the longest wait for a reply is 1 s
LOST = (Phase.DISCONNECTED, Phase.PROBING, Phase.FAULT, Phase.UNCALIBRATED)


class Gripper:
    """An SSG-48 behind a bus.

    Args:
        bus: what carries the messages; the gripper opens and closes it.
        settings: of the gripper.
        clock: what it lives by; the machine's own where none is given.
    """

    def __init__(self, bus: Bus, settings: GripperSettings | None = None, clock: Clock | None = None) -> None:
        self.settings = settings or GripperSettings()
        self.clock = clock or MonotonicClock()
        self.scale = GripperScale(self.settings)
        # a gripper that an earlier program left must not take our first command for its last one
        machine = GripperMachine(self.settings, salt=secrets.randbelow(16))
        self._loop = GripperLoop(machine, bus, self.clock)
        self._changed = Condition()
        self._stop = Event()
        self._thread: Thread | None = None
        self._loop.listen(self._tell_waiters)

    def __enter__(self) -> Gripper:
        """Start."""
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        """Close."""
        self.close()

    @property
    def state(self) -> GripperState:
        """What is known now; never blocks."""
        return self._loop.state

    @property
    def resolution(self) -> float:
        """Opening per count of the gripper [m]."""
        return self.scale.resolution

    def start(self) -> None:
        """Run in a thread of its own from now on; nothing moves by that."""
        if self._thread is None:
            self._stop.clear()
            self._thread = Thread(target=self._loop.run, args=(self._stop,), name="gripper", daemon=True)
            self._thread.start()

    def close(self) -> None:
        """End the thread and close the port; the gripper holds in place, or lets go with `release_on_stop`."""
        thread, self._thread = self._thread, None
        self._stop.set()
        self._loop.wake()
        if thread is not None:
            thread.join(JOIN_TIMEOUT)
        self._loop.close()

    def turn(self) -> None:
        """Make one cycle: at most one request and its reply, or the wait for what is due; only without `start`."""
        self._loop.turn()

    def listen(self, callback: Listener) -> Callable[[], None]:
        """Have a function called with the state after every believed reply and every change of phase.

        It is called in the loop's thread and has to return at once.

        Returns:
            What ends it.
        """
        return self._loop.listen(callback)

    def opening_at(self, time: float) -> float:
        """Return the opening [m] at a time of the last 5 s [s]; NaN where it is not known."""
        return self._loop.opening_at(time)

    def move(
        self, opening: float, speed: float | None = None, force: float | None = None, *, current: float | None = None
    ) -> None:
        """Go to an opening, and stall with a force when something is in the way.

        Args:
            opening: to be reached [m].
            speed: of the opening [m/s], both jaws together; the default of the settings where None.
            force: grip force by the maker's curve [N]; the default current of the settings where None.
            current: the motor's limit [A], in place of a force.

        Raises:
            TargetError: a value is no number or out of bounds, or force and current are both given.
            GripperStateError: the gripper could not move: absent, faulty, not calibrated, calibrating, switched off.
        """
        if current is not None:
            force = self.scale.force_for(current, force)
        self._loop.command(lambda machine, now: machine.move(opening, speed, force, now))

    def check_move(self, opening: float, speed: float | None = None, force: float | None = None) -> None:
        """Refuse what `move` would refuse in whatever state.

        Raises:
            TargetError: a value is no number or out of bounds.
        """
        self._loop.command(lambda machine, _: machine.check_move(opening, speed, force))

    def hold(self) -> None:
        """Stop in place and hold there; during a calibration: stop, limp.

        Raises:
            GripperStateError: the gripper is absent, faulty or not calibrated: its jaws are limp.
        """
        self._loop.command(lambda machine, now: machine.hold(now))

    def calibrate(self) -> None:
        """Find the end stops: the jaws open fully, then close fully, with some 24 N.

        Raises:
            GripperStateError: the gripper is absent or faulty, or calibrates already.
        """
        self._loop.command(lambda machine, now: machine.calibrate())

    def clear_errors(self) -> None:
        """Clear what is latched, an emergency stop too; does nothing without a fault, since it would let go.

        Raises:
            GripperStateError: the gripper is absent or calibrates.
        """
        self._loop.command(lambda machine, now: machine.clear_errors())

    def estop(self) -> None:
        """Stop at once: the messages leave from the calling thread, and the jaws go limp.

        Repeated until the gripper says that it is stopped, also after a lost link; only `clear_errors` ends it.
        """
        self._loop.estop()

    def activate(self, on: bool) -> None:
        """Switch the power stage on, holding in place, or off, limp: it then refuses moves.

        Raises:
            GripperStateError: the gripper is absent, faulty or calibrating.
        """
        self._loop.command(lambda machine, now: machine.activate(on, now))

    def release_power(self) -> None:
        """Let the jaws go limp, ready for the next move; what is held may drop.

        Raises:
            GripperStateError: the gripper is absent, faulty or calibrating.
        """
        self._loop.command(lambda machine, now: machine.release_power(now))

    def wait(self, condition: StateCondition, timeout: float) -> GripperState:
        """Return the first state that fulfils a condition.

        Raises:
            GripperTimeoutError: none did within `timeout` [s].
            GripperStateError: the gripper was closed meanwhile.
        """
        deadline = self.clock.now() + timeout
        while not condition(state := self.state):
            if self._stop.is_set():
                raise GripperStateError("wait: the driver of the gripper has ended; start it again")
            left = deadline - self.clock.now()
            if left <= 0.0:
                raise GripperTimeoutError(
                    f"not within {timeout:g} s: the gripper is {state.phase.value}: {state.message}"
                )
            self._pass_time(condition, left)
        return state

    def grasp_without_vision(
        self,
        current_force: float,
        speed: float | None = None,
        least_opening: float | None = None,
        time_limit: float = 20.0,
    ) -> GripperState:
        """Close until something resists with a force that the motor's current alone tells; return the state holding.

        The force is that of the maker's curve, 7 to 62 N: too much for what is fragile. Blocks; the same without
        waiting is `move(least_opening, speed, current_force)`.

        Args:
            current_force: grip force by the maker's curve [N].
            speed: of the opening [m/s].
            least_opening: how far to close [m]; fully where None.
            time_limit: longest time [s].

        Raises:
            TargetError: a value is no number or out of bounds.
            GripperStateError: the gripper could not move, or was lost on the way.
            GripperTimeoutError: nothing resisted in time; the gripper holds in place.
            GraspError: the jaws closed as far as they may on nothing; the gripper holds in place.
        """
        self.move(self.settings.closed_opening if least_opening is None else least_opening, speed, current_force)
        try:
            state = self.wait(lambda state: state.phase is not Phase.MOVING, time_limit)
        except GripperTimeoutError:
            self.hold()
            raise
        if state.phase in LOST:
            raise GripperStateError(f"the grasp was lost: {state.message}")
        if state.outcome is not MoveOutcome.GRASPED:
            self.hold()
            raise GraspError(f"nothing was grasped ({state.outcome.value}) down to {1e3 * state.opening:.1f} mm")
        return state

    def _pass_time(self, condition: StateCondition, left: float) -> None:
        """Let the gripper get on, by a turn of our own where no thread makes them."""
        if self._thread is None:
            self._loop.turn(left)
            return
        with self._changed:
            if not condition(self.state):
                self._changed.wait(min(left, 0.1))

    def _tell_waiters(self, _: GripperState) -> None:
        """Wake those who wait for a state."""
        with self._changed:
            self._changed.notify_all()
