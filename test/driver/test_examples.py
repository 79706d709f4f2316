"""Claims about the examples: they run against the simulated robot, and the lift ends with what it holds."""

import os
import subprocess
import sys
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path
from threading import Thread
from time import monotonic, sleep
from unittest.mock import MagicMock

import pytest
import rclpy
from driver_node_fakes import wrench
from emulator_fakes import Bench, Fingers
from geometry_msgs.msg import TwistStamped, WrenchStamped
from node_fakes import ros_domain
from process_fakes import running
from sensor_msgs.msg import JointState

from finforce import GripperClient
from finforce.errors import ServiceError
from finforce.ros.transport import free_domain
from finforce.systems.processes import RobotOptions
from finforce.systems.setups import robot_processes

ROOT = Path(__file__).parents[2]
EXAMPLES = ROOT / "examples"
START = 240.0  # s in which the twin has drawn its images, on a machine that does other things as well


def run(name, domain, *arguments, patience=START):
    environment = {**os.environ, "ROS_DOMAIN_ID": str(domain), "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
    command = [sys.executable, EXAMPLES / name, *arguments]
    return subprocess.run(command, env=environment, capture_output=True, text=True, timeout=patience, check=False)


# Smaller images are drawn in a quarter of the time; how long a grasp may take in real time is no claim here.
CHANGES = {"twin_camera": {"size": "320x240"}, "gripper_driver": {"grasp_time_limit": 120.0}}


def eased(part):
    """A process that a machine with other work keeps up with."""
    return replace(part, parameters={**part.parameters, **CHANGES.get(part.executable, {})})


@contextmanager
def watching(domain):
    """A client in a domain of its own."""
    context = rclpy.Context()
    rclpy.init(context=context, domain_id=domain)
    try:
        with GripperClient(context=context) as client:
            yield client
    finally:
        rclpy.shutdown(context=context)


@pytest.fixture
def simulation(tmp_path):
    """The domain of a robot with `sim:=true`, once its jaws are watched."""
    domain = free_domain()
    environment = {**os.environ, "ROS_DOMAIN_ID": str(domain), "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
    options = RobotOptions(sim=True, camera_name="", gripper_port=str(tmp_path / "gripper"))
    parts = [eased(part) for part in robot_processes(options, ROOT) if part.package == "finforce"]
    with (tmp_path / "log").open("w+") as log, ExitStack() as stack:
        started = [running(part.command(), env=environment, stdout=log, stderr=log) for part in parts]
        nodes = [stack.enter_context(node) for node in started]
        until = monotonic() + START
        while "playing as the gripper" not in (tmp_path / "log").read_text():
            assert monotonic() < until and all(node.poll() is None for node in nodes), (tmp_path / "log").read_text()
            sleep(0.5)
        with watching(domain) as client:  # until the solvers have taken their tare
            while client.force is None:
                assert monotonic() < until, (tmp_path / "log").read_text()
                sleep(0.5)
        yield domain
        for node in nodes:
            node.terminate()
        assert [node.wait(20.0) for node in nodes] == [0] * len(nodes), (tmp_path / "log").read_text()


# What ends a grasp where a machine with other work is late; the driver looks for its port now and then.
LATE = ("there is no port", "no reply of the gripper", "no force came", "the newest force is")


def run_in_time(name, domain, *arguments):
    """Run an example until the machine is in time for it."""
    for _ in range(5):
        done = run(name, domain, *arguments)
        if not done.returncode or not any(words in done.stdout + done.stderr for words in LATE):
            break
        sleep(3.0)
    return done


def test_the_example_holds_two_newtons_on_the_simulated_robot(simulation):
    done = run_in_time("hold_two_newtons.py", simulation)
    assert done.returncode == 0, done.stdout + done.stderr
    calibrated, opened, held, force, _ = done.stdout.splitlines()
    assert "calibrated" in calibrated and "open: 48.0 mm" in opened
    assert "holds" in held and "set 2.00 N" in held
    assert float(force.split()[0]) == pytest.approx(2.0, abs=0.4)


def test_ten_lines_are_enough():
    lines = [line for line in (EXAMPLES / "hold_two_newtons.py").read_text().splitlines() if line.strip()]
    assert len(lines) <= 10


@pytest.fixture
def bench():
    with ros_domain() as probe, ExitStack() as stack:
        made = Bench(probe, grasp_force=2.0)
        stack.callback(made.close)
        made.fingers = Fingers(made)
        probe.hear("/lift_until_slip/lift", TwistStamped)
        made.lifts = probe.got["/lift_until_slip/lift"]
        yield made


def beside(bench, call):
    """What a call in a thread of its own returns, while the driver lives."""
    found = []
    thread = Thread(target=lambda: found.append(call()), daemon=True)
    thread.start()
    bench.probe.wait_for(lambda: not thread.is_alive(), START)
    return found[0]


def test_the_lift_stops_when_what_is_held_slips(bench):
    domain = bench.probe.context.get_domain_id()

    def slip():
        if len(bench.lifts) >= 20:
            bench.fingers.TOUCH = 0.0

    bench.probe.create_timer(0.01, slip)
    done = beside(bench, lambda: run("lift_until_slip.py", domain, "--ros-args", "-p", "way:=5.0", patience=60.0))
    assert done.returncode == 0, done.stdout + done.stderr
    assert "slip" in done.stdout + done.stderr
    # the first words of a program come before it is heard
    assert max(lift.twist.linear.z for lift in bench.lifts) == pytest.approx(0.05)
    bench.probe.wait_for(lambda: bench.lifts[-1].twist.linear.z == 0.0)
    assert len(bench.lifts) < 60  # within a second


def test_the_lift_ends_at_its_height_while_the_force_is_held(bench):
    domain = bench.probe.context.get_domain_id()
    done = beside(bench, lambda: run_in_time("lift_until_slip.py", domain, "--ros-args", "-p", "way:=0.02"))
    assert done.returncode == 0 and "lifted, after 20 mm" in done.stdout + done.stderr, done.stdout + done.stderr
    bench.probe.wait_for(lambda: bench.lifts[-1].twist.linear.z == 0.0)


def test_the_client_tells_what_the_driver_says(bench):
    with GripperClient(context=bench.probe.context) as client:
        answer = beside(bench, lambda: client.grasp(1.0))
        assert "set 1.00 N" in answer
        bench.probe.wait_for(lambda: client.force is not None and client.opening is not None)
        assert client.force == pytest.approx(1.0, abs=0.3)
        assert client.opening == pytest.approx(bench.gripper.jaws.opening, abs=4e-4)
        assert client.grasp_state.startswith("holding")
        beside(bench, client.release)
        beside(bench, lambda: client.move(0.030))
        assert client.opening == pytest.approx(0.030, abs=1e-3)
        beside(bench, client.estop)
        with pytest.raises(ServiceError, match="gripper_driver/grasp: "):
            beside_error(bench, lambda: client.grasp(1.0))


def beside_error(bench, call):
    """Raise what a call in a thread of its own raises."""
    found = []

    def caught():
        try:
            call()
        except ServiceError as error:
            found.append(error)
        return None

    beside(bench, caught)
    raise found[0]


def test_a_client_of_a_driver_in_a_namespace_hears_that_robot_alone(probe):
    spoken = {name: probe.speak(f"{name}grasp_wrench", WrenchStamped) for name in ("/", "/r2/", "/r3/")}
    jaws = probe.speak("/r2/joint_states", JointState)
    joints = JointState(name=["left_jaw_joint", "right_jaw_joint"], position=[0.01, 0.01])
    forces = dict(zip(spoken, (7.0, 2.0, 5.0), strict=True))

    def told():
        for name, out in spoken.items():
            out.publish(wrench(forces[name]))
        jaws.publish(joints)
        return client.force is not None

    for driver, force in (("/r2/gripper_driver", 2.0), ("r3/gripper_driver", 5.0), ("/gripper_driver", 7.0)):
        with GripperClient(driver, context=probe.context) as client:
            probe.wait_for(told)
            assert client.force == force
            if driver.startswith("/r2"):
                probe.wait_for(lambda: told() and client.opening is not None)
                assert client.opening == pytest.approx(0.02)


def test_a_client_tells_no_force_that_two_nodes_publish(probe, capfd):
    other = rclpy.create_node("other", context=probe.context)
    outs = [probe.speak("grasp_wrench", WrenchStamped), other.create_publisher(WrenchStamped, "grasp_wrench", 1)]
    with GripperClient(context=probe.context) as client:

        def both_are_known():
            for out in outs:
                out.publish(wrench(1.0))
            return client._node.count_publishers("grasp_wrench") == 2

        probe.wait_for(both_are_known)
        assert client.force is None
    other.destroy_node()
    assert "/grasp_wrench is published by /other and /probe" in capfd.readouterr().err


def test_a_client_that_nobody_tells_a_force_says_so(monkeypatch, capfd):
    monkeypatch.setattr("finforce.ros.client.FOUND", 0.0)
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    with watching(free_domain()) as client:
        assert client.force is None and client.opening is None
    assert "nobody publishes /grasp_wrench, where the gripper_driver is: start a solver there" in capfd.readouterr().err


def test_the_client_waits_for_an_adapter_that_is_not_there_yet_and_for_nothing_else(monkeypatch):
    client, answers = object.__new__(GripperClient), ["calibrate: there is no port 'ssg48'", "done", "calibrate: hot"]
    client._node = MagicMock()

    def call(self, name):
        answer = answers.pop(0)
        if answer.startswith(name):
            raise ServiceError(answer)
        return answer

    monkeypatch.setattr(GripperClient, "_call", call)
    monkeypatch.setattr("finforce.ros.client.sleep", lambda seconds: None)
    assert client.calibrate() == "done"
    with pytest.raises(ServiceError, match="hot"):
        client.calibrate()
