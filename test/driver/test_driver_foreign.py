"""Claims about what the driver did not order, and about faults that were cleared; the emulator's truth is the judge."""

import pytest
from foreign_trials import EVENTS, STARTS, Trial, run_many

from finforce_driver.machine.machine import GripperMachine
from finforce_driver.machine.move import OrderWatch
from finforce_driver.state import MoveOutcome, Phase
from finforce_sim.emulator.firmware import Fault


def test_what_the_driver_did_not_order_never_becomes_a_wrong_state_or_a_crushed_object():
    found, by_event, wrong, _, peak = run_many(12)
    assert (dict(found), dict(by_event), wrong) == ({}, {}, [])
    assert peak < 8.0


def test_the_trials_draw_every_event_and_start():
    trials = [Trial(seed) for seed in range(60)]
    assert {trial.event for trial in trials} == set(EVENTS) and {trial.start for trial in trials} == set(STARTS)


def test_a_driver_that_believes_foreign_orders_is_found_out(monkeypatch):
    monkeypatch.setattr(OrderWatch, "judge", lambda _self, _reply, _asleep: "")
    monkeypatch.setattr(OrderWatch, "strays", lambda _self, _reply: False)
    monkeypatch.setattr(GripperMachine, "_take_unasked", lambda _self, _message: None)
    assert {"over 8 N", "ready while the jaws move"} <= set(run_many(8, 1)[0])


def grasp(rig):
    """Grasp a spring by the motor's current."""
    rig.arrive(0.024)
    rig.emulated.jaws.load = lambda opening: 600.0 * max(0.0, 0.022 - opening)
    assert rig.arrive(0.0, 0.01, 7.5).outcome is MoveOutcome.GRASPED


CAUSES = {
    "temperature": lambda gripper: gripper.faults.add(Fault.TEMPERATURE),
    "supply": lambda gripper: gripper.faults.add(Fault.SUPPLY),
    "encoder": lambda gripper: gripper.faults.add(Fault.ENCODER),
    "watchdog": lambda gripper: gripper.faults.add(Fault.WATCHDOG),
    "stop of another program": lambda gripper: gripper.faults.add(Fault.ESTOP_COMMAND),
    "stop flag of another program": lambda gripper: setattr(gripper.protection, "estop_flag", True),
    "our stop": None,
    "fault that passes by itself": lambda gripper: gripper.faults.add(Fault.SUPPLY),
}


@pytest.mark.parametrize("cause", CAUSES)
def test_a_gripper_whose_fault_was_cleared_grasps_nothing(rig, cause):
    grasp(rig)
    rig.gripper.estop() if CAUSES[cause] is None else CAUSES[cause](rig.emulated)
    rig.wait_for(Phase.FAULT)
    if cause == "fault that passes by itself":
        rig.emulated.faults.clear()
    else:
        rig.gripper.clear_errors()
    state = rig.wait_for(Phase.READY, patience=3.0)
    rig.live(0.5)
    for seen in (state, rig.state):
        assert (seen.outcome, seen.contact, seen.at_target) == (MoveOutcome.NONE, "", False)
        assert not seen.activated
    assert rig.state.opening == pytest.approx(rig.emulated.jaws.opening, abs=4e-4)
    assert rig.arrive(0.020, 0.05, 10.0).activated
