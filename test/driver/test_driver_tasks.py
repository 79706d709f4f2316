"""Claims about what a driver's services, commands and goals do: refusals, waiting, and what ends a grasp."""

import math
from dataclasses import replace
from types import SimpleNamespace

import pytest
from driver_node_fakes import READY, Caller, FakeGoal, FakeGripper
from emulator_fakes import Rig

from finforce_driver.conversions import (
    fill_gripper_command,
    move_from_gripper_command,
    move_from_joint_state,
    news_of_state,
    outcome_of_state,
)
from finforce_driver.errors import DriverError, GraspError, GripperStateError, TargetError
from finforce_driver.grasp.force_monitor import ForceSample
from finforce_driver.grasp.session import GraspSession
from finforce_driver.services import GripperTasks, MoveAction
from finforce_driver.settings import DriverParameters, GraspGoal, GraspSettings
from finforce_driver.state import GraspPhase, MoveOutcome, Phase


def build(gripper=None, **parameters):
    """Tasks and grasps of a fake gripper."""
    gripper = gripper or FakeGripper()
    given = DriverParameters(**parameters)
    session = GraspSession(gripper, GraspGoal(force=given.grasp_force, speed=given.grasp_speed), GraspSettings())
    return gripper, session, GripperTasks(gripper, session, given)


def test_a_calibration_is_answered_when_it_is_over():
    gripper, _, tasks = build()
    with Caller(tasks.calibrate) as caller:
        caller.wait_for(lambda: gripper.calls == [("calibrate",)])
        assert not caller.done
        gripper.reply(phase=Phase.READY)
        assert "calibrated" in caller.result()


def test_a_calibration_that_fails_says_why():
    gripper, _, tasks = build()
    with Caller(tasks.calibrate) as caller:
        caller.wait_for(lambda: gripper.calls == [("calibrate",)])
        gripper.reply(phase=Phase.FAULT, message="let it cool")
        with pytest.raises(GripperStateError, match="let it cool"):
            caller.result()


@pytest.mark.parametrize("other", ["stop", "estop", "close"])
def test_what_is_waited_for_ends_with_another_command(other):
    gripper, _, tasks = build()
    with Caller(tasks.release) as caller:
        caller.wait_for(lambda: gripper.calls)
        getattr(tasks, other)()
        with pytest.raises(GripperStateError, match="another command"):
            caller.result()


@pytest.mark.parametrize("name", ["calibrate", "clear_errors", "release", "grasp_without_vision", "stop", "activate"])
def test_what_the_gripper_refuses_is_raised(name):
    gripper, _, tasks = build()
    gripper.refusal = "check 24 V"
    arguments = (True,) if name == "activate" else ()
    with pytest.raises(DriverError, match="check 24 V"):
        getattr(tasks, name)(*arguments)


def test_release_opens_as_far_as_the_gripper_goes():
    gripper, _, tasks = build(FakeGripper(closed_opening=0.01))
    with Caller(tasks.release) as caller:
        caller.wait_for(lambda: gripper.calls)
        gripper.reply(phase=Phase.READY, outcome=MoveOutcome.REACHED, opening=0.058)
        assert "58.0 mm" in caller.result()
    assert gripper.calls == [("move", pytest.approx(0.058), None, None)]


def test_release_opens_as_far_as_it_is_told():
    gripper, _, tasks = build(release_opening=0.03)
    with Caller(tasks.release) as caller:
        caller.wait_for(lambda: gripper.calls)
        gripper.reply(phase=Phase.READY, outcome=MoveOutcome.BLOCKED)
        with pytest.raises(GripperStateError, match="blocked while opening"):
            caller.result()
    assert gripper.calls[0][1] == 0.03


def test_a_grasp_without_vision_uses_the_motors_force_and_is_named_so():
    gripper, _, tasks = build(motor_force=12.0, grasp_speed=0.006)
    with Caller(tasks.grasp_without_vision) as caller:
        caller.wait_for(lambda: gripper.calls)
        gripper.reply(phase=Phase.READY, outcome=MoveOutcome.GRASPED)
        assert "without vision" in caller.result()
    assert gripper.calls == [("move", 0.0, 0.006, 12.0)]


def test_a_grasp_without_vision_on_nothing_holds_in_place():
    gripper, _, tasks = build()
    with Caller(tasks.grasp_without_vision) as caller:
        caller.wait_for(lambda: gripper.calls)
        gripper.reply(phase=Phase.READY, outcome=MoveOutcome.CLOSED_EMPTY, opening=0.0)
        with pytest.raises(GripperStateError, match="closed on nothing"):
            caller.result()
    assert gripper.calls[-1] == ("hold",)


class Grasping:
    """A grasp by force that has begun to close, its gripper and its forces."""

    def __init__(self, **parameters):
        self.gripper, self.session, self.tasks = build(**parameters)
        self.gripper.listen(self.session.update)
        self.gripper.reply()
        self.caller = Caller(self.tasks.grasp)

    def __enter__(self):
        self.caller.__enter__()
        self.caller.wait_for(lambda: self.session.runs)
        for _ in range(15):
            self.turn()
        assert self.gripper.calls[-1][0] == "move"
        return self

    def __exit__(self, kind, *_):
        if kind is None:
            self.caller.__exit__()

    def turn(self, force=0.0):
        now = self.gripper.clock.now()
        self.session.take_force(ForceSample(stamp=now - 0.03, arrived=now, force=force))
        self.gripper.reply()

    def refusal(self):
        with pytest.raises(GraspError) as raised:
            self.caller.result()
        return str(raised.value)


@pytest.mark.parametrize(
    ("name", "words", "last"),
    [
        ("stop", "stopped by command", "hold"),
        ("estop", "emergency stop", "estop"),
        ("release", "release was commanded", "move"),
        ("close", "the driver ends", "move"),
    ],
)
def test_another_command_ends_a_grasp(name, words, last):
    with Grasping() as grasp:
        with Caller(getattr(grasp.tasks, name)) as other:
            assert words in grasp.refusal()
            grasp.gripper.reply(phase=Phase.READY, outcome=MoveOutcome.REACHED)
            other.result()
        assert not grasp.session.runs
        assert grasp.gripper.calls[-1][0] == last
        assert grasp.session.status.phase is GraspPhase.STOPPED


@pytest.mark.parametrize("name", ["calibrate", "grasp_without_vision"])
def test_what_would_let_go_or_crush_what_a_grasp_holds_is_refused_until_it_is_stopped(name):
    with Grasping() as grasp:
        before = list(grasp.gripper.calls)
        with pytest.raises(GripperStateError, match=f"{name}: a grasp by force is under way; stop or release it first"):
            getattr(grasp.tasks, name)()
        assert grasp.session.runs and grasp.gripper.calls == before
        grasp.tasks.stop()
        assert grasp.refusal()
        with Caller(getattr(grasp.tasks, name)) as other:
            other.wait_for(lambda: grasp.gripper.calls[-1][0] in ("calibrate", "move"))
            grasp.gripper.reply(phase=Phase.READY, outcome=MoveOutcome.GRASPED)
            other.result()


def test_a_command_that_is_refused_leaves_a_grasp_as_it_was():
    with Grasping() as grasp:
        with pytest.raises(TargetError):
            grasp.tasks.move(
                move_from_joint_state(SimpleNamespace(name=(), position=[math.nan], velocity=(), effort=()))
            )
        with pytest.raises(TargetError):
            grasp.session.set_goal(GraspGoal(force=20.0))
        assert grasp.session.runs and not grasp.caller.done
        grasp.tasks.stop()


@pytest.mark.parametrize("force", [math.nan, math.inf, -1.0])
def test_a_force_that_is_none_stops_a_grasp_at_once(force):
    with Grasping() as grasp:
        grasp.turn(force)
        assert grasp.gripper.calls[-1] == ("hold",)
        assert "force" in grasp.refusal()


def test_clearing_errors_leaves_a_grasp_alone():
    with Grasping() as grasp:
        assert "no error" in grasp.tasks.clear_errors()
        assert grasp.session.runs and not grasp.caller.done
        grasp.tasks.stop()


def test_a_second_call_waits_for_the_grasp_that_runs():
    with Grasping() as grasp:
        first = grasp.session._grasp
        with Caller(grasp.tasks.grasp) as second:
            grasp.turn()
            assert grasp.session._grasp is first
            grasp.tasks.stop()
            with pytest.raises(GraspError, match="stopped by command"):
                second.result()


def test_a_gripper_that_refuses_to_move_ends_a_grasp():
    with Grasping() as grasp:
        grasp.gripper.reply(phase=Phase.READY, opening=grasp.gripper.calls[-1][1])
        grasp.gripper.refusal = "check 24 V"
        for _ in range(30):
            grasp.turn()
        assert "check 24 V" in grasp.refusal()
        assert not grasp.session.runs


def test_a_goal_reaches_the_grasp_that_runs():
    with Grasping() as grasp:
        grasp.session.set_goal(GraspGoal(force=2.0))
        grasp.turn()
        assert grasp.session.status.goal == 2.0 and grasp.session.runs
        grasp.tasks.stop()


def told(monkeypatch, grasp):
    """What the grasp that runs is told of touches."""
    heard = []
    monkeypatch.setattr(grasp.session._grasp, "take_touch", lambda touching, stamp: heard.append((touching, stamp)))
    return heard


def test_two_jaws_that_do_not_touch_are_one_word(monkeypatch):
    with Grasping() as grasp:
        heard = told(monkeypatch, grasp)
        for stamp in (10.0, 10.1):
            grasp.session.take_touch("left", False, stamp)
            grasp.session.take_touch("right", False, stamp)
        # the first jaw stands alone until the other has spoken
        assert heard == [(False, 10.0), (False, 10.1)]
        grasp.tasks.stop()


def test_one_jaw_that_touches_is_told_at_once(monkeypatch):
    with Grasping() as grasp:
        heard = told(monkeypatch, grasp)
        grasp.session.take_touch("left", False, 10.0)
        grasp.session.take_touch("right", False, 10.0)
        grasp.session.take_touch("left", True, 10.1)
        grasp.session.take_touch("right", False, 10.1)
        assert heard == [(False, 10.0), (True, 10.1)]
        grasp.tasks.stop()


def test_a_jaw_that_is_silent_does_not_silence_the_other(monkeypatch):
    with Grasping() as grasp:
        heard = told(monkeypatch, grasp)
        grasp.session.take_touch("right", True, 10.0)
        grasp.session.take_touch("left", False, 10.1)
        grasp.session.take_touch("left", False, 11.0)
        assert heard == [(True, 10.0), (False, 11.0)]
        grasp.tasks.stop()


def action(gripper, tasks=None):
    """The action GripperCommand of a gripper."""
    kind = SimpleNamespace(Result=SimpleNamespace, Feedback=SimpleNamespace)
    return MoveAction(kind, move_from_gripper_command, fill_gripper_command, gripper, tasks)


@pytest.mark.parametrize(
    ("outcome", "end", "reached", "stalled"),
    [
        (MoveOutcome.REACHED, "succeed", True, False),
        (MoveOutcome.GRASPED, "succeed", False, True),
        (MoveOutcome.BLOCKED, "abort", False, False),
        (MoveOutcome.TIMED_OUT, "abort", False, False),
    ],
)
def test_the_standard_action_ends_with_the_outcome_of_the_move(outcome, end, reached, stalled):
    gripper, _, tasks = build()
    goal = FakeGoal(0.02, 10.0)
    with Caller(lambda: action(gripper, tasks).execute(goal)) as caller:
        caller.wait_for(lambda: goal.feedback)
        gripper.reply(phase=Phase.READY, outcome=outcome, opening=0.021, force=9.0)
        result = caller.result()
    assert gripper.calls == [("move", 0.02, None, 10.0)] and goal.ends == [end]
    assert (result.position, result.effort, result.reached_goal, result.stalled) == (0.021, 9.0, reached, stalled)


def test_a_cancelled_action_holds_in_place():
    gripper, _, tasks = build()
    goal = FakeGoal(0.02)
    goal.is_cancel_requested = True
    action(gripper, tasks).execute(goal)
    assert gripper.calls[-1] == ("hold",) and goal.ends == ["canceled"]


def test_an_action_that_is_refused_moves_nothing():
    gripper, _, tasks = build()
    goal = FakeGoal(math.nan)
    result = action(gripper, tasks).execute(goal)
    assert gripper.calls == [] and goal.ends == ["abort"]
    assert (result.position, result.reached_goal) == (READY.opening, False)


def test_an_action_of_a_gripper_that_knows_no_opening_has_numbers_all_the_same():
    gripper, _, tasks = build()
    gripper.refusal = "not calibrated"
    gripper.reply(opening=math.nan, force=math.nan)
    result = action(gripper, tasks).execute(FakeGoal(0.02))
    assert (result.position, result.effort) == (0.0, 0.0)


def test_a_first_goal_above_the_limit_is_refused():
    with pytest.raises(TargetError, match="force limit"):
        build(grasp_force=9.0)


@pytest.mark.parametrize(
    ("position", "effort", "words"),
    [
        (0.02, 5.0, "force: got 5 N, expected 7.16 to 62 N"),
        (0.02, 100.0, "force: got 100 N, expected 7.16 to 62 N"),
        (-0.0001, 10.0, "opening: got -0.0001 m, expected 0 to 0.048 m"),
        (math.nan, 10.0, "opening: got nan"),
        (0.02, 0.0, ""),
        (0.02, 10.0, ""),
    ],
)
def test_a_goal_of_the_action_that_cannot_be_is_rejected_with_the_reason(position, effort, words):
    rig = Rig()
    goal = SimpleNamespace(command=SimpleNamespace(position=position, max_effort=effort))
    rejection = action(rig.gripper).rejection(goal)
    assert words in rejection and bool(words) == bool(rejection)
    assert rig.state.outcome is MoveOutcome.NONE


def test_a_gripper_that_is_ready_and_limp_is_said_to_be_limp():
    gripper, _, tasks = build(FakeGripper(replace(READY, activated=False)))
    assert tasks.clear_errors() == "no error is latched; the gripper is ready, limp until the next move"
    assert "limp" in outcome_of_state(gripper.state).text and "limp" in news_of_state(gripper.state)
    assert "limp" not in outcome_of_state(READY).text + news_of_state(READY)


def test_a_grasp_whose_goal_is_changed_again_and_again_says_so(monkeypatch):
    monkeypatch.setattr("finforce_driver.grasp.session.MARGIN", 0.3)
    _, session, tasks = build()
    session.set_goal(replace(session.goal, time_limit=0.1))
    monkeypatch.setattr(session, "update", lambda state: None)  # it goes on
    session.status = None
    with Caller(tasks.grasp) as caller:
        caller.wait_for(lambda: session.runs)
        for force in (1.0, 2.0, 2.0, 1.0):
            session.set_goal(replace(session.goal, force=force))
        with pytest.raises(GraspError, match="not held within 0.4 s: its goal was changed 2 times"):
            caller.result()
