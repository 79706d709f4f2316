"""Pairs requests with their replies, one at a time, and gets back into step after a lost one."""

from __future__ import annotations

import math
from dataclasses import dataclass

from finforce_driver.can.protocol import CanMessage, Command, Move, encode_request, split_identifier

LENGTHS = {
    Command.REPLY: 4,
    Command.PING: 0,
    Command.TEMPERATURE: 2,
    Command.SUPPLY: 2,
    Command.ERRORS: 2,
    Command.CURRENT: 2,
    Command.ENCODER: 8,
}
# asked in turn, so that the late answer to one is not taken for the answer to the next
MARKERS = (Command.PING, Command.CURRENT, Command.ENCODER, Command.ERRORS)
UNANSWERED_PAUSE = 0.001  # [s] for the gripper to take a message that it does not answer: it keeps three at most
TRIES = 2  # with markers before the first answer to one: an adapter may know no remote messages


@dataclass(frozen=True, kw_only=True)
class Request:
    """A message to be sent.

    Attributes:
        message: it.
        answer: command of the message that answers it; None when none does.
        node: that answers.
        move: the order in it, where there is one.
        counted: whether silence says that the gripper does not answer.
    """

    message: CanMessage
    answer: Command | None = None
    node: int = 0
    move: Move | None = None
    counted: bool = True


class Exchange:
    """One request at a time.

    A reply that comes after its time-out would be taken for the one to the next request, and every later one with it.
    After a silence the gripper is asked for something else, whose answer says that nothing older is on the way.

    Attributes:
        pending: request whose reply is waited for.
        sent: when the last request was sent [s].
        free: from when the next one may be sent [s].
        misses: requests in a row without a reply.
        latency: from the last request to its reply [s]; NaN before the first.
    """

    def __init__(self, node: int) -> None:
        self.pending: Request | None = None
        self.sent = math.nan
        self.free = -math.inf
        self.misses = 0
        self.latency = math.nan
        self._node = node
        self._tries = 0
        self._marker = 0
        self._marks = self._rested = False

    @property
    def in_step(self) -> bool:
        """Whether the next reply belongs to the next request."""
        return self._tries == 0

    def begin(self, request: Request, now: float) -> None:
        """Note that a request is sent."""
        self.pending = request if request.answer is not None else None
        self.sent = now
        self.free = now if request.answer is not None else now + UNANSWERED_PAUSE

    def answers(self, message: CanMessage) -> bool:
        """Return whether a message is the reply that is waited for."""
        request, address = self.pending, split_identifier(message.id)
        return (
            request is not None
            and not message.remote
            and (address.node, address.command) == (request.node, request.answer)
            and len(message.data) == LENGTHS[request.answer]
        )

    def end(self, now: float) -> Request:
        """Note the reply and return its request."""
        request, self.pending = self.pending, None
        self.latency = now - self.sent
        if request.counted and request.node == self._node:
            self.misses = 0
        self._marks |= request.message.remote and request.node == self._node
        if request.node == self._node and (request.answer is MARKERS[self._marker] or self._rested):
            self._tries, self._rested = 0, False
        return request

    def miss(self) -> Request | None:
        """Note that no reply came and return the request."""
        request, self.pending = self.pending, None
        if request is not None and request.counted:
            self.misses += 1
            self._tries += 1
            self._marker = (self._marker + 1) % len(MARKERS)
            self._rested = False
        return request

    def marker(self) -> Request | None:
        """Return the request that gets us back into step; None when in step, or when that is not answered."""
        if self.in_step or not (self._marks or self._tries <= TRIES):
            return None
        command = MARKERS[self._marker]
        return Request(message=encode_request(self._node, command), answer=command, node=self._node)

    def rest(self) -> None:
        """Note that so long a pause was made that nothing older can be on the way: the next reply puts us in step."""
        self._rested = True

    def reset(self) -> None:
        """Begin anew on a link that was opened anew."""
        self.pending = None
        self.misses = self._tries = 0
        self._marks = self._rested = False
