"""CPU time of each node in three scenes, with the skip rules and without.

One rendered grasp is cut into three scenes: idle (the object 15 mm from each jaw), approach (5 mm/s) and steady grasp.
They are played as images to all nodes, each in a process of its own, once with every rule and once with none.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import replace
from time import monotonic, time_ns
from typing import TYPE_CHECKING, Any

import pandas as pd

from finforce.errors import MissingDependencyError
from finforce.ros.transport import free_domain
from finforce.skipping import ALL
from finforce_eval.recordings.recording import read_recording
from finforce_eval.replay.live import ReplayLog
from finforce_eval.replay.node_run import await_listeners, awaited_topics
from finforce_eval.replay.playback import RawMessage, read_playback
from finforce_eval.replay.processes import CpuMeter, ProcessGroup, busy_seconds, resident_bytes
from lab.bench.chain import SIDES, chain_processes
from lab.bench.scenes import OBJECT_TOPIC, BenchScene, SceneStream, Span, StreamPart, cut_sections, find_scene
from lab.harness import Figures

if TYPE_CHECKING:
    from finforce.systems.processes import Process

SCENE = BenchScene(
    scenario="hold",
    seed=101,
    changes={"tare": 3.0, "clearance": 0.015, "closing_speed": 0.005, "record": 3.0, "settle": 0.5},
)
SECTIONS = {
    "0:load:0:settle": "idle",
    "0:load:0:record": "idle",
    "0:load:0:ramp": "approach",
    "0:load:7:ramp": "press",
    "0:load:7:settle": "grasp",
    "0:load:7:record": "grasp",
}
SETTINGS: Mapping[str, Sequence[str]] = {"on": ("",), "off": (ALL,)}  # of the rules
USUAL_SECONDS, QUICK_SECONDS = 10.0, 3.0  # of idling and of holding that are measured
WARM_UP, SETTLED = 4.0, 3.0  # [s] of idling, and of holding, before they are measured
MAX_AGE = 2.0  # [s]; a loaded machine shall be slow, not silent


def measure(quick: bool) -> Figures:
    """Return what each node takes in each scene, with the rules and without.

    Raises:
        MissingDependencyError: ROS 2 is not installed.
        FinforceError: the scene cannot be rendered, or a node ended early.
    """
    source = find_scene(SCENE)
    sections = cut_sections(read_playback(source), SECTIONS)
    stream = SceneStream(sections, _plan(sections, QUICK_SECONDS if quick else USUAL_SECONDS))
    rows, nodes = [], chain_processes(read_recording(source), images=True, composed=False)
    for setting, off in SETTINGS.items():
        more = {"max_age": MAX_AGE, "skip_off": list(off)}
        own = [replace(node, parameters={**node.parameters, **more}) for node in nodes]
        rows += _run(own, stream, setting)
    return Figures(tables={"skipping": arrange(pd.DataFrame(rows))})


def arrange(rows: pd.DataFrame) -> pd.DataFrame:
    """Return a row for each node and scene, with the rules beside without: CPU use and answers a second."""
    values = ["CPU/% of a core", "grasp forces/Hz", "other load/%", "memory/MB"]
    wide = rows.pivot_table(index=["node", "scene"], columns="rules", values=values, sort=False)
    wide.columns = [f"{rules}: {name}" for name, rules in wide.columns]
    return wide.reset_index()


def _plan(sections: Mapping[str, Sequence[Any]], seconds: float) -> list[StreamPart]:
    """Return what is played: idle, approach and grasp, each with what comes before it."""
    once = {name: len(images) / 30.0 for name, images in sections.items()}
    return [
        StreamPart(section="idle", seconds=WARM_UP),
        StreamPart(section="idle", seconds=seconds, name="idle"),
        StreamPart(section="approach", seconds=once["approach"], name="approach"),
        StreamPart(section="press", seconds=once["press"]),
        StreamPart(section="grasp", seconds=SETTLED),
        StreamPart(section="grasp", seconds=seconds, name="grasp"),
    ]


class _SceneMeter:
    """Reads the CPU meter where a scene begins or ends."""

    def __init__(self, meter: CpuMeter, stream: SceneStream, answers: Callable[[], int]) -> None:
        self._meter, self._stream, self._answers = meter, stream, answers
        self._span: Span | None = None
        self._before, self._busy = 0, 0.0
        self.rows: list[dict[str, Any]] = []

    def note(self, message: RawMessage) -> None:
        """Note that a message leaves."""
        time = 1e-9 * (message.time - self._stream.begin) + 1e-6
        span = next((span for span in self._stream.spans if span.begin <= time < span.end), None)
        if span is not self._span:
            self.close()
            self._span = span
            self._meter.restart()
            self._before, self._busy = self._answers(), busy_seconds()

    def close(self) -> None:
        """End the scene that is being played."""
        if self._span is None or not self._span.part.name:
            return
        self._meter.sample()
        shares, elapsed = self._meter.shares(), self._meter.elapsed
        common = {
            "scene": self._span.part.name,
            "grasp forces/Hz": (self._answers() - self._before) / elapsed,
            "other load/%": 100.0 * (busy_seconds() - self._busy) / elapsed - sum(shares.values()),
        }
        self.rows += [{"node": node, "CPU/% of a core": cpu, **common} for node, cpu in shares.items()]


def _run(nodes: Sequence[Process], stream: SceneStream, setting: str) -> list[dict[str, Any]]:
    """Play the stream to nodes and return what each takes in each scene.

    Raises:
        ProcessError: a process cannot be started, ended early, or does not listen.
        MissingDependencyError: ROS 2 is not installed.
    """
    try:
        from finforce_eval.replay.node import open_player
    except ImportError as error:
        raise MissingDependencyError(f"running nodes needs ROS 2: pip install 'finforce[ros]' ({error})") from error
    domain, log = free_domain(), ReplayLog(SIDES)
    awaited = [*awaited_topics(nodes, SIDES), OBJECT_TOPIC]
    with ExitStack() as stack:
        player = stack.enter_context(open_player(domain))
        group = stack.enter_context(ProcessGroup(nodes, {"ROS_DOMAIN_ID": str(domain)}))
        player.offer(stream)
        player.listen((), log)  # the grasp force and diagnostics: more listeners would ask for more work
        await_listeners(player, group, awaited)
        player.spin_until(monotonic() + 0.5)
        meter = _SceneMeter(CpuMeter(group.pids), stream, lambda: len(log.grasp))
        offset = time_ns() - stream.begin
        log.begin(offset)
        player.play(stream, offset=offset, sent=meter.note)
        meter.close()
        memory = {name: resident_bytes(pid) / 1e6 for name, pid in group.pids.items()}
        player.spin_until(monotonic() + 0.5)
        group.check()
    return [{**row, "rules": setting, "memory/MB": memory[row["node"]]} for row in meter.rows]
