"""Claims about the driver and grasps by force under random faults, against the emulator's truth.

FINFORCE_FAULTS is the number of faults and of grasps, 120 and 6 without it.
"""

import os

import pytest
from emulator_faults import FaultKind
from fault_trials import FaultRun, choose_kinds
from faulty_grasp_trials import play_all

from finforce_driver.machine.drive import Exchange
from finforce_driver.machine.status_tracker import ReplyFilter


def total(tally):
    return {
        "wrong": dict(tally.wrong),
        "motion": dict(tally.motion),
        "crashes": dict(tally.crashes),
        "hangs": tally.hangs,
        "unrecovered": tally.unrecovered,
    }


CLEAN = {"wrong": {}, "motion": {}, "crashes": {}, "hangs": 0, "unrecovered": 0}


FAULTS = int(os.environ.get("FINFORCE_FAULTS", 0))


@pytest.mark.parametrize("seed", range(3, 3 + max(2, FAULTS // 60)))
def test_faults_never_become_wrong_states_hangs_crashes_or_motion(seed):
    tally = FaultRun(seed, 60, choose_kinds(seed)).run()
    assert sum(tally.faults.values()) >= 60
    assert tally.states > 500
    assert total(tally) == CLEAN


def test_grasps_with_faults_stay_below_the_limit():
    tally = play_all(FAULTS or 6)
    assert tally.cases == len(tally.excess) == sum(tally.ends.values())
    assert not tally.complaints and not tally.wrong


def test_a_driver_that_believes_every_reply_is_found_out(monkeypatch):
    monkeypatch.setattr(ReplyFilter, "take", lambda _self, reply, _drift, _reach: reply)
    assert FaultRun(1, 60, (FaultKind.FLIPPED,)).run().wrong


def test_a_driver_that_does_not_get_back_into_step_is_found_out(monkeypatch):
    monkeypatch.setattr(Exchange, "in_step", True)
    assert FaultRun(7, 40, (FaultKind.LATE,)).run().wrong
