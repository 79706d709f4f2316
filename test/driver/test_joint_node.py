"""Claims about the driver node on another gripper, whose joint is commanded by a topic."""

import pytest
from driver_node_fakes import call, start_driver, wrench
from geometry_msgs.msg import WrenchStamped
from node_fakes import ros_domain
from sensor_msgs.msg import JointState
from std_srvs.srv import Trigger

STIFFNESS, TOUCH = 800.0, 0.0500  # N per m of opening; m
OPEN, STROKE = 0.8, 0.085  # rad, m


class OtherGripper:
    """A joint of 0 (open) to 0.8 rad behind topics at 50 Hz, its fingers on something, and a camera on both."""

    def __init__(self, probe, **parameters):
        self.probe, self.value, self.target = probe, 0.25, 0.25
        given = {
            "interface": "joint_command",
            "port": "/other/command",
            "joint.names": ["finger_joint"],
            "joint.closed": OPEN,
            "joint.open": 0.0,
            "joint.resolution": 0.0003,
            "gripper.stroke": STROKE,
            "grasp.reaction": 0.15,
            "grasp.stale_after": 0.75,
            "max_age": 0.5,
        }
        self.node = start_driver(probe, remap=["joint_states:=/other/joint_states"], **{**given, **parameters})
        self.commands = []
        probe.create_subscription(JointState, "/other/command", self.follow, 10)
        self.states = probe.speak("/other/joint_states", JointState)
        self.forces = probe.speak("grasp_wrench", WrenchStamped)
        probe.connected(self.states)
        probe.connected(self.forces)
        probe.create_timer(0.02, self.tell)
        probe.create_timer(1.0 / 30.0, lambda: self.forces.publish(wrench(self.force)))

    @property
    def opening(self):
        return STROKE * (1.0 - self.value / OPEN)

    @property
    def force(self):
        return STIFFNESS * max(0.0, TOUCH - self.opening)

    def follow(self, command):
        self.commands.append(command)
        self.target = command.position[0]

    def tell(self):
        self.value += min(max(self.target - self.value, -0.02), 0.02)
        self.states.publish(JointState(name=["elbow", "finger_joint"], position=[1.0, self.value]))


@pytest.fixture
def other():
    with ros_domain() as probe:
        yield OtherGripper(probe)


def test_a_force_is_held_by_another_gripper(other):
    other.probe.wait_for(lambda: other.node.gripper.state.phase.value == "ready")
    answer = call(other.probe, Trigger, "grasp", patience=30.0)
    assert answer.success, answer.message
    assert other.force == pytest.approx(1.0, abs=0.3)
    assert all(list(command.name) == ["finger_joint"] for command in other.commands)
    assert len(other.commands) > 5  # it is led
    answer = call(other.probe, Trigger, "release", patience=30.0)
    assert answer.success and other.opening == pytest.approx(STROKE, abs=1e-3)


def test_what_another_gripper_does_not_do_is_said(other):
    other.probe.wait_for(lambda: other.node.gripper.state.phase.value == "ready")
    answer = call(other.probe, Trigger, "calibrate")
    assert not answer.success and "is a joint, which knows where it is" in answer.message
    assert call(other.probe, Trigger, "estop").success
    answer = call(other.probe, Trigger, "grasp")
    assert not answer.success and "emergency stop" in answer.message


def test_the_other_drivers_joint_states_stay_its_own(other):
    other.probe.spin(0.3)
    assert other.probe.got["joint_states"] == [] and other.node.actions == []
