"""The gripper as a state machine: commands and frames in, requests and a state out.

The one who carries its frames asks `next_request`, sends it, and gives what comes to `on_frame`, or tells `on_silence`.
Times are those of the carrier's clock [s].
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping

from finforce_driver.can.bus import Frame
from finforce_driver.can.protocol import Command, decode_reply, split_identifier
from finforce_driver.machine import commands
from finforce_driver.machine.core import Core
from finforce_driver.machine.exchange import Request
from finforce_driver.machine.judge import judge_reply, lose_link, overrule
from finforce_driver.machine.portrait import build_state
from finforce_driver.machine.requests import RequestSource
from finforce_driver.settings import GripperSettings
from finforce_driver.state import SILENT, GripperState, Phase

SHORT_SILENCE = 5  # requests in a row without a reply after which the gripper is taken to be absent
PROBES = 20  # the same before the first reply: a second
ECHOES = 8  # last frames, in which a frame of ours is recognised that an adapter gives back
COMMANDS = frozenset({Command.ESTOP, Command.CLEAR, Command.IDLE, Command.RESET, Command.CALIBRATE})
LOST_ORDER = "the gripper fell silent before the order could be sent: command again"


class GripperMachine:
    """Drives one gripper, without input or output of its own.

    Attributes:
        state: what is known.
        settings: of the gripper.
        link_counts: what the link counts, to be shown in the state.

    Args:
        settings: the same.
        salt: any number, other than that of the program that drove the gripper before.
    """

    def __init__(self, settings: GripperSettings | None = None, salt: int = 0) -> None:
        self.settings = settings or GripperSettings()
        self.link_counts: Mapping[str, int] = {}
        self._core = Core(self.settings, salt)
        self._requests = RequestSource(self._core)
        self._sent: deque[Frame] = deque(maxlen=ECHOES)
        self.state = GripperState()
        self._refresh()

    def move(self, opening: float, speed: float | None, force: float | None, now: float) -> None:
        """Go to an opening [m] at a speed [m/s], stalling with a force [N]; see `Gripper.move`."""
        commands.move(self._core, commands.make_goal(self._core, opening, speed, force), now)
        self._refresh()

    def hold(self, now: float) -> None:
        """Stop in place; see `Gripper.hold`."""
        commands.hold(self._core, now)
        self._refresh()

    def calibrate(self) -> None:
        """Find the end stops; see `Gripper.calibrate`."""
        commands.calibrate(self._core)
        self._refresh()

    def clear_errors(self) -> None:
        """Clear what is latched; see `Gripper.clear_errors`."""
        commands.clear_errors(self._core)
        self._refresh()

    def activate(self, on: bool, now: float) -> None:
        """Switch the power stage on or off; see `Gripper.activate`."""
        commands.activate(self._core, on, now)
        self._refresh()

    def release_power(self, now: float) -> None:
        """Let the jaws go limp; see `Gripper.release_power`."""
        commands.release_power(self._core, now)
        self._refresh()

    def estop(self, now: float) -> list[Frame]:
        """Stop at once: return the frames that are to be sent before anything else; no motion comes after them."""
        core = self._core
        commands.demand_stop(core)
        first = self._requests.begin_stop(now)
        # the gripper keeps three frames at most, and one is on the way already: the second follows its reply
        second = self._requests.end_stop() if core.exchange.pending is None else None
        frames = [request.frame for request in (first, second) if request is not None]
        self._sent.extend(frames)
        self._refresh()
        return frames

    def leave(self, now: float) -> None:
        """Prepare to be ended: hold in place, or let go where the settings say so."""
        core = self._core
        if core.phase in commands.CONNECTED and self.settings.release_on_stop:
            commands.activate(core, False, now)
        elif core.phase in (*commands.USABLE, Phase.CALIBRATING):
            commands.hold(core, now)

    @property
    def has_orders(self) -> bool:
        """Whether an order or an emergency stop has still to be sent."""
        return self._core.orders.pending or (self._core.stop.active and not self._core.known.error)

    @property
    def must_reopen(self) -> bool:
        """Whether nothing has answered for so long that the link is to be opened anew."""
        return self._core.exchange.misses >= self.settings.missed_replies

    def opening_at(self, time: float) -> float:
        """Return the opening [m] at a past time; NaN unknown."""
        core = self._core
        reach = 2.0 / self.settings.poll_rate + self.settings.reply_timeout
        return core.scale.opening_of(core.known.history.place_at(time, reach))

    def next_request(self, now: float) -> Request | None:
        """Return what to send now, None when nothing is due; it counts as sent."""
        request = self._requests.next_request(now)
        if request is not None:
            self._core.exchange.begin(request, now)
            self._sent.append(request.frame)
        return request

    def next_time(self, now: float) -> float:
        """Return when the next request is due at the latest."""
        return self._requests.next_time(now)

    def on_link_open(self) -> None:
        """Begin on a link that was opened."""
        self._core.exchange.reset()
        self._core.joined = True
        self._refresh()

    def on_link_lost(self, reason: str) -> None:
        """Forget what can have changed by the time the link is back, and want nothing."""
        lose_link(self._core, reason)
        self._refresh()

    def on_frame(self, frame: Frame, now: float) -> bool:
        """Take a frame; return whether it was the reply that was waited for."""
        if not self._core.exchange.answers(frame):
            if frame not in self._sent:
                self._take_unasked(frame)
            return False
        core, request = self._core, self._core.exchange.end(now)
        core.counts["replies"] += 1
        if request.answer is Command.REPLY:
            self._take_reply(request, frame, now)
        elif request.node != self.settings.node_id:
            commands.explain_other_node(core, request.node)
            self._refresh()
        elif not request.counted:
            core.known.telemetry.take(request.answer, frame, now)
        return True

    def on_silence(self, now: float, suspicion: str = "") -> None:
        """Note that the reply did not come in time; `suspicion` is what the link has to say to that."""
        core, request = self._core, self._core.exchange.miss()
        if request is None:
            return
        core.counts["lost replies"] += 1
        if request.move is not None and core.orders.urgent and core.orders.wanted.drives:
            core.postpone_hold()
        if not request.counted:
            core.known.telemetry.miss(now)
            return
        if core.exchange.misses >= (PROBES if core.known.reply is None else SHORT_SILENCE) and not core.silent:
            core.silent = True
            if core.orders.pending:
                core.abort(LOST_ORDER)
            core.note = core.note or suspicion or SILENT.format(node=self.settings.node_id)
            self._refresh()

    def _take_reply(self, request: Request, frame: Frame, now: float) -> None:
        """Take the reply to a poll or an order."""
        core, reply = self._core, decode_reply(frame)
        if request.move is not None:
            self._take_echo(request, now)
        order = core.orders.taken
        speed = 0.0 if order is None else core.scale.speed_of(order.speed) / core.scale.resolution
        before = core.known.reply
        believed = core.known.take(reply, now, order, speed)
        core.counts["doubted replies"] = core.known.filter.doubted
        if believed is not None:
            judge_reply(core, before, believed, now)
            self._refresh()

    def _take_echo(self, request: Request, now: float) -> None:
        """Note that an order was answered."""
        core = self._core
        if core.recovery is not None:
            core.recovery.unflagged()
        elif request.move == core.orders.wanted:
            core.orders.take(request.move)
            core.echo.send(request.move, now)
            core.order_sent = now
            core.known.restart_contact()
            if core.job is not None:
                core.job.send(now)

    def _take_unasked(self, frame: Frame) -> None:
        """Count a frame that nobody waits for, and look for other programs' orders."""
        address, core = split_identifier(frame.id), self._core
        if address.node != self.settings.node_id:
            core.counts["frames of other nodes"] += 1
        elif address.command == Command.HEARTBEAT:
            core.counts["heartbeats"] += 1
        elif address.command == Command.MOVE and len(frame.data) == 5 and not frame.remote:
            core.counts["foreign commands"] += 1
            overrule(core, "a move was seen on the bus")
            self._refresh()
        elif address.command in COMMANDS and not frame.remote:
            core.counts["foreign commands"] += 1
            overrule(core, f"command {address.command} was seen on the bus")
            self._refresh()
        else:
            core.counts["unexpected frames"] += 1

    def _refresh(self) -> None:
        """Make the state anew."""
        self.state = build_state(self._core, self.link_counts)
