"""Status of one gripper, goals of the driver, and the request that follows: the most urgent one first."""

from __future__ import annotations

import math
from collections import Counter, deque
from collections.abc import Mapping
from dataclasses import dataclass

from finforce_driver.can.protocol import (
    LARGEST_NODE,
    CanMessage,
    Command,
    Flag,
    Move,
    encode,
    encode_move,
    encode_watchdog,
)
from finforce_driver.machine.move import CLEAR_CURRENT, CONTACT_TIME, GRACE, Arrival, MoveJob, Orders, push_direction
from finforce_driver.machine.procedures import CalibrationRun, EmergencyStop, Recovery, Step
from finforce_driver.machine.status_tracker import StatusTracker
from finforce_driver.settings import SLOWEST_BYTE, GripperSettings
from finforce_driver.state import HALF_CALIBRATED, STOP_PENDING, USABLE, GripperState, MoveOutcome, Phase, describe

LENGTHS = {
    Command.REPLY: 4,
    Command.PING: 0,
    Command.TEMPERATURE: 2,
    Command.SUPPLY: 2,
    Command.ERRORS: 2,
    Command.CURRENT: 2,
    Command.ENCODER: 8,
}
# asked in turn, so that the late answer to one is not taken for the answer to the next
MARKERS = (Command.PING, Command.CURRENT, Command.ENCODER, Command.ERRORS)
UNANSWERED_PAUSE = 0.001  # [s] for the gripper to take a message that it does not answer: it keeps three at most
TRIES = 2  # with markers before the first answer to one: an adapter may know no remote messages


@dataclass(frozen=True, kw_only=True)
class Request:
    """A message to be sent.

    Attributes:
        message: it.
        move: the order in it, where there is one.
        counted: True if silence says that the gripper does not answer.
    """

    message: CanMessage
    move: Move | None = None
    counted: bool = True

    @property
    def answer(self) -> int | None:
        """Command of the message that answers it; None when none does."""
        if self.message.command == Command.MOVE:
            return Command.REPLY
        return self.message.command if self.message.remote else None


class Exchange:
    """One request at a time, paired with its reply; gets back into step after a lost one.

    A reply that comes after its time-out would be taken for the one to the next request, and every later one with it.
    After a silence the gripper is asked for something else, whose answer says that nothing older is on the way.

    Attributes:
        pending: request whose reply is waited for.
        sent: when the last request was sent [s].
        free: from when the next one may be sent [s].
        misses: requests in a row without a reply.
        latency: from the last request to its reply [s]; NaN before the first.
    """

    def __init__(self, node: int) -> None:
        self.pending: Request | None = None
        self.sent = self.latency = math.nan
        self.free = -math.inf
        self._node = node
        self._marker = 0
        self.reset()

    def reset(self) -> None:
        """Begin anew on a link that was opened anew."""
        self.pending = None
        self.misses = self._tries = 0
        self._marks = self._rested = False

    @property
    def in_step(self) -> bool:
        """True if the next reply belongs to the next request."""
        return self._tries == 0

    def begin(self, request: Request, now: float) -> None:
        """Note that a request is sent."""
        self.pending = request if request.answer is not None else None
        self.sent = now
        self.free = now if request.answer is not None else now + UNANSWERED_PAUSE

    def answers(self, message: CanMessage) -> bool:
        """Return whether a message is the reply that is waited for."""
        request = self.pending
        return (
            request is not None
            and not message.remote
            and (message.node, message.command) == (request.message.node, request.answer)
            and len(message.data) == LENGTHS[request.answer]
        )

    def end(self, now: float) -> Request:
        """Note the reply and return its request."""
        request, self.pending = self.pending, None
        self.latency = now - self.sent
        if request.message.node == self._node:
            self.misses = 0 if request.counted else self.misses
            self._marks |= request.message.remote
            if request.answer == MARKERS[self._marker] or self._rested:
                self._tries, self._rested = 0, False
        return request

    def miss(self) -> Request | None:
        """Note that no reply came and return the request."""
        request, self.pending = self.pending, None
        if request is not None and request.counted:
            self.misses += 1
            self._tries += 1
            self._marker = (self._marker + 1) % len(MARKERS)
            self._rested = False
        return request

    def marker(self) -> Request | None:
        """Return the request that gets us back into step; None when in step, or when that is not answered."""
        if self.in_step or not (self._marks or self._tries <= TRIES):
            return None
        return Request(message=encode(self._node, MARKERS[self._marker], remote=True))

    def rest(self) -> None:
        """Note that so long a pause was made that nothing older can be on the way: the next reply puts us in step."""
        self._rested = True


MISSED_REPLIES = 25  # requests in a row without a reply after which the link is opened anew
GO = Flag.ACTIVATE | Flag.GO
DIRECTIONS = {1: "closing", -1: "opening", 0: ""}
LATEST_REPLY = 0.5  # [s] after which no reply is expected any more
SPACING = 0.001  # [s] before a reply is asked for again
WATCHDOG_PERIOD = 1.0  # [s] between two settings of the gripper's watchdog
SEARCH_MISSES = 10  # requests without a reply after which other nodes are looked for


class Drive:
    """One gripper as its driver sees it.

    Attributes:
        settings: of the gripper.
        known: content of the replies.
        exchange: requests and replies.
        orders: orders to the gripper.
        order_sent: when the last order was answered [s].
        stop: the emergency stop.
        recovery: errors being cleared; None: none are.
        calibration: under way; None: none is.
        job: the last move; None: none, or it was replaced by something else.
        ended: outcome of the last move that is no job any more.
        joined: the link is open.
        silent: nothing has answered for long.
        arrival: True if the jaws move by an order from before the link was there; None: that is known.
        watchdogs: messages that set the gripper's watchdog and have still to leave.
        hold_wanted: the jaws are to be held where the next reply says that they are.
        note: sentence that stays until the next command.
        counts: of events by name.
        link_counts: the same, of the link.

    Args:
        settings: of the gripper.
        salt: any number, other than that of the program that drove the gripper before.
    """

    def __init__(self, settings: GripperSettings, salt: int = 0) -> None:
        self.settings = settings
        self.known = StatusTracker(settings)
        self.exchange = Exchange(settings.node_id)
        self.orders = Orders(salt)
        self.order_sent = -math.inf
        self.stop = EmergencyStop()
        self.recovery: Recovery | None = None
        self.calibration: CalibrationRun | None = None
        self.job: MoveJob | None = None
        self.ended = MoveOutcome.NONE
        self.joined = self.silent = False
        self.arrival: Arrival | None = None
        self.watchdogs: deque[CanMessage] = deque()
        self.hold_wanted = False
        self.note = ""
        self.counts: Counter[str] = Counter()
        self.link_counts: Mapping[str, int] = {}
        self.next_watchdog = -math.inf
        self._next_poll = -math.inf
        self._polled = False
        # an order leaves on the word of a reply, not on that of an old one
        self._freshness = 1.5 / settings.poll_rate + settings.reply_timeout
        self._searched = settings.node_id
        self._second_stop: Request | None = None
        self._sources = (
            lambda now: self.end_stop() or self.begin_stop(now),
            self._urgent_order,
            lambda now: self.exchange.marker(),
            self._order,
            self._confirmation,
            self._procedure,
            self._travel,
            self._watchdog,
            self._poll,
            self._telemetry,
        )

    # What is known

    @property
    def phase(self) -> Phase:
        """The phase of the driver."""
        if not self.joined or self.silent:
            return Phase.DISCONNECTED
        if self.known.reply is None:
            return Phase.PROBING
        if self.stop.active or self.recovery is not None or self.known.error:
            return Phase.FAULT
        if self.calibration is not None:
            return Phase.CALIBRATING
        if not self.known.calibrated:
            return Phase.LOST if self.known.calibration_problem not in ("", HALF_CALIBRATED) else Phase.UNCALIBRATED
        if self.arrival is not None and not self.moving:
            return Phase.MOVING if self.arrival.moving else Phase.PROBING
        return Phase.MOVING if self.moving else Phase.READY

    @property
    def moving(self) -> bool:
        """True if a move is under way."""
        return self.job is not None and self.job.outcome is MoveOutcome.NONE

    @property
    def outcome(self) -> MoveOutcome:
        """The outcome of the last move."""
        outcome = self.ended if self.job is None else self.job.outcome
        limp = self.known.reply is not None and not self.known.driving
        return MoveOutcome.NONE if outcome is MoveOutcome.GRASPED and limp else outcome

    @property
    def may_drive(self) -> bool:
        """True if an order that moves the jaws may leave: everything that speaks against it is known and does not."""
        return self.phase in USABLE and self.exchange.in_step and not self.known.filter.alarming

    @property
    def has_orders(self) -> bool:
        """True if an order or an emergency stop has still to be sent."""
        return self.orders.pending or bool(self.watchdogs) or (self.stop.active and not self.known.error)

    @property
    def must_reopen(self) -> bool:
        """True if nothing has answered for so long that the link is to be opened anew."""
        return self.exchange.misses >= MISSED_REPLIES

    def position_now(self, now: float) -> float:
        """Return where the jaws are by now [counts]; NaN unknown."""
        order = self.orders.taken
        return self.known.position_now(now, float(order.position) if order is not None and order.drives else None)

    def setpoint(self, now: float) -> float:
        """Return where the target or the jaws are now [counts], for a move that goes on from there."""
        position, wanted = self.position_now(now), self.orders.wanted
        if wanted is None or not wanted.action:
            return position
        ramp = self.job.steps.ramp(now) if self.job and self.job.steps else float(wanted.position)
        return ramp if abs(ramp - position) <= 2.0 else position

    def order(self, *, position: int, flags: int, speed: int | None = None, current_mA: int | None = None) -> Move:
        """Return an order; what is not given stays as it was last."""
        last = self.orders.wanted or self.orders.taken
        if last is None:
            default = round(1e3 * self.settings.default_current)
            last = Move(position=0, speed=SLOWEST_BYTE, current_mA=default, flags=Flag.OFF)
        return Move(
            position=position,
            speed=last.speed if speed is None else speed,
            current_mA=last.current_mA if current_mA is None else current_mA,
            flags=flags,
        )

    def hold_position(self, now: float) -> int:
        """Return the position that holds the jaws where they are [counts].

        The reply truncates: jaws that rest between two counts report the one on the open side.
        """
        position = self.position_now(now)
        if math.isnan(position):
            return 0
        return math.ceil(position) if self.known.history.speed() >= 0.0 else math.floor(position)

    def want_position(self) -> None:
        """Have the gripper get the order that the present move wants."""
        goal = self.job.goal
        order = self.order(position=self.job.position, flags=GO, speed=goal.byte, current_mA=goal.current_mA)
        self.orders.want(order)

    def report(self) -> GripperState:
        """Return what is known now, in SI units."""
        known, phase, settings = self.known, self.phase, self.settings
        reply, telemetry = known.reply, known.telemetry
        placed = known.calibrated and self.calibration is None
        current = math.nan if reply is None else 1e-3 * reply.current_mA
        stopped = self.stop.active or bool(reply and reply.estopped)
        faults = known.faults(stopped)
        settled = known.stamp - self.order_sent >= GRACE  # the reply speaks of the last order
        return GripperState(
            phase=phase,
            stamp=known.stamp,
            opening=settings.opening_of(known.position) if placed else math.nan,
            velocity=-settings.resolution * known.history.speed() if placed else math.nan,
            current=current,
            force=-settings.force_of(current),
            target=self._target(),
            contact=DIRECTIONS[self._push()] if placed else "",
            at_target=known.driving and bool(reply and reply.at_target) and placed and settled,
            calibrated=placed,
            activated=bool(reply and reply.activated) and not known.power_off,
            faults=faults,
            stop_pending=self.stop.pending,
            estopped=stopped or "E-stop" in faults,
            outcome=self.outcome,
            message=self._sentence(phase, faults),
            temperature=telemetry.temperature,
            voltage=telemetry.voltage,
            latency=self.exchange.latency,
            counts={**self.link_counts, **self.counts},
        )

    def _target(self) -> float:
        """Return the opening that the gripper was told to go to [m]; NaN without one."""
        order = self.orders.wanted
        if order is None or not order.drives:
            return math.nan
        return self.settings.opening_of(order.position) if self.job is None else self.job.goal.opening

    def _push(self) -> int:
        """Return 1 or -1 for what the motor pushes against closing or opening, else 0."""
        reply, order = self.known.reply, self.orders.taken
        if not self.known.driving or self.known.contact_time < CONTACT_TIME:
            return 0
        if abs(reply.current_mA) < CLEAR_CURRENT and order is None:
            return 0
        return push_direction(reply, order is not None and order.position > reply.position)

    def _sentence(self, phase: Phase, faults: tuple[str, ...]) -> str:
        """Return how the gripper is, and what would help."""
        if self.stop.pending:
            return STOP_PENDING
        if self.note and phase is not Phase.FAULT:
            return self.note
        if phase in (Phase.UNCALIBRATED, Phase.LOST) and self.known.calibration_problem:
            return self.known.calibration_problem
        return describe(phase, self.outcome, faults)

    # What is sent next

    def choose_request(self, now: float) -> Request | None:
        """Return what to send at a time [s]; None when nothing is due."""
        if self._quiet(now) or (now < self.exchange.free and not self.stop.active):
            return None
        return next((request for source in self._sources if (request := source(now)) is not None), None)

    def next_time(self, now: float) -> float:
        """Return when the next request is due at the latest [s]."""
        if self._quiet(now):
            return self.calibration.quiet_until(now)
        step = self.job.next_time if self.job is not None and self.may_drive else math.inf
        question = self.known.telemetry.next_time if self._may_ask() else math.inf
        if self._watches_travel():
            question = self.calibration.travel.next_time
        repetition = self.exchange.sent + SPACING if self._wants_reply() else math.inf
        poll = self.exchange.sent + LATEST_REPLY if self._resting() else self._next_poll
        return max(self.exchange.free, min(poll, step, question, repetition))

    def begin_stop(self, now: float) -> Request | None:
        """Return the first message of an emergency stop, an order with its flag; None when it is not due again."""
        if not self.stop.due(now):
            return None
        self._second_stop = Request(message=encode(self.settings.node_id, Command.ESTOP))
        position = self.known.position
        flags = Flag.ACTIVATE | Flag.GO | Flag.ESTOP
        return self._request(self.order(position=0 if math.isnan(position) else math.ceil(position), flags=flags))

    def end_stop(self) -> Request | None:
        """Return the second message of an emergency stop, its own command; None when it was sent."""
        request, self._second_stop = self._second_stop, None
        return request

    def _quiet(self, now: float) -> bool:
        """Return True if the gripper boots and nothing is to be sent; an emergency stop is sent all the same."""
        run = self.calibration
        return run is not None and run.quiet_until(now) is not None and not self.stop.active

    @property
    def _busy(self) -> bool:
        """True if a stop, a recovery or a calibration keeps orders back."""
        return self.stop.active or self.recovery is not None or self.calibration is not None

    def _urgent_order(self, _: float) -> Request | None:
        """An order that makes the gripper stop does not wait for anything."""
        urgent = self.orders.urgent and self.orders.pending and not self._busy
        return self._request(self.orders.wanted) if urgent else None

    def _order(self, now: float) -> Request | None:
        """The wanted order, where it differs from the gripper's and may leave."""
        if self._busy:
            return None
        may_drive = self.may_drive and now - self.known.stamp <= self._freshness
        has_job = self.job is not None and self.orders.wanted is not None
        if may_drive and has_job and not (self.job.sent and self.orders.pending):  # the target of a slow move goes on
            self.job.advance(now, self.known.position, self.known.stamp)
            self.want_position()
        if not self.orders.pending or (self.orders.wanted.drives and not may_drive) or self.known.reply is None:
            return None
        return self._request(self.orders.wanted)

    def _wants_reply(self) -> bool:
        return self.known.filter.wants_reply or self.hold_wanted

    def _confirmation(self, now: float) -> Request | None:
        """A reply that is not believed is asked for again, and one that tells where to hold."""
        return self._request() if self._wants_reply() and now >= self.exchange.sent + SPACING else None

    def _procedure(self, now: float) -> Request | None:
        """The next message of a recovery or a calibration."""
        recovery, run = self.recovery, self.calibration
        if recovery is not None and recovery.step is Step.UNFLAG:
            return self._request(self.order(position=self.hold_position(now), flags=Flag.ACTIVATE))
        command = None
        if recovery is not None and recovery.step is Step.CLEAR:
            command = recovery.clear(now)
        elif run is not None and run.step is Step.RESET:
            command = run.reset(now)
        elif run is not None and run.step is Step.START:
            command = run.start(now)
        return None if command is None else Request(message=encode(self.settings.node_id, command))

    def _travel(self, now: float) -> Request | None:
        """A question for the encoder's count while the gripper looks for its stops, in turn with the polls."""
        if not self._watches_travel() or now < self.calibration.travel.next_time:
            return None
        self.calibration.travel.ask(now)
        self._polled = False
        return self._question(Command.ENCODER)

    def _watchdog(self, now: float) -> Request | None:
        """The gripper's watchdog, again and again, since it forgets it when it restarts; none at the end."""
        seconds = self.settings.watchdog
        if seconds and now >= self.next_watchdog and self.known.reply is not None and self.calibration is None:
            self.next_watchdog = now + WATCHDOG_PERIOD
            self.watchdogs.extend(encode_watchdog(self.settings.node_id, seconds))
        return Request(message=self.watchdogs.popleft()) if self.watchdogs else None

    def _poll(self, now: float) -> Request | None:
        """The empty command at the poll rate; while nothing answers, every other one looks for another node."""
        if now < self._next_poll or self._rests(now):
            return None
        # a late poll does not delay the next ones, unless it is so late that one is left out
        self._next_poll = max(self._next_poll + 1.0 / self.settings.poll_rate, now)
        self._polled = True
        misses = self.exchange.misses
        if misses < SEARCH_MISSES or misses % 2 or self.calibration is not None:
            return self._request()
        self._searched = (self._searched + 1) % (LARGEST_NODE + 1)
        if self._searched == self.settings.node_id:
            return self._request()
        return Request(message=encode(self._searched, Command.PING, remote=True))

    def _rests(self, now: float) -> bool:
        """Return True if a late reply is waited for: the way back into step without markers."""
        if not self._resting():
            return False
        if now < self.exchange.sent + LATEST_REPLY:
            return True
        self.exchange.rest()
        return False

    def _resting(self) -> bool:
        exchange = self.exchange
        return exchange.marker() is None and not exchange.in_step and self.known.reply is not None and not self.silent

    def _telemetry(self, now: float) -> Request | None:
        """A question, where nothing more important is under way."""
        command = self.known.telemetry.question(now) if self._may_ask() else None
        return None if command is None else self._question(command)

    def _may_ask(self) -> bool:
        known = self.known.reply is not None and self.exchange.in_step
        return known and self.calibration is None and self.recovery is None

    def _watches_travel(self) -> bool:
        run = self.calibration
        return run is not None and run.step is Step.WATCH and self._polled and self.exchange.in_step

    def _question(self, command: Command) -> Request:
        return Request(message=encode(self.settings.node_id, command, remote=True), counted=False)

    def _request(self, order: Move | None = None) -> Request:
        """Return the request of an order, or of a poll without one."""
        node = self.settings.node_id
        return Request(message=encode(node, Command.MOVE) if order is None else encode_move(node, order), move=order)
