import pytest
from emulator_fakes import CALIBRATE, CLEAR, ESTOP, RESET, VARIANTS, Host, calibrated_host

from finforce_sim.emulator.control import Mode
from finforce_sim.emulator.firmware import Fault


@pytest.fixture(params=VARIANTS)
def moving(request):
    """Return a host whose gripper closes slowly."""
    host = calibrated_host(request.param)
    host.order(255, 10)
    host.wait(0.1)
    assert host.gripper.mode is Mode.GRIPPER
    return host


def stands(host) -> bool:
    before = host.gripper.jaws.ticks
    host.wait(0.1)
    return host.gripper.jaws.ticks == before


@pytest.mark.parametrize(
    ("name", "value", "fault"),
    [
        ("temperature", 75.5, Fault.TEMPERATURE),
        ("temperature", -20.5, Fault.TEMPERATURE),
        ("voltage", 8.9, Fault.SUPPLY),
        ("voltage", 29.1, Fault.SUPPLY),
        ("magnet", False, Fault.ENCODER),
        ("motor_calibrated", False, Fault.MOTOR_UNCALIBRATED),
        ("estop_flag", True, Fault.ESTOP_FLAG),
    ],
)
def test_faults_stop_the_jaws_and_stay_until_cleared_without_cause(moving, name, value, fault):
    protection = moving.gripper.protection
    sound = getattr(protection, name)
    setattr(protection, name, value)
    moving.wait(0.001)
    assert moving.gripper.faults == {fault} and stands(moving)
    moving.tell(CLEAR)
    assert moving.gripper.faults == {fault}  # the cause is still there
    setattr(protection, name, sound)
    moving.wait(0.1)
    assert moving.gripper.faults == {fault}
    moving.tell(CLEAR)
    assert moving.gripper.faults == set() and moving.gripper.mode is Mode.IDLE


def test_estop_command_is_cleared_by_clear_alone(moving):
    moving.tell(ESTOP)
    assert moving.ask("t07A0")[0].startswith("t079") and stands(moving)
    moving.tell(CLEAR)
    assert moving.ask("t07A0")[0].startswith("t078")


def test_estop_flag_must_be_taken_back_before_the_clear(moving):
    moving.order(flags=0xE0)
    moving.wait(0.001)
    assert moving.poll()[3] & 0x02
    moving.tell(CLEAR)
    assert moving.poll()[3] & 0x02, "a clear before the flag is taken back must not help"
    moving.order(flags=0x80)
    assert moving.poll()[3] & 0x02, "the flag alone must not help either"
    moving.tell(CLEAR)
    assert not moving.poll()[3] & 0x02 and moving.gripper.faults == set()


def test_calibration_survives_a_fault_but_not_a_reset(moving):
    moving.tell(ESTOP, CLEAR)
    assert moving.poll()[3] & 1
    moving.tell(RESET)
    moving.wait(0.31)
    assert not moving.poll()[3] & 1


def test_fault_drops_a_calibration_silently(moving):
    moving.tell(ESTOP, CALIBRATE)
    assert moving.gripper.mode is Mode.IDLE and stands(moving)


def test_reset_is_followed_by_silence_and_the_power_up_state(moving):
    moving.tell(RESET)
    moving.wait(0.29)
    assert moving.ask("t07A0") == []
    moving.wait(0.02)
    (reply,) = moving.ask("t07A0")
    assert reply.endswith("30") and moving.gripper.order.flags == 0


def test_watchdog_is_off_at_first(moving):
    moving.wait(60.0)
    assert moving.gripper.faults == set()


def set_watchdog(host, milliseconds):
    """Set it in the way that the variant takes."""
    length = 4 if host.gripper.variant == "old" else 5
    host.tell(f"t01E{length}{milliseconds:08X}" + "00" * (length - 4))


@pytest.mark.parametrize("line", ["t07A0", "t07A50000012C80", "r0140", "r02E0", "r0340"])
def test_some_messages_feed_the_watchdog(moving, line):
    set_watchdog(moving, 100)
    for _ in range(5):
        moving.wait(0.09)
        moving.ask(line)
    assert moving.gripper.faults == set()
    moving.wait(0.11)
    assert moving.gripper.faults == {Fault.WATCHDOG} and moving.poll()[3] & 0x04


@pytest.mark.parametrize("line", [CALIBRATE, CLEAR, "t07A1FF"])
def test_others_do_not(moving, line):
    set_watchdog(moving, 100)
    moving.wait(0.09)
    moving.ask(line)
    moving.wait(0.02)
    assert moving.gripper.faults == {Fault.WATCHDOG}


def test_each_variant_takes_its_own_length_of_the_watchdog_setter():
    for variant, line in (("new", "t01E40000000A"), ("old", "t01E50000000A00")):
        host = Host(variant)
        host.tell(line)
        host.wait(1.0)
        assert host.gripper.faults == set()
