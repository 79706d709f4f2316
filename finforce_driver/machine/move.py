"""One move, its outcome by the replies since, and the order that carries it out."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from enum import Enum, auto

from finforce_driver.can.protocol import FREE_FLAGS, Flag, Move, Reply
from finforce_driver.settings import Pace
from finforce_driver.state import MoveOutcome

GRACE = 0.05  # [s] after a move in which its replies may still speak of the one before
CONTACT_TIME = 0.1  # [s] and
CONTACT_REPLIES = 5  # replies that a contact must last
REACHED_REPLIES = 2
REST_TIME = 0.3  # [s] at one count, beside the target, that are rest
TOLERANCE = 2  # [counts]: the reply truncates, the gripper stops within a fraction of a count
CLOSED = 250  # [counts] from which contact while closing is with the other jaw
OPENED = 3  # [counts] up to which contact while opening is with the stop
CLEAR_CURRENT = 50  # [mA] from which the sign of the current is trusted
EXTRA_TIME, LEAST_TIME = 1.0, 1.5  # [s] beyond the way's own time, and in all


def push_direction(reply: Reply, closing: bool) -> int:
    """Return 1 when the motor drives closed, -1 when open: by the current's sign, else by what was commanded."""
    if abs(reply.current_mA) >= CLEAR_CURRENT:
        return 1 if reply.current_mA < 0 else -1
    return 1 if closing else -1


@dataclass(frozen=True, kw_only=True)
class _Contact:
    """A contact that lasts: since when [s], at which position, in how many replies."""

    since: float
    position: int
    replies: int


class MoveWatch:
    """Judges one move.

    Attributes:
        closing: whether the move closes.

    Args:
        position: where the move ends [counts].
        closing: the same.
        allowed: its own time [s]; of one that goes in steps, that of two steps.
        now: time [s].
    """

    def __init__(self, *, position: int, closing: bool, allowed: float, now: float) -> None:
        self.closing = closing
        self._position = position
        self._allowed = max(allowed + EXTRA_TIME, LEAST_TIME)
        self._deadline = now + self._allowed
        self._sent = now
        self._contact: _Contact | None = None
        self._arrivals = 0
        self._beside, self._beside_since = -1, now

    def send(self, now: float) -> None:
        """Note that a message of the move was sent: what comes soon after is of the one before."""
        self._sent = now
        self._contact, self._arrivals = None, 0

    def delay(self, now: float) -> None:
        """Note that the move got on: its time begins anew."""
        self._deadline = now + self._allowed

    def take(self, reply: Reply, now: float, final: bool) -> MoveOutcome:
        """Return what became of the move; NONE while it is under way.

        Args:
            reply: the newest one that is believed.
            now: when it came [s].
            final: whether the gripper was sent to the end of the move, not to a step on the way.
        """
        if now - self._sent < GRACE:
            return MoveOutcome.NONE
        self._follow_contact(reply, now)
        contact = self._contact
        if contact and now - contact.since >= CONTACT_TIME and contact.replies >= CONTACT_REPLIES:
            return self._judge_contact(reply)
        there = reply.at_target and abs(reply.position - self._position) <= TOLERANCE
        self._arrivals = self._arrivals + 1 if there and final else 0
        if self._arrivals >= REACHED_REPLIES or self._rests_beside(reply, now, final):
            return MoveOutcome.REACHED
        return MoveOutcome.TIMED_OUT if now > self._deadline else MoveOutcome.NONE

    def _rests_beside(self, reply: Reply, now: float, final: bool) -> bool:
        """Whether the jaws have come to rest a count beside the target, which old firmware never calls reached."""
        if not final or reply.contact or abs(reply.position - self._position) > 1 or reply.position != self._beside:
            self._beside, self._beside_since = reply.position, now
            return False
        return now - self._beside_since >= REST_TIME

    def _follow_contact(self, reply: Reply, now: float) -> None:
        """Keep how long a contact lasts at one place."""
        kept = self._contact
        if not reply.contact:
            self._contact = None
            return
        if kept is None or abs(reply.position - kept.position) > 1:
            kept = _Contact(since=now, position=reply.position, replies=0)
        self._contact = _Contact(since=kept.since, position=kept.position, replies=kept.replies + 1)

    def _judge_contact(self, reply: Reply) -> MoveOutcome:
        """Return what a lasting contact means."""
        if push_direction(reply, self.closing) > 0:
            return MoveOutcome.CLOSED_EMPTY if reply.position >= CLOSED else MoveOutcome.GRASPED
        return MoveOutcome.REACHED if max(reply.position, self._position) <= OPENED else MoveOutcome.BLOCKED


LARGEST_LAG = 3.5  # [counts] that the jaws may stay behind the target: more means that something is in the way
LAG_PAUSE = 0.02  # [s] until a target that waits for the jaws is looked at again


class Steps:
    """A target on its way to another one, at a speed.

    The ideal ramp is the target between the counts; it is rounded, hence half a count off at most. The target waits
    for jaws that stay behind, and a late step delays the ramp: it never hurries.

    Attributes:
        position: present target [counts].
        goal: where it goes [counts].
        next_time: when it is due to go on [s].

    Args:
        start: where the ramp begins [counts]; a fraction is kept.
        goal: where it ends [counts].
        rate: speed [counts/s].
        now: time [s].
    """

    def __init__(self, *, start: float, goal: int, rate: float, now: float) -> None:
        self.goal = goal
        self._period = 1.0 / rate
        self._way = 1 if goal > start else -1
        self.position = round(start)
        self.next_time = now + self._until_step(start)
        self.waiting = False

    @property
    def done(self) -> bool:
        """Whether the target has arrived."""
        return self.position == self.goal

    def ramp(self, now: float) -> float:
        """Return the ideal target at a time [counts]."""
        if self.done:
            return float(self.goal)
        ahead = (self.next_time - now) / self._period
        place = self.position + self._way * (0.5 - ahead)
        return min(max(place, self.position - 0.5), self.position + 0.5)

    def advance(self, now: float, place: float) -> None:
        """Go on by one count when it is due and the jaws have followed.

        Args:
            now: time [s].
            place: of the jaws [counts].
        """
        if self.done or now < self.next_time:
            return
        lag = self._way * (self.position - place)
        if lag < -LARGEST_LAG:  # the jaws are ahead: the ramp began at a place where they have not been
            self.position = round(place)
        self.waiting = lag > LARGEST_LAG
        if self.waiting:
            self.next_time = now + LAG_PAUSE
            return
        self.position += self._way
        self.next_time = max(self.next_time, now - 0.5 * self._period) + self._period

    def _until_step(self, start: float) -> float:
        """Return the time from the start to the first step [s]."""
        return self._period * max(0.0, self._way * (self.position - start) + 0.5)


LOOSE_TIME = 0.1  # [s] without contact after which what was grasped is taken to be gone
PRESSING = (MoveOutcome.GRASPED, MoveOutcome.BLOCKED)


@dataclass(frozen=True, kw_only=True)
class Goal:
    """What was asked for.

    Attributes:
        opening: to be reached [m].
        position: the same [counts].
        pace: how fast.
        current_mA: limit [mA].
    """

    opening: float
    position: int
    pace: Pace
    current_mA: int


class MoveJob:
    """Carries out a goal; one that stalls goes on pressing, and on moving when what it presses on gives way.

    Attributes:
        goal: what was asked for.
        outcome: what became of it; NONE while it is under way.
        sent: an order of it has left.

    Args:
        goal: the same.
        start: where the target or the jaws are now [counts].
        rate: speed [counts/s].
        now: time [s].
    """

    def __init__(self, goal: Goal, *, start: float, rate: float, now: float) -> None:
        self.goal = goal
        self.outcome = MoveOutcome.NONE
        self._rate = rate
        self.steps = Steps(start=start, goal=goal.position, rate=rate, now=now) if goal.pace.stepped else None
        allowed = 2.0 / rate if self.steps else abs(goal.position - start) / rate
        closing = goal.position > start
        self.watch = MoveWatch(position=goal.position, closing=closing, allowed=allowed, now=now)
        self._begun = self._pressed = now
        self.sent = False

    @property
    def position(self) -> int:
        """Where the gripper is to be sent now [counts]."""
        return self.steps.position if self.steps else self.goal.position

    @property
    def next_time(self) -> float:
        """When the target goes on [s]; infinite when it does not."""
        return self.steps.next_time if self.steps and not self.steps.done and self.stepping else math.inf

    @property
    def stepping(self) -> bool:
        """Whether the target may go on: under way, or pressing on something that may give way."""
        return self.outcome is MoveOutcome.NONE or self.outcome in PRESSING

    def advance(self, now: float, place: float, stamp: float) -> None:
        """Let the target go on when it is due.

        Args:
            now: time [s].
            place: of the jaws [counts].
            stamp: when they were there [s].
        """
        if self.steps is None or not self.stepping or stamp <= self._begun:
            return
        if not self.sent and abs(self.steps.position - place) > LARGEST_LAG:
            # the link failed meanwhile, and the jaws are not where they were thought to be
            self.steps = Steps(start=place, goal=self.goal.position, rate=self._rate, now=now)
        before = self.steps.position
        self.steps.advance(now, place)
        if self.steps.position != before:
            self.watch.delay(now)

    def send(self, now: float) -> None:
        """Note that its order was sent."""
        self.sent = True
        self.watch.send(now)

    def take(self, reply: Reply, now: float) -> None:
        """Judge by a believed reply."""
        if self.outcome is MoveOutcome.NONE:
            final = self.steps is None or self.steps.done
            self.outcome = self.watch.take(reply, now, final)
            self._pressed = now
        elif self.outcome in PRESSING:
            self._pressed = now if reply.contact else self._pressed
            if now - self._pressed > LOOSE_TIME:
                self.outcome = MoveOutcome.NONE
                self.watch.delay(now)


REPEATS = 2  # times that an order without effect is sent again


class Orders:
    """Keeps the wanted order and the taken one; it is sent only while they differ.

    After an interruption the same bytes would not count as a new order and would be carried out at the drive's own
    speed: a free flag changes, so that they differ.

    Attributes:
        wanted: what the gripper shall do; None: whatever it does.
        taken: what it has acknowledged; None: unknown.
        urgent: the wanted order makes it stop, and does not wait for a link in doubt.

    Args:
        salt: any number, other than that of the program that drove the gripper before.
    """

    def __init__(self, salt: int = 0) -> None:
        self.wanted: Move | None = None
        self.taken: Move | None = None
        self.urgent = False
        self._salt = salt & FREE_FLAGS
        self._repeats = 0

    @property
    def pending(self) -> bool:
        """Whether the wanted order has still to be sent."""
        return self.wanted is not None and self.wanted != self.taken

    def want(self, move: Move, urgent: bool = False) -> None:
        """Have the gripper get an order; only its `Flag` bits count, the free ones are ours."""
        move = replace(move, flags=move.flags & ~FREE_FLAGS | self._salt)
        if move != self.wanted:
            self._repeats = 0
        self.wanted, self.urgent = move, urgent

    def take(self, move: Move) -> None:
        """Note that an order was answered."""
        self.taken = move
        if not move.flags & Flag.GO:  # the next move to the same place must differ
            self._salt = self._salt + 1 & FREE_FLAGS

    def drop(self) -> None:
        """Want nothing any more, and know nothing: after what may have interrupted the last order."""
        self.wanted = self.taken = None
        self.urgent = False
        self._salt = self._salt + 1 & FREE_FLAGS

    def forget(self) -> None:
        """Want nothing, and do not know whether the last order was taken."""
        self.wanted = self.taken = None
        self.urgent = False

    def repeat(self) -> bool:
        """Send the wanted order again, since it has no effect; return whether that is still worth trying."""
        if self._repeats >= REPEATS:
            return False
        self._repeats += 1
        self.taken = None
        return True


LASTING = 3  # replies: what the gripper was told may cross with what it says


class Echo(Enum):
    """How the gripper follows its order."""

    FOLLOWS = auto()
    UNHEARD = auto()  # it never did: the order was probably lost
    OVERRULED = auto()  # it did before: somebody else gave it another one


class EchoWatch:
    """Looks whether the gripper does what it was told.

    The gripper stays at its target, as it says, until it gets another order, whatever pulls at its jaws: leaving that
    state, or taking itself to be at a target elsewhere, is the sign of an order that was not ours.
    """

    def __init__(self) -> None:
        self._order: Move | None = None
        self._sent = 0.0
        self._heard = self._arrived = False
        self._odd = 0

    def send(self, order: Move, now: float) -> None:
        """Note an order that was answered."""
        if order != self._order:
            self._heard = False
        self._order, self._sent = order, now
        self._odd, self._arrived = 0, False

    def forget(self) -> None:
        """Expect nothing."""
        self._order = None

    def take(self, reply: Reply, now: float) -> Echo:
        """Judge a believed reply."""
        if self._order is None or now - self._sent < GRACE:
            return Echo.FOLLOWS
        if self._fits(self._order, reply):
            self._heard, self._odd = True, 0
            return Echo.FOLLOWS
        self._odd += 1
        if self._odd < LASTING:
            return Echo.FOLLOWS
        self._odd = 0
        return Echo.OVERRULED if self._heard else Echo.UNHEARD

    def _fits(self, order: Move, reply: Reply) -> bool:
        """Return whether a reply echoes an order's flags, and tells of its target and no other."""
        told = bool(order.flags & Flag.ACTIVATE), bool(order.flags & Flag.GO)
        if (reply.activated, reply.action) != told:
            return False
        near = abs(reply.position - order.position) <= TOLERANCE + 1
        if not order.drives or self._arrived:
            return reply.at_target or not order.drives
        self._arrived = reply.at_target and near
        return near or not reply.at_target


LOOK = 0.3  # [s] in which jaws that go at 1.5 mm/s show it
STEPS = 2  # counts that are motion and no rounding


class Arrival:
    """Looks, once a link is there, whether the jaws move by an order from before: of a killed program, or a lost link.

    Jaws that push without moving hold something, and are left alone.

    Attributes:
        moving: they do.
        over: it is known that they do not, or no more.
    """

    def __init__(self) -> None:
        self.moving = self.over = False
        self._first: int | None = None
        self._since = 0.0

    def take(self, reply: Reply, now: float) -> None:
        """Take a believed reply."""
        drives = reply.activated and reply.action and not reply.error
        if not drives or (reply.at_target and not self.moving):
            self.over = True
        elif self._first is None or (self.moving and reply.position != self._first):
            self._first, self._since = reply.position, now
        elif abs(reply.position - self._first) >= STEPS:
            self.moving, self._first, self._since = True, reply.position, now
        elif now - self._since >= LOOK:
            self.over = True
