"""What became of a move, by the replies since it was sent; knows no frames."""

from __future__ import annotations

from dataclasses import dataclass

from finforce_driver.protocol import Reply
from finforce_driver.state import Outcome

GRACE = 0.05  # [s] after a move in which its replies may still speak of the one before
CONTACT_TIME = 0.1  # [s] and
CONTACT_REPLIES = 5  # replies that a contact must last
REACHED_REPLIES = 2
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

    def send(self, now: float) -> None:
        """Note that a frame of the move was sent: what comes soon after is of the one before."""
        self._sent = now
        self._contact, self._arrivals = None, 0

    def delay(self, now: float) -> None:
        """Note that the move got on: its time begins anew."""
        self._deadline = now + self._allowed

    def take(self, reply: Reply, now: float, final: bool) -> Outcome:
        """Return what became of the move; NONE while it is under way.

        Args:
            reply: the newest one that is believed.
            now: when it came [s].
            final: whether the gripper was sent to the end of the move, not to a step on the way.
        """
        if now - self._sent < GRACE:
            return Outcome.NONE
        self._follow_contact(reply, now)
        contact = self._contact
        if contact and now - contact.since >= CONTACT_TIME and contact.replies >= CONTACT_REPLIES:
            return self._judge_contact(reply)
        there = reply.at_target and abs(reply.position - self._position) <= TOLERANCE
        self._arrivals = self._arrivals + 1 if there and final else 0
        if self._arrivals >= REACHED_REPLIES:
            return Outcome.REACHED
        return Outcome.TIMED_OUT if now > self._deadline else Outcome.NONE

    def _follow_contact(self, reply: Reply, now: float) -> None:
        """Keep how long a contact lasts at one place."""
        kept = self._contact
        if not reply.contact:
            self._contact = None
            return
        if kept is None or abs(reply.position - kept.position) > 1:
            kept = _Contact(since=now, position=reply.position, replies=0)
        self._contact = _Contact(since=kept.since, position=kept.position, replies=kept.replies + 1)

    def _judge_contact(self, reply: Reply) -> Outcome:
        """Return what a lasting contact means."""
        if push_direction(reply, self.closing) > 0:
            return Outcome.CLOSED_EMPTY if reply.position >= CLOSED else Outcome.GRASPED
        return Outcome.REACHED if max(reply.position, self._position) <= OPENED else Outcome.BLOCKED
