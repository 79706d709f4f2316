"""An executor of rclpy that keeps its wait set while nothing comes or goes.

It saves the nodes of a robot 5 % of a core in a grasp and 2 % while idle, of some 20 % (docs/skipping.md).
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from time import monotonic, sleep
from typing import Any, NamedTuple

from rclpy.callback_groups import MutuallyExclusiveCallbackGroup, ReentrantCallbackGroup
from rclpy.exceptions import InvalidHandle
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.logging import get_logger
from rclpy.node import Node
from rclpy.subscription import Subscription
from rclpy.timer import Timer

from finforce.skipping import UNCHANGED, UNHEARD, Skips

MOST_AT_ONCE = 20  # messages of one topic, after which the others have their turn
EVENTS_EVERY = 1.0  # s; events of the middleware, as of a connection that does not come about, are the base's
LEAST_SLEEP = 2e-3  # s; to fall asleep and wake up takes time, too
GROUPS = (MutuallyExclusiveCallbackGroup, ReentrantCallbackGroup)  # that are free while no coroutine is under way
ADDERS = {
    "subscriptions": "add_subscription",
    "timers": "add_timer",
    "clients": "add_client",
    "services": "add_service",
}


def is_wanted(publisher: Any, skips: Skips) -> bool:
    """Say whether a message has to be made for a topic; where nobody subscribes that is counted, and it has not."""
    wanted = publisher.get_subscription_count() > 0 or not skips.allows(UNHEARD)
    if not wanted:
        skips.count(UNHEARD)
    return wanted


class _UnknownRclpyError(Exception):
    """What the executor reads of rclpy's inside is not there, or something else."""


class KeepingExecutor(SingleThreadedExecutor):
    """Answers as its base does, for half of the time or less.

    The base makes a list and a wait set of all that a node has, twice for each message. Here both are kept until the
    node says that something came or went; messages and timers go to plain callbacks at once. Whatever else is ready, as
    a service or a coroutine under way, is left to the base, and so is a node with actions. A connection that does not
    come about is noticed with a timer, once a second. While a node has time to spare, all of that waits.

    It reads what rclpy promises nobody. Where a release of rclpy has that otherwise, it says so once and is its base.

    Args:
        context: of rclpy.
    """

    def __init__(self, *, context: Any = None) -> None:
        super().__init__(context=context)
        self._skips: Sequence[Skips] = ()
        self._spare_time: Callable[[], float] = lambda: 0.0
        self._kept: _KeptSet | None = None
        self._look_at_events = 0.0
        self._is_strange = False

    def obey(self, nodes: Sequence[Any]) -> None:
        """Ask nodes' `skips` whether the wait set may be kept, a single one's `spare_time` [s] how long it may wait."""
        self._skips = [node.skips for node in nodes if hasattr(node, "skips")]
        if len(nodes) == 1:
            self._spare_time = getattr(nodes[0], "spare_time", self._spare_time)

    def spin_once(self, timeout_sec: float | None = None) -> None:
        """Wait for work and do it; with a time limit [s] as the base does."""
        if timeout_sec is not None or self._is_strange or not self._may_keep():
            super().spin_once(timeout_sec)
            return
        try:
            self._spin_kept()
        except _UnknownRclpyError as error:
            self._be_base(error)

    def _may_keep(self) -> bool:
        return all(skips.allows(UNCHANGED) for skips in self._skips)

    def _spin_kept(self) -> None:
        """Wait with the kept wait set and do what is ready."""
        with self._own_work():
            is_foreign = self._is_busy() or self._keep().is_foreign
        if is_foreign:
            super().spin_once()
            return
        if (spare := self._spare_time()) > LEAST_SLEEP:
            sleep(spare)  # what comes meanwhile is taken at once
        with self._own_work():
            ready = self._keep().wait((self._guard.handle, self._sigint_gc.handle))
            is_changed = self._guard.handle.pointer in ready.guards
        if not self.context.ok():
            raise ExternalShutdownException
        if is_changed:
            self._release()  # something came or went
        for subscription in ready.messages:
            if self.can_execute(subscription):
                self._hand_over(subscription)
        for timer in ready.timers:
            self._tick(timer)
        if ready.has_more or (ready.timers and monotonic() >= self._look_at_events):
            self._look_at_events = monotonic() + EVENTS_EVERY
            super().spin_once(0.0)

    @contextmanager
    def _own_work(self) -> Iterator[None]:
        """Mark what is done with rclpy's inside: an error there is none of a node's, unless rclpy ends."""
        try:
            yield
        except InvalidHandle:
            raise  # it was taken away meanwhile
        except Exception as error:
            if not self.context.ok():
                raise
            raise _UnknownRclpyError(f"{type(error).__name__}: {error}") from error

    def _be_base(self, error: _UnknownRclpyError) -> None:
        """Say why nothing is kept, and keep nothing from now on."""
        self._is_strange = True
        with suppress(Exception):
            self._release()
        self._kept = None
        get_logger("finforce").warning(f"this rclpy is another one than expected, '{UNCHANGED}' is off: {error}")

    def _keep(self) -> _KeptSet:
        """Return the wait set, made now if there is none."""
        self._kept = self._kept or _KeptSet(self.get_nodes(), self.context)
        return self._kept

    def _is_busy(self) -> bool:
        """Say whether a coroutine is under way, and forget those that are done."""
        with self._tasks_lock:
            self._tasks = [entry for entry in self._tasks if not entry[0].done()]
            return bool(self._tasks)

    def _hand_over(self, subscription: Subscription) -> None:
        """Call back with all messages that wait, until the subscription is gone or its group busy."""
        for _ in range(MOST_AT_ONCE):
            if (taken := self._take(subscription)) is None:
                return
            for skips in self._skips[:1]:
                skips.count(UNCHANGED)
            subscription.callback(taken[0])
            if not self.can_execute(subscription):
                return

    def _take(self, subscription: Subscription) -> tuple[Any, Any] | None:
        """Return a message that waits, with what is known of it; None without one, or when the subscription is gone."""
        with suppress(InvalidHandle), (handle := subscription.handle), self._own_work():
            return handle.take_message(subscription.msg_type, subscription.raw)
        return None

    def _tick(self, timer: Timer) -> None:
        """Call back for a timer, unless a callback before has put it off or taken it away."""
        is_due = False
        with suppress(InvalidHandle), (handle := timer.handle), self._own_work():
            is_due = handle.is_timer_ready() and self.can_execute(timer)
            if is_due:
                handle.call_timer()
        if is_due:
            timer.callback()

    def remove_node(self, node: Node) -> None:
        """Let go of a node and of all that it has."""
        self._release()
        super().remove_node(node)

    def shutdown(self, timeout_sec: float | None = None) -> bool:
        """End; see the base."""
        self._release()
        return super().shutdown(timeout_sec)

    def _release(self) -> None:
        if self._kept is not None:
            self._kept.release()
            self._kept = None


class _Ready(NamedTuple):
    """What a wait has ended with: what has plain callbacks, pointers of guards, whether there is more."""

    messages: Sequence[Subscription]
    timers: Sequence[Timer]
    guards: Collection[int]
    has_more: bool


class _KeptSet:
    """What nodes have, and a wait set large enough for it.

    Attributes:
        is_foreign: whether there is something that only the base can wait for.
    """

    def __init__(self, nodes: Sequence[Node], context: Any) -> None:
        from rclpy.event_handler import EventHandler  # not all releases have them
        from rclpy.impl.implementation_singleton import rclpy_implementation

        waitables = [item for node in nodes for item in node.waitables]
        foreign = [item for item in waitables if not isinstance(item, EventHandler)]
        self.is_foreign = bool(foreign) or any(True for node in nodes for _ in node.guards)
        self._stack = ExitStack()
        found = {kind: [item for node in nodes for item in getattr(node, kind) if self._hold(item)] for kind in ADDERS}
        sizes = {kind: len(items) for kind, items in found.items()}
        self._set = rclpy_implementation.WaitSet(
            sizes["subscriptions"], 2, sizes["timers"], sizes["clients"], sizes["services"], 0, context.handle
        )
        entities = [(item, getattr(self._set, ADDERS[kind])) for kind, items in found.items() for item in items]
        self._adds = [(add, item.handle) for item, add in entities if type(item.callback_group) in GROUPS]
        self._gated = [(item, add) for item, add in entities if type(item.callback_group) not in GROUPS]
        self._plain = {item.handle.pointer: item for item in found["subscriptions"] if _is_plain(item)}
        timers = [item for item in found["timers"] if not inspect.iscoroutinefunction(item.callback)]
        self._timers = {item.handle.pointer: item for item in timers}

    def _hold(self, entity: Any) -> bool:
        """Keep an entity's handle until `release`; return whether it still had one."""
        try:
            self._stack.enter_context(entity.handle)
        except InvalidHandle:
            return False
        return True

    def release(self) -> None:
        """Let go of all handles."""
        self._stack.close()

    def wait(self, guards: Sequence[Any]) -> _Ready:
        """Wait until something is ready, or a guard is triggered."""
        waiting = self._set
        waiting.clear_entities()
        for guard in guards:
            waiting.add_guard_condition(guard)
        for add, handle in self._adds:
            add(handle)
        for entity, add in self._gated:
            if entity.callback_group.can_execute(entity):
                add(entity.handle)
        waiting.wait(-1)
        look = waiting.get_ready_entities
        pointers, due = look("subscription"), look("timer")
        messages = [self._plain[pointer] for pointer in pointers if pointer in self._plain]
        timers = [self._timers[pointer] for pointer in due if pointer in self._timers]
        is_all = len(messages) == len(pointers) and len(timers) == len(due)
        return _Ready(messages, timers, look("guard_condition"), not is_all or any(map(look, ("client", "service"))))


def _is_plain(subscription: Subscription) -> bool:
    """Whether a callback takes the message alone, and is done when it returns."""
    takes_message = subscription._callback_type is Subscription.CallbackType.MessageOnly
    return takes_message and not inspect.iscoroutinefunction(subscription.callback)
