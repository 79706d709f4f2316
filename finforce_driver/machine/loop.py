"""Carries a machine's messages over a bus, one request at a time, and opens the bus again and again."""

from __future__ import annotations

import logging
from collections.abc import Callable
from threading import Event, RLock

from finforce.errors import FinforceError
from finforce_driver.can.bus import Bus
from finforce_driver.clock import Clock
from finforce_driver.errors import LinkError
from finforce_driver.machine.exchange import Request
from finforce_driver.machine.machine import GripperMachine
from finforce_driver.state import GripperState

LOG = logging.getLogger(__name__)
FIRST_PAUSE, LONGEST_PAUSE = 0.5, 5.0  # [s] between two tries to open the bus
SHORTEST_WAIT = 1e-4  # [s], so that a rounding error of the clock makes no endless loop
LATE_MESSAGES = 64  # that are taken at most between two requests, however many come
LEAVING_TURNS = 20  # that the last order may take

Listener = Callable[[GripperState], None]


class GripperLoop:
    """Runs a machine on a bus.

    Whatever is sent is chosen and sent under one lock, so that after an emergency stop, which takes it too, no message
    that was chosen before can leave.

    Args:
        machine: to be run.
        bus: that it runs on, closed.
        clock: what time it is.
    """

    def __init__(self, machine: GripperMachine, bus: Bus, clock: Clock) -> None:
        self._machine, self._bus, self._clock = machine, bus, clock
        self._lock = RLock()
        self._wake = Event()
        self._listeners: list[Listener] = []
        self._told: GripperState | None = None
        self._opened = False
        self._pause, self._next_open = FIRST_PAUSE, clock.now()

    @property
    def state(self) -> GripperState:
        """What is known now."""
        return self._machine.state

    def listen(self, callback: Listener) -> Callable[[], None]:
        """Have a function called with every new state; return what ends that."""
        self._listeners.append(callback)
        return lambda: self._listeners.remove(callback) if callback in self._listeners else None

    def opening_at(self, time: float) -> float:
        """Return the opening [m] at a past time [s]; NaN unknown."""
        with self._lock:
            return self._machine.opening_at(time)

    def command(self, action: Callable[[GripperMachine, float], None]) -> None:
        """Give the machine a command and wake the loop."""
        with self._lock:
            action(self._machine, self._clock.now())
        self._wake.set()

    def estop(self) -> None:
        """Stop the gripper from the calling thread; what cannot be sent now is sent as soon as the bus is open."""
        with self._lock:
            messages = self._machine.estop(self._clock.now())
            if self._opened:
                try:
                    for message in messages:
                        self._bus.send(message)
                except FinforceError as error:
                    LOG.warning("the emergency stop waits for the link: %s", error)
        self._wake.set()

    def wake(self) -> None:
        """End a wait."""
        self._wake.set()

    def run(self, stop: Event) -> None:
        """Make turns until `stop` is set."""
        while not stop.is_set():
            self.turn()

    def turn(self, longest: float = LONGEST_PAUSE) -> None:
        """Make one cycle: open the bus, or one request and its reply, or wait at most `longest` [s] for what is due."""
        self._wake.clear()
        try:
            if self._opened:
                self._exchange(longest)
            else:
                self._open(longest)
        except FinforceError as error:
            self._lose(str(error))
        except Exception as error:  # a driver that dies would leave the gripper alone with its last order
            LOG.exception("unexpected error in the gripper's loop")
            self._lose(f"unexpected error, please report it: {type(error).__name__}: {error}")
        self._tell()

    def close(self) -> None:
        """Send what is to be sent at the end, and close the bus."""
        if self._opened:
            with self._lock:
                self._machine.leave(self._clock.now())
            for _ in range(LEAVING_TURNS):
                if not (self._opened and self._machine.has_orders):
                    break
                self.turn(0.0)
        self._drop("the driver has ended")
        self._tell()

    def _open(self, longest: float) -> None:
        """Open the bus when its time has come, else wait for that."""
        left = self._next_open - self._clock.now()
        if left > SHORTEST_WAIT:
            self._clock.wait(max(min(left, longest), SHORTEST_WAIT), self._wake)
            return
        self._bus.open()
        with self._lock:
            self._opened = True
            self._machine.on_link_open()

    def _exchange(self, longest: float) -> None:
        """Send what is due and receive its reply, or wait."""
        self._take_late_messages()
        with self._lock:
            now = self._clock.now()
            request = self._machine.next_request(now)
            if request is not None:
                self._bus.send(request.message)
            left = self._machine.next_time(now) - now
        if request is None:
            self._clock.wait(max(min(left, longest), SHORTEST_WAIT), self._wake)
        elif request.answer is not None:
            self._receive(request, now)
        if self._machine.must_reopen:
            raise LinkError(self._machine.state.message)

    def _take_late_messages(self) -> None:
        """Take what has come without being asked for: it must not pass for the next reply."""
        for _ in range(LATE_MESSAGES):
            message = self._bus.receive(0.0)
            if message is None:
                return
            with self._lock:
                self._machine.on_message(message, self._clock.now())

    def _receive(self, request: Request, sent: float) -> None:
        """Wait for the reply to a request that was sent at a time [s]."""
        deadline = sent + self._machine.settings.reply_timeout
        while (left := deadline - self._clock.now()) > 0.0:
            message = self._bus.receive(left)
            if message is None:
                break
            with self._lock:
                if self._machine.on_message(message, self._clock.now(), self._bus.counts):
                    self._pause = FIRST_PAUSE
                    return
        with self._lock:
            self._machine.on_silence(self._clock.now(), self._bus.suspicion)

    def _lose(self, reason: str) -> None:
        """Close a bus that failed, and open it later."""
        self._drop(reason)
        self._next_open = self._clock.now() + self._pause
        self._pause = min(2.0 * self._pause, LONGEST_PAUSE)

    def _drop(self, reason: str) -> None:
        """Close the bus and tell the machine."""
        with self._lock:
            self._opened = False
            self._machine.on_link_lost(reason)
        self._bus.close()

    def _tell(self) -> None:
        """Call the listeners if the state is new."""
        state = self._machine.state
        if state is self._told:
            return
        self._told = state
        for listener in list(self._listeners):
            try:
                listener(state)
            except Exception:  # somebody else's error must not stop the gripper's driver
                LOG.exception("a listener to the gripper failed")
