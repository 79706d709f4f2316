"""The gripper as a state machine: commands and CAN messages in, requests and a state out.

Whoever carries its messages asks `next_request`, sends it, and gives what comes to `on_message`, or tells `on_silence`.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Mapping
from functools import wraps
from threading import Event, RLock
from typing import Any

from finforce_driver.can.protocol import CanMessage, Command, Flag, Reply, decode_move, decode_reply, encode_watchdog
from finforce_driver.errors import GripperStateError
from finforce_driver.machine.drive import GO, Drive, Request
from finforce_driver.machine.move import CLEAR_CURRENT, Arrival, Goal, MoveJob, OrderWatch
from finforce_driver.machine.procedures import CalibrationRun, Recovery, Step, Travel
from finforce_driver.machine.status_tracker import Telemetry
from finforce_driver.settings import SLOWEST_BYTE, GripperSettings, check_numbers
from finforce_driver.state import (
    HALF_CALIBRATED,
    LOST,
    OTHER_MASTER,
    OTHER_NODE,
    REBOOTED,
    SILENT,
    USABLE,
    MoveOutcome,
    Phase,
)

SHORT_SILENCE = 5  # requests in a row without a reply after which the gripper is taken to be absent
PROBES = 20  # the same before the first reply: a second
ECHOES = 8  # last messages, in which one of ours is recognised that an adapter gives back
OLD = 0.1  # [s] after which a reply does not tell where moving jaws are
STANDING = 2.0  # [counts/s], below which an unknown order is taken to hold
FOREIGN = frozenset({Command.ESTOP, Command.CLEAR, Command.IDLE, Command.RESET})  # after which the jaws are limp
INHERITED = "the jaws were moving by an order from before the link was there; they are held"
LOST_ORDER = "the gripper fell silent before the order could be sent: command again"
NO_FAULTS = (False, False, False, False)
CONNECTED = (Phase.UNCALIBRATED, Phase.LOST, Phase.READY, Phase.MOVING)
REFUSALS = {
    Phase.DISCONNECTED: "no gripper answers",
    Phase.PROBING: "the gripper has not answered yet: wait for its first reply",
    Phase.UNCALIBRATED: "the gripper is not calibrated: calibrate it first",
    Phase.LOST: "where the jaws are is not known: calibrate first",
    Phase.CALIBRATING: "the gripper calibrates, which another command would cut short: wait",
    Phase.FAULT: "a fault or an emergency stop is latched: clear the errors first",
}


def _command(method: Callable[..., None]) -> Callable[..., None]:
    """Have a method hold the lock and, unless it raises, make the state anew and wake the carrier."""

    @wraps(method)
    def run(self: GripperMachine, *values: Any, **named: Any) -> None:
        with self._lock:
            method(self, *values, **named)
            self.refresh()
        self._wake.set()

    return run


class GripperMachine(Drive):
    """Drives one gripper, without input or output of its own; what is known and wanted changes here.

    Attributes:
        state: the present state; reading it never blocks.

    Args:
        settings: of the gripper.
        now: returns the time of the carrier's clock [s].
        salt: any number, other than that of the program that drove the gripper before.
    """

    def __init__(self, settings: GripperSettings, now: Callable[[], float], salt: int = 0) -> None:
        super().__init__(settings, salt)
        self._now = now
        self._lock, self._wake = RLock(), Event()
        self._watch = OrderWatch()
        self._enabled = True  # not switched off
        self._sent: deque[CanMessage] = deque(maxlen=ECHOES)
        self.refresh()

    def refresh(self) -> None:
        """Make the state anew."""
        self.state = self.report()

    # Commands

    @_command
    def move(self, opening: float, speed: float | None = None, force: float | None = None) -> None:
        """Go to an opening, and stall with a force when something is in the way; the same goal again changes nothing.

        Args:
            opening: to be reached [m].
            speed: of the opening [m/s], both jaws together; the default of the settings where None.
            force: grip force by the maker's curve [N]; the default current of the settings where None.

        Raises:
            TargetError: a value is no number or out of bounds.
            GripperStateError: the gripper could not move: absent, faulty, not calibrated, calibrating, switched off.
        """
        goal = self._make_goal(opening, speed, force)
        self._require("move", USABLE)
        if not self._enabled:
            raise GripperStateError("move: the gripper was switched off: activate it first")
        job = self.job
        if job is not None and job.goal == goal and job.outcome in (MoveOutcome.NONE, MoveOutcome.REACHED):
            return
        now = self._now()
        start = self.setpoint(now)
        self.hold_wanted = False
        self._end_job(MoveOutcome.REPLACED)
        fastest, speed = self.settings.fastest, self.settings.default_speed if speed is None else speed
        self.note = f"speed {speed:g} m/s is limited to {fastest:.3g} m/s" if speed > fastest else ""
        self.ended = MoveOutcome.NONE
        self.job = MoveJob(goal, start=start, now=now)
        self.want_position()

    def check_move(self, opening: float, speed: float | None = None, force: float | None = None) -> None:
        """Reject what `move` would reject in whatever state.

        Raises:
            TargetError: a value is no number or out of bounds.
        """
        self._make_goal(opening, speed, force)

    @_command
    def hold(self) -> None:
        """Stop in place and hold, or end a calibration, limp; a gripper that stands or was let go stays as it is.

        One that has just fallen silent is held as soon as it answers again.

        Raises:
            GripperStateError: the gripper is absent, faulty or not calibrated: its jaws are limp.
        """
        if self.silent and self.calibration is None and self.known.driving:
            self._end_job(MoveOutcome.REPLACED)
            self._postpone_hold()
            self.refresh()
            raise GripperStateError("hold pending: the gripper does not answer; it is held as soon as it does")
        self._require("hold", (*USABLE, Phase.CALIBRATING))
        self._hold(self._now())

    @_command
    def calibrate(self) -> None:
        """Find the end stops: the jaws open fully, then close fully, with some 24 N.

        Raises:
            GripperStateError: the gripper is absent or faulty, or calibrates already.
        """
        self._require("calibrate", CONNECTED)
        self._end_job(MoveOutcome.REPLACED)
        self.orders.drop()
        self._watch.forget()
        self.note, self._enabled = "", True
        self.calibration = CalibrationRun(
            self.settings, calibrated=self.known.calibrated, reset=bool(self.known.calibration_problem)
        )

    @_command
    def clear_errors(self) -> None:
        """Clear what is latched, an emergency stop too; does nothing without a fault, since it would let go.

        Raises:
            GripperStateError: the gripper is absent or calibrates.
        """
        self._require("clear_errors", (*CONNECTED, Phase.FAULT))
        self.note = ""
        if self.phase is Phase.FAULT and self.recovery is None:
            self._abort()
            self.recovery = Recovery(unflag=self.stop.active or bool(self.known.reply and self.known.reply.estopped))
            self.stop.rest()

    @_command
    def activate(self, on: bool) -> None:
        """Switch the power stage on, holding in place, or off, limp: it then refuses moves.

        Raises:
            GripperStateError: the gripper is absent, faulty or calibrating.
        """
        self._require("activate", CONNECTED)
        self.note, self._enabled = "", on
        if not on:
            self._let_go(Flag.OFF)
        elif not self.known.calibrated:
            self.orders.want(self.order(position=0, flags=Flag.ACTIVATE))
        elif not self.known.driving:
            self._end_job(MoveOutcome.REPLACED)
            self.orders.want(self.order(position=self.hold_position(self._now()), flags=GO))

    @_command
    def release_power(self) -> None:
        """Let the jaws go limp, ready for the next move; what is held may drop.

        Raises:
            GripperStateError: the gripper is absent, faulty or calibrating.
        """
        self._require("release_power", CONNECTED)
        self.note = ""
        self._let_go(Flag.ACTIVATE)

    def opening_at(self, time: float) -> float:
        """Return the opening [m] at a time of the last 5 s [s]; NaN where it is not known."""
        validity = 2.0 / self.settings.poll_rate + self.settings.reply_timeout
        with self._lock:
            return self.settings.opening_of(self.known.history.position_at(time, validity))

    def demand_stop(self) -> list[CanMessage]:
        """Stop at once, in whichever state: return the messages to be sent before anything else; no motion follows."""
        self._break_calibration()
        self.recovery = None
        self._abort()
        self.stop.demand()
        first = self.begin_stop(self._now())
        # the gripper keeps three messages at most, and one is on the way already: the second follows its reply
        second = self.end_stop() if self.exchange.pending is None else None
        messages = [request.message for request in (first, second) if request is not None]
        self._sent.extend(messages)
        self.refresh()
        return messages

    @_command
    def leave(self) -> None:
        """Prepare to be ended: hold in place, or let go where the settings say so."""
        if self.phase in CONNECTED and self.settings.release_on_stop:
            self.activate(False)
        elif self.phase in (*USABLE, Phase.CALIBRATING):
            self.hold()
        if self.settings.watchdog and not self.settings.release_on_stop:
            # what is held stays held, with nobody to feed the watchdog
            self.watchdogs = deque(encode_watchdog(self.settings.node_id, 0.0))
            self.next_watchdog = math.inf

    # What the carrier asks and tells

    def next_request(self, now: float) -> Request | None:
        """Return what to send now, None when nothing is due; it counts as sent."""
        request = self.choose_request(now)
        if request is not None:
            self.exchange.begin(request, now)
            self._sent.append(request.message)
        return request

    def on_link_open(self) -> None:
        """Begin on a link that was opened."""
        self.exchange.reset()
        self.joined, self.arrival = True, Arrival()
        self.refresh()

    def on_link_lost(self, reason: str) -> None:
        """Forget what can have changed by the time the link is back, and want nothing."""
        if self.calibration is not None:
            # without an earlier calibration the gripper's flag will say whether it was completed
            self.known.calibration_problem = self.known.calibration_problem or (
                HALF_CALIBRATED if self.known.calibrated else ""
            )
            self.calibration = None
        self.recovery = None
        self._abort(reason)
        self.known.forget()
        self.exchange.reset()
        self.joined = self.silent = False
        self.arrival = None
        self.refresh()

    def on_message(self, message: CanMessage, now: float, link_counts: Mapping[str, int] | None = None) -> bool:
        """Take a message; return whether it was the reply that was waited for.

        Args:
            message: as it came.
            now: when [s].
            link_counts: counters of the link, shown in the state.
        """
        self.link_counts = link_counts or self.link_counts
        if not self.exchange.answers(message):
            if message not in self._sent:
                self._take_unasked(message)
            return False
        request = self.exchange.end(now)
        self.counts["replies"] += 1
        if request.answer == Command.REPLY:
            self._take_reply(request, message, now)
        elif message.node != self.settings.node_id:
            self.note = OTHER_NODE.format(node=self.settings.node_id, other=message.node)
            self.refresh()
        elif not request.counted and (asker := self._asker(request)) is not None:
            asker.take(message, now)
        return True

    def on_silence(self, now: float, suspicion: str = "") -> None:
        """Note that the reply did not come in time; `suspicion` is what the link has to say to that."""
        request = self.exchange.miss()
        if request is None:
            return
        self.counts["lost replies"] += 1
        if request.move is not None and self.orders.urgent and self.orders.wanted.drives:
            self._postpone_hold()
        if not request.counted:
            if (asker := self._asker(request)) is not None:
                asker.miss(now)
            return
        if self.exchange.misses >= (PROBES if self.known.reply is None else SHORT_SILENCE) and not self.silent:
            self.silent = True
            if self.orders.pending:
                self._abort(LOST_ORDER)
            self.note = self.note or suspicion or SILENT.format(node=self.settings.node_id)
            self.refresh()

    def _asker(self, request: Request) -> Telemetry | Travel | None:
        """Return what a question was asked for; None once nobody wants to know."""
        if request.answer != Command.ENCODER:
            return self.known.telemetry
        return None if self.calibration is None else self.calibration.travel

    # Within

    def _require(self, what: str, phases: tuple[Phase, ...]) -> None:
        """Refuse what cannot be done in the present phase, by raising GripperStateError."""
        if self.phase not in phases:
            raise GripperStateError(f"{what}: {REFUSALS[self.phase]}" + (f" ({self.note})" if self.note else ""))

    def _make_goal(self, opening: float, speed: float | None, force: float | None) -> Goal:
        """Return a move in the gripper's units; raises TargetError."""
        check_numbers(opening=opening, speed=speed, force=force)
        settings = self.settings
        default = round(1e3 * settings.default_current)
        speed = settings.default_speed if speed is None else speed
        byte = settings.speed_byte(speed)
        stepped = speed < settings.speed_of(SLOWEST_BYTE)
        return Goal(
            opening=float(opening),
            position=settings.position_of(opening),
            rate=(speed if stepped else settings.speed_of(byte)) / settings.resolution,
            byte=byte,
            stepped=stepped,
            current_mA=default if force is None else settings.current_of(force),
        )

    def _hold(self, now: float) -> None:
        """Stop in place; see `hold`."""
        if self.calibration is not None:
            self._break_calibration()
            self.orders.want(self.order(position=0, flags=Flag.ACTIVATE), urgent=True)
            return
        stepping = self.job is not None and self.job.steps is not None and self.job.stepping
        # a hold that had to wait comes with the first reply after a gap, which tells no speed
        still = abs(self.known.history.speed()) <= STANDING and not self.hold_wanted
        standing = still and not self.moving and not stepping
        self._end_job(MoveOutcome.REPLACED)
        self.note, self.hold_wanted = "", False
        drives = self.known.driving or self.orders.pending
        if now - self.known.stamp > OLD and drives:
            self._postpone_hold()
            return
        kept, position = self.orders.wanted, self.position_now(now)
        if standing or not drives or (kept is not None and (not kept.drives or abs(kept.position - position) <= 1.0)):
            return
        self._hold_here(now)

    def _let_go(self, flags: Flag) -> None:
        """Want an order that moves nothing and holds nothing."""
        self._end_job(MoveOutcome.REPLACED)
        self.hold_wanted = False
        self.orders.want(self.order(position=self.hold_position(self._now()), flags=flags), urgent=True)

    def _end_job(self, outcome: MoveOutcome) -> None:
        """End a move that is under way; one that has ended keeps its outcome."""
        if self.job is not None:
            self.ended = outcome if self.moving else self.job.outcome
            self.job = None

    def _abort(self, note: str = "") -> None:
        """Want nothing any more, after what the gripper may have been interrupted by."""
        self._end_job(MoveOutcome.ABORTED)
        self.hold_wanted = False
        self.orders.drop()
        self._watch.forget()
        self.note = note

    def _break_calibration(self) -> None:
        """Note that a calibration under way is cut short."""
        if self.calibration is not None:
            self.calibration, self.known.calibration_problem = None, HALF_CALIBRATED
            self.known.power_off = True

    def _postpone_hold(self) -> None:
        """Hold as soon as it is known where: at an old position, to hold would be to go back."""
        self.orders.forget()
        self._watch.forget()
        self.hold_wanted = True

    def _take_reply(self, request: Request, message: CanMessage, now: float) -> None:
        """Take the reply to a poll or an order, and draw the conclusions if it is believed."""
        if request.move is not None:
            self._take_echo(request, now)
        order, before = self.orders.taken, self.known.reply
        speed = 0.0 if order is None else self.settings.speed_of(order.speed) / self.settings.resolution
        reply = decode_reply(message, now)
        believed = self.known.take(reply, order, speed)
        self.counts["unconfirmed replies"] = self.known.filter.rejected
        if believed is not None:
            self._conclude(before, believed)
            self.refresh()
        elif self._watch.rests and self.orders.wanted == self.orders.taken and self._watch.strays(reply):
            self.orders.renew()  # true or not, a reply shows jaws that leave their place: this undoes a foreign order

    def _take_echo(self, request: Request, now: float) -> None:
        """Note that an order was answered."""
        self.known.power_off = False
        if self.recovery is not None:
            self.recovery.unflagged()
        elif request.move == self.orders.wanted:
            self.orders.take(request.move)
            self._watch.send(request.move, now, self.known.position)
            self.order_sent = now
            self.known.restart_contact()
            if self.job is not None:
                self.job.send(now)

    def _conclude(self, before: Reply | None, reply: Reply) -> None:
        """Draw the conclusions from a reply that is believed; `before` is the one before it."""
        if self.silent or before is None:
            self.silent, self.note = False, ""
        self.known.power_off |= reply.error
        if self.recovery is None:
            self.stop.take(reply)
        self._follow_recovery(reply)
        self._follow_fault(before, reply)
        if self.calibration is not None:
            self._follow_calibration(reply)
        elif before is not None and before.calibrated and not reply.calibrated:
            self._abort(REBOOTED)
            self.known.calibration_problem = ""
        elif before is not None and reply.calibrated and not before.calibrated and not self.known.calibration_problem:
            self._invalidate_calibration("the gripper was calibrated, but not by this driver", False)
        elif not reply.error:
            self._follow_orders(reply)
        self._follow_arrival(reply)
        if self.hold_wanted and self.phase in USABLE:
            self._hold(reply.time)

    def _follow_arrival(self, reply: Reply) -> None:
        """Hold jaws that move by an order from before the link was there."""
        arrival = self.arrival
        if arrival is None:
            return
        was_moving = arrival.moving
        arrival.take(reply)
        if arrival.over:
            self.arrival = None
        elif arrival.moving and not was_moving and self.orders.wanted is None:
            self._hold_here(reply.time)
            self.note = INHERITED

    def _hold_here(self, now: float) -> None:
        """Want the jaws to stay where they are by now."""
        self.orders.want(self.order(position=self.hold_position(now), flags=GO), urgent=True)

    def _follow_recovery(self, reply: Reply) -> None:
        """Let the clearing of errors go on."""
        recovery = self.recovery
        if recovery is None:
            return
        recovery.take(reply)
        if recovery.step.over:
            self.recovery, self.known.power_off = None, True
            self._abort()
            if recovery.step is Step.DONE:
                self.stop.end()
            else:
                self.known.telemetry.ask_errors(reply.time)

    def _follow_fault(self, before: Reply | None, reply: Reply) -> None:
        """End what a fault ends, and have its name asked for."""
        if reply.faults == (before.faults if before is not None else NO_FAULTS):
            return
        self.known.telemetry.ask_errors(reply.time)
        if reply.error and self.recovery is None:
            self._abort()

    def _follow_calibration(self, reply: Reply) -> None:
        """Let the calibration go on, and end it."""
        run = self.calibration
        run.take(reply)
        if run.step.over:
            self.calibration = None
            self.known.calibration_problem = HALF_CALIBRATED if run.step is Step.FAILED else ""
            self.known.power_off = True
            self.known.restart_history()
            self._abort(run.reason)
            self.ended = MoveOutcome.NONE

    def _follow_orders(self, reply: Reply) -> None:
        """Judge the move, and whether the gripper has our order."""
        fault, runs = self._watch.judge(reply, self.known.power_off), abs(reply.current_mA) >= CLEAR_CURRENT
        if fault and not self._watch.heard and not runs:
            if not self.orders.repeat():
                self._watch.forget()
        elif fault and not runs and not self._watch.strays(reply):
            self._release_control(fault)
        elif fault and not (self.orders.pending or (not self._watch.heard and self.orders.repeat())):
            self._invalidate_calibration(fault, self.known.driving)
        if self.job is not None:
            self.job.take(reply)
            if self.job.outcome is MoveOutcome.TIMED_OUT and self.orders.pending:
                self.orders.drop()

    def _take_unasked(self, message: CanMessage) -> None:
        """Count a message that nobody waits for, and look for other programs' orders."""
        if message.node != self.settings.node_id:
            self.counts["messages of other nodes"] += 1
        elif message.command == Command.HEARTBEAT:
            self.counts["heartbeats"] += 1
        elif message.remote:
            self.counts["unexpected messages"] += 1
        elif message.command == Command.MOVE and len(message.data) == 5:
            self._handle_foreign_command("a move was seen on the bus", decode_move(message).drives)
        elif message.command == Command.CALIBRATE and not message.data:
            self._handle_foreign_command("a calibration was seen on the bus", True)
        elif message.command in FOREIGN and not message.data:
            self._release_control(f"command {message.command} was seen on the bus")
        else:
            self.counts["unexpected messages"] += 1

    def _release_control(self, what: str) -> None:
        """Yield to another program: the gripper has its order, and gets none of ours until one is asked for."""
        self.counts["foreign commands"] += 1
        self._break_calibration()
        self._abort(OTHER_MASTER.format(what=what))
        self.known.power_off = True
        self.refresh()

    def _handle_foreign_command(self, what: str, drives: bool) -> None:
        """Answer another program's order: one that moves the jaws takes them from us."""
        if drives:
            self._invalidate_calibration(f"another program commands this gripper ({what})", self.known.driving)
        else:
            self._release_control(what)

    def _invalidate_calibration(self, what: str, hold: bool) -> None:
        """Trust the end stops no more, and stop the jaws, once: two drivers that stop each other must come to rest.

        Args:
            what: happened.
            hold: the jaws are to be held where they were last; else they are to be limp.
        """
        self.counts["foreign commands"] += 1
        if self.phase is Phase.LOST:
            self._watch.forget()
            return
        position, flags = self.hold_position(self._now()), GO if hold else Flag.ACTIVATE
        stop = self.order(position=position, flags=flags)
        self._break_calibration()
        self._abort()
        self.known.calibration_problem = LOST.format(what=what)
        self.orders.want(stop, urgent=True)
        self.refresh()
