"""Claims about the driver's actions over real ROS; run by test_driver_actions.py, in a process with control_msgs."""

from contextlib import ExitStack

import pytest
from action_msgs.msg import GoalStatus
from control_msgs.action import GripperCommand, ParallelGripperCommand
from driver_node_fakes import call
from emulator_fakes import Bench, Fingers
from node_fakes import ros_domain
from rclpy.action import ActionClient
from rclpy.parameter import Parameter
from sensor_msgs.msg import JointState
from std_srvs.srv import Trigger

from finforce_driver.node import GripperDriverNode

JOINTS = ["left_jaw_joint", "right_jaw_joint"]
STEP = 0.048 / 255


class Trial:
    """The driver on an emulated gripper, and clients of both of its actions."""

    def __init__(self, probe, stack):
        self.bench = Bench(probe)
        self.probe = probe
        stack.callback(self.bench.close)
        self.clients = {}
        for kind, name in ((GripperCommand, "gripper_cmd"), (ParallelGripperCommand, "parallel_gripper_cmd")):
            client = ActionClient(probe, kind, f"/gripper_driver/{name}")
            assert client.wait_for_server(10.0)
            self.clients[kind] = client
        self.bench.wait_for_joints()
        self.feedback = []

    def ask(self, kind, goal):
        """The handle of a goal."""
        sent = self.clients[kind].send_goal_async(goal, lambda message: self.feedback.append(message.feedback))
        self.probe.wait_for(sent.done)
        return sent.result()

    def result(self, handle):
        """Status and result of a goal that was accepted."""
        assert handle.accepted
        answer = handle.get_result_async()
        self.probe.wait_for(answer.done)
        return answer.result().status, answer.result().result

    def parallel(self, *, wait=True, **command):
        handle = self.ask(ParallelGripperCommand, ParallelGripperCommand.Goal(command=JointState(**command)))
        return self.result(handle) if wait else handle

    def single(self, position, max_effort=0.0):
        goal = GripperCommand.Goal()
        goal.command.position, goal.command.max_effort = position, max_effort
        return self.ask(GripperCommand, goal)


@pytest.fixture
def trial():
    with ros_domain() as probe, ExitStack() as stack:
        yield Trial(probe, stack)


def test_joints_go_to_half_the_opening_each(trial):
    status, result = trial.parallel(name=JOINTS, position=[0.01, 0.01], velocity=[0.05, 0.05])
    assert status == GoalStatus.STATUS_SUCCEEDED and result.reached_goal and not result.stalled
    assert trial.bench.gripper.jaws.opening == pytest.approx(0.02, abs=2 * STEP)
    assert list(result.state.name) == JOINTS
    assert list(result.state.position) == pytest.approx([0.01] * 2, abs=2 * STEP)
    assert list(result.state.effort) == []  # nobody sees a force
    assert trial.feedback and len(trial.feedback[0].state.position) == 2


def test_one_joint_that_the_other_mimics_moves_both(trial):
    status, _ = trial.parallel(name=["left_jaw_joint"], position=[0.015])
    assert status == GoalStatus.STATUS_SUCCEEDED
    assert trial.bench.gripper.jaws.opening == pytest.approx(0.03, abs=2 * STEP)


def test_what_is_grasped_on_the_way_is_a_success_that_stalled(trial):
    trial.bench.gripper.jaws.object_opening = 0.025
    status, result = trial.parallel(name=JOINTS, position=[0.0, 0.0], effort=[10.0, 10.0])
    assert status == GoalStatus.STATUS_SUCCEEDED and result.stalled and not result.reached_goal


def test_a_goal_that_is_cancelled_holds_in_place(trial):
    handle = trial.parallel(wait=False, name=JOINTS, position=[0.0, 0.0], velocity=[0.002, 0.002])
    trial.probe.wait_for(lambda: trial.feedback)
    trial.probe.wait_for(handle.cancel_goal_async().done)
    assert trial.result(handle)[0] == GoalStatus.STATUS_CANCELED
    place = trial.bench.gripper.jaws.opening
    trial.probe.spin(0.5)
    assert trial.bench.gripper.jaws.opening == pytest.approx(place, abs=2 * STEP) and place > 0.01


@pytest.mark.parametrize("effort", [5.0, 100.0])
def test_a_goal_that_cannot_be_is_rejected(trial, effort):
    assert not trial.parallel(wait=False, name=JOINTS, position=[0.01, 0.01], effort=[effort] * 2).accepted
    assert not trial.parallel(wait=False, name=["elbow"], position=[0.01]).accepted
    assert not trial.single(0.02, effort).accepted
    assert not trial.single(-0.0001).accepted


def test_the_older_action_takes_the_opening_and_says_whether_it_is_reached(trial):
    status, result = trial.result(trial.single(0.03))
    assert status == GoalStatus.STATUS_SUCCEEDED and result.reached_goal
    assert result.position == pytest.approx(0.03, abs=2 * STEP)


@pytest.mark.parametrize(
    ("interface", "action"),
    [("parallel_gripper_command", "parallel_gripper_cmd"), ("gripper_command", "gripper_cmd")],
)
def test_a_second_driver_holds_a_force_by_the_actions_of_the_first(trial, interface, action):
    half = interface.startswith("parallel")
    given = {
        "interface": interface,
        "port": f"/gripper_driver/{action}",
        "joint.names": JOINTS if half else ["left_jaw_joint"],
        "joint.open": 0.024 if half else 0.048,
        "joint.rate": 8.0,
        "joint.resolution": 0.0002,
        "joint.largest_force": 62.0,
        "grasp.reaction": 0.3,
        "grasp.stale_after": 0.75,
        "max_age": 0.5,
    }
    Fingers(trial.bench)
    if not half:  # whose joint is the opening
        out = trial.probe.speak("/opening", JointState)
        double = lambda: out.publish(  # noqa: E731
            JointState(name=["left_jaw_joint"], position=[2.0 * trial.bench.joints[-1].position[0]])
        )
        trial.probe.create_timer(0.02, double)
    parameters = [Parameter(name, value=value) for name, value in given.items()]
    states = "joint_states" if half else "opening"
    remapped = ["--ros-args", "-r", "__node:=second_driver", "-r", f"joint_states:={states}"]
    second = GripperDriverNode(context=trial.probe.context, parameter_overrides=parameters, cli_args=remapped)
    trial.probe.spinner.add_node(second)
    trial.probe.wait_for(lambda: second.gripper.state.phase.value == "ready")
    client = trial.probe.create_client(Trigger, "/second_driver/grasp")
    assert client.wait_for_service(10.0)
    answer = client.call_async(Trigger.Request())
    trial.probe.wait_for(answer.done, 40.0)
    assert answer.result().success, answer.result().message
    assert trial.bench.gripper.jaws.force == pytest.approx(1.0, abs=0.35)
    assert call(trial.probe, Trigger, "stop").success
