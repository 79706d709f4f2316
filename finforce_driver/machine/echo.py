"""Compares what the gripper says of its last order with what it was told."""

from __future__ import annotations

from enum import Enum, auto

from finforce_driver.can.protocol import Flag, Move, Reply
from finforce_driver.machine.move import GRACE, TOLERANCE

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
