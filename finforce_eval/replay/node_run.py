"""The real nodes while messages are played to them: their answers, CPU time and memory."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from os import getpid
from time import monotonic, time_ns
from typing import TYPE_CHECKING

import psutil

from finforce.camera_topics import COLOR_TOPIC, INFO_TOPIC
from finforce.optional import import_ros
from finforce.ros.tracing import FOLDER
from finforce.ros.transport import free_domain
from finforce.systems.processes import PIPELINE, executables_of
from finforce_eval.replay.answers import ReplayLog
from finforce_eval.replay.playback import Playback, RawMessage
from finforce_eval.replay.process_group import ProcessError, ProcessGroup, begin_shares, end_shares, resident_bytes
from finforce_eval.tasks import progress_bar

if TYPE_CHECKING:
    from finforce.systems.processes import Process
    from finforce_eval.replay.node import PlayerNode

PATIENCE = 400.0  # [s]; a first start compiles all that is compiled, three processes at once on few slow cores
PLAYER = "player"
OBJECT_TOPIC = "/object_pose"
QUIET = 25.0  # [% of a core] that everything else may take; above it latencies are those of a busy machine
LINGER = 0.5  # [s]; the last answers may still be on their way when the last message has left


def describe_load(others: Iterable[float]) -> str:
    """Return a sentence on what else ran during some runs, others (n,) [% of a core]."""
    largest = max(others, default=0.0)
    if largest <= QUIET:
        return f"Everything else on the machine took at most {largest:.0f} % of a core."
    return (
        f"THE MACHINE WAS BUSY: everything else took up to {largest:.0f} % of a core; repeat it when nothing else runs."
    )


@dataclass(frozen=True, kw_only=True)
class Playing:
    """The options of playing a recording.

    Attributes:
        rate: speed; at 1 the stamps are shifted to now, else they stay and the nodes take their time from /clock.
        domain: ROS_DOMAIN_ID; None takes one by chance.
        trace: folder in which the nodes note when they were at work; empty for none. Then only the grasp
            force is received: more would add work.
    """

    rate: float = 1.0
    domain: int | None = None
    trace: str = ""

    @property
    def environment(self) -> dict[str, str]:
        """Variables of the nodes' processes."""
        domain = str(free_domain() if self.domain is None else self.domain)
        return {"ROS_DOMAIN_ID": domain} | ({FOLDER: self.trace} if self.trace else {})

    @property
    def has_clock(self) -> bool:
        """True if the nodes take their time from /clock."""
        return self.rate != 1.0


@dataclass(frozen=True, kw_only=True)
class NodeRun:
    """The outcome of a run.

    Attributes:
        log: the answers, by recorded stamp.
        cpu: of each process while the stream was played, all its threads [% of a core].
        memory: resident at the stream's end [bytes].
        others: CPU use of everything else on the machine meanwhile [% of a core]; it should be small.
    """

    log: ReplayLog
    cpu: Mapping[str, float]
    memory: Mapping[str, int]
    others: float


def awaited_topics(processes: Sequence[Process], sides: Sequence[str]) -> list[str]:
    """Return the topics that nodes of some jaws listen to once all of them are ready."""
    names, composed = executables_of(processes), any(process.executable == PIPELINE for process in processes)
    sees, localizes = "keypoint_detector" in names, "contact_estimator" in names
    topics = [COLOR_TOPIC, INFO_TOPIC] if sees else []  # to depth, with depth:=none, nobody listens
    if not (sees and composed):
        kinds = ("keypoints", "jaw_pose") if localizes else ("keypoints",)
        topics += [f"/{side}/{kind}" for side in sides for kind in kinds]
    return [*topics, OBJECT_TOPIC] if localizes else topics


def _await_listeners(player: PlayerNode, nodes: ProcessGroup, topics: Collection[str]) -> None:
    """Wait until somebody other than the player listens to each of the topics.

    Raises:
        ProcessError: a process ended, or nobody listens after `PATIENCE`.
    """

    def ready() -> bool:
        nodes.check()
        return player.has_listeners(topics)

    if not player.wait_for(ready, PATIENCE):
        raise ProcessError(f"no subscriber on {' or '.join(topics)} after {PATIENCE:g} s")


def run_nodes(
    processes: Sequence[Process],
    messages: Playback,
    sides: Sequence[str],
    *,
    heard: Sequence[str] | None = None,
    detector: bool = False,
    playing: Playing | None = None,
) -> NodeRun:
    """Play messages to processes in real time; nothing outlives the call.

    Args:
        processes: to be started, and ended.
        messages: the recording to play.
        sides: jaws that are played.
        heard: jaws whose own results are heard in addition to the grasp force, at a cost to the nodes; all without.
        detector: True if the results of a key point detector are heard, too.
        playing: rate, domain and trace; at the recorded speed on a domain by chance without.

    Raises:
        ProcessError: a process cannot be started, ended early, or does not listen.
        MissingDependencyError: ROS 2 is not installed.
    """
    open_player = import_ros("finforce_eval.replay.node", "running nodes").open_player
    log, playing = ReplayLog(tuple(sides)), playing or Playing()
    environment = playing.environment
    with ExitStack() as stack:
        player = stack.enter_context(open_player(int(environment["ROS_DOMAIN_ID"])))
        nodes = stack.enter_context(ProcessGroup(processes, environment))
        player.offer(messages)
        player.listen(sides if heard is None else heard, log, detector=detector)
        _await_listeners(player, nodes, awaited_topics(processes, sides))
        player.spin_until(monotonic() + LINGER)
        log.offset = 0 if playing.has_clock else time_ns() - messages.begin
        meters = begin_shares({**nodes.pids, PLAYER: getpid()})
        psutil.cpu_percent()
        _play(player, nodes, messages, log, playing)
        busy, shares = psutil.cpu_percent() * psutil.cpu_count(), end_shares(meters)
        memory = {name: resident_bytes(pid) for name, pid in nodes.pids.items()}
        log.end()
        player.spin_until(monotonic() + LINGER)
        nodes.check()
    return NodeRun(
        log=log,
        cpu={name: shares[name] for name in memory},
        memory=memory,
        others=max(0.0, busy - sum(shares.values())),
    )


def _play(player: PlayerNode, nodes: ProcessGroup, messages: Playback, log: ReplayLog, playing: Playing) -> None:
    """Play messages as long as all processes run, and log when each left."""
    with progress_bar(len(messages), "msg", "replay") as bar:

        def note(message: RawMessage) -> None:
            nodes.check()
            log.take_sent(message.topic, message.stamp, monotonic())
            bar.update()

        player.play(messages, rate=playing.rate, offset=None if playing.has_clock else log.offset, sent=note)
