"""What is sent next: one message at a time, the most urgent first."""

from __future__ import annotations

import math

from finforce_driver.can.protocol import (
    LARGEST_NODE,
    CanMessage,
    Command,
    Flag,
    Move,
    encode_command,
    encode_move,
    encode_poll,
    encode_request,
    encode_watchdog,
)
from finforce_driver.machine.drive import Drive
from finforce_driver.machine.exchange import Request
from finforce_driver.machine.procedures import CalibrationStep, RecoveryStep

LATEST_REPLY = 0.5  # [s] after which no reply is expected any more
SPACING = 0.001  # [s] before a reply is asked for again
WATCHDOG_PERIOD = 1.0  # [s] between two settings of the gripper's watchdog
SEARCH_MISSES = 10  # requests without a reply after which other nodes are looked for


class RequestSource:
    """Chooses the next request.

    Args:
        drive: what the gripper is doing and shall do.
    """

    def __init__(self, drive: Drive) -> None:
        self._drive = drive
        self._node = drive.settings.node_id
        self._next_poll = -math.inf
        self._polled = False
        self._next_watchdog = -math.inf
        self._watchdogs: list[CanMessage] = []
        # an order leaves on the word of a reply, not on that of an old one
        self._freshness = 1.5 / drive.settings.poll_rate + drive.settings.reply_timeout
        self._searched = drive.settings.node_id
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
        if self._quiet(now) or (now < self._drive.exchange.free and not self._drive.stop.active):
            return None
        return next((request for source in self._sources if (request := source(now)) is not None), None)

    def next_time(self, now: float) -> float:
        """Return when something is due at the latest [s]."""
        drive = self._drive
        if self._quiet(now):
            return drive.calibration.quiet_until(now)
        step = drive.job.next_time if drive.job is not None and drive.may_drive else math.inf
        question = drive.known.telemetry.next_time if self._may_ask() else math.inf
        if self._may_watch():
            question = drive.calibration.travel.next_time
        wanted = drive.known.filter.doubtful or drive.hold_wanted
        repetition = drive.exchange.sent + SPACING if wanted else math.inf
        poll = drive.exchange.sent + LATEST_REPLY if self._resting() else self._next_poll
        return max(drive.exchange.free, min(poll, step, question, repetition))

    def begin_stop(self, now: float) -> Request | None:
        """Return the first message of an emergency stop, an order with its flag; None when it is not due again."""
        drive = self._drive
        if not drive.stop.due(now):
            return None
        place = drive.known.place
        position = 0 if math.isnan(place) else math.ceil(place)
        self._stop_rest = Request(message=encode_command(self._node, Command.ESTOP))
        return self._request_of(drive.order(position=position, flags=Flag.ACTIVATE | Flag.GO | Flag.ESTOP))

    def end_stop(self) -> Request | None:
        """Return the second message of an emergency stop, its own command; None when it was sent."""
        request, self._stop_rest = self._stop_rest, None
        return request

    def _quiet(self, now: float) -> bool:
        """Whether the gripper boots and nothing is to be sent; an emergency stop is sent all the same."""
        run = self._drive.calibration
        return run is not None and run.quiet_until(now) is not None and not self._drive.stop.active

    def _stop(self, now: float) -> Request | None:
        """The emergency stop until it is acknowledged: an order with its flag, and its own command."""
        return self.end_stop() or self.begin_stop(now)

    def _urgent_order(self, _: float) -> Request | None:
        """An order that makes the gripper stop does not wait for anything."""
        drive = self._drive
        if (
            not (drive.orders.urgent and drive.orders.pending)
            or drive.stop.active
            or drive.calibration
            or drive.recovery
        ):
            return None
        return self._request_of(drive.orders.wanted)

    def _marker(self, _: float) -> Request | None:
        """The way back into step."""
        return self._drive.exchange.marker()

    def _doubt(self, now: float) -> Request | None:
        """A reply that is not believed is asked for again, and one that tells where to hold."""
        drive = self._drive
        wanted = drive.known.filter.doubtful or drive.hold_wanted
        return self._poll_now() if wanted and now >= drive.exchange.sent + SPACING else None

    def _sequence(self, now: float) -> Request | None:
        """The next message of a recovery or a calibration."""
        drive = self._drive
        if drive.recovery is not None and drive.recovery.step is RecoveryStep.UNFLAG:
            return self._request_of(drive.order(position=drive.place_for_order(now), flags=Flag.ACTIVATE))
        if drive.recovery is not None and drive.recovery.step is RecoveryStep.CLEAR:
            drive.recovery.clear(now)
            return Request(message=encode_command(self._node, Command.CLEAR))
        if drive.calibration is not None and drive.calibration.step is CalibrationStep.RESET:
            drive.calibration.reset(now)
            return Request(message=encode_command(self._node, Command.RESET))
        if drive.calibration is not None and drive.calibration.step is CalibrationStep.START:
            drive.calibration.start(now)
            return Request(message=encode_command(self._node, Command.CALIBRATE))
        return None

    def _travel(self, now: float) -> Request | None:
        """A question for the encoder's count while the gripper looks for its stops, in turn with the polls."""
        run = self._drive.calibration
        if not self._may_watch() or not run.travel.is_due(now):
            return None
        run.travel.ask(now)
        self._polled = False
        message = encode_request(self._node, Command.ENCODER)
        return Request(message=message, answer=Command.ENCODER, node=self._node, counted=False)

    def _watchdog(self, now: float) -> Request | None:
        """The gripper's watchdog, again and again, since it forgets it when it restarts; none at the end."""
        drive, seconds = self._drive, self._drive.settings.watchdog
        if drive.farewell:
            return Request(message=drive.farewell.popleft())
        if not seconds or drive.known.reply is None or drive.calibration is not None:
            return None
        if now >= self._next_watchdog:
            self._next_watchdog = now + WATCHDOG_PERIOD
            self._watchdogs = encode_watchdog(self._node, seconds)
        return Request(message=self._watchdogs.pop(0)) if self._watchdogs else None

    def _order(self, now: float) -> Request | None:
        """The wanted order, where it differs from the gripper's and may leave."""
        drive = self._drive
        orders = drive.orders
        if drive.stop.active or drive.recovery is not None or drive.calibration is not None:
            return None
        may_drive = drive.may_drive and now - drive.known.stamp <= self._freshness
        if may_drive:
            drive.advance_move(now)
        if not orders.pending or (orders.wanted.drives and not may_drive):
            return None
        return self._request_of(orders.wanted) if drive.known.reply is not None else None

    def _poll(self, now: float) -> Request | None:
        """The empty command at the poll rate; while nothing answers, every other one looks for another node."""
        if now < self._next_poll or self._rests(now):
            return None
        period = 1.0 / self._drive.settings.poll_rate
        # a late poll does not delay the next ones, unless it is so late that one is left out
        self._next_poll = max(self._next_poll + period, now)
        self._polled = True
        misses = self._drive.exchange.misses
        if misses < SEARCH_MISSES or misses % 2 or self._drive.calibration is not None:
            return self._poll_now()
        return self._search()

    def _rests(self, now: float) -> bool:
        """Whether a late reply is waited for: the way back into step without markers."""
        if not self._resting():
            return False
        if now < self._drive.exchange.sent + LATEST_REPLY:
            return True
        self._drive.exchange.rest()
        return False

    def _resting(self) -> bool:
        drive, exchange = self._drive, self._drive.exchange
        return exchange.marker() is None and not exchange.in_step and drive.known.reply is not None and not drive.silent

    def _search(self) -> Request:
        """A ping to another node, which changes nothing there."""
        self._searched = (self._searched + 1) % (LARGEST_NODE + 1)
        if self._searched == self._node:
            return self._poll_now()
        message = encode_request(self._searched, Command.PING)
        return Request(message=message, answer=Command.PING, node=self._searched)

    def _telemetry(self, now: float) -> Request | None:
        """A question, where nothing more important is under way."""
        command = self._drive.known.telemetry.question(now) if self._may_ask() else None
        if command is None:
            return None
        return Request(message=encode_request(self._node, command), answer=command, node=self._node, counted=False)

    def _may_ask(self) -> bool:
        drive = self._drive
        known = drive.known.reply is not None and drive.exchange.in_step
        return known and drive.calibration is None and drive.recovery is None

    def _may_watch(self) -> bool:
        run = self._drive.calibration
        watches = run is not None and run.step is CalibrationStep.WATCH
        return watches and self._polled and self._drive.exchange.in_step

    def _poll_now(self) -> Request:
        return Request(message=encode_poll(self._node), answer=Command.REPLY, node=self._node)

    def _request_of(self, order: Move) -> Request:
        return Request(message=encode_move(self._node, order), answer=Command.REPLY, node=self._node, move=order)
