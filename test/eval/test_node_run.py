"""Processes under a stream: found by their names, measured while it is played, ended with it."""

import os
import subprocess
import sys

import pytest

from finforce_eval.recordings.recording import POSE
from finforce_eval.recordings.writer import MessageFactory
from finforce_eval.replay.node_run import Listener, describe_load, find_processes, run_nodes
from finforce_eval.replay.playback import RawMessage
from finforce_eval.replay.processes import ProcessError
from finforce_eval.replay.synthetic_stream import SyntheticStream

TOPIC = "/left/jaw_pose"


def test_processes_are_found_by_the_names_of_their_nodes():
    wait = [sys.executable, "-c", "print('up', flush=True); input()"]
    children = {
        name: subprocess.Popen([*wait, f"__node:={name}"], stdin=subprocess.PIPE, stdout=subprocess.PIPE)
        for name in ("left", "left_other")
    }
    try:
        assert all(child.stdout.readline() for child in children.values())
        assert find_processes(["left", "left_other"]) == {name: child.pid for name, child in children.items()}
        with pytest.raises(ProcessError, match="node right"):
            find_processes(["left", "right"])
    finally:
        for child in children.values():
            child.communicate(b"end\n")
    with pytest.raises(ProcessError, match="left"):
        find_processes(["left"], os.getpid())


def make_film(count):
    """Poses at 30 Hz."""
    factory, messages = MessageFactory(), []
    for index in range(count):
        stamp = 10**12 + round(index * 1e9 / 30)
        pose = factory.pose(stamp, "camera", [0.0, 0.0, 0.1], [0.0, 0.0, 0.0, 1.0])
        messages.append(RawMessage(stamp, TOPIC, POSE, bytes(factory.typestore.serialize_cdr(pose, POSE)), True))
    return SyntheticStream(messages=messages)


def test_a_busy_machine_is_said_and_a_quiet_one_too():
    assert describe_load([3.0, 12.0]) == "Everything else on the machine took at most 12 % of a core."
    assert describe_load([3.0, 60.0]).startswith("THE MACHINE WAS BUSY") and "60 %" in describe_load([60.0])


def test_a_listener_is_played_to_measured_and_ended():
    pytest.importorskip("rclpy")
    run = run_nodes([Listener(name="listener", topics={TOPIC: POSE})], make_film(30), ("left",), [TOPIC])
    assert run.seconds == pytest.approx(29 / 30, abs=0.5)  # a busy machine is late
    assert 0.0 <= run.cpu["listener"] < 200.0
    assert 20e6 < run.memory["listener"] < 400e6  # a Python with rclpy
    assert run.player > 0.0 and run.others >= 0.0
    with pytest.raises(ProcessError):
        find_processes(["listener"])


def test_a_process_that_ends_early_is_said_with_its_last_words():
    pytest.importorskip("rclpy")
    broken = Listener(name="listener", topics={TOPIC: "no_such_msgs/msg/Nothing"})
    with pytest.raises(ProcessError, match="no_such_msgs"):
        run_nodes([broken], make_film(3), ("left",), [TOPIC])
