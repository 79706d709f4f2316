"""What the driver knows of one gripper and wants of it; requests are chosen from it, and the state is read from it."""

from __future__ import annotations

import math
from collections import Counter, deque
from collections.abc import Mapping

from finforce_driver.can.protocol import CanMessage, Flag, Move
from finforce_driver.machine.exchange import Exchange
from finforce_driver.machine.knowledge import Knowledge
from finforce_driver.machine.move import CLEAR_CURRENT, CONTACT_TIME, GRACE, Arrival, MoveJob, Orders, push_direction
from finforce_driver.machine.procedures import CalibrationRun, EmergencyStop, Recovery, StopStage
from finforce_driver.settings import SLOWEST_BYTE, GripperScale, GripperSettings
from finforce_driver.state import HALF_CALIBRATED, STOP_PENDING, GripperState, MoveOutcome, Phase, describe

MISSED_REPLIES = 25  # requests in a row without a reply after which the link is opened anew
GO = Flag.ACTIVATE | Flag.GO
USABLE = (Phase.READY, Phase.MOVING)
DIRECTIONS = {1: "closing", -1: "opening", 0: ""}


class Drive:
    """One gripper as its driver sees it.

    Attributes:
        settings: of the gripper.
        scale: its units.
        known: what the replies say.
        exchange: requests and replies.
        orders: what the gripper shall do.
        order_sent: when the last order was answered [s].
        stop: the emergency stop.
        recovery: errors being cleared; None: none are.
        calibration: under way; None: none is.
        job: the last move; None: none, or it was replaced by something else.
        ended: outcome of the last move that is no job any more.
        joined: the link is open.
        silent: nothing has answered for long.
        arrival: whether the jaws move by an order from before the link was there; None: that is known.
        farewell: messages that have still to leave before the end.
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
        self.scale = GripperScale(settings)
        self.known = Knowledge(settings)
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
        self.farewell: deque[CanMessage] = deque()
        self.hold_wanted = False
        self.note = ""
        self.counts: Counter[str] = Counter()
        self.link_counts: Mapping[str, int] = {}

    @property
    def phase(self) -> Phase:
        """Where the driver is with the gripper."""
        if not self.joined or self.silent:
            return Phase.DISCONNECTED
        if self.known.reply is None:
            return Phase.PROBING
        if self.stop.active or self.recovery is not None or self.known.error:
            return Phase.FAULT
        if self.calibration is not None:
            return Phase.CALIBRATING
        if not self.known.calibrated:
            return Phase.UNCALIBRATED
        if self.arrival is not None and not self.moving:
            return Phase.MOVING if self.arrival.moving else Phase.PROBING
        return Phase.MOVING if self.moving else Phase.READY

    @property
    def moving(self) -> bool:
        """Whether a move is under way."""
        return self.job is not None and self.job.outcome is MoveOutcome.NONE

    @property
    def outcome(self) -> MoveOutcome:
        """What became of the last move."""
        outcome = self.ended if self.job is None else self.job.outcome
        limp = self.known.reply is not None and not self.known.driving
        return MoveOutcome.NONE if outcome is MoveOutcome.GRASPED and limp else outcome

    @property
    def may_drive(self) -> bool:
        """Whether an order that moves the jaws may leave: everything that speaks against it is known and does not."""
        return self.phase in USABLE and self.exchange.in_step and not self.known.filter.alarming

    @property
    def settled(self) -> bool:
        """Whether the last believed reply speaks of the last order, not of the one before."""
        return self.known.stamp - self.order_sent >= GRACE

    @property
    def has_orders(self) -> bool:
        """Whether an order or an emergency stop has still to be sent."""
        return self.orders.pending or bool(self.farewell) or (self.stop.active and not self.known.error)

    @property
    def must_reopen(self) -> bool:
        """Whether nothing has answered for so long that the link is to be opened anew."""
        return self.exchange.misses >= MISSED_REPLIES

    def opening_at(self, time: float) -> float:
        """Return the opening [m] at a past time; NaN unknown."""
        reach = 2.0 / self.settings.poll_rate + self.settings.reply_timeout
        return self.scale.opening_of(self.known.history.place_at(time, reach))

    def place_now(self, now: float) -> float:
        """Return where the jaws are by now [counts]; NaN unknown."""
        order = self.orders.taken
        return self.known.place_now(now, float(order.position) if order is not None and order.drives else None)

    def setpoint(self, now: float) -> float:
        """Return where the target or the jaws are now [counts], for a move that goes on from there."""
        place, wanted = self.place_now(now), self.orders.wanted
        if wanted is None or not wanted.flags & Flag.GO:
            return place
        ramp = self.job.steps.ramp(now) if self.job and self.job.steps else float(wanted.position)
        return ramp if abs(ramp - place) <= 2.0 else place

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

    def place_for_order(self, now: float) -> int:
        """Return the position that holds the jaws where they are [counts].

        The reply truncates: jaws that rest between two counts report the one on the open side.
        """
        place = self.place_now(now)
        if math.isnan(place):
            return 0
        return math.ceil(place) if self.known.history.speed() >= 0.0 else math.floor(place)

    def advance_move(self, now: float) -> None:
        """Let the target of a slow move go on when it is due."""
        if self.job is not None and self.orders.wanted is not None and not (self.job.sent and self.orders.pending):
            self.job.advance(now, self.known.place, self.known.stamp)
            self.want_position()

    def want_position(self) -> None:
        """Have the gripper get the order that the present move wants."""
        goal = self.job.goal
        order = self.order(position=self.job.position, flags=GO, speed=goal.pace.byte, current_mA=goal.current_mA)
        self.orders.want(order)

    def report(self) -> GripperState:
        """Return what is known now, in SI units."""
        known, phase = self.known, self.phase
        reply, telemetry = known.reply, known.telemetry
        placed = known.calibrated and self.calibration is None
        current = math.nan if reply is None else 1e-3 * reply.current_mA
        stopped = self.stop.active or bool(reply and reply.estopped)
        faults = known.faults(stopped)
        return GripperState(
            phase=phase,
            stamp=known.stamp,
            opening=self.scale.opening_of(known.place) if placed else math.nan,
            velocity=-self.scale.resolution * known.history.speed() if placed else math.nan,
            current=current,
            force=-self.scale.force_of(current),
            target=self._target(),
            contact=DIRECTIONS[self._push()],
            at_target=known.driving and bool(reply and reply.at_target) and placed and self.settled,
            calibrated=placed,
            activated=bool(reply and reply.activated),
            faults=faults,
            stop_pending=self.stop.stage is StopStage.WANTED,
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
        return self.scale.opening_of(order.position) if self.job is None else self.job.goal.opening

    def _push(self) -> int:
        """Return 1 or -1 for what the motor pushes against closing or opening, else 0."""
        reply = self.known.reply
        placed = self.known.driving and self.known.calibrated and self.calibration is None
        if not placed or self.known.contact_time < CONTACT_TIME:
            return 0
        order = self.orders.taken
        if abs(reply.current_mA) < CLEAR_CURRENT and order is None:
            return 0
        return push_direction(reply, order is not None and order.position > reply.position)

    def _sentence(self, phase: Phase, faults: tuple[str, ...]) -> str:
        """Return how the gripper is, and what would help."""
        if self.stop.stage is StopStage.WANTED:
            return STOP_PENDING
        if self.note and phase is not Phase.FAULT:
            return self.note
        if phase is Phase.UNCALIBRATED and self.known.half_calibrated:
            return HALF_CALIBRATED
        return describe(phase, self.outcome, faults)
