"""CPU time of each node per second of scene, with the rules of what need not be done and without.

One rendered grasp is cut into three scenes: idle (the object 15 mm from each jaw), approach (5 mm/s) and steady grasp.
They are played as images to all nodes, once with every rule and once with none.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from time import monotonic, time_ns
from typing import TYPE_CHECKING, Any

import numpy as np

from finforce.errors import MissingDependencyError
from finforce.ros.transport import free_domain
from finforce.skipping import ALL, AWAY, CONTACT, EVERYWHERE, IDLE, SOLVER, STILL, UNHEARD, UNNEEDED
from finforce.systems.processes import compose
from finforce_eval.recordings.recording import read_recording
from finforce_eval.replay.live import ReplayLog
from finforce_eval.replay.node_run import await_listeners, awaited_topics
from finforce_eval.replay.playback import RawMessage, read_playback
from finforce_eval.replay.processes import CpuMeter, ProcessGroup, busy_seconds, resident_bytes
from finforce_keypoints.settings import ANNOTATED, RULES
from lab.bench.chain import SIDES, chain_processes
from lab.bench.scenes import OBJECT_TOPIC, BenchScene, SceneStream, Span, StreamPart, cut_sections, find_scene

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
ON, OFF = "rules on", "rules off"
SETTINGS: Mapping[str, Sequence[str]] = {ON: ("",), OFF: (ALL,)}
# each rule that these scenes give work to, switched off alone
EACH: Mapping[str, Sequence[str]] = {
    ON: ("",),
    **{f"without {rule!r}": (rule,) for rule in (UNHEARD, AWAY, IDLE, STILL, UNNEEDED, ANNOTATED)},
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
    composed: bool = False,
) -> SkippingFigures:
    """Return what each node takes in each scene, with the rules and without.

    Args:
        quick: idle and steady grasp are measured for three seconds each, not for ten; the approach takes three.
        seconds: the same time, where another one is wanted.
        solver: tier; the node's own default when empty.
        settings: rules that are off, by the name of the setting.
        composed: whether all nodes share one process.

    Raises:
        MissingDependencyError: ROS 2 is not installed.
        FinforceError: the scene cannot be rendered, or a node ended early.
    """
    source = find_scene(SCENE)
    sections = cut_sections(read_playback(source), SECTIONS)
    stream = SceneStream(sections, _plan(sections, seconds or (QUICK_SECONDS if quick else USUAL_SECONDS)))
    nodes = {name: _build_nodes(source, off, solver) for name, off in settings.items()}
    runs = {name: _run(compose(own) if composed else own, stream, name) for name, own in nodes.items()}
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
    for node in chain_processes(read_recording(source), images=True, composed=False):
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

    def __init__(self, meter: CpuMeter, stream: SceneStream, answers: Callable[[], int], setting: str) -> None:
        self._meter, self._stream, self._answers, self._setting = meter, stream, answers, setting
        self._span: Span | None = None
        self._before, self._busy = 0, 0.0
        self.costs: list[SceneCost] = []

    def look(self, message: RawMessage) -> None:
        """Note that a message leaves."""
        time = 1e-9 * (message.time - self._stream.begin) + 1e-6
        span = next((span for span in self._stream.spans if span.begin <= time < span.end), None)
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


def _run(nodes: Sequence[Process], stream: SceneStream, setting: str) -> _Run:
    """Play the stream to nodes and read what they take.

    Raises:
        ProcessError: a process cannot be started, ended early, or does not listen.
        MissingDependencyError: ROS 2 is not installed.
    """
    try:
        from finforce_eval.replay.node import open_player
    except ImportError as error:
        raise MissingDependencyError(f"running nodes needs ROS 2: pip install 'finforce[ros]' ({error})") from error
    domain, log, run = free_domain(), ReplayLog(SIDES), _Run()
    awaited = [*awaited_topics(nodes, SIDES), OBJECT_TOPIC]
    with ExitStack() as stack:
        player = stack.enter_context(open_player(domain))
        group = stack.enter_context(ProcessGroup(nodes, {"ROS_DOMAIN_ID": str(domain)}))
        player.offer(stream)
        player.listen((), log)  # the grasp force and diagnostics: more listeners would ask for more work

        await_listeners(player, group, awaited)
        player.spin_until(monotonic() + 0.5)
        pids = group.pids
        watch = _SkipWatch(CpuMeter(pids), stream, lambda: len(log.grasp), setting)
        offset = time_ns() - stream.begin
        log.begin(offset)
        player.play(stream, offset=offset, sent=watch.look)
        watch.close()
        run.memory = {name: resident_bytes(pid) / 1e6 for name, pid in pids.items()}
        log.end()
        player.spin_until(monotonic() + 0.5)
        group.check()
    run.costs = watch.costs
    run.skipped = {name: _counts_of(values) for name, values in log.health.items()}
    return run


def _counts_of(values: Mapping[str, str]) -> dict[str, str]:
    """Return the counts of the rules in a node's diagnostics, by rule."""
    mark = "skipped: "
    return {key.removeprefix(mark): value for key, value in values.items() if key.startswith(mark)}


if TYPE_CHECKING:
    from matplotlib.figure import Figure

SCENES = ("idle", "approach", "grasp")
MOST_IDLE = 2.0  # [% of a core] that a node may take while idle
MOST_STEADY = 0.5  # of the cost without rules that a steady grasp may take


@dataclass(frozen=True, kw_only=True)
class SceneCost:
    """What a node took in one scene.

    Attributes:
        setting: of the rules.
        scene: its name.
        node: its name.
        cpu: CPU time per second of scene [% of a core].
        others: CPU use of everything that is no node of ours meanwhile [% of a core].
        images: of which the grasp force came, per second.
    """

    setting: str
    scene: str
    node: str
    cpu: float
    others: float
    images: float


@dataclass(frozen=True, kw_only=True)
class SkippingFigures:
    """What was measured: costs, memory [MB] by setting and node, and what the rules skipped by node and rule."""

    costs: Sequence[SceneCost]
    memory: Mapping[str, Mapping[str, float]]
    skipped: Mapping[str, Mapping[str, str]]


def find_cost(figures: SkippingFigures, setting: str, scene: str, node: str) -> float:
    """Return the CPU use of a node in a scene [% of a core], NaN where it was not measured."""
    found = (cost.cpu for cost in figures.costs if (cost.setting, cost.scene, cost.node) == (setting, scene, node))
    return next(found, float("nan"))


def _nodes_of(figures: SkippingFigures) -> list[str]:
    return list(dict.fromkeys(cost.node for cost in figures.costs))


def format_table(figures: SkippingFigures) -> str:
    """Return the CPU use of each node in each scene [% of a core] and the memory [MB] as text."""
    head = f"{'CPU, % of a core':<22}" + "".join(f"{f'{scene} on':>13}{'off':>7}{'ratio':>7}" for scene in SCENES)
    lines = [head + f"{'MB':>7}", "-" * (len(head) + 7)]
    for node in _nodes_of(figures):
        line = f"{node:<22}"
        for scene in SCENES:
            on, off = (find_cost(figures, setting, scene, node) for setting in (ON, OFF))
            line += f"{on:>13.1f}{off:>7.1f}{on / off if off else np.nan:>7.2f}"
        lines.append(line + f"{figures.memory.get(ON, {}).get(node, np.nan):>7.0f}")
    load = ", ".join(f"{cost.setting}, {cost.scene}: {cost.others:.0f} %" for cost in _one_per_scene(figures))
    images = ", ".join(f"{cost.setting}, {cost.scene}: {cost.images:.1f}" for cost in _one_per_scene(figures))
    return "\n".join([*lines, f"Grasp forces per second: {images}.", f"Everything else on the machine: {load}."])


def format_each(figures: SkippingFigures) -> str:
    """Return what all nodes together take in each scene [% of a core], by setting, and beside that with all rules."""
    width = max(len(name) for name in figures.memory)
    totals = {
        name: [sum(find_cost(figures, name, scene, node) for node in _nodes_of(figures)) for scene in SCENES]
        for name in figures.memory
    }
    head = "CPU of all nodes, % of a core".ljust(width) + "".join(f"{scene:>12}{'more':>7}" for scene in SCENES)
    lines = [head, "-" * len(head)]
    for name, costs in totals.items():
        pairs = zip(costs, totals.get(ON, [np.nan] * len(SCENES)), strict=True)
        lines.append(name.ljust(len(head) - 19 * len(SCENES)) + "".join(f"{c:>12.1f}{c - on:>7.1f}" for c, on in pairs))
    return "\n".join(lines)


def _one_per_scene(figures: SkippingFigures) -> list[SceneCost]:
    """Return one cost of each setting and scene."""
    return list({(cost.setting, cost.scene): cost for cost in figures.costs}.values())


def as_json(figures: SkippingFigures) -> dict[str, Any]:
    """Return the figures as they are written."""
    return {
        "costs": [asdict(cost) for cost in figures.costs],
        "memory_MB": figures.memory,
        "skipped": figures.skipped,
        "aims": {"idle_pct": MOST_IDLE, "steady_share": MOST_STEADY},
    }


def draw(figures: SkippingFigures, path: Path | str) -> None:
    """Draw the CPU use of each node, one panel per scene, with the rules and without, and write it to a file.

    Raises:
        MissingDependencyError: matplotlib is not installed.
    """
    draw_costs(figures).savefig(path)


def draw_costs(figures: SkippingFigures) -> Figure:
    """Return the picture of `draw`."""
    from finforce_eval.figures.figures import BLACK, BLUE, GREY, new_figure, style_axes

    figure, nodes = new_figure(11, 3.6), _nodes_of(figures)
    panels = figure.subplots(1, len(SCENES), sharey=True)
    places = np.arange(len(nodes))
    for axes, scene in zip(panels, SCENES, strict=True):
        style_axes(axes)
        for shift, setting, color in ((-0.2, OFF, GREY), (0.2, ON, BLUE)):
            costs = [find_cost(figures, setting, scene, node) for node in nodes]
            bars = axes.bar(places + shift, costs, width=0.38, color=color, label=setting)
            axes.bar_label(bars, fmt="%.1f", fontsize=7)
        axes.set_title(scene, loc="left", fontsize=10)
        axes.set_xticks(places, [node.replace("_", "\n") for node in nodes], fontsize=7)
    panels[0].axhline(MOST_IDLE, color=BLACK, linewidth=0.8, linestyle=":")
    panels[0].set(ylabel="CPU time per second [% of a core]", yscale="symlog")
    panels[-1].legend(frameon=False, fontsize=8)
    return figure
