import pytest
from emulator_fakes import CALIBRATE, CLEAR, IDLE, RESET, Host, calibrated_host

from finforce_sim.emulator.control import Mode


def test_calibration_finds_the_stops_closes_and_goes_limp(variant):
    host = Host(variant)
    host.tell(CALIBRATE)
    opened, duration = 0.0, 0
    while not host.poll()[3] & 1:
        duration += 1
        opened = max(opened, host.gripper.jaws.opening)
        assert duration < 5000
    low, high = (2.0, 3.0) if variant == "new" else (0.75, 1.5)
    assert low < 1e-3 * duration < high
    assert opened == pytest.approx(0.048) and host.gripper.jaws.opening == pytest.approx(0.0, abs=1e-12)
    assert host.gripper.mode is Mode.IDLE
    host.wait(0.2)
    assert host.poll() == bytes.fromhex("FF000031")


def test_first_calibrated_reply_carries_a_stale_position():
    host = Host()
    host.calibrate()
    host.tell(RESET)
    host.wait(0.4)
    assert host.poll()[0] == 0  # whole turns are lost: closed jaws look open
    host.tell(CALIBRATE)
    reply = host.poll()
    while not reply[3] & 1:
        reply = host.poll()
    assert reply[0] < 250 and host.poll()[0] == 255


def test_object_in_the_jaws_spoils_the_calibration(variant):
    host = Host(variant, object_opening=0.02)
    host.calibrate()
    assert host.poll()[0] == 255 and host.gripper.jaws.opening == pytest.approx(0.02)


def test_calibration_that_finds_no_stop_times_out(variant):
    host = calibrated_host(variant)
    host.gripper.jaws.slips = True
    host.tell(CALIBRATE)
    host.wait(13.5 if variant == "old" else 29.5)
    assert host.poll()[3] & 1 and host.gripper.mode is Mode.CALIBRATE  # not cleared at the start
    host.wait(1.0)
    assert not host.poll()[3] & 1 and host.gripper.mode is Mode.IDLE


@pytest.mark.parametrize("line", [IDLE, CLEAR, "t07A50000012C80"])
def test_aborted_calibration_goes_on_where_it_was(line):
    host = Host()
    host.tell(CALIBRATE)
    host.wait(0.9)  # the open stop was found, the jaws are closing
    host.ask(line)
    host.wait(0.1)
    between = host.gripper.jaws.opening
    assert host.gripper.mode is not Mode.CALIBRATE and 0.01 < between < 0.047
    host.tell(CALIBRATE)
    host.wait(0.05)
    assert host.gripper.jaws.opening < between


def test_empty_polls_do_not_abort_a_calibration(variant):
    host = Host(variant)
    host.tell(CALIBRATE)
    for _ in range(4000):
        host.poll()
    assert host.gripper.calibrated


def test_order_during_calibration_aborts_it_and_is_noted():
    host = Host()
    host.tell(CALIBRATE)
    host.wait(0.5)
    host.order()
    host.wait(5.0)
    assert not host.gripper.calibrated
    assert host.gripper.violations["order during calibration"] == 1


def test_gripper_that_is_not_configured_calibrates_but_does_nothing_else(variant):
    host = Host(variant)
    host.gripper.configured = False
    host.calibrate()
    assert host.gripper.jaws.opening == pytest.approx(0.0, abs=1e-12)
    host.order(0, 255)
    host.wait(0.5)
    assert host.poll()[0] == 0 and host.gripper.jaws.opening == pytest.approx(0.0, abs=1e-12)
