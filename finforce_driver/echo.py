"""Compares what the gripper says of its last order with what it was told; knows no other program."""

from __future__ import annotations

from enum import Enum, auto

from finforce_driver.protocol import Flag, Move, Reply
from finforce_driver.verdict import GRACE, TOLERANCE

LASTING = 3  # replies: what the gripper was told may cross with what it says


class Echo(Enum):
    """How the gripper follows its order."""

    FOLLOWS = auto()
    UNHEARD = auto()  # it never did: the order was probably lost
    OVERRULED = auto()  # it did before: somebody else gave it another one


class EchoWatch:
    """Looks whether the gripper does what it was told."""

    def __init__(self) -> None:
        self._order: Move | None = None
        self._sent = 0.0
        self._heard = False
        self._odd = 0

    def send(self, order: Move, now: float) -> None:
        """Note an order that was answered."""
        if order != self._order:
            self._heard = False
        self._order, self._sent, self._odd = order, now, 0

    def forget(self) -> None:
        """Expect nothing."""
        self._order = None

    def take(self, reply: Reply, now: float) -> Echo:
        """Judge a believed reply."""
        if self._order is None or now - self._sent < GRACE:
            return Echo.FOLLOWS
        if _fits(self._order, reply):
            self._heard, self._odd = True, 0
            return Echo.FOLLOWS
        self._odd += 1
        if self._odd < LASTING:
            return Echo.FOLLOWS
        self._odd = 0
        return Echo.OVERRULED if self._heard else Echo.UNHEARD


def _fits(order: Move, reply: Reply) -> bool:
    """Return whether a reply echoes an order's flags and is not at another target than the order's."""
    told = bool(order.flags & Flag.ACTIVATE), bool(order.flags & Flag.GO)
    if (reply.activated, reply.action) != told:
        return False
    elsewhere = abs(reply.position - order.position) > TOLERANCE + 1
    return not (order.drives and reply.at_target and elsewhere)
