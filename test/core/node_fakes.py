"""Nodes under test: a DDS domain of their own with a probe, an estimator that answers by rule, processes."""

import os
import subprocess
import sys
import threading
from contextlib import contextmanager
from dataclasses import dataclass
from time import monotonic, time_ns
from unittest import mock

import numpy as np
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import WrenchStamped
from process_fakes import running
from rclpy.node import Node
from rclpy.parameter import Parameter
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import Header

from finforce.errors import ObservationError
from finforce.ros import node as ros
from finforce.ros.node import TolerantExecutor
from finforce.ros.start import start
from finforce.ros.transport import free_domain
from finforce_ifea.errors import UnderLoadError
from finforce_ifea.jaw.jaw import load_jaw
from finforce_ifea.node import IfeaSolverNode

KEYPOINTS = load_jaw("bench").keypoints
PATIENCE = 10.0


@dataclass
class FakeSolution:
    """A solution of one image."""

    status: str = "ok"
    message: str = ""
    force: tuple = (-2.0, 0.0, 0.5)
    torque: tuple = (0.0, -0.08, 0.0)
    force_stddev: tuple = (0.05, 0.01, 0.02)
    torque_stddev: tuple = (0.001, 0.002, 0.003)
    magnitude_stddev: float = 0.05
    contact_point: tuple = (0.013, 0.0, 0.04)
    residual: float = 2e-4
    kkt: float = 1e-9
    iterations: int = 3
    keypoints_used: np.ndarray = None

    @property
    def trusted(self):
        return self.status in ("ok", "unloaded")


class FakeEstimator:
    """Answers every image with `answer`, after checking it as a real one does."""

    surface_triangles = np.array([[0, 1, 2], [0, 2, 3]])
    tared = is_idle = False
    is_taring = True  # as one of whom nothing is known yet, which is never at rest
    friction = (0.0, 0.02)
    touch_probability, friction_source = 0.0, "expected"

    def __init__(self, **answer):
        self.answer = answer
        self.observations, self.contacts, self.resets, self.interruptions = [], [], 0, 0
        self.under_load = False

    def update(self, observation, contact):
        if observation.points.shape != KEYPOINTS.shape:
            raise ObservationError(f"{len(observation.points)} key points; expected {len(KEYPOINTS)}")
        self.observations.append(observation)
        self.contacts.append(contact)
        used = np.isfinite(observation.points).all(axis=1)
        return FakeSolution(keypoints_used=used, **self.answer)

    def learn(self):
        self.learnt = len(self.observations)

    def surface(self):
        return np.array([[0.0, 0, 0], [0.01, 0, 0], [0.01, 0, 0.08], [0, 0, 0.08]])

    def tare(self):
        if self.under_load:
            raise UnderLoadError("3.1 N press on the jaw; take the object away first")
        return "15 key points tared over 30 images"

    def reset(self):
        self.resets += 1

    def interrupt(self):
        self.interruptions += 1


class Probe(Node):
    """Publishes what a test says and keeps what comes back, by topic."""

    def __init__(self, executor, **options):
        super().__init__("probe", **options)
        self.spinner = executor
        executor.add_node(self)
        self.got = {}

    def hear(self, topic, kind=WrenchStamped, qos=ros.RESULT):
        self.got[topic] = []
        return self.create_subscription(kind, topic, self.got[topic].append, qos)

    def speak(self, topic, kind=PointCloud2, qos=ros.RESULT):
        return self.create_publisher(kind, topic, qos)

    def spin(self, seconds):
        until = monotonic() + seconds
        while monotonic() < until:
            self.spinner.spin_once(timeout_sec=0.02)

    def wait_for(self, condition, seconds=PATIENCE):
        until = monotonic() + seconds
        while not condition():
            assert monotonic() < until, f"waited {seconds} s in vain; heard {self.heard()}"
            self.spinner.spin_once(timeout_sec=0.02)

    def heard(self):
        states = [status.message for array in self.got["/diagnostics"][-3:] for status in array.status]
        return {topic: len(messages) for topic, messages in self.got.items()}, states

    def connected(self, publisher, count=1):
        """Wait until both ends know of each other: a reader drops what comes before it knows the writer."""

        def is_met():
            readers = [reader for node in self.spinner.get_nodes() for reader in node.subscriptions]
            own = [reader for reader in readers if reader.topic_name == publisher.topic_name]
            return publisher.get_subscription_count() >= count and all(r.get_publisher_count() > 0 for r in own)

        self.wait_for(is_met)

    def diagnosis(self, jaw="left", level=None, word=""):
        """Wait for the state of a jaw at a level, with a word in its message."""
        found = []

        def matches():
            states = [s for array in self.got["/diagnostics"] for s in array.status if f"{jaw} jaw" in s.name]
            found[:] = [s for s in states if (level is None or s.level[0] == level) and word in s.message]
            return bool(found)

        self.wait_for(matches)
        return found[-1]


@contextmanager
def ros_domain():
    """Give a probe with an executor and a context of its own; solvers are added by `start_solver`."""
    os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
    context = rclpy.Context()
    rclpy.init(context=context, domain_id=free_domain())
    executor = TolerantExecutor(context=context)
    probe = Probe(executor, context=context)
    probe.hear("/diagnostics", DiagnosticArray)
    try:
        yield probe
    finally:
        for node in executor.get_nodes():
            node.destroy_node()
        rclpy.try_shutdown(context=context)


def start_solver(probe, estimator=None, pipeline=None, **parameters):
    """Add a solver node around an estimator, of a pipeline or alone, to the probe's executor."""
    # a loaded machine is late: neither is an image old then, nor a node silent
    given = {"contact_height": 0.04, "diagnostics_period": 0.1, "max_age": 3.0, **parameters}
    overrides = [Parameter(name, value=value) for name, value in given.items()]
    estimator = estimator or FakeEstimator()
    node = IfeaSolverNode(lambda *_: estimator, pipeline, context=probe.context, parameter_overrides=overrides)
    probe.spinner.add_node(node)
    return node


def keypoint_cloud(stamp=None, *, frame="left_jaw", points=KEYPOINTS, **columns):
    """A cloud as the key point detector sends it; `stamp` [ns] is now by default."""
    header = Header(stamp=ros.stamp_message(time_ns() if stamp is None else stamp), frame_id=frame)
    likelihood = np.full(len(points), 0.9, dtype=np.float32)
    return ros.cloud_message(header, {**ros.xyz_columns(points), "likelihood": likelihood, **columns})


START_PATIENCE = 240.0  # s; a first start compiles


def command_of(name, *parameters):
    """The command line of a node with parameters `name:=value`."""
    given = [word for parameter in parameters for word in ("-p", parameter)]
    return [sys.executable, "-m", "finforce.ros.start", name, "--ros-args", *given]


def environment():
    own = {"ROS_DOMAIN_ID": str(free_domain()), "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
    return {**os.environ, **own}


def run_node(command):
    """What came of a node that ends by itself."""
    return subprocess.run(command, capture_output=True, text=True, timeout=START_PATIENCE, env=environment())


def run_here(name, *parameters):
    """The exit status of a node of this very process that ends by itself."""
    with mock.patch.object(sys, "argv", command_of(name, *parameters)[3:]):
        return start(name)


def stop_when_ready(command, number):
    """The exit status of a node that is sent a signal once it is ready, and all that it said."""
    with running(command, stderr=subprocess.PIPE, text=True, env=environment()) as node:
        guard = threading.Timer(START_PATIENCE, node.kill)
        guard.start()
        said = []
        for line in node.stderr:
            said.append(line)
            if " ready" in line or "node started" in line:  # a driver is, whether or not its gripper is there
                node.send_signal(number)
        guard.cancel()
        return node.wait(10), "".join(said)
