"""Claims about grasps by force through the driver node: forces, touches and goals by topic, the end of a grasp."""

import math
from time import time_ns

import numpy as np
import pytest
import rclpy
from driver_node_fakes import (
    COMMAND,
    GOAL,
    READY,
    ask,
    call,
    driver,
    gripper_state,
    send,
    wrench,
)
from geometry_msgs.msg import WrenchStamped
from sensor_msgs.msg import JointState
from std_msgs.msg import Header
from std_srvs.srv import Trigger

from finforce.health import Level
from finforce.ros import node as ros

SECOND = 1_000_000_000


BAD_FORCES = {
    "old": (lambda: wrench(1.0, stamp=time_ns() - SECOND), Level.STALE, "old"),
    "ahead": (lambda: wrench(1.0, stamp=time_ns() + 5 * SECOND), Level.ERROR, "ahead of the node's clock"),
    "message": (lambda: wrench(1.0, message="left_jaw"), Level.ERROR, "expected 'gripper_base'"),
}


def grasping(probe, **parameters):
    """A driver with a grasp that has begun to close, its gripper, its forces' publisher, and the answer to come."""
    gripper, node = driver(probe, **parameters)
    out = probe.speak("grasp_wrench", WrenchStamped)
    probe.connected(out)
    gripper.reply()
    answer = ask(probe, Trigger, "grasp")
    probe.wait_for(lambda: node.session.runs)

    def turn(force=0.0):
        out.publish(wrench(force))
        probe.spin(0.02)
        gripper.reply()

    for _ in range(20):
        turn()
    assert gripper.calls and gripper.calls[-1][0] == "move"
    return gripper, node, out, answer


@pytest.mark.parametrize("name", BAD_FORCES)
def test_a_force_that_cannot_be_is_named_and_not_used(probe, name):
    make, level, words = BAD_FORCES[name]
    gripper, _ = driver(probe)
    gripper.reply()
    out = probe.speak("grasp_wrench", WrenchStamped)
    probe.connected(out)
    out.publish(make())
    gripper_state(probe, None, words)
    assert gripper.calls == []


def test_forces_of_two_nodes_are_refused_with_both_names(probe):
    gripper, node = driver(probe)
    gripper.reply()
    out = probe.speak("grasp_wrench", WrenchStamped)
    second = rclpy.create_node("second_solver", context=probe.context)
    try:
        second.create_publisher(WrenchStamped, "grasp_wrench", ros.RESULT)
        probe.wait_for(lambda: node.count_publishers("/grasp_wrench") == 2)
        out.publish(wrench(1.0))
        gripper_state(probe, None, "published by /probe and /second_solver")
        assert node.seen is None
    finally:
        second.destroy_node()


def test_a_grasp_closes_with_the_forces_and_says_how_it_is(probe):
    gripper, *_ = grasping(probe, grasp_speed=0.005)
    _, opening, speed, force = gripper.calls[-1]
    assert opening < READY.opening and speed <= 0.005 and force == 7.5
    probe.wait_for(lambda: probe.got["/gripper_driver/grasp_state"])
    state = probe.got["/gripper_driver/grasp_state"][-1]
    assert "overshoot bound [N]" in {entry.key for entry in state.values}
    values = {entry.key: entry.value for entry in gripper_state(probe).values}
    assert values["grasp"] == "approach" and values["set force [N]"] == "1.00"


def test_a_move_ends_the_grasp_and_a_bad_one_does_not(probe):
    gripper, node, _, answer = grasping(probe)
    send(probe, COMMAND, JointState(position=[math.nan]))
    gripper_state(probe, Level.ERROR, "opening: got nan")
    assert node.session.runs
    send(probe, COMMAND, JointState(position=[0.04]))
    probe.wait_for(answer.done)
    assert "another move" in answer.result().message and gripper.calls[-1] == ("move", 0.04, None, None)


@pytest.mark.parametrize("force", [math.nan, -1.0])
def test_a_force_that_is_none_stops_the_grasp_at_once(probe, force):
    gripper, _, out, answer = grasping(probe)
    out.publish(wrench(force))
    probe.wait_for(answer.done)
    assert not answer.result().success and "force" in answer.result().message
    assert gripper.calls[-1] == ("hold",)


def test_a_force_topic_that_goes_silent_stops_the_grasp(probe):
    gripper, _, _, answer = grasping(probe)
    for _ in range(30):
        probe.spin(0.02)
        gripper.reply()
    assert answer.done() and not answer.result().success
    assert gripper.calls[-1] == ("hold",)


def test_a_grasp_that_failed_is_told_until_something_else_is_commanded(probe):
    gripper, node, out, answer = grasping(probe)
    out.publish(wrench(-1.0))
    probe.wait_for(answer.done)
    gripper.reply()
    state = gripper_state(probe, Level.WARN, "a grasp force of -1.0 N came")
    assert state.level[0] == Level.WARN and node.session.status.failed
    assert call(probe, Trigger, "stop").success
    assert not node.session.status.failed


def test_a_motor_that_presses_while_the_camera_sees_nothing_is_an_error_and_the_jaws_back_off(probe):
    gripper, node, out, answer = grasping(probe)
    for _ in range(10):
        out.publish(wrench(0.0))
        probe.spin(0.02)
        gripper.reply(force=6.0)
    probe.wait_for(answer.done)
    assert not answer.result().success and "the motor presses with 6.0 N" in answer.result().message
    name, opening, *_ = gripper.calls[-1]
    assert name == "move" and opening == pytest.approx(READY.opening, abs=2e-4)
    gripper_state(probe, Level.ERROR, "the motor presses with 6.0 N")


def test_the_goal_changes_while_a_grasp_runs(probe):
    _, node, _, _ = grasping(probe)
    send(probe, GOAL, JointState(effort=[2.0]))
    probe.wait_for(lambda: node.session.goal.force == 2.0)
    values = {}

    def shown():
        values.update({entry.key: entry.value for entry in gripper_state(probe).values})
        return values["set force [N]"] == "2.00"

    probe.wait_for(shown)
    assert node.session.runs


def contact(side, touching, *, message=None):
    header = Header(stamp=ros.stamp_message(time_ns()), frame_id=message or f"{side}_jaw")
    columns = {**ros.xyz_columns(np.zeros((1, 3))), "touching": np.array([touching], dtype=np.uint8)}
    return ros.cloud_message(header, columns)


def test_a_contact_in_another_frame_is_named(probe):
    gripper, _ = driver(probe)
    gripper.reply()
    send(probe, "left/contact", contact("left", 1, message="camera"))
    gripper_state(probe, Level.ERROR, "expected 'left_jaw'")


def test_touches_reach_the_grasp(probe, monkeypatch):
    _, node, _, _ = grasping(probe)
    told = []
    monkeypatch.setattr(node.session, "take_touch", lambda jaw, touching, stamp: told.append((jaw, touching)))
    send(probe, "left/contact", contact("left", 1))
    send(probe, "right/contact", contact("right", 0))
    probe.wait_for(lambda: len(told) == 2)
    assert sorted(told) == [("left", True), ("right", False)]


def test_the_end_of_a_grasp_is_told_once_and_kept_for_whoever_comes_later(probe):
    *_, answer = grasping(probe)
    assert call(probe, Trigger, "stop").success
    probe.wait_for(answer.done)
    state = probe.got["/gripper_driver/grasp_state"]
    probe.wait_for(lambda: state[-1].level[0] == Level.WARN)
    assert "stopped by command" in state[-1].message
    late = []
    probe.create_subscription(type(state[-1]), "/gripper_driver/grasp_state", late.append, ros.LATCHED)
    probe.wait_for(lambda: late)
    assert late[0].message == state[-1].message


def stddev(value, frame="left_jaw"):
    message = WrenchStamped(header=Header(stamp=ros.stamp_message(time_ns()), frame_id=frame))
    message.wrench.force.x = value
    return message


def test_the_stated_deviation_of_the_jaws_reaches_the_grasp(probe):
    _, node, _, _ = grasping(probe)
    send(probe, "left/wrench_stddev", stddev(0.1))
    send(probe, "right/wrench_stddev", stddev(0.3, "right_jaw"))
    out = probe.speak("grasp_wrench", WrenchStamped)
    probe.connected(out)

    def told():
        out.publish(wrench(0.0))
        probe.spin(0.02)
        return node.session.status.stddev == pytest.approx(0.3)

    probe.wait_for(told)


def test_a_deviation_that_cannot_be_is_named_and_not_used(probe):
    grasping(probe)
    send(probe, "left/wrench_stddev", stddev(math.nan))
    gripper_state(probe, Level.ERROR, "expected finite numbers from 0")
