"""The real nodes while a stream is played: their answers, CPU time and memory."""

from __future__ import annotations

import sys
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from os import getpid
from time import monotonic, time_ns
from typing import TYPE_CHECKING, Any, Protocol

from finforce.errors import MissingDependencyError
from finforce.ros.transport import free_domain
from finforce.systems.processes import PIPELINE, executables_of
from finforce_eval.replay.live import ReplayLog
from finforce_eval.replay.playback import RawMessage
from finforce_eval.replay.processes import (
    CpuMeter,
    ProcessError,
    ProcessGroup,
    busy_seconds,
    resident_bytes,
)
from finforce_eval.replay.synthetic_stream import SyntheticStream
from finforce_keypoints.parameters import COLOR_TOPIC, DEPTH_TOPIC, INFO_TOPIC

if TYPE_CHECKING:
    from finforce.systems.processes import Process
    from finforce_eval.replay.node import PlayerNode

PATIENCE = 180.0  # [s]; a first start compiles the element loops
PLAYER = "player"
QUIET = 25.0  # [% of a core] that everything else may take; above it latencies are those of a busy machine
LINGER = 1.0  # [s]; the last answers may still be on their way when the last message has left


def describe_load(others: Iterable[float]) -> str:
    """Return a sentence on what else ran during some runs, others (n,) [% of a core]."""
    largest = max(others, default=0.0)
    if largest <= QUIET:
        return f"Everything else on the machine took at most {largest:.0f} % of a core."
    return (
        f"THE MACHINE WAS BUSY: everything else took up to {largest:.0f} % of a core; repeat it when nothing else runs."
    )


class Runnable(Protocol):
    """What a `ProcessGroup` starts."""

    label: str

    def command(self) -> list[str]:
        """Return the command line."""


@dataclass(frozen=True, kw_only=True)
class NodeRun:
    """What came of a run.

    Attributes:
        log: the answers, by recorded stamp.
        cpu: of each process while the stream was played, all its threads [% of a core].
        memory: resident at the stream's end [bytes].
        player: CPU use of this process, which plays [% of a core].
        others: CPU use of everything else on the machine meanwhile [% of a core]; it should be small.
        seconds: for which it was played.
    """

    log: ReplayLog
    cpu: Mapping[str, float]
    memory: Mapping[str, int]
    player: float
    others: float
    seconds: float


def awaited_topics(processes: Sequence[Process], sides: Sequence[str]) -> list[str]:
    """Return the topics that nodes of some jaws listen to once all of them are ready."""
    names, composed = executables_of(processes), any(process.executable == PIPELINE for process in processes)
    sees, localizes = "keypoint_detector" in names, "contact_estimator" in names
    topics = [COLOR_TOPIC, DEPTH_TOPIC, INFO_TOPIC] if sees else []
    if not (sees and composed):
        kinds = ("keypoints", "jaw_pose") if localizes else ("keypoints",)
        topics += [f"/{side}/{kind}" for side in sides for kind in kinds]
    return topics


def await_listeners(player: PlayerNode, nodes: ProcessGroup, topics: Collection[str]) -> None:
    """Wait until somebody beside the player listens to each of the topics.

    Raises:
        ProcessError: a process ended, or nobody listens after three minutes.
    """

    def ready() -> bool:
        nodes.check()
        return player.has_listeners(topics)

    if not player.wait_for(ready, PATIENCE):
        raise ProcessError(f"nobody listens to {' or '.join(topics)} after {PATIENCE:g} s")


def run_nodes(
    processes: Sequence[Runnable],
    stream: SyntheticStream,
    sides: Sequence[str],
    awaited: Collection[str] = (),
    *,
    heard: Sequence[str] | None = None,
    detector: bool = False,
    watch: Callable[[Mapping[str, int], RawMessage], Any] = lambda pids, message: None,
) -> NodeRun:
    """Play a stream to processes in real time, stamps shifted to now; nothing outlives the call.

    Args:
        processes: to be started, and ended.
        stream: what is played.
        sides: jaws that are played.
        awaited: topics that somebody has to listen to before the stream begins; without any those of our own nodes.
        heard: jaws whose own results are heard beside the grasp force, which makes them work for it; all without.
        detector: whether the results of a key point detector are heard, too.
        watch: called with the process ids, by label, before each message leaves.

    Raises:
        ProcessError: a process cannot be started, ended early, or does not listen.
        MissingDependencyError: ROS 2 is not installed.
    """
    try:
        from finforce_eval.replay.node import open_player
    except ImportError as error:
        raise MissingDependencyError(f"running nodes needs ROS 2: pip install 'finforce[ros]' ({error})") from error
    domain, log = free_domain(), ReplayLog(tuple(sides))
    with ExitStack() as stack:
        player = stack.enter_context(open_player(domain))
        nodes = stack.enter_context(ProcessGroup(processes, {"ROS_DOMAIN_ID": str(domain)}))
        player.offer(stream)
        player.listen(sides if heard is None else heard, log, detector=detector)

        await_listeners(player, nodes, awaited or awaited_topics(processes, sides))
        player.spin_until(monotonic() + LINGER)
        pids = nodes.pids
        meter = CpuMeter({**pids, PLAYER: getpid()})
        offset = time_ns() - stream.begin
        log.begin(offset)
        busy = busy_seconds()
        meter.sample()

        def note(message: RawMessage) -> None:
            watch(pids, message)
            log.take_sent(message.topic, message.stamp, monotonic())

        player.play(stream, offset=offset, sent=note)
        meter.sample()
        busy = busy_seconds() - busy
        memory = {name: resident_bytes(pid) for name, pid in pids.items()}
        log.end()
        player.spin_until(monotonic() + LINGER)
        nodes.check()
    shares = meter.shares()
    return NodeRun(
        log=log,
        cpu={name: shares[name] for name in pids},
        memory=memory,
        player=shares[PLAYER],
        others=max(0.0, 100.0 * busy / meter.elapsed - sum(shares.values())),
        seconds=meter.elapsed,
    )


LISTENER = """
import sys
from importlib import import_module
import rclpy
from rclpy.qos import QoSProfile, ReliabilityPolicy
rclpy.init(args=sys.argv)
node = rclpy.create_node("listener")
quality = QoSProfile(depth=5, reliability=ReliabilityPolicy.RELIABLE)
for entry in sys.argv[1:sys.argv.index("--ros-args")]:
    topic, kind = entry.split("=")
    package, _, name = kind.split("/")
    node.create_subscription(getattr(import_module(package + ".msg"), name), topic, lambda message: None, quality)
try:
    rclpy.spin(node)
except (KeyboardInterrupt, rclpy.executors.ExternalShutdownException):
    pass
"""


@dataclass(frozen=True, kw_only=True)
class Listener:
    """A process that hears topics and does nothing: what receiving them costs by itself.

    Attributes:
        label: name of the node.
        topics: type by topic.
    """

    label: str
    topics: Mapping[str, str]

    def command(self) -> list[str]:
        """Return the command line."""
        topics = [f"{topic}={kind}" for topic, kind in self.topics.items()]
        return [sys.executable, "-c", LISTENER, *topics, "--ros-args", "-r", f"__node:={self.label}"]
