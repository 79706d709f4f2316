"""Several nodes in one process: messages go from one to the next as they are, and a fault stops one of them alone."""

from __future__ import annotations

import inspect
import traceback
from collections import deque
from collections.abc import Callable
from statistics import median
from time import perf_counter
from typing import Any

from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.subscription import Subscription

from finforce.ros.messages import pack

BUDGET = 5e-3  # [s] that a stage may take before those that could go on without it do
WATCHED = 15  # messages over which that is judged


class Stage:
    """One node of several in a process.

    Attributes:
        fault: what has stopped it, empty while it works.

    Args:
        pipeline: of the process.
    """

    def __init__(self, pipeline: Pipeline) -> None:
        self.pipeline, self.fault = pipeline, ""
        self._node: Node | None = None

    def guard(self, node: Node, callback: Callable) -> Callable:
        """Return a callback whose failure stops this stage alone, and that does nothing from then on."""
        self._node = node
        if inspect.iscoroutinefunction(callback):

            async def wait(*words: Any) -> Any:
                try:
                    return None if self.fault else await callback(*words)
                except Exception as error:
                    return self._stop(error)

            return wait

        def call(*words: Any) -> Any:
            try:
                return None if self.fault else callback(*words)
            except Exception as error:
                return self._stop(error)

        return call

    def _stop(self, error: Exception) -> None:
        """Stop for an error, unless the process ends anyway."""
        if not self._node.context.ok():
            raise error
        self.fault = f"{type(error).__name__}: {error}"
        self._node.get_logger().error(f"this stage has stopped, the others go on\n{traceback.format_exc()}")


class Port:
    """A subscription of a stage, to another stage of the process or to what comes from outside.

    Args:
        stage: that it belongs to.
        topic: its full name.
        callback: takes messages, guarded.
        subscribe: makes the subscription to what comes from outside.
        drop: ends that.
        can_wait: whether the process goes on without it where it takes too long.
    """

    def __init__(
        self,
        stage: Stage,
        topic: str,
        callback: Callable,
        subscribe: Callable[[], Subscription],
        drop: Callable[[Subscription], Any],
        *,
        can_wait: bool = False,
    ) -> None:
        self.topic, self._stage, self._callback = topic, stage, callback
        self._subscribe, self._drop = subscribe, drop
        self._can_wait = can_wait
        self._times: deque[float] = deque(maxlen=WATCHED)
        self._is_open = True
        self.outside: Subscription | None = None

    def connect(self) -> None:
        """Subscribe to what comes from outside, if no stage of this process publishes it."""
        if self._is_open and not self._stage.pipeline.publishes(self.topic):
            self.outside = self._subscribe()

    def close(self) -> None:
        """Take nothing more."""
        self._is_open = False
        self._stage.pipeline.remove(self)
        if self.outside is not None:
            self._drop(self.outside)
            self.outside = None

    @property
    def is_slow(self) -> bool:
        """Whether it takes more than its budget, and others need not wait for it."""
        return self._can_wait and len(self._times) == WATCHED and median(self._times) > BUDGET

    def take(self, message: Any) -> None:
        """Take a message of another stage."""
        before = perf_counter()
        self._callback(message)
        self._times.append(perf_counter() - before)


class Outlet:
    """A publisher of a stage: to other stages as it is, to listeners outside serialised, where there are any.

    Args:
        pipeline: of the process.
        topic: its full name.
        publisher: to the outside.
        qos: what it keeps for listeners that come later.
    """

    def __init__(self, pipeline: Pipeline, topic: str, publisher: Publisher, qos: QoSProfile) -> None:
        self._pipeline, self._topic, self._publisher = pipeline, topic, publisher
        self._is_kept = qos.durability == DurabilityPolicy.TRANSIENT_LOCAL

    def publish(self, message: Any) -> None:
        """Publish a message."""
        self._pipeline.hand_on(self._topic, message)
        if self._is_kept or self._publisher.get_subscription_count():
            self._publisher.publish(pack(message))

    def get_subscription_count(self) -> int:
        """Return how many listen, here and outside."""
        return len(self._pipeline.ports(self._topic)) + self._publisher.get_subscription_count()


class Pipeline:
    """The stages of one process, and the topics between them.

    A message is taken by all stages that wait for it before its publisher goes on, so that an image is through once the
    first stage has done with it. Of a stage that takes more than its budget the others do not wait: it has its turn
    after them, with the newest message.
    """

    def __init__(self) -> None:
        self._ports: dict[str, list[Port]] = {}
        self._topics: set[str] = set()
        self._waiting: dict[Port, Any] = {}
        self._left: deque[Callable[[], None]] = deque()
        self._delayed: list[Callable[[], None]] = []
        self._is_open = False
        self._depth = 0

    def publishes(self, topic: str) -> bool:
        """Say whether a stage publishes a topic."""
        return topic in self._topics

    def ports(self, topic: str) -> list[Port]:
        """Return who takes a topic's messages from another stage."""
        return self._ports.get(topic, []) if topic in self._topics else []

    def add(self, port: Port) -> Port:
        """Take a subscription; before `open` it waits for who may publish."""
        self._ports.setdefault(port.topic, []).append(port)
        self.when_open(port.connect)
        return port

    def when_open(self, connect: Callable[[], None]) -> None:
        """Do something once all stages are there."""
        if self._is_open:
            connect()
        else:
            self._delayed.append(connect)

    def remove(self, port: Port) -> None:
        """Forget a subscription."""
        if port in (kept := self._ports.get(port.topic, [])):
            kept.remove(port)
        self._waiting.pop(port, None)

    def outlet(self, topic: str, publisher: Publisher, qos: QoSProfile) -> Outlet:
        """Return what publishes a topic, inside and outside."""
        self._topics.add(topic)
        return Outlet(self, topic, publisher, qos)

    def open(self) -> None:
        """Connect the stages, all of which are there."""
        self._is_open = True
        while self._delayed:
            self._delayed.pop(0)()

    def hand_on(self, topic: str, message: Any) -> None:
        """Give a message to the stages that take it."""
        for port in tuple(self._ports.get(topic, ())):
            if port.outside is not None or not self._is_open:
                continue
            if port.is_slow:
                self._waiting[port] = message
            else:
                port.take(message)

    def turn(self, callback: Callable) -> Callable:
        """Return a callback for messages, after which those have their turn that nobody waited for."""
        if inspect.iscoroutinefunction(callback):
            return callback

        def call(message: Any) -> None:
            self._depth += 1
            try:
                callback(message)
            finally:
                self._depth -= 1
                self._catch_up()

        return call

    def afterwards(self, action: Callable[[], None]) -> None:
        """Do something once the outermost callback has returned."""
        self._left.append(action)
        self._catch_up()

    def _catch_up(self) -> None:
        while self._waiting and not self._depth:
            port, message = self._waiting.popitem()
            port.take(message)
        while self._left and not self._depth:
            self._left.popleft()()
