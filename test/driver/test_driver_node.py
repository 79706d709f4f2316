"""Claims about the driver node around a gripper that does as it is told: what leaves it, and what it refuses."""

import math
import sys
from time import time_ns
from types import ModuleType, SimpleNamespace

import pytest
from driver_node_fakes import (
    COMMAND,
    GOAL,
    READY,
    FakeGoal,
    ask,
    call,
    driver,
    gripper_state,
    send,
    wrench,
)
from geometry_msgs.msg import WrenchStamped
from sensor_msgs.msg import JointState
from std_srvs.srv import SetBool, Trigger

from finforce.health import Level
from finforce.messages import stamp_of
from finforce_driver.state import GripperState, MoveOutcome, Phase

SECOND = 1_000_000_000


def test_joint_states_have_half_the_opening_and_the_time_of_the_reply(probe):
    gripper, _ = driver(probe)
    before = time_ns()
    gripper.reply(opening=0.03, velocity=-0.004, force=5.0)
    probe.wait_for(lambda: probe.got["joint_states"])
    joints = probe.got["joint_states"][0]
    assert list(joints.name) == ["left_jaw_joint", "right_jaw_joint"]
    assert list(joints.position) == [0.015] * 2
    assert list(joints.velocity) == [-0.002] * 2
    assert list(joints.effort) == []  # nobody sees the force, and the motor's current is not it
    # the stamp is taken from two clocks, one after the other
    assert before - SECOND // 1000 < stamp_of(joints) < time_ns()


def test_the_stamp_is_that_of_the_reply_and_not_of_its_publication(probe):
    gripper, node = driver(probe)
    before = time_ns()
    gripper.reply(stamp=gripper.clock.now() - 0.5)
    probe.wait_for(lambda: probe.got["joint_states"])
    stamp = stamp_of(probe.got["joint_states"][0])
    # half a second before, to what the two clocks and the machine's load allow
    assert stamp == pytest.approx(before - SECOND // 2, abs=0.2 * SECOND)


def test_an_old_reply_is_not_published_again(probe):
    gripper, _ = driver(probe)
    gripper.reply()
    probe.wait_for(lambda: probe.got["joint_states"])
    gripper.reply(stamp=gripper.state.stamp, phase=Phase.DISCONNECTED, message="the adapter is gone")
    gripper_state(probe, Level.ERROR, "the adapter is gone")
    assert len(probe.got["joint_states"]) == 1


@pytest.mark.parametrize("unknown", ["opening", "velocity"])
def test_joints_are_named_from_the_first_reply_on_and_have_no_values_while_they_are_not_known(probe, unknown):
    gripper, _ = driver(probe, joint_effort="motor")
    gripper.reply(phase=Phase.UNCALIBRATED, message="calibrate first", **{unknown: math.nan})
    gripper_state(probe, Level.WARN, "calibrate first")
    joints = probe.got["joint_states"][0]
    assert len(joints.name) == 2
    assert [len(values) for values in (joints.position, joints.velocity, joints.effort)] == [0, 0, 0]
    gripper.reply(phase=Phase.READY, **{unknown: getattr(READY, unknown)})
    probe.wait_for(lambda: len(probe.got["joint_states"]) > 1)
    assert list(probe.got["joint_states"][1].position) == [0.5 * READY.opening] * 2


@pytest.mark.parametrize(("source", "effort"), [("vision", [1.5] * 2), ("motor", [5.0] * 2), ("none", [])])
def test_effort_is_the_force_of_its_source(probe, source, effort):
    gripper, _ = driver(probe, joint_effort=source)
    out = probe.speak("grasp_wrench", WrenchStamped)
    probe.connected(out)
    out.publish(wrench(1.5))
    probe.spin(0.1)
    gripper.reply(force=5.0)
    probe.wait_for(lambda: probe.got["joint_states"])
    assert list(probe.got["joint_states"][-1].effort) == effort


def test_effort_is_empty_when_the_force_has_become_old(probe):
    gripper, _ = driver(probe)
    out = probe.speak("grasp_wrench", WrenchStamped)
    probe.connected(out)
    out.publish(wrench(1.5))
    probe.spin(0.4)
    gripper.reply()
    probe.wait_for(lambda: probe.got["joint_states"])
    assert list(probe.got["joint_states"][-1].effort) == []


def test_a_command_that_is_repeated_as_controllers_do_moves_once(probe):
    gripper, _ = driver(probe)
    gripper.reply()
    for _ in range(5):
        send(probe, COMMAND, JointState(name=["left_jaw_joint", "right_jaw_joint"], position=[0.01]))
        probe.spin(0.02)
    assert gripper.calls == [("move", 0.02, None, None)]
    gripper.reply(phase=Phase.READY, outcome=MoveOutcome.GRASPED)
    send(probe, COMMAND, JointState(name=["left_jaw_joint", "right_jaw_joint"], position=[0.01]))
    probe.spin(0.05)
    assert len(gripper.calls) == 1
    assert call(probe, Trigger, "stop").success
    send(probe, COMMAND, JointState(name=["left_jaw_joint", "right_jaw_joint"], position=[0.01]))
    probe.wait_for(lambda: len(gripper.calls) == 3)  # after the stop it is a new one


def test_a_command_moves(probe):
    gripper, _ = driver(probe)
    send(probe, COMMAND, JointState(position=[0.02], velocity=[0.005], effort=[10.0]))
    probe.wait_for(lambda: gripper.calls)
    assert gripper.calls == [("move", 0.02, 0.005, 10.0)]


BAD_COMMANDS = {
    "NaN opening": (JointState(position=[math.nan]), "opening: got nan"),
    "no opening": (JointState(velocity=[0.01]), "a command without position"),
}


@pytest.mark.parametrize("name", BAD_COMMANDS)
def test_a_bad_command_is_named_and_moves_nothing(probe, name):
    message, words = BAD_COMMANDS[name]
    gripper, _ = driver(probe)
    gripper.reply()
    send(probe, COMMAND, message)
    gripper_state(probe, Level.ERROR, words)
    assert gripper.calls == []


BAD_GOALS = {
    "negative force": (JointState(effort=[-1.0]), "force: got -1"),
    "force above the limit": (JointState(effort=[9.0]), "the force limit"),
}


@pytest.mark.parametrize("name", BAD_GOALS)
def test_a_bad_goal_is_named_and_the_last_one_stays(probe, name):
    message, words = BAD_GOALS[name]
    gripper, node = driver(probe, grasp_force=1.5)
    gripper.reply()
    send(probe, GOAL, message)
    gripper_state(probe, Level.ERROR, words)
    assert (node.session.goal.force, gripper.calls) == (1.5, [])


def test_an_emergency_stop_reaches_the_gripper_and_says_what_ends_it(probe):
    gripper, _ = driver(probe)
    answer = call(probe, Trigger, "estop")
    assert answer.success and "clear_errors" in answer.message
    assert gripper.calls == [("estop",)]


def test_an_emergency_stop_without_a_link_is_pending_and_no_success(probe):
    gripper, _ = driver(probe)
    gripper.reply(phase=Phase.DISCONNECTED)
    answer = call(probe, Trigger, "estop")
    assert not answer.success and "emergency stop pending: no link" in answer.message
    assert gripper.calls == [("estop",)]


def test_stop_holds_in_place(probe):
    gripper, _ = driver(probe)
    assert call(probe, Trigger, "stop").success
    assert gripper.calls == [("hold",)]


@pytest.mark.parametrize("on", [True, False])
def test_the_power_stage_is_switched(probe, on):
    gripper, _ = driver(probe)
    assert call(probe, SetBool, "activate", SetBool.Request(data=on)).success
    assert gripper.calls == [("activate", on)]


@pytest.mark.parametrize("name", ["calibrate", "stop"])
def test_what_the_gripper_refuses_is_the_answer(probe, name):
    gripper, _ = driver(probe)
    gripper.refusal = "the gripper does not answer: check 24 V"
    answer = call(probe, Trigger, name)
    assert not answer.success and "check 24 V" in answer.message


def test_the_node_answers_while_a_calibration_is_waited_for(probe):
    gripper, _ = driver(probe)
    calibration = ask(probe, Trigger, "calibrate")
    probe.wait_for(lambda: gripper.calls == [("calibrate",)])
    assert call(probe, Trigger, "estop").success
    probe.wait_for(calibration.done)
    assert not calibration.result().success and "another command" in calibration.result().message


def test_the_node_starts_the_gripper_and_closes_it_with_itself(probe):
    gripper, node = driver(probe)
    assert gripper.started and not gripper.closed
    node.destroy_node()
    assert gripper.closed


def test_temperature_voltage_and_events_are_in_the_diagnostics(probe):
    gripper, _ = driver(probe)
    gripper.reply(counts={"lost replies": 3}, faults=(), message="ready")
    state = gripper_state(probe, Level.OK)
    values = {entry.key: entry.value for entry in state.values}
    assert (values["temperature [deg C]"], values["voltage [V]"], values["events"]) == ("26", "24.0", "3 lost replies")
    assert float(values["request to reply p50 [ms]"]) == 2.0


def test_silence_is_stale(probe):
    gripper, _ = driver(probe, max_age=0.1)
    gripper.reply()
    gripper_state(probe, Level.STALE, "nothing has arrived on /dev/ttyACM0")


@pytest.mark.parametrize("phase", [Phase.FAULT, Phase.DISCONNECTED])
def test_a_gripper_that_cannot_be_used_is_an_error(probe, phase):
    driver(probe, GripperState(phase=phase, message="check the cable"))
    gripper_state(probe, Level.ERROR, "check the cable")


def test_a_clock_that_does_not_go_yet_gives_no_joint_states(probe):
    gripper, _ = driver(probe, use_sim_time=True)
    gripper.reply()
    gripper_state(probe, Level.ERROR, "use_sim_time without /clock")
    assert not probe.got["joint_states"]


class FakeServer:
    """What the node makes of the action server's class."""

    def __init__(self, node, kind, name, execute, goal_callback, cancel_callback):
        self.kind, self.name, self.execute, self.destroyed = kind, name, execute, False
        self.judge = goal_callback

    def destroy(self):
        self.destroyed = True


def test_the_standard_action_is_offered_where_its_type_is_installed(probe, monkeypatch):
    kind = SimpleNamespace(Result=SimpleNamespace, Feedback=SimpleNamespace)
    package = ModuleType("control_msgs.action")
    package.GripperCommand = package.ParallelGripperCommand = kind
    monkeypatch.setitem(sys.modules, "control_msgs", ModuleType("control_msgs"))
    monkeypatch.setitem(sys.modules, "control_msgs.action", package)
    monkeypatch.setattr("finforce_driver.node.ActionServer", FakeServer)
    gripper, node = driver(probe)
    actions = list(node.actions)
    assert [action.name for action in actions] == ["~/gripper_cmd", "~/parallel_gripper_cmd"]
    action = actions[0]
    goal = FakeGoal(0.02)
    result = probe.spinner.create_task(action.execute, goal)
    probe.wait_for(lambda: gripper.calls)
    gripper.reply(phase=Phase.READY, outcome=MoveOutcome.REACHED)
    probe.wait_for(result.done)
    assert result.result().reached_goal and goal.ends == ["succeed"]
    node.destroy_node()
    assert all(action.destroyed for action in actions)


def test_an_emergency_stop_that_the_gripper_does_not_confirm_is_pending(probe):
    gripper, _ = driver(probe)
    gripper.reply(stop_pending=True, estopped=True, phase=Phase.FAULT)
    answer = call(probe, Trigger, "estop")
    assert not answer.success and "emergency stop pending" in answer.message
