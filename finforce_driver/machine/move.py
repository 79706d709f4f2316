"""One move, its outcome by the replies since, and the order that carries it out."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from finforce_driver.can.protocol import FREE_FLAGS, Move, Reply
from finforce_driver.state import MoveOutcome

GRACE = 0.05  # [s] after a move in which its replies may still speak of the one before
CONTACT_TIME = 0.1  # [s] and
CONTACT_REPLIES = 5  # replies that a contact must last
REACHED_REPLIES = 2
REST_TIME = 0.3  # [s] at one count, next to the target, that are rest
TOLERANCE = 2  # [counts]: the reply truncates, the gripper stops within a fraction of a count
CLOSED = 250  # [counts] from which contact while closing is with the other jaw
OPENED = 3  # [counts] up to which contact while opening is with the stop
CLEAR_CURRENT = 50  # [mA] from which the sign of the current is trusted
EXTRA_TIME = 1.0  # [s], allowed beyond the travel's own time
LEAST_TIME = 1.5  # [s], allowed for any move


def push_direction(reply: Reply, closing: bool) -> int:
    """Return 1 when the motor drives closed, -1 when open: by the current's sign, else by what was commanded."""
    if abs(reply.current_mA) >= CLEAR_CURRENT:
        return 1 if reply.current_mA < 0 else -1
    return 1 if closing else -1


LARGEST_LAG = 3.5  # [counts] that the jaws may lag behind the target: more means that something is in the way
LAG_PAUSE = 0.02  # [s] until a target that waits for the jaws is looked at again


class Steps:
    """A target on its way to another one, at a speed.

    The ideal ramp is the target between the counts; it is rounded, hence half a count off at most. The target waits
    for jaws that lag behind, and a late step delays the ramp: it never hurries.

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
        self._sign = 1 if goal > start else -1
        self.position = round(start)
        self.next_time = now + self._period * max(0.0, self._sign * (self.position - start) + 0.5)
        self.waiting = False

    @property
    def done(self) -> bool:
        """True if the target has arrived."""
        return self.position == self.goal

    def ramp(self, now: float) -> float:
        """Return the ideal target at a time [counts]."""
        if self.done:
            return float(self.goal)
        ahead = (self.next_time - now) / self._period
        ideal = self.position + self._sign * (0.5 - ahead)
        return min(max(ideal, self.position - 0.5), self.position + 0.5)

    def advance(self, now: float, jaws: float) -> None:
        """Go on by one count when it is due at a time [s] and the jaws [counts] have followed."""
        if self.done or now < self.next_time:
            return
        lag = self._sign * (self.position - jaws)
        if lag < -LARGEST_LAG:  # the jaws are ahead: the ramp began where they have not been
            self.position = round(jaws)
        self.waiting = lag > LARGEST_LAG
        if self.waiting:
            self.next_time = now + LAG_PAUSE
            return
        self.position += self._sign
        self.next_time = max(self.next_time, now - 0.5 * self._period) + self._period


LOOSE_TIME = 0.1  # [s] without contact after which what was grasped is taken to be gone
PRESSING = (MoveOutcome.GRASPED, MoveOutcome.BLOCKED)


@dataclass(frozen=True, kw_only=True)
class Goal:
    """The goal of a move.

    Attributes:
        opening: to be reached [m].
        position: the same [counts].
        rate: speed [counts/s].
        byte: speed byte of the orders.
        stepped: the speed is below what the byte can do, the target has to be moved on in steps.
        current_mA: limit [mA].
    """

    opening: float
    position: int
    rate: float
    byte: int
    stepped: bool
    current_mA: int


class MoveJob:
    """Carries out a goal; one that stalls goes on pressing, and on moving when what it presses on gives way.

    Attributes:
        goal: target, speed and current.
        outcome: its outcome; NONE while it is under way.
        sent: an order of it has left.
        steps: target of a slow move; None: the gripper goes to the end by itself.

    Args:
        goal: the same.
        start: where the target or the jaws are now [counts].
        now: time [s].
    """

    def __init__(self, goal: Goal, *, start: float, now: float) -> None:
        self.goal = goal
        self.outcome = MoveOutcome.NONE
        self.sent = False
        self.steps = self._ramp_from(start, now) if goal.stepped else None
        # of a move in steps, the time of two steps
        allowed = 2.0 / goal.rate if self.steps else abs(goal.position - start) / goal.rate
        self._allowed = max(allowed + EXTRA_TIME, LEAST_TIME)
        self._deadline = now + self._allowed
        self._closing = goal.position > start
        self._begun = self._pressed = self._sent_at = now
        self._contact: Reply | None = None  # the first of those that report it at one position
        self._contacts = self._arrivals = 0
        self._rest_position, self._rest_since = -1, now

    @property
    def position(self) -> int:
        """The position to which the gripper is to be sent now [counts]."""
        return self.steps.position if self.steps else self.goal.position

    @property
    def next_time(self) -> float:
        """The time at which the target goes on [s]; infinite when it does not."""
        return self.steps.next_time if self.steps and not self.steps.done and self.stepping else math.inf

    @property
    def stepping(self) -> bool:
        """True if the target may go on: under way, or pressing on something that may give way."""
        return self.outcome is MoveOutcome.NONE or self.outcome in PRESSING

    def advance(self, now: float, jaws: float, stamp: float) -> None:
        """Let the target go on when it is due.

        Args:
            now: time [s].
            jaws: where they are [counts].
            stamp: when they were there [s].
        """
        if self.steps is None or not self.stepping or stamp <= self._begun:
            return
        if not self.sent and abs(self.steps.position - jaws) > LARGEST_LAG:
            # the link failed meanwhile, and the jaws are not where they were thought to be
            self.steps = self._ramp_from(jaws, now)
        before = self.steps.position
        self.steps.advance(now, jaws)
        if self.steps.position != before:
            self._deadline = now + self._allowed

    def send(self, now: float) -> None:
        """Note that its order was sent: what comes soon after speaks of the one before."""
        self.sent, self._sent_at = True, now
        self._contact, self._arrivals = None, 0

    def take(self, reply: Reply) -> None:
        """Judge by a believed reply."""
        if self.outcome is MoveOutcome.NONE:
            self.outcome = self._judge(reply)
            self._pressed = reply.time
        elif self.outcome in PRESSING:
            self._pressed = reply.time if reply.contact else self._pressed
            if reply.time - self._pressed > LOOSE_TIME:
                self.outcome = MoveOutcome.NONE
                self._deadline = reply.time + self._allowed

    def _ramp_from(self, start: float, now: float) -> Steps:
        return Steps(start=start, goal=self.goal.position, rate=self.goal.rate, now=now)

    def _judge(self, reply: Reply) -> MoveOutcome:
        """Return what became of the move; NONE while it is under way."""
        if reply.time - self._sent_at < GRACE:
            return MoveOutcome.NONE
        if self._lasting_contact(reply):
            if push_direction(reply, self._closing) > 0:
                return MoveOutcome.CLOSED_EMPTY if reply.position >= CLOSED else MoveOutcome.GRASPED
            stopped = max(reply.position, self.goal.position) <= OPENED
            return MoveOutcome.REACHED if stopped else MoveOutcome.BLOCKED
        final = self.steps is None or self.steps.done  # else the gripper was sent to a step on the way
        there = reply.at_target and abs(reply.position - self.goal.position) <= TOLERANCE
        self._arrivals = self._arrivals + 1 if there and final else 0
        if self._arrivals >= REACHED_REPLIES or self._rests_next_to_goal(reply, final):
            return MoveOutcome.REACHED
        return MoveOutcome.TIMED_OUT if reply.time > self._deadline else MoveOutcome.NONE

    def _lasting_contact(self, reply: Reply) -> bool:
        """Return True if a contact has lasted for long enough at one position."""
        if not reply.contact:
            self._contact = None
            return False
        if self._contact is None or abs(reply.position - self._contact.position) > 1:
            self._contact, self._contacts = reply, 0
        self._contacts += 1
        return reply.time - self._contact.time >= CONTACT_TIME and self._contacts >= CONTACT_REPLIES

    def _rests_next_to_goal(self, reply: Reply, final: bool) -> bool:
        """Return True if the jaws have come to rest a count off the goal, which old firmware never calls reached."""
        near = abs(reply.position - self.goal.position) <= 1
        if not final or reply.contact or not near or reply.position != self._rest_position:
            self._rest_position, self._rest_since = reply.position, reply.time
            return False
        return reply.time - self._rest_since >= REST_TIME


REPEATS = 2  # times that an order without effect is sent again


class Orders:
    """Keeps the wanted order and the taken one; it is sent only while they differ.

    After an interruption the same bytes would not count as a new order and would be carried out at the drive's own
    speed: a free flag changes, so that they differ.

    Attributes:
        wanted: order for the gripper; None: none.
        taken: order that it has acknowledged; None: unknown.
        urgent: the wanted order makes it stop, and does not wait for the link to be in step.

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
        """True if the wanted order has still to be sent."""
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
        if not move.action:  # the next move to the same place must differ
            self._salt = self._salt + 1 & FREE_FLAGS

    def drop(self) -> None:
        """Want nothing any more, and know nothing: after what may have interrupted the last order."""
        self.forget()
        self._salt = self._salt + 1 & FREE_FLAGS

    def forget(self) -> None:
        """Want nothing, and do not know whether the last order was taken."""
        self.wanted = self.taken = None
        self.urgent = False

    def renew(self) -> None:
        """Give the wanted order anew, as another one that says the same."""
        self._salt = self._salt + 1 & FREE_FLAGS
        self.want(self.wanted, self.urgent)

    def repeat(self) -> bool:
        """Send the wanted order again, since it has no effect; return whether that is still worth trying."""
        if self._repeats >= REPEATS:
            return False
        self._repeats += 1
        self.taken = None
        return True


LASTING = 3  # replies: what the gripper was told may cross with what it says
STRAY = 3.0  # [counts] that the jaws may be off their way: truncation, and what the gripper calls reached
EXCESS = 1.25  # times the current limit, and `CLEAR_CURRENT`, that the motor does not exceed
SLACK = 0.5  # of the current limit, below which nothing is pressed on


class OrderWatch:
    """Looks whether the gripper does what it was told, and nothing else.

    The gripper stays at its target, as it says, until it gets another order, whatever pulls at its jaws. Another
    target, a way that does not lead to the target though the motor does not resist, and a motor that is stronger than
    its limit, or runs while it should sleep, are signs of an order that was not ours.

    Attributes:
        heard: it followed the order before: one that is ignored now was overruled, else it was probably lost.
    """

    def __init__(self) -> None:
        self._order: Move | None = None
        self._sent = 0.0
        self.heard = self._arrived = False
        self._odd = 0
        self._low = self._high = math.nan  # [counts] between which the jaws may be
        self._position = -1  # in the last reply

    @property
    def rests(self) -> bool:
        """True if the jaws have come to rest under a known order."""
        return self._order is not None and self._order.drives and self._high - self._low <= 2.0

    def send(self, order: Move, now: float, position: float) -> None:
        """Note an order that was answered, when the jaws were at a position [counts]."""
        before, self._order = self._order, order
        if before is not None and before.flags != order.flags:
            one, other = (replace(move, flags=move.flags | FREE_FLAGS) for move in (before, order))
            if one == other:
                return  # given anew, against another one
        self.heard = self.heard and order == before
        self._sent, self._odd, self._arrived = now, 0, False
        self._low, self._high = sorted((order.position if math.isnan(position) else position, order.position))

    def forget(self) -> None:
        """Expect no order to be carried out: the power stage sleeps, or what it does is not known."""
        self._order, self._odd = None, 0
        self._low = self._high = math.nan

    def judge(self, reply: Reply, power_off: bool) -> str:
        """Judge a believed reply; return what is wrong, empty where nothing is.

        Args:
            reply: as it came.
            power_off: True if the power stage is off.
        """
        order = self._order
        stands, self._position = reply.position == self._position, reply.position
        if order is None:
            self._low, self._high = (reply.position if math.isnan(end) else end for end in (self._low, self._high))
            runs = power_off and abs(reply.current_mA) >= CLEAR_CURRENT and self.strays(reply)
            return "the motor runs without an order" if runs else ""
        if reply.time - self._sent < GRACE:
            self._low, self._high = min(self._low, reply.position), max(self._high, reply.position)
            return ""
        if order.drives and self.strays(reply):
            return "the jaws leave the way that they were ordered to go"
        self._low, self._high = sorted((reply.position, order.position))
        if self._fits(order, reply, stands):
            self.heard, self._odd = True, 0
            return ""
        self._odd = (self._odd + 1) % LASTING
        return "" if self._odd else "the gripper does not follow its last command"

    def strays(self, reply: Reply) -> bool:
        """Return whether the jaws are off their way, and the motor does not push them back to it."""
        beyond = (reply.position > self._high + STRAY) - (reply.position < self._low - STRAY)
        resists = abs(reply.current_mA) >= CLEAR_CURRENT and push_direction(reply, False) == -beyond
        return beyond != 0 and not resists

    def _fits(self, order: Move, reply: Reply, stands: bool) -> bool:
        """Return whether a reply echoes an order's flags, and tells of its target and current and no other."""
        if (reply.activated, reply.action) != (order.activated, order.action):
            return False
        current, least = abs(reply.current_mA), SLACK * order.current_mA * reply.contact
        if not order.drives or not least <= current <= EXCESS * order.current_mA + CLEAR_CURRENT:
            return current <= CLEAR_CURRENT and not order.drives
        near = abs(reply.position - order.position) <= TOLERANCE + 1
        self._arrived |= reply.at_target and near
        return near or reply.at_target == self._arrived or (reply.at_target and not stands)


SETTLING_TIME = 0.3  # [s] in which jaws that go at 1.5 mm/s show it
MOTION = 2  # counts that are motion and no rounding


class Arrival:
    """Looks, once a link is there, whether the jaws move by an order from before: of a killed program, or a lost link.

    Jaws that push without moving hold something, and are left alone.

    Attributes:
        moving: they do.
        over: it is known that they do not, or no more.
    """

    def __init__(self) -> None:
        self.moving = self.over = False
        self._first: Reply | None = None

    def take(self, reply: Reply) -> None:
        """Take a believed reply."""
        first = self._first
        if not reply.driving or (reply.at_target and not self.moving):
            self.over = True
        elif first is None or (self.moving and reply.position != first.position):
            self._first = reply
        elif abs(reply.position - first.position) >= MOTION:
            self.moving, self._first = True, reply
        elif reply.time - first.time >= SETTLING_TIME:
            self.over = True
