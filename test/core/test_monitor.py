"""Claims about `finforce echo` and `finforce status`: a real node is seen without the `ros2` command."""

import re
from threading import Event, Thread

import numpy as np
import pytest
import yaml
from geometry_msgs.msg import WrenchStamped
from node_fakes import KEYPOINTS, keypoint_cloud, ros_domain, start_solver
from sensor_msgs.msg import JointState
from std_msgs.msg import Header

from finforce.errors import SilentTopicError
from finforce.health import Level, Report
from finforce.ros import monitor
from finforce.ros import node as ros
from finforce.ros.transport import free_domain
from finforce_eval.cli import status
from finforce_eval.cli.main import main


@pytest.fixture
def system(monkeypatch):
    """A solver in a domain of its own that is given key points, and spins in a thread until the test ends."""
    with ros_domain() as probe:
        monkeypatch.setattr(monitor, "DISCOVERY", 60.0)  # on a busy machine; it ends when a publisher is found
        monkeypatch.setenv("ROS_DOMAIN_ID", str(probe.context.get_domain_id()))
        start_solver(probe)
        keypoints, ended = probe.speak("/left/keypoints"), Event()
        probe.speak("/latched", WrenchStamped, ros.LATCHED).publish(
            ros.wrench_message(Header(frame_id="left_jaw"), [1.0, 2.0, 1 / 3])
        )

        def spin():
            while not ended.is_set():
                keypoints.publish(keypoint_cloud())
                probe.spin(0.05)

        thread = Thread(target=spin)
        thread.start()
        try:
            yield probe
        finally:
            ended.set()
            thread.join()


def test_messages_are_printed_as_yaml(system, capsys):
    assert main(["echo", "left/wrench", "--count", "2"]) == 0
    documents = [document for document in yaml.safe_load_all(capsys.readouterr().out) if document]
    assert [document["header"]["frame_id"] for document in documents] == ["left_jaw"] * 2
    assert documents[0]["wrench"]["force"] == {"x": -2.0, "y": 0.0, "z": 0.5}


def test_a_message_fits_on_one_line(system, capsys):
    assert main(["echo", "/left/keypoints", "--count", "3", "--line"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 3
    cloud = yaml.safe_load(lines[0])
    np.testing.assert_allclose(cloud["z"], KEYPOINTS[:, 2], rtol=1e-6)
    assert cloud["likelihood"] == pytest.approx([0.9] * len(KEYPOINTS))


def test_a_latched_message_is_shown_after_it_was_sent(system, capsys):
    assert main(["echo", "latched", "--count", "1"]) == 0
    assert yaml.safe_load(capsys.readouterr().out.removesuffix("---\n"))["wrench"]["force"]["z"] == 0.3333333


def test_a_topic_that_nobody_publishes_is_named_with_the_one_that_was_meant(system, capsys, monkeypatch):
    for patience in (2.0, 10.0):  # the longer on a busy machine, where others are seen late
        monkeypatch.setattr(monitor, "DISCOVERY", patience)
        assert main(["echo", "/left/wrensh"]) == 2
        if "did you mean" in (said := capsys.readouterr().err):
            break
    assert "nobody publishes /left/wrensh; did you mean /left/wrench" in said
    assert main(["echo", "left wrench"]) == 2
    assert "expected a name such as /grasp_wrench" in capsys.readouterr().err


def test_silence_on_a_topic_is_said_with_its_publisher(system, monkeypatch):
    monkeypatch.setattr(monitor, "PATIENCE", 1.0)
    system.speak("/silent")

    def note(text):
        assert text.startswith("no message on /silent for 1 s; published by probe")
        raise InterruptedError

    with pytest.raises(InterruptedError):
        next(monitor.iter_messages("/silent", note))


def test_without_a_system_its_domain_is_named(monkeypatch):
    monkeypatch.setattr(monitor, "DISCOVERY", 0.5)
    domain = free_domain()
    with pytest.raises(SilentTopicError, match=rf"nobody publishes /diagnostics; .*ROS_DOMAIN_ID={domain}\? finforce"):
        next(monitor.iter_statuses(0.1, domain=domain))


def test_a_domain_that_cannot_be_is_named(monkeypatch, capsys):
    monkeypatch.setenv("ROS_DOMAIN_ID", "9999")
    assert main(["status", "--once"]) != 0
    assert "ROS_DOMAIN_ID=9999: expected 0 to 232" in capsys.readouterr().err


def test_the_state_of_a_running_solver_is_a_table(system, monkeypatch, capsys):
    monkeypatch.setattr(status, "COLLECTED", 3.0)
    assert main(["status", "--once"]) == 0
    head, *rows = capsys.readouterr().out.splitlines()
    assert head.split() == ["part", "state", "Hz", "ms", "p95"]
    (row,) = [row for row in rows if "left jaw" in row]
    _, state, rate, latency, _ = re.split(" {2,}", row)
    assert state in ("OK", "WARN") and float(rate) > 1.0 and float(latency) > 0.0


def test_a_part_in_error_or_silent_ends_the_command_with_1(monkeypatch, capsys):
    states = {
        "left jaw": monitor.NodeStatus(report=Report(level=Level.OK, message="published"), age=0.2),
        "gripper": monitor.NodeStatus(report=Report(level=Level.OK, message="holds"), age=9.0),
    }
    monkeypatch.setattr(monitor, "iter_statuses", lambda period: iter([states]))
    assert main(["status", "--once"]) == 1
    assert "gripper   STALE              no diagnostics for 9 s; before: holds" in capsys.readouterr().out
    del states["gripper"]
    assert main(["status", "--once"]) == 0
    states.clear()
    assert main(["status", "--once"]) == 1 and "nodes that are starting" in capsys.readouterr().out


def test_a_row_is_cut_to_the_terminal():
    state = monitor.NodeStatus(report=Report(level=Level.ERROR, message="no depth " * 30), age=0.1)
    head, row = status.format_statuses({"left jaw": state}, 60).splitlines()
    assert len(row) == 60 and "ERROR" in row


def test_long_sequences_are_shown_in_part():
    message = JointState(position=np.linspace(0.0, 1.0, 100).tolist(), name=["left_jaw_joint"])
    shown = monitor.describe_message(message)
    assert shown["position"][-1] == "... 100 in all" and len(shown["position"]) == monitor.LONGEST + 1
    assert shown["name"] == ["left_jaw_joint"] and shown["header"]["stamp"] == {"sec": 0, "nanosec": 0}
