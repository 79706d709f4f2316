"""Claims about what a driver reads of messages and says of itself: commands, goals, stamps, levels, words."""

import math
from dataclasses import replace
from types import SimpleNamespace

import pytest
from driver_node_fakes import READY, FakeGripper

from finforce.health import Level, StampError
from finforce.messages import NANOSECONDS
from finforce.settings import ParameterError
from finforce_driver.conversions import (
    MessageTimes,
    goal_from_joint_state,
    move_from_gripper_command,
    move_from_joint_state,
    news_of_state,
    outcome_of_state,
)
from finforce_driver.errors import TargetError
from finforce_driver.grasp.session import GraspSession
from finforce_driver.node import build_gripper
from finforce_driver.settings import DriverParameters, GraspGoal, GraspSettings, GripperSettings
from finforce_driver.state import MoveOutcome, Phase, describe_record

JOINTS = ("left_jaw_joint", "right_jaw_joint")


def joints(position=(), velocity=(), effort=(), name=()):
    return SimpleNamespace(name=name, position=position, velocity=velocity, effort=effort)


def test_one_value_for_both_joints_is_that_of_each():
    # what a hardware interface sends for a joint and another one that mimics it
    assert move_from_joint_state(joints([0.01], name=JOINTS), JOINTS).opening == pytest.approx(0.02)


def test_a_command_leaves_to_the_driver_what_it_does_not_say():
    move = move_from_joint_state(joints(position=[0.02]))
    assert (move.opening, move.speed, move.force) == (0.02, None, None)
    move = move_from_joint_state(joints([0.02], [0.005], [10.0]))
    assert (move.opening, move.speed, move.force) == (0.02, 0.005, 10.0)


@pytest.mark.parametrize("names", [JOINTS[:1], JOINTS[1:], JOINTS, JOINTS[::-1]])
def test_a_command_that_names_joints_means_their_values_each_half_the_opening(names):
    count = len(names)
    move = move_from_joint_state(joints([0.01] * count, [0.004] * count, [9.0] * count, names), JOINTS)
    assert (move.opening, move.speed, move.force) == pytest.approx((0.02, 0.008, 9.0))


@pytest.mark.parametrize(
    ("message", "words"),
    [
        (
            joints([0.01], name=["finger_joint"]),
            r"joints \['finger_joint'\]; expected left_jaw_joint or right_jaw_joint",
        ),
        (joints([], name=JOINTS), "0 positions of 2 joints"),
        (joints([0.01, 0.01, 0.01], name=JOINTS), "3 positions of 2 joints"),
        (joints([0.01, 0.02], name=JOINTS), "expected the same for both joints"),
        (joints([0.01] * 2, name=[JOINTS[0]] * 2), "or both, or no name"),
    ],
)
def test_a_command_of_other_joints_is_refused(message, words):
    with pytest.raises(TargetError, match=words):
        move_from_joint_state(message, JOINTS)


@pytest.mark.parametrize(
    ("message", "words"),
    [
        (joints(velocity=[0.01]), "a command without position"),
        (joints(position=[0.01, 0.01]), "2 values of position"),
        (joints(position=[0.01], effort=[1.0, 1.0]), "2 values of effort"),
    ],
)
def test_a_command_that_is_none_is_refused(message, words):
    with pytest.raises(TargetError, match=words):
        move_from_joint_state(message)


def test_no_effort_of_the_standard_action_is_the_drivers_own():
    goal = SimpleNamespace(command=SimpleNamespace(position=0.01, max_effort=0.0))
    assert move_from_gripper_command(goal).force is None
    goal.command.max_effort = 12.0
    assert move_from_gripper_command(goal).force == 12.0


def test_a_goal_changes_only_what_it_says():
    last = GraspGoal(force=1.5, speed=0.006, time_limit=7.0)
    assert goal_from_joint_state(joints([0.01], (), [2.5]), last) == GraspGoal(
        force=2.5, speed=0.006, least_opening=0.01, time_limit=7.0
    )


@pytest.mark.parametrize(
    ("message", "words"),
    [
        (joints(), "an empty grasp goal"),
        (joints(effort=[math.nan]), "force: got nan"),
        (joints(effort=[-1.0]), "force: got -1"),
        (joints(velocity=[math.nan]), "speed: got nan"),
        (joints(position=[-0.01]), "least_opening: got -0.01"),
    ],
)
def test_a_goal_that_cannot_be_is_refused(message, words):
    with pytest.raises(TargetError, match=words):
        goal_from_joint_state(message, GraspGoal(force=1.0))


class SteppedClock:
    """The gripper's clock, stepped by hand."""

    time = 100.0

    def now(self):
        return self.time


def test_a_stamp_keeps_its_age_on_the_grippers_clock():
    times = MessageTimes(SteppedClock(), ("force",), max_age=0.2)
    now = 1_700_000_000 * NANOSECONDS
    assert times.enter("force", now - 50_000_000, now) == pytest.approx(99.95, abs=1e-9)
    assert times.to_stamp(99.95, now) == now - 50_000_000


def test_sources_do_not_disturb_each_other():
    times = MessageTimes(SteppedClock(), ("left", "right"), max_age=0.2)
    for name in ("left", "right"):
        times.enter(name, 10 * NANOSECONDS, 10 * NANOSECONDS)
    with pytest.raises(StampError, match="stand still"):
        times.enter("left", 10 * NANOSECONDS, 10 * NANOSECONDS)


def test_a_clock_that_does_not_go_yet_stamps_nothing():
    times = MessageTimes(SteppedClock(), (), max_age=0.2)
    with pytest.raises(StampError, match="use_sim_time without /clock"):
        times.to_stamp(99.9, 0)


@pytest.mark.parametrize("name", ["port", "interface", "gripper_frame"])
def test_a_name_that_is_empty_is_refused(name):
    with pytest.raises(ParameterError, match=f"{name} is empty; expected a name"):
        DriverParameters(**{name: ""})


def test_openings_beyond_the_stroke_are_refused_at_the_start():
    with pytest.raises(TargetError, match=r"release_opening: got 0.4 m, expected 0 to 0.048 m"):
        build_gripper(DriverParameters(release_opening=0.4), GripperSettings())
    with pytest.raises(TargetError, match=r"least opening: got 0.06 m, expected 0 to 0.048 m"):
        GraspSession(FakeGripper(), GraspGoal(force=1.0, least_opening=0.06), GraspSettings())
    GraspSession(FakeGripper(closed_opening=0.01), GraspGoal(force=1.0, least_opening=0.0), GraspSettings())


@pytest.mark.parametrize("names", [(), ("a",), ("a", "a"), ("a", "b", "c")])
def test_joints_that_are_not_two_are_refused(names):
    with pytest.raises(ParameterError, match="joint_names"):
        DriverParameters(joint_names=names)


@pytest.mark.parametrize(
    ("changes", "level"),
    [
        ({}, Level.OK),
        ({"phase": Phase.MOVING}, Level.OK),
        ({"outcome": MoveOutcome.GRASPED}, Level.OK),
        ({"outcome": MoveOutcome.ABORTED}, Level.WARN),
        ({"outcome": MoveOutcome.BLOCKED}, Level.WARN),
        ({"phase": Phase.UNCALIBRATED}, Level.WARN),
        ({"phase": Phase.DISCONNECTED}, Level.ERROR),
        ({"estopped": True}, Level.ERROR),
        ({"faults": ("temperature",)}, Level.ERROR),
    ],
)
def test_the_level_follows_from_phase_faults_and_outcome(changes, level):
    assert outcome_of_state(replace(READY, message="", **changes)).level == level


def test_what_is_not_known_is_a_dash():
    figures = describe_record(replace(READY, opening=math.nan, temperature=math.nan, force=-0.0))
    assert (figures["opening [mm]"], figures["temperature [deg C]"]) == ("-", "-")
    assert figures["force by the maker's curve [N]"] == "0.0"


def test_moves_are_no_news_and_faults_are():
    assert news_of_state(READY) == news_of_state(replace(READY, phase=Phase.MOVING, message="moving"))
    assert news_of_state(replace(READY, phase=Phase.FAULT, message="let it cool")) == "let it cool"
