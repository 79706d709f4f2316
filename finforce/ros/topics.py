"""The topics of nodes, also of several in one process: there messages go from one to the next as they are."""

from __future__ import annotations

import inspect
import traceback
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from copy import copy
from dataclasses import dataclass, field
from functools import partial
from math import inf
from statistics import median
from time import monotonic, perf_counter
from typing import Any

from numpy.typing import NDArray
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.clock import Clock, ClockType
from rclpy.event_handler import PublisherEventCallbacks, SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, QoSCompatibility, QoSProfile, ReliabilityPolicy, qos_check_compatible
from rclpy.qos_overriding_options import QoSOverridingOptions
from rclpy.subscription import Subscription
from rclpy.timer import Timer
from sensor_msgs.msg import CompressedImage, Image
from std_msgs.msg import Header

from finforce.camera_topics import COMPRESSED, COMPRESSED_COLOR, ENDS, RAW
from finforce.health import UNHEARD, Skips
from finforce.messages import NANOSECONDS, CloudColumns
from finforce.ros.messages import pack
from finforce.ros.tracing import note

STEADY_CLOCK = Clock(clock_type=ClockType.STEADY_TIME)
SENSOR = QoSProfile(depth=5, reliability=ReliabilityPolicy.BEST_EFFORT)
BUFFERED = QoSProfile(depth=20, reliability=ReliabilityPolicy.BEST_EFFORT)  # a tenth of a second, and more
NEWEST = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)  # whoever is slow misses what was overtaken
RESULT = QoSProfile(depth=10, reliability=ReliabilityPolicy.RELIABLE)
STEADY = QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE)  # the newest alone
REQUESTS = QoSProfile(depth=100, reliability=ReliabilityPolicy.RELIABLE)  # one that is passed over waits for ever
LATCHED = QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL)

_OVERRIDABLE = QoSOverridingOptions.with_default_policies()  # by the parameters qos_overrides.TOPIC...

BUDGET = 5e-3  # [s] that a stage may take before those that could go on without it do
WATCHED = 15  # messages over which that is judged
_LOOKED_FOR, _AT_REST = 0.2, 1.0  # [s] between looks at who publishes, and at whether images are wanted
_MOST_WAITING = 1000  # messages, more than any queue keeps


class Pipeline:
    """The topics between the nodes of one process, which are its stages.

    A message is taken by all stages that wait for it before its publisher goes on, so that an image is through once the
    first stage has done with it. Of a stage that takes more than its budget the others do not wait: it has its turn
    after them, with the newest message. Messages go, and come from outside, as far as answers are needed: of whom
    somebody outside listens to, and of whom a stage hears that is needed itself.

    Args:
        is_shared: True if there are several nodes; they are connected by `open`, and a fault stops one of them alone.

    Attributes:
        stages: of its nodes.
        spare: time between the callback before and the one at work, for which the process had nothing to do [s].
    """

    def __init__(self, is_shared: bool = True) -> None:
        self.is_shared, self._is_open = is_shared, not is_shared
        self.stages: list[Stage] = []
        self._ports: dict[str, list[Port]] = {}
        self._sources: dict[str, Stage] = {}
        self._waiting: dict[Port, Any] = {}
        self._left: deque[Callable[[], None]] = deque()
        self._looks: list[Callable[[], None]] = []
        self._timers: list[Timer] = []
        self._delayed: list[Callable[[], None]] = []
        self._depth, self._ended, self.spare = 0, perf_counter(), 0.0

    def publishes(self, topic: str) -> bool:
        """Say whether a stage publishes a topic."""
        return topic in self._sources

    def count_ports(self, topic: str) -> int:
        """Return how many stages take a topic's messages from another one now."""
        return sum(port.is_open for port in self._ports.get(topic, ())) if topic in self._sources else 0

    def add(self, port: Port) -> Port:
        """Take a subscription; before `open` it waits for who may publish."""
        self._ports.setdefault(port.topic, []).append(port)
        self.when_open(lambda: port.stage.look(port.follow))
        return port

    def look(self, node: Node, action: Callable[[], None]) -> None:
        """Do something now, every so often, and when somebody begins to listen to a stage that rests."""
        self._find_needed()
        action()
        self._looks.append(action)
        if len(self._looks) == 1:
            self._looking = self.call_every(_LOOKED_FOR, node, self.look_again)

    def look_again(self) -> None:
        """Find out which stages are needed, and do what depends on it."""
        self._find_needed()
        for look in self._looks:
            look()
        is_awake = any(stage.is_needed for stage in self.stages)
        period = round((_LOOKED_FOR if is_awake else _AT_REST) * NANOSECONDS)
        if self._looking.timer_period_ns != period:
            self._looking.timer_period_ns = period
            self._looking.reset()

    def _find_needed(self) -> None:
        """Find the stages that are needed: from those that need images themselves back to their sources."""
        before = [stage.is_needed for stage in self.stages]
        for stage in self.stages:
            stage.is_needed = False
        left = [stage for stage in self.stages if stage.needs_images()]
        while left:
            stage = left.pop()
            if not stage.is_needed:
                stage.is_needed = True
                own = [port for ports in self._ports.values() for port in ports if port.stage is stage]
                left += [self._sources[port.topic] for port in own if port.topic in self._sources and port.is_wanted()]
        for stage, was_needed in zip(self.stages, before, strict=True):
            if stage.is_needed != was_needed:
                stage.turned()

    def call_every(self, period: float, node: Node, action: Callable[[], Any]) -> Timer:
        """Do something every `period` seconds, whatever /clock says, from `open` on in step: each wake is dear."""
        self._timers.append(node.create_timer(period, action, clock=STEADY_CLOCK))
        return self._timers[-1]

    def when_open(self, connect: Callable[[], None]) -> None:
        """Do something once all stages are there."""
        if self._is_open:
            connect()
        else:
            self._delayed.append(connect)

    def outlet(self, stage: Stage, topic: str, publisher: Publisher, qos: QoSProfile) -> Outlet:
        """Return what publishes a stage's topic, inside and outside."""
        self._sources[topic] = stage
        return Outlet(self, topic, publisher, qos.durability == DurabilityPolicy.TRANSIENT_LOCAL)

    def open(self) -> None:
        """Connect the stages, all of which are there."""
        self._is_open = True
        while self._delayed:
            self._delayed.pop(0)()
        for timer in self._timers:
            timer.reset()

    def hand_on(self, topic: str, message: Any) -> None:
        """Give a message to the stages that take it."""
        for port in tuple(self._ports.get(topic, ())):
            if port.outside is not None or not port.is_open:
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
            if not self._depth:
                self.spare = perf_counter() - self._ended
            self._depth += 1
            try:
                callback(message)
            finally:
                self._depth -= 1
                self._catch_up()
                self._ended = perf_counter()

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


@dataclass(eq=False)
class Port:
    """A subscription, to another stage of the process or to what comes from outside.

    Attributes:
        stage: whose it is.
        topic: its full name.
        callback: takes messages, guarded.
        subscribe: makes the subscription to what comes from outside.
        is_contested: says whether several nodes outside publish the topic, whose messages are then dropped.
        is_wanted: says whether messages are wanted now.
        can_wait: True if a process of several nodes may go on without it where it takes too long.
        is_open: True if they were when that was last asked.
        outside: the subscription to what comes from outside; None while there is none.
    """

    stage: Stage
    topic: str
    callback: Callable
    subscribe: Callable[[], Subscription]
    is_contested: Callable[[], bool]
    is_wanted: Callable[[], bool]
    can_wait: bool = field(default=False, init=False)
    is_open: bool = field(default=False, init=False)
    outside: Subscription | None = field(default=None, init=False)
    _times: deque[float] = field(default_factory=lambda: deque(maxlen=WATCHED), init=False)

    def follow(self) -> None:
        """Take messages while they are wanted: from outside, if no stage of this process publishes them."""
        self.is_open = self.is_wanted()
        is_outside = self.is_open and not self.stage.pipeline.publishes(self.topic)
        if is_outside and self.outside is None:
            self.outside = self.subscribe()
        elif not is_outside and self.outside is not None:
            self.stage.node.destroy_subscription(self.outside)
            self.outside = None

    @property
    def is_slow(self) -> bool:
        """True if it takes more than its budget, and others need not wait for it."""
        return self.can_wait and len(self._times) == WATCHED and median(self._times) > BUDGET

    def take(self, message: Any) -> None:
        """Take a message of another stage."""
        before = perf_counter()
        self.callback(message)
        self._times.append(perf_counter() - before)

    def take_waiting(self) -> Iterator[Any]:
        """Yield the messages that wait to be taken, which would have their turn later; malformed ones are dropped.

        Of another stage of the same process nothing ever waits.
        """
        if self.outside is None:
            return
        is_contested = self.is_contested()
        with (handle := self.outside.handle):
            for _ in range(_MOST_WAITING):
                try:
                    taken = handle.take_message(self.outside.msg_type, self.outside.raw)
                except RuntimeError:  # the middleware's error of bytes that it cannot read; they are taken all the same
                    continue
                if taken is None:
                    return
                if not is_contested:
                    yield taken[0]


@dataclass(eq=False)
class Outlet:
    """A publisher of a stage: to other stages as it is, to listeners outside serialised, where there are any.

    Attributes:
        pipeline: of the process.
        topic_name: the full name of the topic.
        publisher: to the outside.
        is_kept: True if messages are kept for listeners that come later.
    """

    pipeline: Pipeline
    topic_name: str
    publisher: Publisher
    is_kept: bool

    def publish(self, message: Any) -> None:
        """Publish a message; of `CloudColumns` the cloud, packed only where it leaves the process."""
        self.pipeline.hand_on(self.topic_name, message)
        if self.is_kept or self.publisher.get_subscription_count():
            self.publisher.publish(pack(message))

    def get_subscription_count(self) -> int:
        """Return how many listen, here and outside."""
        return self.pipeline.count_ports(self.topic_name) + self.publisher.get_subscription_count()


class Stage:
    """One node's ends of topics: says which do not meet because the two ends ask for different service.

    Attributes:
        node: whose ends these are.
        pipeline: of its process.
        fault: reason why this node has stopped while others of its process go on; empty while it works.
        is_needed: True if its answers are needed; else it rests, and hears nothing. See `rest_unheard`.
        turned: called when it begins or ends to rest.

    Args:
        node: whose ends these are.
        pipeline: of its process; None where the node is alone.
    """

    def __init__(self, node: Node, pipeline: Pipeline | None = None) -> None:
        self.node, self.pipeline, self.fault = node, pipeline or Pipeline(is_shared=False), ""
        self.is_needed, self.turned = True, lambda: None
        self.needs_images: Callable[[], bool] = lambda: True
        self._answers: list[Outlet] = []
        self._events = MutuallyExclusiveCallbackGroup()
        self._awake_until = -inf
        self.pipeline.stages.append(self)
        self._suspects: dict[str, tuple[bool, QoSProfile]] = {}
        self._contested: set[str] = set()

    def guard(self, callback: Callable) -> Callable:
        """Return a callback whose failure stops this node alone, where its process has others; then it does nothing."""
        if not self.pipeline.is_shared:
            return callback
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
        if not self.node.context.ok():
            raise error
        self.fault = f"{type(error).__name__}: {error}"
        self.node.get_logger().error(f"this stage has stopped; the others continue\n{traceback.format_exc()}")

    def guard_taker(self, topic: str, callback: Callable) -> Callable:
        """Return a guarded callback for a topic's messages, after which others of the process may have their turn."""
        if not inspect.iscoroutinefunction(callback):
            callback = note(self.node.get_name(), self.node.resolve_topic_name(topic), callback)
        return self.pipeline.turn(self.guard(callback))

    def look(self, action: Callable[[], None]) -> None:
        """Do something now and every so often."""
        self.pipeline.look(self.node, self.guard(action))

    def afterwards(self, action: Callable[[], None]) -> None:
        """Do something once the image is through the whole process."""
        self.pipeline.afterwards(self.guard(action))

    def publisher(self, kind: type, topic: str, qos: QoSProfile, *, is_answer: bool = True) -> Outlet:
        """Create a watched publisher.

        Args:
            kind: of the messages.
            topic: of the messages.
            qos: that is offered.
            is_answer: True if the messages are made of images, for which the node is needed by who listens.
        """
        qos = copy(qos)  # overrides are written into it
        events = PublisherEventCallbacks(
            incompatible_qos=lambda _: self._suspect(topic, True, qos),
            matched=lambda _: self._end_rest(),
        )
        options = {"callback_group": self._events, "qos_overriding_options": _OVERRIDABLE}
        made = self.node.create_publisher(kind, topic, qos, event_callbacks=events, **options)
        outlet = self.pipeline.outlet(self, self.node.resolve_topic_name(topic), made, qos)
        self._answers += [outlet] if is_answer else []
        return outlet

    def rest_unheard(
        self, skips: Skips, turned: Callable[[], None], is_busy: Callable[[], bool] = lambda: False
    ) -> None:
        """Rest from now on while nobody needs the answers, unless that rule is off.

        Args:
            skips: the rules.
            turned: called when a rest begins or ends.
            is_busy: says whether the node needs images for itself.
        """

        def needs_images() -> bool:
            itself = not skips.allows(UNHEARD) or is_busy() or monotonic() < self._awake_until
            return itself or any(answer.publisher.get_subscription_count() for answer in self._answers)

        self.turned, self.needs_images = self.guard(turned), needs_images

    def keep_awake(self, seconds: float) -> None:
        """Take messages for some time [s], whoever listens."""
        self._awake_until = monotonic() + seconds
        self._end_rest()

    def _end_rest(self) -> None:
        """Look at once who listens, if the node rests."""
        if not self.is_needed:  # which it cannot before all stages are there
            self.pipeline.look_again()

    def _is_contested(self, topic: str) -> bool:
        """Say, also in log and diagnostics, whether several nodes publish a topic."""
        rivals = describe_rivals(self.node, topic)
        if rivals:
            self._contested.add(topic)
            self.node.get_logger().error(f"{rivals}; its messages are dropped", throttle_duration_sec=5.0)
        return bool(rivals)

    @staticmethod
    def _take_unless(is_contested: Callable[[], bool], callback: Callable) -> Callable:
        """Return a callback for messages from outside, which are dropped while these are contested."""
        if inspect.iscoroutinefunction(callback):

            async def wait(message: Any) -> None:
                if not is_contested():
                    await callback(message)

            return wait
        return lambda message: None if is_contested() else callback(message)

    def subscription(
        self,
        kind: type,
        topic: str,
        callback: Callable,
        qos: QoSProfile,
        *,
        is_exclusive: bool = True,
        is_wanted: Callable[[], bool] | None = None,
        **options: Any,
    ) -> Port:
        """Create a watched subscription.

        Args:
            kind: of the messages.
            topic: of the messages.
            callback: takes them.
            qos: that is asked for.
            is_exclusive: messages are dropped while several nodes publish the topic: they may contradict each other.
            is_wanted: says whether messages are wanted now; None: while the node's answers are needed.
            options: of the subscription, as its callback group.
        """
        qos = copy(qos)
        events = SubscriptionEventCallbacks(incompatible_qos=lambda _: self._suspect(topic, False, qos))
        guarded = self.guard_taker(topic, callback)

        is_contested = partial(self._is_contested, topic) if is_exclusive else lambda: False

        def subscribe() -> Subscription:
            taker = self._take_unless(is_contested, guarded)
            return self.node.create_subscription(
                kind, topic, taker, qos, event_callbacks=events, **{"qos_overriding_options": _OVERRIDABLE, **options}
            )

        name, is_wanted = self.node.resolve_topic_name(topic), is_wanted or (lambda: self.is_needed)
        return self.pipeline.add(Port(self, name, guarded, subscribe, is_contested, is_wanted))

    def large_subscription(self, kind: type, topic: str, callback: Callable, **options: Any) -> Callable[[], None]:
        """Subscribe to messages of a megabyte from outside, whose lost pieces come again, unless nobody keeps them.

        Best effort alone loses most of such messages where Fast DDS has its default of 512 kB of shared memory. From a
        publisher that offers no more, the messages are taken as they come.

        Args:
            kind: of the messages.
            topic: of the messages.
            callback: takes them.
            options: of the subscription, as its callback group.

        Returns:
            What ends it.
        """
        made: list[Subscription] = []
        taker = self._take_unless(partial(self._is_contested, topic), self.guard_taker(topic, callback))

        def subscribe(qos: QoSProfile, **events: Any) -> None:
            made.append(self.node.create_subscription(kind, topic, taker, copy(qos), **events, **options))

        def take_as_it_comes(_: Any) -> None:
            if made:
                self.node.get_logger().warning(f"{topic} is published best effort: large messages may be lost")
                close()
                subscribe(SENSOR)  # without overrides, which now hold what was asked for at first

        def connect() -> None:
            events = SubscriptionEventCallbacks(incompatible_qos=take_as_it_comes)
            subscribe(STEADY, event_callbacks=events, qos_overriding_options=_OVERRIDABLE)

        def close() -> None:
            while made:
                self.node.destroy_subscription(made.pop())

        self.pipeline.when_open(connect)
        return close

    def _suspect(self, topic: str, writes: bool, qos: QoSProfile) -> None:
        self._suspects[self.node.resolve_topic_name(topic)] = (writes, qos)
        self.node.get_logger().error("; ".join(self.mismatches()))

    def mismatches(self) -> list[str]:
        """Return one sentence per mismatch, and per topic with several publishers, that still stands."""
        found = [self._mismatches_of(topic, *end) for topic, end in self._suspects.items()]
        found.append([rivals for topic in sorted(self._contested) if (rivals := describe_rivals(self.node, topic))])
        return [sentence for sentences in found for sentence in sentences]

    def _mismatches_of(self, topic: str, writes: bool, qos: QoSProfile) -> list[str]:
        """Compare our end of a topic with every other end that stands against it."""
        node, sentences = self.node, []
        for end in (node.get_subscriptions_info_by_topic if writes else node.get_publishers_info_by_topic)(topic):
            pair = (qos, end.qos_profile) if writes else (end.qos_profile, qos)
            compatibility, why = qos_check_compatible(*pair)
            if compatibility == QoSCompatibility.ERROR:
                sentences.append(f"quality of service of {topic} does not match {end.node_name}: {why}")
        return sentences


_PARTICIPANT = 12  # bytes of an endpoint's id that name its process


def describe_rivals(node: Node, topic: str) -> str:
    """Return a sentence with the nodes that publish a topic where they are several, also of one name; else nothing.

    Several publishers of one node are one.
    """
    topic = node.resolve_topic_name(topic)
    if node.count_publishers(topic) < 2:
        return ""
    ends = node.get_publishers_info_by_topic(topic)
    nodes = {(f"{end.node_namespace.rstrip('/')}/{end.node_name}", *end.endpoint_gid[:_PARTICIPANT]) for end in ends}
    names = sorted(name for name, *_ in nodes)
    return f"{topic} is published by {' and '.join(names)}; expected one: stop the others" if len(names) > 1 else ""


_HOST = 4  # bytes of an endpoint's id that name its machine, of Fast DDS


def is_published_here(node: Node, topic: str) -> bool:
    """Say whether a node of this machine publishes a topic."""
    own, ends = (node.get_publishers_info_by_topic(name) for name in ("/parameter_events", topic))
    here = {(*end.endpoint_gid[:_HOST],) for end in own if end.node_name == node.get_name()}
    return any((*end.endpoint_gid[:_HOST],) in here for end in ends)


def is_wanted(publisher: Outlet, skips: Skips) -> bool:
    """Say whether anybody subscribes to a topic, whose message need not be made otherwise; that is counted."""
    wanted = publisher.get_subscription_count() > 0 or not skips.allows(UNHEARD)
    if not wanted:
        skips.count(UNHEARD)
    return wanted


def send_cloud(publisher: Outlet, header: Header, columns: Mapping[str, NDArray]) -> None:
    """Publish a cloud of columns (n,), which is packed only where it leaves the process."""
    publisher.publish(CloudColumns(header, columns))


class ImageInput:
    """A subscription to the images of a topic, raw or compressed, while they are wanted.

    Args:
        stage: of the node.
        topic: of raw images; one that ends as compressed images do is subscribed to whatever the transport.
        take: takes the name of the topic and a message.
        transport: raw, compressed, or auto: raw, and compressed while nobody publishes raw ones.
        end: of the topic of compressed images.
        is_wanted: says whether anything is to be done with images; None: while the node's answers are needed.
        options: of the subscription, as its callback group.
    """

    def __init__(
        self,
        stage: Stage,
        topic: str,
        take: Callable[[str, Any], Any],
        transport: str,
        end: str = COMPRESSED_COLOR,
        is_wanted: Callable[[], bool] | None = None,
        **options: Any,
    ) -> None:
        self._stage, self._take, self._options = stage, take, options
        self._is_wanted = is_wanted or (lambda: stage.is_needed)
        packed = topic if topic.endswith(ENDS) else stage.node.resolve_topic_name(topic) + end
        only = packed if topic.endswith(ENDS) or transport == COMPRESSED else topic if transport == RAW else ""
        self._choices = (only,) if only else (topic, packed)
        self._topic, self._close = "", lambda: None
        stage.pipeline.when_open(lambda: stage.look(self._follow))

    def _follow(self) -> None:
        """Subscribe to what is published, raw images first; to nothing while nothing is wanted."""
        there = (name for name in self._choices if self._stage.node.count_publishers(name))
        topic = next(there, self._topic or self._choices[0]) if self._is_wanted() else ""
        if topic == self._topic:
            return
        self._close()
        if self._topic and topic:
            self._stage.node.get_logger().info(f"no publisher on {self._topic}: using {topic}")
        self._topic, self._close = topic, lambda: None
        if topic:
            kind = CompressedImage if topic.endswith(ENDS) else Image
            self._close = self._stage.large_subscription(kind, topic, partial(self._take, topic), **self._options)
