"""What a gripper is doing and shall do, as one record that commands, requests and replies share."""

from __future__ import annotations

import math
from collections import Counter

from finforce_driver.can.protocol import Flag, Move
from finforce_driver.machine.calibration import CalibrationRun
from finforce_driver.machine.echo import EchoWatch
from finforce_driver.machine.exchange import Exchange
from finforce_driver.machine.knowledge import Knowledge
from finforce_driver.machine.move import GRACE, MoveJob
from finforce_driver.machine.orders import Orders
from finforce_driver.machine.stop import EmergencyStop, Recovery
from finforce_driver.settings import GripperSettings
from finforce_driver.state import Outcome, Phase
from finforce_driver.units import SLOWEST_BYTE, GripperScale


class Core:
    """The state of the machine.

    Attributes:
        settings: of the gripper.
        scale: its units.
        known: what the replies say.
        exchange: requests and replies.
        orders: what it shall do.
        echo: whether it does that.
        stop: the emergency stop.
        recovery: errors being cleared; None: none are.
        calibration: under way; None: none is.
        job: the last move; None: none, or it was replaced by something else.
        outcome: of the last move without a job.
        enabled: moves are allowed: it was not switched off.
        hold_wanted: the jaws are to be held where the next reply says that they are.
        joined: the link is open.
        silent: nothing answers for long.
        note: sentence that stays until the next command.
        order_sent: when the last order was answered [s].
        counts: of events by name.
    """

    def __init__(self, settings: GripperSettings, salt: int) -> None:
        self.settings = settings
        self.scale = GripperScale(settings)
        self.known = Knowledge(settings)
        self.exchange = Exchange(settings.node_id)
        self.orders = Orders(salt)
        self.echo = EchoWatch()
        self.stop = EmergencyStop()
        self.recovery: Recovery | None = None
        self.calibration: CalibrationRun | None = None
        self.job: MoveJob | None = None
        self.outcome = Outcome.NONE
        self.enabled = True
        self.joined = self.silent = self.hold_wanted = False
        self.note = ""
        self.order_sent = -math.inf
        self.counts: Counter[str] = Counter()

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
        return Phase.MOVING if self.moving else Phase.READY

    @property
    def moving(self) -> bool:
        """Whether a move is under way."""
        return self.job is not None and self.job.outcome is Outcome.NONE

    @property
    def may_drive(self) -> bool:
        """Whether an order that moves the jaws may leave: everything that speaks against it is known and does not."""
        return self.phase in (Phase.READY, Phase.MOVING) and self.exchange.in_step and not self.known.filter.alarming

    @property
    def settled(self) -> bool:
        """Whether the last believed reply speaks of the last order, not of the one before."""
        return self.known.stamp - self.order_sent >= GRACE

    def end_job(self, outcome: Outcome) -> None:
        """End a move that is under way; one that has ended keeps its outcome."""
        if self.job is not None:
            self.outcome = outcome if self.moving else self.job.outcome
            self.job = None

    def abort(self, note: str = "") -> None:
        """Want nothing any more, after what the gripper may have been interrupted by."""
        self.end_job(Outcome.ABORTED)
        self.hold_wanted = False
        self.orders.drop()
        self.echo.forget()
        self.note = note

    def postpone_hold(self) -> None:
        """Hold as soon as it is known where: at an old place, to hold would be to go back."""
        self.orders.forget()
        self.echo.forget()
        self.hold_wanted = True

    def order(self, *, position: int, flags: int, speed: int | None = None, current_mA: int | None = None) -> Move:
        """Return an order; what is not given stays as it was last."""
        last = self.orders.wanted or self.orders.taken
        default = Move(
            position=0, speed=SLOWEST_BYTE, current_mA=round(1e3 * self.settings.default_current), flags=Flag.OFF
        )
        last = last or default
        return Move(
            position=position,
            speed=last.speed if speed is None else speed,
            current_mA=last.current_mA if current_mA is None else current_mA,
            flags=flags,
        )

    def place_now(self, now: float) -> float:
        """Return where the jaws are by now [counts]; NaN unknown."""
        order = self.orders.taken
        return self.known.place_now(now, float(order.position) if order is not None and order.drives else None)

    def place_for_order(self, now: float) -> int:
        """Return the position that holds the jaws where they are [counts].

        The reply truncates: jaws that rest between two counts report the one on the open side.
        """
        place = self.place_now(now)
        if math.isnan(place):
            return 0
        return math.ceil(place) if self.known.history.speed() >= 0.0 else math.floor(place)

    def setpoint(self, now: float) -> float:
        """Return where the target or the jaws are now [counts], for a move that goes on from there."""
        place, wanted = self.place_now(now), self.orders.wanted
        if wanted is None or not wanted.flags & Flag.GO:
            return place
        ramp = self.job.steps.ramp(now) if self.job and self.job.steps else float(wanted.position)
        return ramp if abs(ramp - place) <= 2.0 else place
