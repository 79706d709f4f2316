"""Claims about commands that come while another one is waited for, and about what is left of a grasp that has ended."""

from dataclasses import replace

import pytest
from driver_node_fakes import READY, Caller, FakeGripper
from test_driver_tasks import Grasping, build

from finforce.health import Level
from finforce_driver.conversions import news_of_state, outcome_of_state
from finforce_driver.errors import GraspError, GripperStateError
from finforce_driver.state import MoveOutcome, Phase


@pytest.mark.parametrize("name", ["grasp", "stop"])
def test_a_command_that_is_refused_does_not_end_the_wait_for_another(name):
    gripper, _, tasks = build()
    with Caller(tasks.calibrate) as caller:
        caller.wait_for(lambda: gripper.calls == [("calibrate",)])
        gripper.refusal = "the gripper calibrates"
        with pytest.raises((GraspError, GripperStateError)):
            getattr(tasks, name)()
        gripper.reply(phase=Phase.READY)
        assert "calibrated" in caller.result()


def test_a_grasp_that_begins_ends_the_wait_for_another_command():
    gripper, session, tasks = build()
    gripper.reply()
    with Caller(tasks.release) as release:
        release.wait_for(lambda: gripper.calls)
        gripper.reply()
        with Caller(tasks.grasp) as grasp:
            with pytest.raises(GripperStateError, match="another command"):
                release.result()
            session.stop("enough")
            with pytest.raises(GraspError):
                grasp.result()


@pytest.mark.parametrize(
    "change", [{"phase": Phase.DISCONNECTED, "message": "unplugged"}, {"phase": Phase.FAULT, "message": "too hot"}]
)
def test_a_grasp_that_lost_its_gripper_is_over_and_the_next_one_is_judged_anew(change):
    with Grasping() as grasp:
        grasp.gripper.reply(**change)
        assert change["message"] in grasp.refusal()
        assert not grasp.session.runs
        grasp.gripper.reply(phase=Phase.CALIBRATING, message="wait")
        with pytest.raises(GraspError, match="wait"):
            grasp.tasks.grasp()


def test_the_end_of_a_grasp_is_told_at_once():
    told = []
    gripper, session, tasks = build(FakeGripper(replace(READY, phase=Phase.UNCALIBRATED)))
    session._ended = lambda: told.append(session.status.phase.value)
    with pytest.raises(GraspError, match="uncalibrated"):
        tasks.grasp()
    assert told == ["stopped"]


@pytest.mark.parametrize("outcome", [MoveOutcome.REACHED, MoveOutcome.REPLACED, MoveOutcome.NONE])
def test_what_another_program_does_to_a_gripper_that_works_is_a_warning(outcome):
    state = replace(READY, outcome=outcome, message="another program commands this gripper: stop it")
    assert outcome_of_state(state).level == Level.WARN
    assert news_of_state(state) == state.message


def test_an_ordinary_sentence_is_no_warning():
    assert (
        outcome_of_state(replace(READY, outcome=MoveOutcome.REACHED, message="the opening is reached")).level
        == Level.OK
    )
    assert outcome_of_state(replace(READY, phase=Phase.MOVING, message="moving")).level == Level.OK
