"""What is sent next: one message at a time, the most urgent first."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from finforce_driver.can.bus import CanMessage
from finforce_driver.can.protocol import (
    LARGEST_NODE,
    Command,
    Flag,
    Move,
    encode_command,
    encode_move,
    encode_poll,
    encode_request,
    encode_watchdog,
)
from finforce_driver.machine.calibration import CalibrationStep
from finforce_driver.machine.exchange import Request
from finforce_driver.machine.stop import RecoveryStep

if TYPE_CHECKING:
    from finforce_driver.machine.machine import GripperMachine

LATEST_REPLY = 0.5  # [s] after which no reply is expected any more
SPACING = 0.001  # [s] before a reply is asked for again
WATCHDOG_PERIOD = 1.0  # [s] between two settings of the gripper's watchdog
SEARCH_MISSES = 10  # requests without a reply after which other nodes are looked for


class RequestSource:
    """Chooses the next request.

    Args:
        machine: what the gripper is doing and shall do.
    """

    def __init__(self, machine: GripperMachine) -> None:
        self._machine = machine
        self._node = machine.settings.node_id
        self._next_poll = -math.inf
        self._polled = False
        self._next_watchdog = -math.inf
        self._watchdogs: list[CanMessage] = []
        # an order leaves on the word of a reply, not on that of an old one
        self._freshness = 1.5 / machine.settings.poll_rate + machine.settings.reply_timeout
        self._searched = machine.settings.node_id
        self._stop_rest: Request | None = None
        self._sources = (
            self._stop,
            self._urgent_order,
            self._marker,
            self._order,
            self._doubt,
            self._sequence,
            self._travel,
            self._watchdog,
            self._poll,
            self._telemetry,
        )

    def next_request(self, now: float) -> Request | None:
        """Return what to send at a time [s]; None when nothing is due."""
        if self._quiet(now) or (now < self._machine.exchange.free and not self._machine.stop.active):
            return None
        return next((request for source in self._sources if (request := source(now)) is not None), None)

    def next_time(self, now: float) -> float:
        """Return when something is due at the latest [s]."""
        machine = self._machine
        if self._quiet(now):
            return machine.calibration.quiet_until(now)
        step = machine.job.next_time if machine.job is not None and machine.may_drive else math.inf
        question = machine.known.telemetry.next_time if self._may_ask() else math.inf
        if self._may_watch():
            question = machine.calibration.travel.next_time
        wanted = machine.known.filter.doubtful or machine.hold_wanted
        repetition = machine.exchange.sent + SPACING if wanted else math.inf
        poll = machine.exchange.sent + LATEST_REPLY if self._resting() else self._next_poll
        return max(machine.exchange.free, min(poll, step, question, repetition))

    def begin_stop(self, now: float) -> Request | None:
        """Return the first message of an emergency stop, an order with its flag; None when it is not due again."""
        machine = self._machine
        if not machine.stop.due(now):
            return None
        place = machine.known.place
        position = 0 if math.isnan(place) else math.ceil(place)
        self._stop_rest = Request(message=encode_command(self._node, Command.ESTOP))
        return self._request_of(machine.order(position=position, flags=Flag.ACTIVATE | Flag.GO | Flag.ESTOP))

    def end_stop(self) -> Request | None:
        """Return the second message of an emergency stop, its own command; None when it was sent."""
        request, self._stop_rest = self._stop_rest, None
        return request

    def _quiet(self, now: float) -> bool:
        """Whether the gripper boots and nothing is to be sent; an emergency stop is sent all the same."""
        run = self._machine.calibration
        return run is not None and run.quiet_until(now) is not None and not self._machine.stop.active

    def _stop(self, now: float) -> Request | None:
        """The emergency stop until it is acknowledged: an order with its flag, and its own command."""
        return self.end_stop() or self.begin_stop(now)

    def _urgent_order(self, _: float) -> Request | None:
        """An order that makes the gripper stop does not wait for anything."""
        machine = self._machine
        if (
            not (machine.orders.urgent and machine.orders.pending)
            or machine.stop.active
            or machine.calibration
            or machine.recovery
        ):
            return None
        return self._request_of(machine.orders.wanted)

    def _marker(self, _: float) -> Request | None:
        """The way back into step."""
        return self._machine.exchange.marker()

    def _doubt(self, now: float) -> Request | None:
        """A reply that is not believed is asked for again, and one that tells where to hold."""
        machine = self._machine
        wanted = machine.known.filter.doubtful or machine.hold_wanted
        return self._poll_now() if wanted and now >= machine.exchange.sent + SPACING else None

    def _sequence(self, now: float) -> Request | None:
        """The next message of a recovery or a calibration."""
        machine = self._machine
        if machine.recovery is not None and machine.recovery.step is RecoveryStep.UNFLAG:
            return self._request_of(machine.order(position=machine.place_for_order(now), flags=Flag.ACTIVATE))
        if machine.recovery is not None and machine.recovery.step is RecoveryStep.CLEAR:
            machine.recovery.clear(now)
            return Request(message=encode_command(self._node, Command.CLEAR))
        if machine.calibration is not None and machine.calibration.step is CalibrationStep.RESET:
            machine.calibration.reset(now)
            return Request(message=encode_command(self._node, Command.RESET))
        if machine.calibration is not None and machine.calibration.step is CalibrationStep.START:
            machine.calibration.start(now)
            return Request(message=encode_command(self._node, Command.CALIBRATE))
        return None

    def _travel(self, now: float) -> Request | None:
        """A question for the encoder's count while the gripper looks for its stops, in turn with the polls."""
        run = self._machine.calibration
        if not self._may_watch() or not run.travel.is_due(now):
            return None
        run.travel.ask(now)
        self._polled = False
        message = encode_request(self._node, Command.ENCODER)
        return Request(message=message, answer=Command.ENCODER, node=self._node, counted=False)

    def _watchdog(self, now: float) -> Request | None:
        """The gripper's watchdog, again and again, since it forgets it when it restarts; none at the end."""
        machine, seconds = self._machine, self._machine.settings.watchdog
        if machine.farewell:
            return Request(message=machine.farewell.popleft())
        if not seconds or machine.known.reply is None or machine.calibration is not None:
            return None
        if now >= self._next_watchdog:
            self._next_watchdog = now + WATCHDOG_PERIOD
            self._watchdogs = encode_watchdog(self._node, seconds)
        return Request(message=self._watchdogs.pop(0)) if self._watchdogs else None

    def _order(self, now: float) -> Request | None:
        """The wanted order, where it differs from the gripper's and may leave."""
        machine = self._machine
        orders = machine.orders
        if machine.stop.active or machine.recovery is not None or machine.calibration is not None:
            return None
        may_drive = machine.may_drive and now - machine.known.stamp <= self._freshness
        if may_drive:
            machine.advance_move(now)
        if not orders.pending or (orders.wanted.drives and not may_drive):
            return None
        return self._request_of(orders.wanted) if machine.known.reply is not None else None

    def _poll(self, now: float) -> Request | None:
        """The empty command at the poll rate; while nothing answers, every other one looks for another node."""
        if now < self._next_poll or self._rests(now):
            return None
        period = 1.0 / self._machine.settings.poll_rate
        # a late poll does not delay the next ones, unless it is so late that one is left out
        self._next_poll = max(self._next_poll + period, now)
        self._polled = True
        misses = self._machine.exchange.misses
        if misses < SEARCH_MISSES or misses % 2 or self._machine.calibration is not None:
            return self._poll_now()
        return self._search()

    def _rests(self, now: float) -> bool:
        """Whether a late reply is waited for: the way back into step without markers."""
        if not self._resting():
            return False
        if now < self._machine.exchange.sent + LATEST_REPLY:
            return True
        self._machine.exchange.rest()
        return False

    def _resting(self) -> bool:
        machine, exchange = self._machine, self._machine.exchange
        return (
            exchange.marker() is None
            and not exchange.in_step
            and machine.known.reply is not None
            and not machine.silent
        )

    def _search(self) -> Request:
        """A ping to another node, which changes nothing there."""
        self._searched = (self._searched + 1) % (LARGEST_NODE + 1)
        if self._searched == self._node:
            return self._poll_now()
        message = encode_request(self._searched, Command.PING)
        return Request(message=message, answer=Command.PING, node=self._searched)

    def _telemetry(self, now: float) -> Request | None:
        """A question, where nothing more important is under way."""
        command = self._machine.known.telemetry.question(now) if self._may_ask() else None
        if command is None:
            return None
        return Request(message=encode_request(self._node, command), answer=command, node=self._node, counted=False)

    def _may_ask(self) -> bool:
        machine = self._machine
        known = machine.known.reply is not None and machine.exchange.in_step
        return known and machine.calibration is None and machine.recovery is None

    def _may_watch(self) -> bool:
        run = self._machine.calibration
        watches = run is not None and run.step is CalibrationStep.WATCH
        return watches and self._polled and self._machine.exchange.in_step

    def _poll_now(self) -> Request:
        return Request(message=encode_poll(self._node), answer=Command.REPLY, node=self._node)

    def _request_of(self, order: Move) -> Request:
        return Request(message=encode_move(self._node, order), answer=Command.REPLY, node=self._node, move=order)
