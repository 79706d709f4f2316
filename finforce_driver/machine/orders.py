"""The 5-byte order that the gripper shall have, the one that it is known to have, and whether it follows that."""

from __future__ import annotations

from dataclasses import replace
from enum import Enum, auto

from finforce_driver.can.protocol import FREE_FLAGS, Flag, Move, Reply
from finforce_driver.machine.move import GRACE, TOLERANCE

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
