"""CPU share and memory of each node at 30 Hz while it works, beside processes that only hear the same topics.

A rendered grasp is played as images, twice in a row, to all nodes at once; the gripper is emulated by a process of its
own. Scores no force.
"""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from finforce.systems.processes import Process
from finforce_eval.bench.chain import SIDES, awaited_topics, chain_processes
from finforce_eval.bench.scenes import GRASP, find_scene
from finforce_eval.errors import RecordingError
from finforce_eval.recordings.recording import CLOUD, POSE, WRENCH, read_recording
from finforce_eval.replay.node_run import Listener, NodeRun, describe_load, run_nodes
from finforce_eval.replay.synthetic_stream import MASK_TOPIC, OBJECT_TOPIC, Film, film_images, film_keypoints, film_mask
from finforce_keypoints.parameters import COLOR_TOPIC, DEPTH_TOPIC, INFO_TOPIC

RATE = 30  # [Hz]
REPEATS = 2
DRIVER = "gripper_driver"
# what a node hears for each image; a listener to the same is its yardstick
CAMERA, SOLVED, PRESSED, GRASPED = "of the camera", "of key points", "of the jaws", "of the grasp"
YARDSTICKS = {
    "keypoint_detector": CAMERA,
    "left_ifea_solver": SOLVED,
    "right_ifea_solver": SOLVED,
    "contact_estimator": PRESSED,
    DRIVER: GRASPED,
}
HEARD = {
    CAMERA: (COLOR_TOPIC, DEPTH_TOPIC, INFO_TOPIC),
    SOLVED: ("/left/keypoints", "/left/contact", "/left/object_outline"),
    PRESSED: (OBJECT_TOPIC, *(f"/{side}/{name}" for side in SIDES for name in ("jaw_pose", "surface", "wrench"))),
    GRASPED: ("/grasp_wrench", "/left/contact", "/right/contact"),
}
KINDS = {"wrench": WRENCH, "grasp_wrench": WRENCH, "jaw_pose": POSE, "object_pose": POSE}


@dataclass(frozen=True, kw_only=True)
class NodeRow:
    """One node in one setting.

    Attributes:
        setting: what is played, and where the object's pose comes from.
        node: its name.
        cpu: all its threads [% of a core].
        hearing: of a process that hears the same and does nothing [% of a core]; NaN where none was run.
        memory_MB: resident at the end.
        answered: share of the images of which the grasp force came, of the setting.
    """

    setting: str
    node: str
    cpu: float
    hearing: float
    memory_MB: float
    answered: float


@dataclass(frozen=True, kw_only=True)
class NodeFigures:
    """What was measured; of each setting how long it was played [s], and the other load [% of a core]."""

    rows: Sequence[NodeRow]
    seconds: Mapping[str, float]
    others: Mapping[str, float]


def measure(quick: bool) -> NodeFigures:
    """Return CPU share and memory of each node, with object poses by topic and by the tracker.

    Args:
        quick: poses by topic only, played once.

    Raises:
        MissingDependencyError: ROS 2 is not installed.
        FinforceError: the scene cannot be rendered, or a node ended early.
    """
    source, repeats = find_scene(GRASP), 1 if quick else REPEATS
    heard = _run_all(source, repeats, "topic", _listeners())
    runs = {"poses by topic": _run_all(source, repeats, "topic")}
    if not quick:
        runs["tracker"] = _run_all(source, repeats, "tracker")
        runs["key points"] = _run_keypoints(source, repeats)
    hearing = {node: heard.cpu[_listener_name(yardstick)] for node, yardstick in YARDSTICKS.items()}
    rows = [row for setting, run in runs.items() for row in make_rows(setting, run, hearing)]
    return NodeFigures(
        rows=rows,
        seconds={setting: run.seconds for setting, run in runs.items()},
        others={setting: run.others for setting, run in runs.items()},
    )


def _run_all(source: Path, repeats: int, poses: str, listeners: Sequence[Listener] = ()) -> NodeRun:
    """Run all nodes from images, with object poses from "topic" or "tracker"."""
    tracks = poses == "tracker"
    film = replace(film_images(source, RATE, poses=not tracks), repeats=repeats)
    if tracks:
        film = film.joined([film_mask(source)])
    awaited = [*awaited_topics(images=True), *([MASK_TOPIC] if tracks else [OBJECT_TOPIC])]
    with emulated_gripper() as port:
        nodes = chain_processes(read_recording(source), images=True, pose_source=poses)
        driver = Process(executable=DRIVER, name=DRIVER, parameters={"port": port})
        return run_nodes([*nodes, driver, *listeners], film, SIDES, awaited, detector=True)


def _run_keypoints(source: Path, repeats: int) -> NodeRun:
    """Run solvers and contact estimator from key points."""
    film: Film = replace(film_keypoints(source, RATE), repeats=repeats)
    nodes = chain_processes(read_recording(source), images=False)
    return run_nodes(nodes, film, SIDES, [*awaited_topics(images=False), OBJECT_TOPIC])


def _listeners() -> list[Listener]:
    """Return a listener of each kind."""
    return [
        Listener(name=_listener_name(kind), topics={topic: _type_of(topic) for topic in topics})
        for kind, topics in HEARD.items()
    ]


def _listener_name(kind: str) -> str:
    return f"listener_{kind.replace(' ', '_')}"


def _type_of(topic: str) -> str:
    """Return the type of a topic."""
    if topic in (COLOR_TOPIC, DEPTH_TOPIC):
        return "sensor_msgs/msg/Image"
    if topic == INFO_TOPIC:
        return "sensor_msgs/msg/CameraInfo"
    return KINDS.get(topic.rsplit("/", 1)[1], CLOUD)


@contextmanager
def emulated_gripper() -> Iterator[str]:
    """Give the port of an emulated gripper that runs for the length of the block.

    Raises:
        RecordingError: it does not start.
    """
    command = [sys.executable, "-m", "finforce_driver.emulator"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as emulator:
        try:
            port = emulator.stdout.readline().strip()
            if not port:
                raise RecordingError("the emulated gripper gave no port; expected the path of one")
            yield port
        finally:
            emulator.terminate()


def make_rows(setting: str, run: NodeRun, hearing: Mapping[str, float]) -> list[NodeRow]:
    """Return a row for each node of a run.

    Args:
        setting: of the run.
        run: what came of it.
        hearing: CPU share of what only hears the same, by node [% of a core].
    """
    sent = set().union(*(log.sent for log in run.log.jaws.values()))
    answered = len(sent & run.log.grasp.keys()) / len(sent) if sent else float("nan")
    return [
        NodeRow(
            setting=setting,
            node=node,
            cpu=share,
            hearing=hearing.get(node, float("nan")),
            memory_MB=1e-6 * run.memory[node],
            answered=answered,
        )
        for node, share in run.cpu.items()
    ]


def format_table(figures: NodeFigures) -> str:
    """Return the rows as a table in Markdown."""
    lines = [
        "| at 30 Hz | node | CPU/% of a core | only hearing the same/% | memory/MB |",
        "|---|---|---|---|---|",
    ]
    for row in figures.rows:
        hearing = "-" if row.hearing != row.hearing else f"{row.hearing:.1f}"
        lines.append(f"| {row.setting} | {row.node} | {row.cpu:.1f} | {hearing} | {row.memory_MB:.0f} |")
    for setting, seconds in figures.seconds.items():
        answered = next(row.answered for row in figures.rows if row.setting == setting)
        lines.append(
            f"{setting}: {seconds:.1f} s, grasp force of {answered:.0%} of the images (the tare included), other load "
            f"{figures.others[setting]:.0f} % of a core."
        )
    return "\n".join([*lines, describe_load(figures.others.values())])


def as_json(figures: NodeFigures) -> dict[str, Any]:
    """Return the figures as plain values."""
    return asdict(figures)


def draw(figures: NodeFigures, path: Path | str) -> None:
    """Draw the CPU share of each node by setting, with the part that only hearing takes.

    Raises:
        MissingDependencyError: matplotlib is not installed.
    """
    from finforce_eval.figures.figures import BLUE, GREEN, GREY, ORANGE, new_figure, style_axes

    nodes = [name for name in YARDSTICKS if any(row.node == name for row in figures.rows)]
    figure = new_figure(9.5, 4.2)
    axes = figure.subplots()
    style_axes(axes)
    settings = list(figures.seconds)
    height = 0.8 / len(settings)
    for number, (setting, colour) in enumerate(zip(settings, (BLUE, ORANGE, GREEN), strict=False)):
        rows = {row.node: row for row in figures.rows if row.setting == setting}
        places = [index + (number - 0.5 * (len(settings) - 1)) * height for index, node in enumerate(nodes)]
        shares = [rows[node].cpu if node in rows else 0.0 for node in nodes]
        axes.barh(places, shares, 0.9 * height, color=colour, label=setting)
        for place, node, share in zip(places, nodes, shares, strict=True):
            if node in rows:
                axes.text(share, place, f" {share:.1f} %, {rows[node].memory_MB:.0f} MB", va="center", fontsize=8)
    hearing = {row.node: row.hearing for row in figures.rows if row.setting == settings[0]}
    axes.barh(range(len(nodes)), [hearing.get(node, 0.0) for node in nodes], 0.8, color=GREY, alpha=0.45,
              label="only hearing the same topics")  # fmt: skip
    axes.set_yticks(range(len(nodes)), nodes)
    axes.invert_yaxis()
    axes.set(xlabel="CPU time [% of one core]")
    axes.margins(x=0.15)
    axes.set_title("Each node at 30 Hz while a grasp is played", loc="left", fontsize=11)
    figure.legend(loc="outside lower center", ncols=4, frameon=False, fontsize=9)
    figure.savefig(path)
