"""Claims about the messages, to the byte."""

import pytest
from emulator_fakes import message_of
from hypothesis import given
from hypothesis import strategies as st

from finforce_driver.can.protocol import (
    Command,
    Flag,
    Move,
    decode_errors,
    decode_move,
    decode_reply,
    decode_supply,
    decode_temperature,
    encode,
    encode_move,
)
from finforce_driver.errors import TargetError

GO = Flag.ACTIVATE | Flag.GO
# the worked messages of the maker's library
MOVES = {
    "t07A5001E012CC0": (0, 30, 300, GO),
    "t07A5FF1E012CC0": (255, 30, 300, GO),
    "t07A5326402BCC0": (50, 100, 700, GO),
    "t07A5F06402BCC0": (240, 100, 700, GO),
    "t07A5801E01F4C0": (128, 30, 500, GO),
    "t07A5FFFF0514C0": (255, 255, 1300, GO),
    "t07A50000012C80": (0, 0, 300, Flag.ACTIVATE),
    "t07A50000012C00": (0, 0, 300, Flag.OFF),
    "t07A5801E01F4E0": (128, 30, 500, GO | Flag.ESTOP),
}
COMMANDS = {
    "t0000": Command.ESTOP,
    "t0020": Command.CLEAR,
    "t0180": Command.IDLE,
    "t01C0": Command.RESET,
    "t07C0": Command.CALIBRATE,
}
REQUESTS = {
    "r0140": Command.PING,
    "r02E0": Command.TEMPERATURE,
    "r0300": Command.SUPPLY,
    "r0340": Command.ERRORS,
    "r0360": Command.CURRENT,
    "r0380": Command.ENCODER,
}
# position, current [mA], activated, action, code, overheated, watchdog, estopped, calibrated, error
REPLIES = {
    "t078400000030": (0, 0, 0, 0, 3, 0, 0, 0, 0, 0),
    "t0784800000C1": (128, 0, 1, 1, 0, 0, 0, 0, 1, 0),
    "t078478FE64E1": (120, -412, 1, 1, 1, 0, 0, 0, 1, 0),
    "t078478FE64D1": (120, -412, 1, 1, 2, 0, 0, 0, 1, 0),
    "t07840A0195D1": (10, 405, 1, 1, 2, 0, 0, 0, 1, 0),
    "t07840A0195E1": (10, 405, 1, 1, 1, 0, 0, 0, 1, 0),
    "t078463FFDDF1": (99, -35, 1, 1, 3, 0, 0, 0, 1, 0),
    "t0784FFFFF431": (255, -12, 0, 0, 3, 0, 0, 0, 1, 0),
    "t079480000383": (128, 3, 1, 0, 0, 0, 0, 1, 1, 1),
    "t0794800003C9": (128, 3, 1, 1, 0, 1, 0, 0, 1, 1),
    "t0794800003C5": (128, 3, 1, 1, 0, 0, 1, 0, 1, 1),
}
ERRORS = {
    "t03420080": (),
    "t03528180": ("E-stop",),
    "t03528080": (),
    "t035280A0": ("watchdog",),
    "t03529080": ("supply",),
    "t03528000": ("motor not calibrated",),
    "t0352FE80": ("temperature", "encoder", "supply", "driver", "velocity", "current"),
}
FLAG_FIELDS = ("overheated", "watchdog", "estopped", "calibrated", "error")
REPLY_FIELDS = ("position", "current_mA", "activated", "action", "code", *FLAG_FIELDS)


@pytest.mark.parametrize("line", MOVES)
def test_moves_are_coded_as_the_maker_does(line):
    position, speed, current, flags = MOVES[line]
    move = Move(position=position, speed=speed, current_mA=current, flags=flags)
    assert encode_move(0, move) == message_of(line)
    assert decode_move(message_of(line)) == move


@pytest.mark.parametrize("line", COMMANDS)
def test_commands_are_coded_as_the_maker_does(line):
    assert encode(0, COMMANDS[line]) == message_of(line)


@pytest.mark.parametrize("line", REQUESTS)
def test_requests_are_remote_messages(line):
    assert encode(0, REQUESTS[line], remote=True) == message_of(line)


def test_a_poll_is_empty():
    assert encode(0, Command.MOVE) == message_of("t07A0")


@pytest.mark.parametrize("line", REPLIES)
def test_replies_are_read_as_the_gripper_means_them(line):
    got = decode_reply(message_of(line), 0.0)
    assert tuple(int(getattr(got, name)) for name in REPLY_FIELDS) == REPLIES[line]


def test_both_codes_of_contact_are_contact_and_no_other_is():
    contacts = [decode_reply(message_of(f"t0784000000{bits:X}1"), 0.0).contact for bits in (0xC, 0xD, 0xE, 0xF)]
    assert contacts == [False, True, True, False]


def test_telemetry_is_read():
    assert decode_temperature(message_of("t02E2001A")) == 26.0
    assert decode_temperature(message_of("t02E2FFF6")) == -10.0
    assert decode_supply(message_of("t03025DC0")) == pytest.approx(24.0)


@pytest.mark.parametrize("line", ERRORS)
def test_errors_are_named(line):
    assert decode_errors(message_of(line)) == ERRORS[line]


def test_identifiers_of_all_nodes():
    wanted = {0: 0x07A, 1: 0x0FA, 6: 0x37A, 15: 0x7FA}
    assert {node: encode(node, Command.MOVE).id for node in wanted} == wanted


@given(st.integers(0, 15), st.integers(0, 63))
def test_node_and_command_are_read_back_from_the_identifier(node, command):
    message = encode(node, command)
    assert (message.node, message.command) == (node, command)


@given(st.integers(0, 255), st.integers(0, 255), st.integers(1, 2800), st.integers(0, 255))
def test_decoding_inverts_encoding(position, speed, current, flags):
    move = Move(position=position, speed=speed, current_mA=current, flags=flags)
    assert decode_move(encode_move(3, move)) == move


@pytest.mark.parametrize(
    "change", [{"position": 256}, {"position": -1}, {"speed": 256}, {"current_mA": 0}, {"current_mA": -500}]
)
def test_what_the_gripper_would_misread_is_refused(change):
    with pytest.raises(TargetError, match=next(iter(change))):
        encode_move(0, Move(**{"position": 0, "speed": 3, "current_mA": 500, "flags": 0, **change}))


def test_only_an_order_with_both_flags_and_no_stop_drives():
    driving = [flags for flags in range(0, 256, 16) if Move(position=0, speed=3, current_mA=1, flags=flags).drives]
    assert driving == [0xC0, 0xD0]
