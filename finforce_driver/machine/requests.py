"""What is sent next: one frame at a time, the most urgent first."""

from __future__ import annotations

import math

from finforce_driver.can.protocol import (
    LARGEST_NODE,
    Command,
    Flag,
    Move,
    encode_command,
    encode_move,
    encode_poll,
    encode_request,
)
from finforce_driver.machine.calibration import CalibrationStep
from finforce_driver.machine.commands import want_position
from finforce_driver.machine.core import Core
from finforce_driver.machine.exchange import Request
from finforce_driver.machine.stop import RecoveryStep

LATEST_REPLY = 0.5  # [s] after which no reply is expected any more
SPACING = 0.001  # [s] before a reply is asked for again
SEARCH_MISSES = 10  # requests without a reply after which other nodes are looked for


class RequestSource:
    """Chooses the next request.

    Args:
        core: what the gripper is doing and shall do.
    """

    def __init__(self, core: Core) -> None:
        self._core = core
        self._node = core.settings.node_id
        self._next_poll = -math.inf
        # an order leaves on the word of a reply, not on that of an old one
        self._freshness = 1.5 / core.settings.poll_rate + core.settings.reply_timeout
        self._searched = core.settings.node_id
        self._stop_rest: Request | None = None
        self._sources = (
            self._stop,
            self._urgent_order,
            self._marker,
            self._order,
            self._doubt,
            self._sequence,
            self._poll,
            self._telemetry,
        )

    def next_request(self, now: float) -> Request | None:
        """Return what to send at a time [s]; None when nothing is due."""
        if self._quiet(now) or (now < self._core.exchange.free and not self._core.stop.active):
            return None
        return next((request for source in self._sources if (request := source(now)) is not None), None)

    def next_time(self, now: float) -> float:
        """Return when something is due at the latest [s]."""
        core = self._core
        if self._quiet(now):
            return core.calibration.quiet_until(now)
        step = core.job.next_time if core.job is not None and core.may_drive else math.inf
        question = core.known.telemetry.next_time if self._may_ask() else math.inf
        wanted = core.known.filter.doubtful or core.hold_wanted
        repetition = core.exchange.sent + SPACING if wanted else math.inf
        poll = core.exchange.sent + LATEST_REPLY if self._resting() else self._next_poll
        return max(core.exchange.free, min(poll, step, question, repetition))

    def begin_stop(self, now: float) -> Request | None:
        """Return the first frame of an emergency stop, an order with its flag; None when it is not due again."""
        core = self._core
        if not core.stop.due(now):
            return None
        place = core.known.place
        position = 0 if math.isnan(place) else math.ceil(place)
        self._stop_rest = Request(frame=encode_command(self._node, Command.ESTOP))
        return self._request_of(core.order(position=position, flags=Flag.ACTIVATE | Flag.GO | Flag.ESTOP))

    def end_stop(self) -> Request | None:
        """Return the second frame of an emergency stop, its own command; None when it was sent."""
        request, self._stop_rest = self._stop_rest, None
        return request

    def _quiet(self, now: float) -> bool:
        """Whether the gripper boots and nothing is to be sent; an emergency stop is sent all the same."""
        run = self._core.calibration
        return run is not None and run.quiet_until(now) is not None and not self._core.stop.active

    def _stop(self, now: float) -> Request | None:
        """The emergency stop until it is acknowledged: an order with its flag, and its own command."""
        return self.end_stop() or self.begin_stop(now)

    def _urgent_order(self, _: float) -> Request | None:
        """An order that makes the gripper stop does not wait for anything."""
        core = self._core
        if not (core.orders.urgent and core.orders.pending) or core.stop.active or core.calibration or core.recovery:
            return None
        return self._request_of(core.orders.wanted)

    def _marker(self, _: float) -> Request | None:
        """The way back into step; during a calibration only polls are sent."""
        return None if self._core.calibration else self._core.exchange.marker()

    def _doubt(self, now: float) -> Request | None:
        """A reply that is not believed is asked for again, and one that tells where to hold."""
        core = self._core
        wanted = core.known.filter.doubtful or core.hold_wanted
        return self._poll_now() if wanted and now >= core.exchange.sent + SPACING else None

    def _sequence(self, now: float) -> Request | None:
        """The next frame of a recovery or a calibration."""
        core = self._core
        if core.recovery is not None and core.recovery.step is RecoveryStep.UNFLAG:
            return self._request_of(core.order(position=core.place_for_order(now), flags=Flag.ACTIVATE))
        if core.recovery is not None and core.recovery.step is RecoveryStep.CLEAR:
            core.recovery.clear(now)
            return Request(frame=encode_command(self._node, Command.CLEAR))
        if core.calibration is not None and core.calibration.step is CalibrationStep.RESET:
            core.calibration.reset(now)
            return Request(frame=encode_command(self._node, Command.RESET))
        if core.calibration is not None and core.calibration.step is CalibrationStep.START:
            core.calibration.start(now)
            return Request(frame=encode_command(self._node, Command.CALIBRATE))
        return None

    def _order(self, now: float) -> Request | None:
        """The wanted order, where it differs from the gripper's and may leave."""
        core = self._core
        orders, job = core.orders, core.job
        if core.stop.active or core.recovery is not None or core.calibration is not None:
            return None
        may_drive = core.may_drive and now - core.known.stamp <= self._freshness
        if job is not None and orders.wanted is not None and may_drive and not (job.sent and orders.pending):
            job.advance(now, core.known.place, core.known.stamp)
            want_position(core)
        if not orders.pending or (orders.wanted.drives and not may_drive):
            return None
        return self._request_of(orders.wanted) if core.known.reply is not None else None

    def _poll(self, now: float) -> Request | None:
        """The empty command at the poll rate; while nothing answers, every other one looks for another node."""
        if now < self._next_poll or self._rests(now):
            return None
        period = 1.0 / self._core.settings.poll_rate
        # a late poll does not delay the next ones, unless it is so late that one is left out
        self._next_poll = max(self._next_poll + period, now)
        misses = self._core.exchange.misses
        if misses < SEARCH_MISSES or misses % 2 or self._core.calibration is not None:
            return self._poll_now()
        return self._search()

    def _rests(self, now: float) -> bool:
        """Whether a late reply is waited for: the way back into step without markers."""
        if not self._resting():
            return False
        if now < self._core.exchange.sent + LATEST_REPLY:
            return True
        self._core.exchange.rest()
        return False

    def _resting(self) -> bool:
        core, exchange = self._core, self._core.exchange
        unmarked = core.calibration is not None or exchange.marker() is None
        return unmarked and not exchange.in_step and core.known.reply is not None and not core.silent

    def _search(self) -> Request:
        """A ping to another node, which changes nothing there."""
        self._searched = (self._searched + 1) % (LARGEST_NODE + 1)
        if self._searched == self._node:
            return self._poll_now()
        frame = encode_request(self._searched, Command.PING)
        return Request(frame=frame, answer=Command.PING, node=self._searched)

    def _telemetry(self, now: float) -> Request | None:
        """A question, where nothing more important is under way."""
        command = self._core.known.telemetry.question(now) if self._may_ask() else None
        if command is None:
            return None
        return Request(frame=encode_request(self._node, command), answer=command, node=self._node, counted=False)

    def _may_ask(self) -> bool:
        core = self._core
        known = core.known.reply is not None and core.exchange.in_step
        return known and core.calibration is None and core.recovery is None

    def _poll_now(self) -> Request:
        return Request(frame=encode_poll(self._node), answer=Command.REPLY, node=self._node)

    def _request_of(self, order: Move) -> Request:
        return Request(frame=encode_move(self._node, order), answer=Command.REPLY, node=self._node, move=order)
