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

import logging
import secrets
from collections.abc import Callable
from threading import Condition, Event, Thread
from time import monotonic

from finforce.errors import FinforceError
from finforce_driver.can.protocol import Bus
from finforce_driver.errors import GripperStateError, GripperTimeoutError, LinkError
from finforce_driver.machine.drive import Request
from finforce_driver.machine.machine import GripperMachine
from finforce_driver.settings import GripperSettings
from finforce_driver.state import GripperState

LOG = logging.getLogger(__name__)
FIRST_PAUSE = 0.5  # [s], between the first two attempts to open the bus
LONGEST_PAUSE = 5.0  # [s], between later ones
SHORTEST_WAIT = 1e-4  # [s], so that a rounding error of the clock makes no endless loop
LATE_MESSAGES = 64  # that are taken at most between two requests, however many come
LEAVING_TURNS = 20  # that the last order may take
Listener = Callable[[GripperState], None]
StateCondition = Callable[[GripperState], bool]
JOIN_TIMEOUT = 2.0  # [s], for a cycle under way: the longest wait for a reply is 1 s


class Clock:
    """The clock of the machine; a test steps one of its own."""

    def now(self) -> float:
        """Return the time since some moment [s]; it never goes back."""
        return monotonic()

    def wait(self, seconds: float, wake: Event) -> None:
        """Return after `seconds` [s], or as soon as `wake` is set."""
        if seconds > 0.0:
            wake.wait(seconds)


class StateSource:
    """A source of states that others listen to and wait for.

    Attributes:
        state: the present one; reading it never blocks.
        clock: its time.
    """

    state: GripperState

    def __init__(self, clock: Clock | None) -> None:
        self.clock = clock or Clock()
        self._listeners: list[Listener] = []
        self._told: GripperState | None = None
        self._changed, self._ended = Condition(), Event()

    def listen(self, callback: Listener) -> Callable[[], None]:
        """Have a function called with the state after every believed reply and every change of phase.

        It is called in the thread that changes the state and has to return at once.

        Returns:
            What ends it.
        """
        self._listeners.append(callback)
        return lambda: self._listeners.remove(callback) if callback in self._listeners else None

    def wait(self, condition: StateCondition, timeout: float) -> GripperState:
        """Return the first state that fulfils a condition.

        Raises:
            GripperTimeoutError: none did within `timeout` [s].
            GripperStateError: the gripper was closed meanwhile.
        """
        deadline = self.clock.now() + timeout
        while not condition(state := self.state):
            if self._ended.is_set():
                raise GripperStateError("wait: the driver of the gripper has ended; start it again")
            left = deadline - self.clock.now()
            if left <= 0.0:
                raise GripperTimeoutError(
                    f"not within {timeout:g} s: the gripper is {state.phase.value}: {state.message}"
                )
            self._pass_time(condition, left)
        return state

    def _pass_time(self, condition: StateCondition, left: float) -> None:
        """Wait for another state, a tenth of a second at most."""
        with self._changed:
            if not condition(self.state):
                self._changed.wait(min(left, 0.1))

    def _tell(self) -> None:
        """Tell waiters and listeners the state if it is new."""
        state = self.state
        if state is self._told:
            return
        self._told = state
        with self._changed:
            self._changed.notify_all()
        for listener in list(self._listeners):
            try:
                listener(state)
            except Exception:  # somebody else's error must not stop the gripper's driver
                LOG.exception("a listener to the gripper failed")


class Gripper(GripperMachine, StateSource):
    """Drives an SSG-48 over a CAN bus, which is reopened whenever it fails.

    One lock covers the choice and the sending of every message. An emergency stop takes it too, so no message that was
    chosen before the stop is sent after it.

    Args:
        bus: bus that carries the messages; the gripper opens and closes it.
        settings: settings of the gripper.
        clock: source of time; None for the clock of this machine.
    """

    def __init__(self, bus: Bus, settings: GripperSettings | None = None, clock: Clock | None = None) -> None:
        StateSource.__init__(self, clock)
        # a gripper that an earlier program left must not take our first command for its last one
        salt = secrets.randbelow(16)
        GripperMachine.__init__(self, settings or GripperSettings(), self.clock.now, salt)
        self._bus = bus
        self._thread: Thread | None = None
        self._pause, self._next_open = FIRST_PAUSE, self.clock.now()

    def __enter__(self) -> Gripper:
        """Start."""
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        """Close."""
        self.close()

    @property
    def resolution(self) -> float:
        """Opening per count of the gripper [m]."""
        return self.settings.resolution

    def start(self) -> None:
        """Run in a thread of its own from now on; nothing moves by that."""
        if self._thread is None:
            self._ended.clear()
            self._thread = Thread(target=self._run, name="gripper", daemon=True)
            self._thread.start()

    def close(self) -> None:
        """End the thread and close the port; the gripper holds in place, or lets go with `release_on_stop`."""
        thread, self._thread = self._thread, None
        self._ended.set()
        self._wake.set()
        if thread is not None:
            thread.join(JOIN_TIMEOUT)
        if self.joined:
            self.leave()
            for _ in range(LEAVING_TURNS):
                if not (self.joined and self.has_orders):
                    break
                self.turn(0.0)
        self._drop("the driver has ended")
        self._tell()

    def turn(self, longest: float = LONGEST_PAUSE) -> None:
        """Make one cycle, only without `start`: open the bus, or one request and its reply, or wait for what is due.

        Args:
            longest: wait [s].
        """
        self._wake.clear()
        try:
            if self.joined:
                self._exchange(longest)
            else:
                self._open(longest)
        except FinforceError as error:
            self._lose(str(error))
        except Exception as error:  # a driver that dies would leave the gripper alone with its last order
            LOG.exception("unexpected error in the gripper's loop")
            self._lose(f"unexpected error, please report it: {type(error).__name__}: {error}")
        self._tell()

    def estop(self) -> None:
        """Stop at once: the messages leave from the calling thread, and the jaws go limp.

        Repeated until the gripper says that it is stopped, also after a lost link; only `clear_errors` ends it.
        """
        with self._lock:
            messages = self.demand_stop()
            if self.joined:
                try:
                    for message in messages:
                        self._bus.send(message)
                except FinforceError as error:
                    LOG.warning("the emergency stop waits for the link: %s", error)
        self._wake.set()

    def _pass_time(self, condition: StateCondition, left: float) -> None:
        """Let the gripper get on, by a turn of our own where no thread makes them."""
        if self._thread is None:
            self.turn(left)
        else:
            super()._pass_time(condition, left)

    def _run(self) -> None:
        """Make turns until the gripper is closed."""
        while not self._ended.is_set():
            self.turn()

    def _open(self, longest: float) -> None:
        """Open the bus when its time has come, else wait for that."""
        left = self._next_open - self.clock.now()
        if left > SHORTEST_WAIT:
            self.clock.wait(max(min(left, longest), SHORTEST_WAIT), self._wake)
            return
        self._bus.open()
        with self._lock:
            self.on_link_open()

    def _exchange(self, longest: float) -> None:
        """Send what is due and receive its reply, or wait."""
        self._take_late_messages()
        with self._lock:
            now = self.clock.now()
            request = self.next_request(now)
            if request is not None:
                self._bus.send(request.message)
            left = self.next_time(now) - now
        if request is None:
            self.clock.wait(max(min(left, longest), SHORTEST_WAIT), self._wake)
        elif request.answer is not None:
            self._receive(request, now)
        if self.must_reopen:
            raise LinkError(self.state.message)

    def _take_late_messages(self) -> None:
        """Take what has come without being asked for: it must not pass for the next reply."""
        for _ in range(LATE_MESSAGES):
            message = self._bus.receive(0.0)
            if message is None:
                return
            with self._lock:
                self.on_message(message, self.clock.now())

    def _receive(self, request: Request, sent: float) -> None:
        """Wait for the reply to a request that was sent at a time [s]."""
        deadline = sent + self.settings.reply_timeout
        while (left := deadline - self.clock.now()) > 0.0:
            message = self._bus.receive(left)
            if message is None:
                break
            with self._lock:
                if self.on_message(message, self.clock.now(), self._bus.counts):
                    self._pause = FIRST_PAUSE
                    return
        with self._lock:
            self.on_silence(self.clock.now(), self._bus.suspicion)

    def _lose(self, reason: str) -> None:
        """Close a bus that failed, and open it later."""
        self._drop(reason)
        self._next_open = self.clock.now() + self._pause
        self._pause = min(2.0 * self._pause, LONGEST_PAUSE)

    def _drop(self, reason: str) -> None:
        """Close the bus and tell the machine."""
        with self._lock:
            self.on_link_lost(reason)
        self._bus.close()
