"""An executor of one thread that waits for what it waited for last."""

from __future__ import annotations

from contextlib import suppress
from inspect import iscoroutinefunction
from time import monotonic
from typing import Any, NamedTuple

from rclpy.event_handler import EventHandler
from rclpy.exceptions import InvalidHandle
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor, TimeoutException
from rclpy.impl.implementation_singleton import rclpy_implementation as rcl
from rclpy.logging import get_logger
from rclpy.node import Node
from rclpy.task import Task

_KINDS = ("timer", "subscription", "guard_condition", "client", "service")
_LOOK_PERIOD = 1.0  # [s] between two looks of rclpy's own executor while messages come


class _Watched(NamedTuple):
    """What is waited for: a wait set, handles by the method that adds them to it, and plain callbacks by address."""

    has_actions: bool
    wait_set: Any
    handles: dict[str, list[Any]]
    guards: list[Any]
    timers: dict[int, Any]
    subscriptions: dict[int, Any]


class TolerantExecutor(SingleThreadedExecutor):
    """Takes messages and timers without a look through all entities of all nodes each time.

    rclpy gathers the entities and builds a wait set with every message, for a fifth of a pipeline's time. While
    messages come, those and timers are waited for here, in a set that lasts until an entity comes or goes. All else is
    left to rclpy as soon as it is ready, events once in a second. Without messages, rclpy works alone.

    Bytes that are no message of their topic's type are dropped; rclpy's own executor would end with the node.
    """

    def __init__(self, **options: Any) -> None:
        """Take the options of rclpy's executors."""
        self._watched: _Watched | None = None
        self._is_busy, self._has_taken, self._look_at = False, False, 0.0
        super().__init__(**options)

    def wake(self) -> None:
        """Gather the entities anew, as a node asks where one has come or gone, and see who need not await any more."""
        self._watched, self._look_at = None, 0.0
        super().wake()

    def add_node(self, node: Node) -> bool:
        """Take a node; False if it was there."""
        self._watched = None
        return super().add_node(node)

    def create_task(self, callback: Any, *args: Any, **options: Any) -> Task:
        """Take a callback or coroutine to be worked on at once."""
        self._look_at = 0.0
        return super().create_task(callback, *args, **options)

    def _take_subscription(self, sub: Any) -> Any:
        """Return what calls back with a message; nothing for one that the middleware cannot read."""
        self._is_busy = self._has_taken = True
        try:
            return super()._take_subscription(sub)
        except RuntimeError as error:
            get_logger("finforce").warning(f"dropped a message on {sub.topic_name}: {error}", throttle_duration_sec=2.0)
            return None

    def _spin_once_impl(self, timeout_sec: Any = None, *conditions: Any) -> None:
        """Work on what is ready, or wait for a time [s]."""
        if not self._context.ok():
            raise ExternalShutdownException()
        is_plain = not conditions and (timeout_sec is None or isinstance(timeout_sec, float | int))
        if not (is_plain and self._is_busy):
            return super()._spin_once_impl(timeout_sec, *conditions)
        if (left := self._look_at - monotonic()) <= 0.0:
            self._is_busy, self._has_taken = self._has_taken, False
            self._look_at = monotonic() + _LOOK_PERIOD
            return self._look()
        self._work(left if timeout_sec is None or timeout_sec < 0.0 else min(timeout_sec, left))
        return None

    @property
    def _awaits(self) -> bool:
        """True if a callback awaits something."""
        return any(not task.done() for task, *_ in self._tasks)

    def _look(self) -> None:
        """Let rclpy work on all that is ready, once."""
        self._cb_iter = None
        with suppress(TimeoutException):
            while True:
                handler, *_ = self.wait_for_ready_callbacks(0.0)
                handler()
                handler.result()

    def _work(self, timeout: float) -> None:
        """Call back with the messages and timers that are ready within a time [s]."""
        watched = self._watched or self._watch()
        self._watched = None if self._awaits else watched
        if watched.has_actions:  # which are to be heard at once
            self._is_busy = False
            return
        try:
            ready = self._wait(watched, timeout)
        except InvalidHandle:
            self._watched = None
            return
        for guard in watched.guards:
            guard._executor_triggered |= guard.handle.pointer in ready["guard_condition"]
        left = {address for addresses in ready.values() for address in addresses}
        left.discard(self._guard.handle.pointer)  # rclpy's own callbacks trigger it, too; `wake` says so itself
        for address, timer in watched.timers.items():
            if address in left and timer.handle.is_timer_ready():
                _call(self._take_timer(timer))
        for address, subscription in watched.subscriptions.items():
            if address in left:
                _call(self._take_subscription(subscription))
        if not left <= watched.timers.keys() | watched.subscriptions.keys():
            self._look_at = 0.0

    def _wait(self, watched: _Watched, timeout: float) -> dict[str, list[int]]:
        """Return the addresses of what is ready within a time [s], by kind."""
        wait_set = watched.wait_set
        wait_set.clear_entities()
        for add, handles in watched.handles.items():
            for handle in handles:
                getattr(wait_set, add)(handle)
        wait_set.wait(round(1e9 * timeout))
        if not self._context.ok():
            raise ExternalShutdownException()
        return {kind: wait_set.get_ready_entities(kind) for kind in _KINDS}

    def _watch(self) -> _Watched:
        """Gather what is waited for: all but what shares its callback group with one who awaits."""
        nodes = self.get_nodes()

        def gather(kind: str) -> list[Any]:
            return [entity for node in nodes for entity in getattr(node, kind) if self.can_execute(entity)]

        timers, subscriptions = gather("timers"), gather("subscriptions")
        guards, clients, services = gather("guards"), gather("clients"), gather("services")
        handles = {
            "add_subscription": [each.handle for each in subscriptions],
            "add_guard_condition": [each.handle for each in (*guards, self._guard, self._sigint_gc)],
            "add_timer": [each.handle for each in timers],
            "add_client": [each.handle for each in clients],
            "add_service": [each.handle for each in services],
        }
        counts = *map(len, handles.values()), 0
        plain = {
            kind: {each.handle.pointer: each for each in entities if not iscoroutinefunction(each.callback)}
            for kind, entities in (("timers", timers), ("subscriptions", subscriptions))
        }
        has_actions = not all(isinstance(each, EventHandler) for node in nodes for each in node.waitables)
        return _Watched(has_actions, rcl.WaitSet(*counts, self._context.handle), handles, guards, **plain)


def _call(callback: Any) -> None:
    """Run the coroutine function of an entity that was taken, which awaits nothing; None: nothing was there."""
    if callback is not None:
        with suppress(StopIteration):
            callback().send(None)
