import struct

import pytest
from emulator_fakes import CALIBRATE, CLEAR, ESTOP, IDLE, VARIANTS, Host, calibrated_host, code_of, current_of

from finforce_driver.can.protocol import CanMessage, decode_move
from finforce_driver.errors import TargetError
from finforce_sim.emulator.control import Endpoints, Mode, ticks_per_second
from finforce_sim.emulator.firmware import EmulatedGripper, Fault


@pytest.fixture(params=VARIANTS)
def host(request):
    return Host(request.param)


def set_reply(host, *, position, current=0.0, code=0, order="0000000000", calibrated=False):
    """Bring a gripper into the state that a reply is said to tell of."""
    gripper = host.gripper
    gripper._position, gripper.jaws.current, gripper.calibrated = position, current, calibrated
    gripper._control.order, gripper._control.object_code = (
        decode_move(CanMessage(id=0x07A, data=bytes.fromhex(order))),
        code,
    )


def test_after_power_up_the_reply_is_that_of_the_maker(host):
    assert host.ask("t07A0") == ["t078400000030"]


@pytest.mark.parametrize(
    ("state", "line"),
    [
        (dict(position=128, order="80000000C0", calibrated=True), "t0784800000C1"),
        (dict(position=120, current=-412.0, code=1, order="FF1E01F4C0", calibrated=True), "t078478FE64E1"),
        (dict(position=120, current=-412.0, code=2, order="FF1E01F4C0", calibrated=True), "t078478FE64D1"),
        (dict(position=10, current=405.0, code=2, order="001E01F4C0", calibrated=True), "t07840A0195D1"),
        (dict(position=10, current=405.0, code=1, order="001E01F4C0", calibrated=True), "t07840A0195E1"),
        (dict(position=99, current=-35.0, code=3, order="641E01F4C0", calibrated=True), "t078463FFDDF1"),
        (dict(position=255, current=-12.0, code=3, calibrated=True), "t0784FFFFF431"),
    ],
)
def test_replies_are_packed_as_the_maker_packs_them(host, state, line):
    set_reply(host, **state)
    assert host.ask("t07A0") == [line]


def test_estop_flag_shows_in_the_reply(host):
    set_reply(host, position=0x48, calibrated=True)
    host.gripper.faults.add(Fault.ESTOP_FLAG)
    assert host.ask("t07A0") == ["t079448000003"]


@pytest.mark.parametrize(("fault", "status"), [(Fault.TEMPERATURE, "C9"), (Fault.WATCHDOG, "C5"), (Fault.SUPPLY, "C1")])
def test_faults_show_in_the_reply(host, fault, status):
    set_reply(host, position=0x48, order="48000000C0", calibrated=True)
    host.gripper.faults.add(fault)
    assert host.ask("t07A0") == [f"t0794480000{status}"]


def test_telemetry_is_answered_to_remote_messages(host):
    gripper = host.gripper
    gripper.jaws.current = -35.9
    assert host.ask("r0140") == ["t0140"]
    assert host.ask("r02E0") == ["t02E2001A"]
    assert host.ask("r0300") == ["t03025DC0"]
    gripper.step()
    assert host.ask("r0340") == ["t03420080"]
    gripper.jaws.current = -35.9
    assert host.ask("r0360") == ["t0362FFDD"]
    gripper.step()
    assert host.ask("r0380") == ["t0388" + struct.pack(">ii", 10329, 0).hex().upper()]


@pytest.mark.parametrize(
    ("cause", "line"),
    [
        (Fault.ESTOP_COMMAND, "t03528180"),
        (Fault.ESTOP_FLAG, "t03528080"),
        (Fault.WATCHDOG, "t035280A0"),
        (Fault.SUPPLY, "t03529080"),
        (Fault.ENCODER, "t0352A080"),
        (Fault.TEMPERATURE, "t0352C080"),
    ],
)
def test_error_state_is_packed_as_the_maker_packs_it(host, cause, line):
    host.gripper.faults.add(cause)
    assert host.ask("r0340") == [line]


def test_motor_without_calibration_can_never_be_cleared(host):
    host.gripper.protection.motor_calibrated = False
    host.wait(0.01)
    host.tell(CLEAR)
    assert host.ask("r0340") == ["t03528000"]


def test_commands_are_silent_and_data_messages_are_no_requests(host):
    for line in (ESTOP, CLEAR, IDLE, CALIBRATE, "t01E5000001F400"):
        host.wait(0.001)
        assert host.ask(line) == []
    for line in ("t0140", "t02E0", "t0340"):
        host.wait(0.001)
        assert host.ask(line) == []
    assert host.ask("r0140") == ["t0140"]


@pytest.mark.parametrize("node", range(16))
def test_only_the_own_node_is_answered(node):
    gripper = EmulatedGripper(node_id=node)
    for other in range(16):
        gripper.step()
        answers = gripper.handle(CanMessage(id=other << 7 | 0x7A))
        assert [answer.id for answer in answers] == ([node << 7 | 0x78] if other == node else [])


def test_any_length_is_answered_but_only_five_bytes_are_an_order(host):
    for length in range(9):
        host.wait(0.001)
        answers = host.gripper.handle(CanMessage(id=0x7A, data=b"\xc8" * length))
        assert len(answers) == 1
        assert (host.gripper.order.flags != 0) == (length >= 5)
    assert host.gripper.order.position == 0xC8


def test_currents_below_zero_are_read_as_such():
    assert decode_move(CanMessage(id=0x07A, data=bytes.fromhex("001EFED4C0"))).current_mA == -300


def test_positions_round_trip_with_the_makers_truncation():
    endpoints = Endpoints()
    reported = [endpoints.position(endpoints.target(position)) for position in range(256)]
    assert reported == [0, *range(254), 255]  # one less everywhere but at the ends


def test_speeds_are_those_of_the_maker():
    speeds = {
        3: 980,
        10: 3175,
        20: 6311,
        30: 9447,
        40: 12582,
        50: 15718,
        100: 31396,
        128: 40176,
        200: 62753,
        255: 80000,
    }
    assert {byte: ticks_per_second(byte) for byte in speeds} == speeds


def test_messages_beyond_the_controllers_memory_are_lost(host):
    assert [len(host.ask("t07A0")) for _ in range(5)] == [1, 1, 1, 0, 0]
    assert host.gripper.violations["burst"] == 3


def test_first_reply_to_an_order_still_tells_of_before():
    host = calibrated_host()
    reply = host.order(200, 100, 500)
    assert reply[3] & 0xC0 == 0xC0 and reply[0] == 0 and code_of(reply) == 0x30
    assert code_of(host.poll()) == 0x00


def test_unknown_variant_and_node_are_refused():
    with pytest.raises(TargetError, match="new, old"):
        EmulatedGripper("newest")
    with pytest.raises(TargetError, match="0 to 15"):
        EmulatedGripper(node_id=16)


def test_orders_set_the_mode_only_without_fault(host):
    host.order()
    assert host.gripper.mode is Mode.GRIPPER
    host.tell(ESTOP)
    reply = host.order(7)
    assert host.gripper.mode is Mode.IDLE and reply[3] & 0xC0 == 0xC0 and current_of(reply) == 0
