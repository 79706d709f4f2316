"""What every node shares: parameters, quality of service, diagnostics, start and stop, and messages."""

from __future__ import annotations

import gc
import inspect
import os
import signal
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import Field, fields
from functools import partial
from threading import Event, Thread
from typing import Any

import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus  # noqa: F401 - for those who publish
from geometry_msgs.msg import PoseStamped, TwistStamped, WrenchStamped  # noqa: F401 - for those who publish
from numpy.typing import NDArray
from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor
from rclpy.callback_groups import CallbackGroup
from rclpy.clock import Clock, ClockType
from rclpy.event_handler import PublisherEventCallbacks, SubscriptionEventCallbacks
from rclpy.exceptions import NameValidationException, ParameterException
from rclpy.executors import Executor, ExternalShutdownException
from rclpy.expand_topic_name import expand_topic_name
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, QoSCompatibility, QoSProfile, ReliabilityPolicy, qos_check_compatible
from rclpy.subscription import Subscription
from rclpy.task import Future
from rclpy.validate_full_topic_name import validate_full_topic_name
from rclpy.validate_topic_name import validate_topic_name
from sensor_msgs.msg import CameraInfo, Image, JointState, PointCloud2  # noqa: F401 - for those who subscribe
from std_msgs.msg import Header, String  # noqa: F401 - for those who publish
from std_srvs.srv import SetBool, Trigger
from visualization_msgs.msg import MarkerArray  # noqa: F401 - for those who publish

from finforce.caches import is_compiled
from finforce.errors import FinforceError
from finforce.health import Level, Outcome, Report
from finforce.messages import CloudColumns
from finforce.processors import free_caller
from finforce.ros.executor import TolerantExecutor
from finforce.ros.messages import (  # noqa: F401 - for those who publish
    KeptMessage,
    cloud_message,
    force_stddev,
    grasp_force,
    image_message,
    is_touching,
    pack,
    points_marker,
    pose_message,
    stamp_message,
    status_message,
    twist_message,
    twist_speed,
    wrench_message,
    xyz_columns,
)
from finforce.ros.pipeline import Outlet, Port, Stage
from finforce.ros.tracing import note, write_trace
from finforce.ros.transport import CHOICES, PROFILES, TRANSPORT, provide_transport  # noqa: F401 - for tests
from finforce.settings import ParameterError, RecordT, bounds_of, check_value, constraints, describe, is_parameter
from finforce.skipping import UNHEARD, Skips
from finforce.stamps import NANOSECONDS  # noqa: F401 - for those with stamps

SENSOR = QoSProfile(depth=5, reliability=ReliabilityPolicy.BEST_EFFORT)
NEWEST = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)  # whoever is slow misses what was overtaken
RESULT = QoSProfile(depth=10, reliability=ReliabilityPolicy.RELIABLE)
STEADY = QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE)  # the newest alone
REQUESTS = QoSProfile(depth=100, reliability=ReliabilityPolicy.RELIABLE)  # one that is passed over waits for ever
LATCHED = QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL)

STEADY_CLOCK = Clock(clock_type=ClockType.STEADY_TIME)

provide_transport()  # read when the first context is made, whoever makes it


def declare_record(node: Node, record: type[RecordT], prefix: str = "") -> RecordT:
    """Declare a ROS parameter for every field of a frozen dataclass that is a `setting`, and return the record.

    Field metadata: `description`, `unit`, `min`, `max`, `choices`, `topic` (names one, or several), `settable` (not
    read-only); NaN may be a default.

    Args:
        node: the node that gets the parameters.
        record: the dataclass; every field needs a default.
        prefix: put before each name, with a dot.

    Raises:
        ParameterError: a value has the wrong type or is out of bounds, or a topic's name cannot be one.
    """
    values = {}
    for entry in filter(is_parameter, fields(record)):
        name = f"{prefix}.{entry.name}" if prefix else entry.name
        value = _read_value(node, name, entry, prefix)
        check_value(entry, value, name=name)
        if entry.metadata.get("topic"):
            for topic in (value,) if isinstance(value, str) else value:
                _check_topic(node, name, topic)
        values[entry.name] = value
    return record(**values)


def _read_value(node: Node, name: str, entry: Field, prefix: str) -> Any:
    """Declare a parameter and return its value; an empty list, which has no type in ROS, is one of the field's.

    A value that was given under the parameter's former name counts, with a warning.
    """
    former = ".".join(filter(None, (prefix, entry.metadata.get("alias"))))
    if entry.metadata.get("alias") and former in node._parameter_overrides:
        node.get_logger().warning(f"parameter {former} is deprecated; use {name}")
        given = node._parameter_overrides.pop(former)
        node._parameter_overrides.setdefault(name, Parameter(name, given.type_, given.value))
    try:
        value = node.declare_parameter(name, entry.default, describe_field(entry)).value
    except ParameterException as error:
        raise ParameterError(f"parameter {name}: {error}") from error
    if value is None and not isinstance(entry.default, (tuple, list)):
        raise ParameterError(f"parameter {name} is empty; expected a value such as {entry.default!r}")
    return () if value is None else value


def _check_topic(node: Node, name: str, topic: str) -> None:
    """Refuse a parameter whose value is no name of a topic."""
    try:
        validate_topic_name(topic)
        validate_full_topic_name(expand_topic_name(topic, node.get_name(), node.get_namespace()))
    except (NameValidationException, ValueError) as error:
        # rclpy draws the place under the name, and tells where it was found out
        why = str(error).splitlines()[0].partition(": ")[2].partition(", at /")[0].rstrip(":")
        raise ParameterError(f"parameter {name} is {topic!r}; expected the name of a topic: {why}") from error


def name_unknown_parameters(node: Node) -> None:
    """Warn of parameters that were given and that the node does not have: most are misspelt."""
    for name in node._parameter_overrides:  # rclpy tells of them nowhere else
        if not node.has_parameter(name):
            node.get_logger().warning(f"there is no parameter '{name}'; it is ignored")


def describe_field(entry: Field) -> ParameterDescriptor:
    """Return the description, unit, range and choices of a field as ROS tools show them."""
    fixed, bounds = not entry.metadata.get("settable", False), bounds_of(entry)
    text = ParameterDescriptor(description=describe(entry), read_only=fixed, additional_constraints=constraints(entry))
    if bounds and isinstance(entry.default, float):
        text.floating_point_range = [FloatingPointRange(from_value=float(bounds[0]), to_value=float(bounds[1]))]
    elif bounds:
        text.integer_range = [IntegerRange(from_value=bounds[0], to_value=bounds[1])]
    return text


class QosWatch:
    """Makes a node's ends of topics, and says which do not meet because the two ends ask for different service.

    Attributes:
        node: whose connections these are.

    Args:
        node: the same.
        stage: what the node is in a process of several.
    """

    def __init__(self, node: Node, stage: Stage | None = None) -> None:
        self.node, self._stage = node, stage
        self._suspects: dict[str, tuple[bool, QoSProfile]] = {}

    @property
    def fault(self) -> str:
        """What has stopped this node while others of its process go on; empty while it works."""
        return self._stage.fault if self._stage else ""

    def guard(self, callback: Callable) -> Callable:
        """Return a callback whose failure stops this node alone, where its process has others."""
        return self._stage.guard(self.node, callback) if self._stage else callback

    def guard_taker(self, topic: str, callback: Callable) -> Callable:
        """Return a guarded callback for a topic's messages, after which others of the process may have their turn."""
        if not inspect.iscoroutinefunction(callback):
            callback = note(self.node.get_name(), self.node.resolve_topic_name(topic), callback)
        return self._stage.pipeline.turn(self.guard(callback)) if self._stage else callback

    def afterwards(self, action: Callable[[], None]) -> None:
        """Do something once the image is through the whole process."""
        if self._stage:
            self._stage.pipeline.afterwards(self.guard(action))
        else:
            action()

    def when_open(self, connect: Callable[[], None]) -> None:
        """Connect to the outside, once all nodes of the process are there."""
        if self._stage:
            self._stage.pipeline.when_open(connect)
        else:
            connect()

    def publisher(self, kind: type, topic: str, qos: QoSProfile) -> Any:
        """Create a watched publisher."""
        events = PublisherEventCallbacks(incompatible_qos=lambda _: self._suspect(topic, True, qos))
        made = self.node.create_publisher(kind, topic, qos, event_callbacks=events)
        return self._stage.pipeline.outlet(self.node.resolve_topic_name(topic), made, qos) if self._stage else made

    def subscription(
        self,
        kind: type,
        topic: str,
        callback: Callable,
        qos: QoSProfile,
        *,
        can_wait: bool = False,
        **options: Any,
    ) -> Subscription | Port:
        """Create a watched subscription.

        Args:
            kind: of the messages.
            topic: of the messages.
            callback: takes them.
            qos: that is asked for.
            can_wait: a process of several nodes may go on without this one where it takes long.
            options: of the subscription, as its callback group.
        """
        events = SubscriptionEventCallbacks(incompatible_qos=lambda _: self._suspect(topic, False, qos))
        guarded = self.guard_taker(topic, callback)
        subscribe = partial(self.node.create_subscription, kind, topic, guarded, qos, event_callbacks=events, **options)
        if self._stage is None:
            return subscribe()
        port = Port(
            self._stage,
            self.node.resolve_topic_name(topic),
            guarded,
            subscribe,
            self.node.destroy_subscription,
            can_wait=can_wait,
        )
        return self._stage.pipeline.add(port)

    def drop(self, subscription: Subscription | Port) -> None:
        """End a subscription."""
        if isinstance(subscription, Port):
            subscription.close()
        else:
            self.node.destroy_subscription(subscription)

    def _suspect(self, topic: str, writes: bool, qos: QoSProfile) -> None:
        self._suspects[self.node.resolve_topic_name(topic)] = (writes, qos)
        self.node.get_logger().error("; ".join(self.faults()))

    def faults(self) -> list[str]:
        """Return one sentence per mismatch that still stands."""
        found = [self._mismatches(topic, *end) for topic, end in self._suspects.items()]
        return [sentence for sentences in found for sentence in sentences]

    def _mismatches(self, topic: str, writes: bool, qos: QoSProfile) -> list[str]:
        """Compare our end of a topic with every other end that stands against it."""
        node, sentences = self.node, []
        for end in (node.get_subscriptions_info_by_topic if writes else node.get_publishers_info_by_topic)(topic):
            pair = (qos, end.qos_profile) if writes else (end.qos_profile, qos)
            verdict, why = qos_check_compatible(*pair)
            if verdict == QoSCompatibility.ERROR:
                sentences.append(f"quality of service of {topic} does not match {end.node_name}: {why}")
        return sentences


class LargeSubscription:
    """A subscription to messages of a megabyte, whose lost pieces come again, unless their publisher keeps nothing.

    Best effort alone loses most of such messages where Fast DDS has its default of 512 kB of shared memory.

    Attributes:
        current: the subscription; None until all nodes of the process are there.

    Args:
        qos: makes subscriptions and watches them.
        kind: of the messages.
        topic: of the messages.
        callback: takes them.
        options: of the subscription, as its callback group.
    """

    def __init__(self, qos: QosWatch, kind: type, topic: str, callback: Callable, **options: Any) -> None:
        self._qos, self._node, self._steady = qos, qos.node, True
        self._asked: Any = (kind, topic, callback)
        self._options = options
        self.current: Subscription | Port | None = None
        qos.when_open(self._connect)

    def _connect(self) -> None:
        kind, topic, callback = self._asked
        events = SubscriptionEventCallbacks(incompatible_qos=self._on_mismatch)
        self.current = self._node.create_subscription(
            kind, topic, self._qos.guard_taker(topic, callback), STEADY, event_callbacks=events, **self._options
        )

    def _on_mismatch(self, _: Any) -> None:
        """Take the messages as they come from a publisher that offers no more."""
        if self._steady:
            self._steady = False
            self._node.get_logger().warning(f"{self._asked[1]} comes with best effort: large messages may be lost")
            self._node.destroy_subscription(self.current)
            self.current = self._qos.subscription(*self._asked, SENSOR, **self._options)


def is_wanted(publisher: Any, skips: Skips) -> bool:
    """Say whether anybody subscribes to a topic, whose message need not be made otherwise; that is counted."""
    wanted = publisher.get_subscription_count() > 0 or not skips.allows(UNHEARD)
    if not wanted:
        skips.count(UNHEARD)
    return wanted


def warn_first_start(node: Node) -> None:
    """Log that a first start compiles, where nothing was compiled before."""
    if not is_compiled():
        node.get_logger().info("compiling, which takes about a minute once; `finforce prepare` does it ahead of time")


def publish_diagnostics(
    node: Node, qos: QosWatch, name: str, period: float, report: Callable[[list[Outcome]], Report]
) -> None:
    """Publish a report on /diagnostics every `period` seconds; mismatches of `qos` are its alarms."""
    publisher = qos.publisher(DiagnosticArray, "/diagnostics", RESULT)

    def make() -> Report | None:
        return report([Outcome(level=Level.ERROR, reason="qos", text=fault) for fault in qos.faults()])

    guarded = qos.guard(make)

    def publish() -> None:
        made = guarded() or Report(level=Level.ERROR, message=f"stopped by {qos.fault}; start the process again")
        status = status_message(name, node.get_name(), made)
        publisher.publish(DiagnosticArray(header=Header(stamp=node.get_clock().now().to_msg()), status=[status]))

    # on the steady clock: a stopped /clock must show, too
    node.create_timer(period, publish, clock=STEADY_CLOCK)


def serve_trigger(qos: QosWatch, name: str, action: Callable[[], str], group: CallbackGroup | None = None) -> None:
    """Offer an action as a Trigger service, aside in a group if it takes long; a refusal comes back as the message."""
    _serve(qos, Trigger, name, lambda _: action(), group)


def serve_switch(qos: QosWatch, name: str, action: Callable[[bool], str]) -> None:
    """Offer an action that is told yes or no as a SetBool service; what it refuses comes back as the message."""
    _serve(qos, SetBool, name, lambda request: action(request.data), None)


def _serve(qos: QosWatch, kind: type, name: str, action: Callable[[Any], str], group: CallbackGroup | None) -> None:
    node = qos.node

    def act(request: Any) -> tuple[bool, str]:
        try:
            return True, action(request)
        except FinforceError as error:
            return False, str(error)

    guarded = qos.guard(act)

    def attempt(request: Any) -> tuple[bool, str]:
        return guarded(request) or (False, f"stopped by {qos.fault}; start the process again")

    async def answer(request: Any, response: Any) -> Any:
        answered = await run_aside(node, partial(attempt, request)) if group else attempt(request)
        response.success, response.message = answered
        return response

    node.create_service(kind, name, answer, callback_group=group, qos_profile=REQUESTS)


async def run_aside(node: Node, action: Callable[[], Any]) -> Any:
    """Run an action in a thread of its own; only the callback that awaits it, and its group, wait."""
    done, executor = Future(), node.executor

    def run() -> None:
        free_caller()
        try:
            done.set_result(action())
        except Exception as error:
            done.set_exception(error)
        executor.wake()  # else it would look again with the next message only

    Thread(target=run, daemon=True).start()
    return await done


def send_cloud(publisher: Any, header: Header, columns: Mapping[str, NDArray]) -> None:
    """Publish a cloud of columns (n,), which is packed only where it leaves the process."""
    cloud = CloudColumns(header, columns)
    publisher.publish(cloud if isinstance(publisher, Outlet) else pack(cloud))


def send_kept(publisher: Any, kept: KeptMessage, stamp: int) -> None:
    """Publish a kept message under a stamp [ns]."""
    publisher.publish(kept.message_at(stamp) if isinstance(publisher, Outlet) else kept.at(stamp))


def take_waiting(subscription: Subscription | Port) -> Iterator[Any]:
    """Yield the messages that wait to be taken, which would have their turn later."""
    if isinstance(subscription, Port):
        subscription = subscription.outside
    if subscription is None:
        return  # it is of the same process, where nothing waits
    yield from _take_all(subscription)


_GLANCE = 0.1  # [s] between looks at whether a node that is being built is still wanted
_MOST_WAITING = 1000  # messages, more than any queue keeps


def _take_all(subscription: Subscription) -> Iterator[Any]:
    """Yield the messages that wait in a subscription; bytes that are none are passed over."""
    with (handle := subscription.handle):
        for _ in range(_MOST_WAITING):
            try:
                taken = handle.take_message(subscription.msg_type, subscription.raw)
            except RuntimeError:  # the middleware's error of bytes that it cannot read; they are taken all the same
                continue
            if taken is None:
                return
            yield taken[0]


def run_node(
    name: str, build: Callable[[], Node], args: Sequence[str] | None = None, work: Callable[..., None] = rclpy.spin
) -> int:
    """Build a node and let it work until it is done, Ctrl-C or SIGTERM; return 0, or 2 on our errors."""
    return run_nodes(name, lambda: [build()], args, lambda nodes, executor: work(*nodes, executor))


def spin(nodes: Sequence[Node], executor: Executor) -> None:
    """Let nodes work until their process is told to end."""
    for node in nodes:
        executor.add_node(node)
    while executor.context.ok():
        executor.spin_once()


@contextmanager
def _ending_with_context() -> Iterator[None]:
    """End the process as soon as a signal has shut the context down, within the `with` block.

    A node that is being built may compile for a minute; it has nothing yet that wants an end of its own, and what it
    keeps in caches is written whole or not at all. A start that failed shuts the context down, too, after the block.
    """
    built = Event()

    def watch() -> None:
        while not built.wait(_GLANCE):
            if not rclpy.ok() and not built.is_set():
                sys.stdout.flush()
                sys.stderr.flush()
                os._exit(0)

    Thread(target=watch, name="context", daemon=True).start()
    try:
        yield
    finally:
        built.set()


def run_nodes(
    name: str, build: Callable[[], Sequence[Node]], args: Sequence[str] | None, work: Callable[..., None] = spin
) -> int:
    """Build nodes and let them work in one thread, as `run_node` does one."""
    try:
        rclpy.init(args=args)
    except RuntimeError as error:  # what stands after --ros-args is none of its words
        print(f"{name}: {str(error).partition(', at ')[0]}", file=sys.stderr)
        return 2
    # an executor that is made after a signal cannot be taken down quietly; a node takes long to build
    executor, nodes = TolerantExecutor(), ()
    try:
        with _ending_with_context():
            nodes = build()
        gc.collect()
        gc.freeze()  # what was built stays, and would be looked through for garbage again and again
        work(nodes, executor)
    except (KeyboardInterrupt, ExternalShutdownException):
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # a launch sends it again after the terminal
    except FinforceError as error:
        print(f"{name}: {error}", file=sys.stderr)
        return 2
    except Exception:
        if rclpy.ok():  # else the signal took the context away while the node was being built
            raise
    finally:
        write_trace()
        for node in nodes:
            node.destroy_node()
        rclpy.try_shutdown()
    return 0
