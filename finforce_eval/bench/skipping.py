"""CPU time of each node per second of scene, with the rules of what need not be done and without.

One rendered grasp is cut into three scenes: idle (the object 15 mm from each jaw), approach (5 mm/s) and steady grasp.
They are played as images to all nodes, once with every rule and once with none.
"""

from __future__ import annotations

import random
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from pathlib import Path
from time import monotonic, time_ns
from typing import TYPE_CHECKING, Any

from finforce.errors import MissingDependencyError
from finforce.skipping import ALL, AWAY, CONTACT, EVERYWHERE, IDLE, SOLVER, STILL, UNCHANGED, UNHEARD, UNNEEDED
from finforce_eval.bench.chain import SIDES, awaited_topics, chain_processes
from finforce_eval.bench.scene_reel import OBJECT_TOPIC, SceneReel, Span, StreamPart, cut_sections
from finforce_eval.bench.scenes import BenchScene, find_scene
from finforce_eval.bench.skipping_figures import (  # noqa: F401 - for those who print and draw
    OFF,
    ON,
    SceneCost,
    SkippingFigures,
    as_json,
    draw,
    format_each,
    format_table,
)
from finforce_eval.recordings.recording import read_recording
from finforce_eval.replay.cpu_share import CpuMeter, busy_seconds, resident_bytes
from finforce_eval.replay.live import ReplayLog
from finforce_eval.replay.node_run import await_listeners, find_processes
from finforce_eval.replay.playback import RawMessage, read_playback
from finforce_eval.replay.processes import ProcessGroup
from finforce_keypoints.settings import ANNOTATED, RULES

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
SETTINGS: Mapping[str, Sequence[str]] = {ON: ("",), OFF: (ALL,)}
# each rule that these scenes give work to, switched off alone
EACH: Mapping[str, Sequence[str]] = {
    ON: ("",),
    **{f"without {rule!r}": (rule,) for rule in (UNCHANGED, UNHEARD, AWAY, IDLE, STILL, UNNEEDED, ANNOTATED)},
}
OF_NODE = {"ifea_solver": SOLVER, "contact_estimator": CONTACT, "keypoint_detector": RULES}
USUAL_SECONDS, QUICK_SECONDS = 10.0, 3.0  # of idling and of holding that are measured
WARM_UP, SETTLED = 4.0, 3.0  # [s] of idling, and of holding, before they are measured
MAX_AGE = 2.0  # [s]; a loaded machine shall be slow, not silent


def measure(
    quick: bool = False,
    *,
    seconds: float | None = None,
    solver: str = "",
    settings: Mapping[str, Sequence[str]] = SETTINGS,
) -> SkippingFigures:
    """Return what each node takes in each scene, with the rules and without.

    Args:
        quick: idle and steady grasp are measured for three seconds each, not for ten; the approach takes three.
        seconds: the same time, where another one is wanted.
        solver: tier; the node's own default when empty.
        settings: rules that are off, by the name of the setting.

    Raises:
        MissingDependencyError: ROS 2 is not installed.
        FinforceError: the scene cannot be rendered, or a node ended early.
    """
    source = find_scene(SCENE)
    sections = cut_sections(read_playback(source), SECTIONS)
    reel = SceneReel(sections, _plan(sections, seconds or (QUICK_SECONDS if quick else USUAL_SECONDS)))
    runs = {name: _run(_build_nodes(source, off, solver), reel, name) for name, off in settings.items()}
    return SkippingFigures(
        costs=[cost for run in runs.values() for cost in run.costs],
        memory={name: run.memory for name, run in runs.items()},
        skipped=runs[ON].skipped if ON in runs else {},
    )


def _plan(sections: Mapping[str, Sequence[Any]], seconds: float) -> list[StreamPart]:
    """Return the course: idle, approach and grasp, each with what comes before it."""
    once = {name: len(images) / 30.0 for name, images in sections.items()}
    return [
        StreamPart(section="idle", seconds=WARM_UP),
        StreamPart(section="idle", seconds=seconds, name="idle"),
        StreamPart(section="approach", seconds=once["approach"], name="approach"),
        StreamPart(section="press", seconds=once["press"]),
        StreamPart(section="grasp", seconds=SETTLED),
        StreamPart(section="grasp", seconds=seconds, name="grasp"),
    ]


def _build_nodes(source: Path, off: Sequence[str], solver: str) -> list[Process]:
    """Return the nodes from images to the grasp force, some rules off."""
    nodes = []
    for node in chain_processes(read_recording(source), images=True):
        more = {"estimator.solver": solver} if solver and node.executable == "ifea_solver" else {}
        known = {"", ALL, *EVERYWHERE, *OF_NODE[node.executable]}
        more |= {"max_age": MAX_AGE, "skip_off": [rule for rule in off if rule in known] or [""]}
        nodes.append(replace(node, parameters={**node.parameters, **more}))
    return nodes


@dataclass(kw_only=True)
class _Run:
    """The figures of one setting, as they come."""

    costs: list[SceneCost] = field(default_factory=list)
    memory: dict[str, float] = field(default_factory=dict)
    skipped: dict[str, dict[str, str]] = field(default_factory=dict)


class _SkipWatch:
    """Reads the CPU meter where a part begins or ends."""

    def __init__(self, meter: CpuMeter, reel: SceneReel, answers: Callable[[], int], setting: str) -> None:
        self._meter, self._reel, self._answers, self._setting = meter, reel, answers, setting
        self._span: Span | None = None
        self._before, self._busy = 0, 0.0
        self.costs: list[SceneCost] = []

    def look(self, message: RawMessage) -> None:
        """Note that a message leaves."""
        time = 1e-9 * (message.time - self._reel.begin) + 1e-6
        span = next((span for span in self._reel.spans if span.begin <= time < span.end), None)
        if span is not self._span:
            self.close()
            self._span = span
            self._meter.restart()
            self._before, self._busy = self._answers(), busy_seconds()

    def close(self) -> None:
        """End the part that is being played."""
        if self._span is None or not self._span.part.name:
            return
        self._meter.sample()
        shares, elapsed = self._meter.shares(), self._meter.elapsed
        others = 100.0 * (busy_seconds() - self._busy) / elapsed - sum(shares.values())
        images = (self._answers() - self._before) / elapsed
        self.costs += [
            SceneCost(
                setting=self._setting, scene=self._span.part.name, node=node, cpu=cpu, others=others, images=images
            )
            for node, cpu in shares.items()
        ]


def _run(nodes: Sequence[Process], reel: SceneReel, setting: str) -> _Run:
    """Play the reel to nodes and read what they take.

    Raises:
        ProcessError: a process cannot be started, ended early, or does not listen.
        MissingDependencyError: ROS 2 is not installed.
    """
    try:
        from finforce_eval.replay.node import open_player
    except ImportError as error:
        raise MissingDependencyError(f"running nodes needs ROS 2: pip install 'finforce[ros]' ({error})") from error
    domain, log, run = random.randint(1, 99), ReplayLog(SIDES), _Run()
    awaited = [*awaited_topics(images=True), OBJECT_TOPIC]
    with ExitStack() as stack:
        player = stack.enter_context(open_player(domain))
        group = stack.enter_context(ProcessGroup(nodes, {"ROS_DOMAIN_ID": str(domain)}))
        player.offer(reel)
        player.listen((), log)  # the grasp force and diagnostics: more listeners would ask for more work

        await_listeners(player, group, awaited)
        player.spin_until(monotonic() + 0.5)
        pids = find_processes([node.name for node in nodes])
        watch = _SkipWatch(CpuMeter(pids), reel, lambda: len(log.grasp), setting)
        log.offset = time_ns() - reel.begin
        player.play(reel, offset=log.offset, sent=watch.look)
        watch.close()
        run.memory = {name: resident_bytes(pid) / 1e6 for name, pid in pids.items()}
        log.ended = True
        player.spin_until(monotonic() + 0.5)
        group.check()
    run.costs = watch.costs
    run.skipped = {name: _counts_of(values) for name, values in log.health.items()}
    return run


def _counts_of(values: Mapping[str, str]) -> dict[str, str]:
    """Return the counts of the rules in a node's diagnostics, by rule."""
    mark = "skipped: "
    return {key.removeprefix(mark): value for key, value in values.items() if key.startswith(mark)}
