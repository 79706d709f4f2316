"""Shared parts of all nodes: parameters, quality of service, diagnostics, start and stop, and messages."""

from __future__ import annotations

import ctypes
import gc
import os
import signal
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import Field, fields, replace
from functools import cache, partial
from threading import Event, Thread
from time import perf_counter, sleep
from typing import Any

import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus  # noqa: F401 - for those who publish
from geometry_msgs.msg import PoseStamped, TwistStamped, WrenchStamped  # noqa: F401 - for those who publish
from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor
from rclpy.callback_groups import CallbackGroup, MutuallyExclusiveCallbackGroup
from rclpy.exceptions import NameValidationException, ParameterException
from rclpy.executors import Executor, ExternalShutdownException
from rclpy.expand_topic_name import expand_topic_name
from rclpy.logging import get_logger
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.task import Future
from rclpy.validate_full_topic_name import validate_full_topic_name
from rclpy.validate_topic_name import validate_topic_name
from sensor_msgs.msg import CameraInfo, Image, JointState, PointCloud2  # noqa: F401 - for those who subscribe
from std_msgs.msg import Header, String  # noqa: F401 - for those who publish
from std_srvs.srv import SetBool, Trigger
from visualization_msgs.msg import MarkerArray  # noqa: F401 - for those who publish

from finforce.caches import FIRST_START, is_compiled
from finforce.errors import FinforceError
from finforce.health import Health, Level, Outcome, Report
from finforce.messages import NANOSECONDS
from finforce.processors import free_caller
from finforce.ros.executor import TolerantExecutor
from finforce.ros.frames import Frames  # noqa: F401 - for those with frames
from finforce.ros.messages import (  # noqa: F401 - for those who publish
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
    wrench_message,
    xyz_columns,
)
from finforce.ros.topics import (  # noqa: F401 - for those with topics
    BUFFERED,
    LATCHED,
    NEWEST,
    REQUESTS,
    RESULT,
    SENSOR,
    STEADY_CLOCK,
    ImageInput,
    Outlet,
    Pipeline,
    Stage,
    describe_rivals,
    is_published_here,
    is_wanted,
    send_cloud,
)
from finforce.ros.tracing import write_trace
from finforce.ros.transport import (  # noqa: F401 - for those with topics
    CHOICES,
    PROFILES,
    TRANSPORT,
    provide_transport,
    remedy_for_losses,
)
from finforce.settings import ParameterError, RecordT, bounds_of, check_value, constraints, describe, is_parameter

_POLL_PERIOD = 0.1  # [s] of asking whether a node that is being built is still wanted

provide_transport()  # read when the first context is made, whoever makes it


def declare_record(node: Node, record: type[RecordT], prefix: str = "") -> RecordT:
    """Declare a ROS parameter for every field of a frozen dataclass that is a `setting`, and return the record.

    Field metadata: `description`, `unit`, `min`, `max`, `choices`, `topic` (names one, or several: the record has
    their full names), `settable` (not read-only); NaN may be a default.

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
        value = _read_value(node, name, entry)
        check_value(entry, value, name=name)
        if entry.metadata.get("topic"):
            found = [_full_topic(node, name, topic) for topic in ((value,) if isinstance(value, str) else value)]
            value = found[0] if isinstance(value, str) else tuple(found)
        values[entry.name] = value
    return record(**values)


def _read_value(node: Node, name: str, entry: Field) -> Any:
    """Declare a parameter and return its value; an empty list, which has no type in ROS, is one of the field's."""
    try:
        value = node.declare_parameter(name, entry.default, describe_field(entry)).value
    except ParameterException as error:
        raise ParameterError(f"parameter {name}: {error}") from error
    if value is None and not isinstance(entry.default, (tuple, list)):
        raise ParameterError(f"parameter {name} is empty; expected a value such as {entry.default!r}")
    return () if value is None else value


def _full_topic(node: Node, name: str, topic: str) -> str:
    """Return a topic with the namespace of a node; refuse a parameter whose value is no name of a topic."""
    try:
        validate_topic_name(topic)
        full = expand_topic_name(topic, node.get_name(), node.get_namespace())
        validate_full_topic_name(full)
        return full
    except (NameValidationException, ValueError) as error:
        # rclpy draws the place under the name, and tells where it was found out
        why = str(error).splitlines()[0].partition(": ")[2].partition(", at /")[0].rstrip(":")
        raise ParameterError(f"parameter {name} is {topic!r}; expected the name of a topic: {why}") from error


def name_unknown_parameters(node: Node) -> None:
    """Warn of parameters that were given and that the node does not have: most are misspelt."""
    for name in node._parameter_overrides:  # rclpy tells of them nowhere else
        if not node.has_parameter(name) and not name.startswith("qos_overrides."):
            node.get_logger().warning(f"there is no parameter '{name}'; it is ignored")


def follow_settings(node: Node, record: RecordT, apply: Callable[[RecordT], None], prefix: str = "") -> None:
    """Call back with a record, as `declare_record` returned it, after settable parameters of it were changed.

    ROS refuses values outside the declared bounds.
    """
    names = {f"{prefix}.{entry.name}" if prefix else entry.name: entry.name for entry in fields(record)}

    def take(changed: list[Parameter]) -> None:
        given = {names[parameter.name]: parameter.value for parameter in changed if parameter.name in names}
        if given:
            current.update(given)
            apply(replace(record, **current))

    current: dict[str, Any] = {}
    node.add_post_set_parameters_callback(take)


def describe_field(entry: Field) -> ParameterDescriptor:
    """Return the description, unit, range and choices of a field as ROS tools show them."""
    fixed, bounds = not entry.metadata.get("settable", False), bounds_of(entry)
    text = ParameterDescriptor(description=describe(entry), read_only=fixed, additional_constraints=constraints(entry))
    if bounds and isinstance(entry.default, float):
        text.floating_point_range = [FloatingPointRange(from_value=float(bounds[0]), to_value=float(bounds[1]))]
    elif bounds:
        text.integer_range = [IntegerRange(from_value=bounds[0], to_value=bounds[1])]
    return text


class ImageNode(Node):
    """A node that answers images of one jaw or two: what it cannot use is rejected, said and counted.

    Attributes:
        health: health of each jaw's answers, by side; filled by the node.
        stage: of the node.
        answer: message that a rejected image does not get, as "wrench".
    """

    stage: Stage
    answer = "answer"

    def __init__(self, name: str, **options: Any) -> None:
        super().__init__(name, **options)
        self.health: dict[str, Health] = {}

    def now(self) -> int:
        """Return the time of the node's clock [ns]."""
        return self.get_clock().now().nanoseconds

    def confirm(self, side: str, stamp: int, outcome: Outcome, began: float) -> None:
        """Count a published answer to an image of `stamp` [ns] that was begun at `began` [s of perf_counter]."""
        age = (self.now() - stamp) / NANOSECONDS
        self.health[side].publish(outcome, latency=perf_counter() - began, age=age)

    def turn(self) -> None:
        """Begin or end to rest: nothing was to arrive so far."""
        for health in self.health.values():
            health.resume()

    @property
    def unheard(self) -> str:
        """The answer that nobody needs; empty while somebody does."""
        return "" if self.stage.is_needed else self.answer

    @contextmanager
    def rejections(self, *sides: str) -> Iterator[None]:
        """Survive what is wrong with a message of some jaws, of all without a name, and say it."""
        try:
            yield
        except FinforceError as error:
            self.reject(Outcome.of_error(error), *sides)

    def reject(self, outcome: Outcome, *sides: str) -> None:
        """Say why some jaws, all without a name, have no answer."""
        self.get_logger().warning(f"no {self.answer}: {outcome.text}", throttle_duration_sec=2.0)
        for side in sides or self.health:
            self.health[side].refuse(outcome)


@cache
def warn_first_start() -> None:
    """Log, once in a process, that a first start compiles, where nothing was compiled before."""
    if not is_compiled():
        get_logger("finforce").info(FIRST_START)


def publish_diagnostics(stage: Stage, name: str, period: float, report: Callable[[list[Outcome]], Report]) -> None:
    """Publish a report on /diagnostics every `period` seconds; faults of the stage's topics are its alarms."""
    node, publisher = stage.node, stage.publisher(DiagnosticArray, "/diagnostics", RESULT, is_answer=False)
    space = node.get_namespace().lstrip("/")
    space += "/" if space else ""

    def make() -> Report | None:
        return report([Outcome(level=Level.ERROR, reason=fault, text=fault) for fault in stage.mismatches()])

    guarded = stage.guard(make)

    def publish() -> None:
        made = guarded() or Report(level=Level.ERROR, message=f"stopped by {stage.fault}; start the process again")
        status = status_message(f"{space}{name}", f"{space}{node.get_name()}", made)
        publisher.publish(DiagnosticArray(header=Header(stamp=node.get_clock().now().to_msg()), status=[status]))

    stage.pipeline.call_every(period, node, publish)


def serve_trigger(
    stage: Stage, name: str, action: Callable[[], str], group: CallbackGroup | None = None, *, awake: float = 0.0
) -> None:
    """Offer an action as a Trigger service, aside in a group if it takes long; a refusal comes back as the message.

    A node that rests takes images for some time before, `awake` [s].
    """
    _serve(stage, Trigger, name, lambda _: action(), group, awake)


def serve_switch(stage: Stage, name: str, action: Callable[[bool], str]) -> None:
    """Offer an action that is told yes or no as a SetBool service; what it refuses comes back as the message."""
    _serve(stage, SetBool, name, lambda request: action(request.data), None)


def _serve(
    stage: Stage,
    kind: type,
    name: str,
    action: Callable[[Any], str],
    group: CallbackGroup | None,
    awake: float = 0.0,
) -> None:
    node = stage.node

    def act(request: Any) -> tuple[bool, str]:
        try:
            return True, action(request)
        except FinforceError as error:
            return False, str(error)

    guarded = stage.guard(act)

    def attempt(request: Any) -> tuple[bool, str]:
        return guarded(request) or (False, f"stopped by {stage.fault}; start the process again")

    async def answer(request: Any, response: Any) -> Any:
        if awake and not stage.is_needed:
            stage.keep_awake(awake)
            await run_aside(node, partial(sleep, awake))
        answered = await run_aside(node, partial(attempt, request)) if group else attempt(request)
        response.success, response.message = answered
        return response

    own = group or (MutuallyExclusiveCallbackGroup() if awake else None)  # else no images would come meanwhile
    node.create_service(kind, name, answer, callback_group=own, qos_profile=REQUESTS)


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


def run_node(name: str, build: Callable[[], Node], work: Callable[..., None] = rclpy.spin) -> int:
    """Build a node and let it work until it is done, Ctrl-C or SIGTERM; return 0, or 2 on our errors."""
    return run_nodes(name, lambda: [build()], None, lambda nodes, executor: work(*nodes, executor))


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
        while not built.wait(_POLL_PERIOD):
            if not rclpy.ok() and not built.is_set():
                sys.stdout.flush()
                sys.stderr.flush()
                os._exit(0)

    Thread(target=watch, name="context", daemon=True).start()
    try:
        yield
    finally:
        built.set()


_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD = -1, -3  # parameters of mallopt, as glibc numbers them
_MOST_FREE = 32 << 20  # bytes on top of the heap, above which they are returned
_LARGE = 4 << 20  # bytes, greater than an image that is worked on: such blocks are returned as soon as they are freed


def _return_memory() -> None:
    """Have glibc return what the start has freed, some 30 MB, and from now on what a search for the jaws frees.

    By default it adapts both limits to the largest blocks ever freed, and keeps 15 MB more.
    """
    with suppress(OSError, AttributeError):  # another C library
        libc = ctypes.CDLL(None)
        libc.malloc_trim(0)
        libc.mallopt(_M_TRIM_THRESHOLD, _MOST_FREE)
        libc.mallopt(_M_MMAP_THRESHOLD, _LARGE)


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
        _return_memory()
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
