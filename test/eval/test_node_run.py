"""Processes under a stream: found by their names, measured while it is played, ended with it."""

import sys
from dataclasses import dataclass

import pytest

from finforce_eval.recordings.recording import POSE
from finforce_eval.recordings.writer import pose_message, typestore
from finforce_eval.replay.node_run import describe_load, run_nodes
from finforce_eval.replay.playback import RawMessage
from finforce_eval.replay.process_group import ProcessError
from lab.bench.chain import SyntheticStream

TOPIC = "/left/keypoints"

LISTENER = """
import sys
from importlib import import_module
import rclpy
from rclpy.qos import QoSProfile, ReliabilityPolicy
rclpy.init(args=sys.argv)
node = rclpy.create_node("listener")
quality = QoSProfile(depth=5, reliability=ReliabilityPolicy.RELIABLE)
package, _, name = sys.argv[2].split("/")
node.create_subscription(getattr(import_module(package + ".msg"), name), sys.argv[1], lambda message: None, quality)
try:
    rclpy.spin(node)
except (KeyboardInterrupt, rclpy.executors.ExternalShutdownException):
    pass
"""


@dataclass(frozen=True)
class Listener:
    """A process that hears a topic and does nothing."""

    kind: str = POSE
    label: str = "listener"
    executable: str = "listener"

    def command(self):
        return [sys.executable, "-c", LISTENER, TOPIC, self.kind]


def make_film(count):
    """Poses at 30 Hz."""
    messages = []
    for index in range(count):
        stamp = 10**12 + round(index * 1e9 / 30)
        pose = pose_message(stamp, "camera", [0.0, 0.0, 0.1], [0.0, 0.0, 0.0, 1.0])
        messages.append(RawMessage(stamp, TOPIC, POSE, bytes(typestore().serialize_cdr(pose, POSE)), True))
    return SyntheticStream(messages=messages)


def test_a_busy_machine_is_said_and_a_quiet_one_too():
    assert describe_load([3.0, 12.0]) == "Everything else on the machine took at most 12 % of a core."
    assert describe_load([3.0, 60.0]).startswith("THE MACHINE WAS BUSY") and "60 %" in describe_load([60.0])


def test_a_listener_is_played_to_measured_and_ended():
    pytest.importorskip("rclpy")
    run = run_nodes([Listener()], make_film(30), ("left",))
    assert 0.0 <= run.cpu["listener"] < 200.0
    assert 20e6 < run.memory["listener"] < 400e6  # a Python with rclpy
    assert run.others >= 0.0


def test_a_process_that_ends_early_is_said_with_its_last_words():
    pytest.importorskip("rclpy")
    broken = Listener("no_such_msgs/msg/Nothing")
    with pytest.raises(ProcessError, match="no_such_msgs"):
        run_nodes([broken], make_film(3), ("left",))
