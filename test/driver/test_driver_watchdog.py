"""Claims about the gripper's watchdog, which ends the last order of a driver that was killed."""

import pytest
from emulator_fakes import VARIANTS, Rig

from finforce_driver.errors import TargetError
from finforce_driver.settings import GripperSettings
from finforce_driver.state import MoveOutcome, Phase

both_variants = pytest.mark.parametrize("variant", VARIANTS)


@both_variants
@pytest.mark.parametrize("watchdog", [0.0, 0.3])
def test_what_is_left_of_a_killed_drivers_order_ends_with_the_grippers_watchdog(variant, watchdog):
    rig = Rig(variant, watchdog=watchdog)
    rig.arrive(0.04)
    rig.live(1.2)
    rig.gripper.move(0.0, 0.01)
    rig.live(0.5)
    before = rig.emulated.jaws.opening
    rig.clock.wait(3.0)  # killed: nobody asks any more, the jaws go on
    closed = before - rig.emulated.jaws.opening
    assert closed > 0.02 if not watchdog else closed < 0.01 * (watchdog + 0.1)


@both_variants
def test_a_driver_with_a_watchdog_leaves_what_it_holds_held(variant):
    rig = Rig(variant, watchdog=0.3)
    rig.live(1.2)
    rig.arrive(0.03)
    rig.gripper.close()
    rig.clock.wait(3.0)
    assert rig.emulated.faults == set() and rig.emulated.order.activated


@both_variants
def test_a_watchdog_is_set_again_after_a_restart_and_does_not_bite_a_driver_that_asks(variant):
    rig = Rig(variant, watchdog=0.3)
    rig.live(1.2)
    rig.emulated.reboot()
    rig.live(3.0)
    rig.gripper.calibrate()
    rig.wait_for(Phase.READY)
    rig.live(2.0)
    assert rig.emulated.protection.watchdog_period == 300
    assert rig.arrive(0.03).outcome is MoveOutcome.REACHED


def test_a_watchdog_that_a_moment_would_trip_is_refused():
    with pytest.raises(TargetError, match=r"watchdog: got 0\.05 s, expected 0 for none, or 0\.2 s at least"):
        GripperSettings(watchdog=0.05)
