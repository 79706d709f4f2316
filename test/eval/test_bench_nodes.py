"""The benchmark of nodes: whose share is told, beside what only hears the same."""

from pathlib import Path
from types import SimpleNamespace

import pytest

from finforce.systems.options import ReplayOptions
from finforce.systems.processes import replay_processes
from finforce_eval.bench import nodes as bench
from finforce_eval.bench.nodes import HEARD, YARDSTICKS, NodeFigures, make_rows
from finforce_eval.replay.live import ReplayLog
from finforce_eval.replay.node_run import NodeRun


@pytest.fixture
def run():
    """Two nodes, of whose four images three were answered."""
    log = ReplayLog(("left",))
    log.jaws["left"].sent = dict.fromkeys(range(4), 0.0)
    log.grasp = dict.fromkeys(range(1, 4), 1.0)
    cpu, memory = {"left_ifea_solver": 10.0, "gripper_driver": 4.0}, {"left_ifea_solver": 2e8, "gripper_driver": 1e8}
    return NodeRun(log=log, cpu=cpu, memory=memory, player=20.0, others=7.0, seconds=5.0)


def test_row_holds_share_memory_and_what_hearing_alone_takes(run):
    solver, driver = make_rows("here", run, {"left_ifea_solver": 3.0})
    assert (solver.cpu, solver.hearing, solver.memory_MB, solver.answered) == (10.0, 3.0, 200.0, 0.75)
    assert driver.hearing != driver.hearing  # not known
    figures = NodeFigures(rows=[solver, driver], seconds={"here": 5.0}, others={"here": 7.0})
    text = bench.format_table(figures)
    assert (
        "| here | left_ifea_solver | 10.0 | 3.0 | 200 |" in text and "| here | gripper_driver | 4.0 | - | 100 |" in text
    )
    assert "grasp force of 75%" in text and "other load 7 %" in text


def test_every_node_of_the_graph_has_a_yardstick_that_hears_something():
    options = ReplayOptions(jaws="both", object_mesh="a.stl", images=True)
    nodes = {process.name for process in replay_processes(options, None)}
    assert nodes | {bench.DRIVER} == set(YARDSTICKS)
    assert set(YARDSTICKS.values()) == set(HEARD)
    assert len({listener.name for listener in bench._listeners()}) == len(HEARD)


def test_topics_have_their_types():
    kinds = {topic: bench._type_of(topic) for topics in HEARD.values() for topic in topics}
    assert kinds["/left/wrench"] == kinds["/grasp_wrench"] == "geometry_msgs/msg/WrenchStamped"
    assert kinds["/object_pose"] == kinds["/left/jaw_pose"] == "geometry_msgs/msg/PoseStamped"
    assert kinds["/left/surface"] == kinds["/left/contact"] == "sensor_msgs/msg/PointCloud2"
    assert sorted(kinds.values()).count("sensor_msgs/msg/Image") == 2


def test_emulated_gripper_has_a_port_for_the_length_of_the_block():
    with bench.emulated_gripper() as port:
        assert Path(port).exists()
    assert not Path(port).exists()


def test_an_emulated_gripper_that_does_not_start_is_said(monkeypatch):
    monkeypatch.setattr(bench.sys, "executable", "false")
    with pytest.raises(bench.RecordingError, match="no port"), bench.emulated_gripper():
        pass


def test_quick_runs_leave_tracker_and_key_points_out(monkeypatch, run):
    played = []
    whole = SimpleNamespace(**{**vars(run), "cpu": dict.fromkeys(map(bench._listener_name, HEARD), 1.0)})

    def run_all(source, repeats, poses, listeners=()):
        played.append((repeats, poses))
        return whole if listeners else run

    monkeypatch.setattr(bench, "find_scene", lambda scene: None)
    monkeypatch.setattr(bench, "_run_all", run_all)
    monkeypatch.setattr(bench, "_run_keypoints", lambda source, repeats: run)
    assert set(bench.measure(True).seconds) == {"poses by topic"} and set(played) == {(1, "topic")}
    assert set(bench.measure(False).seconds) == {"poses by topic", "tracker", "key points"}


def test_picture_is_written(run, tmp_path):
    rows = make_rows("here", run, {"left_ifea_solver": 3.0})
    bench.draw(NodeFigures(rows=rows, seconds={"here": 5.0}, others={"here": 7.0}), tmp_path / "nodes.png")
    assert (tmp_path / "nodes.png").stat().st_size > 10_000
