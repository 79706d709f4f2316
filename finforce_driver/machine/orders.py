"""The 5-byte order that the gripper shall have and the one that it is known to have."""

from __future__ import annotations

from dataclasses import replace

from finforce_driver.can.protocol import FREE_FLAGS, Flag, Move

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
