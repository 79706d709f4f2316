import pytest
from emulator_fakes import LineHost
from hypothesis import given
from hypothesis import strategies as st

from finforce_driver.can.protocol import CanMessage
from finforce_driver.can.slcan import decode_line, encode_message
from finforce_driver.errors import TargetError
from finforce_sim.emulator.adapter import EmulatedAdapter
from finforce_sim.emulator.firmware import EmulatedGripper

REPLY = b"t078400000030\r"
POLL = b"t07A0\r"


def test_silent_adapter_says_nothing_but_messages():
    host = LineHost(opened=False)
    assert host.say(b"C\rS8\rO\r") == b""
    assert host.say(POLL) == REPLY
    assert host.say(b"nonsense\r\r") == b""


def test_acknowledging_adapter_answers_every_line():
    host = LineHost(ack_mode="lawicel", opened=False)
    assert host.say(b"C\r") == b"\a"  # is closed already
    assert host.say(POLL) == b"\a"
    assert host.say(b"S8\r") == b"\r"
    assert host.say(b"O\r") == b"\r"
    assert host.say(POLL) == b"z\r" + REPLY
    assert host.say(b"r0140\r") == b"z\rt0140\r"
    assert host.say(b"T000007A00\r") == b"Z\r"
    assert host.say(b"S6\r") == b"\a"  # only while closed
    assert host.say(b"t07A1\r") == b"\a"
    assert host.say(b"C\r") == b"\r"
    assert host.say(POLL) == b"\a"


def test_blank_lines_and_a_second_open_change_nothing():
    host = LineHost(opened=False)
    host.say(b"C\rS8\r\rO\rO\r")
    assert host.say(b"\r" + POLL) == REPLY


@pytest.mark.parametrize("rate", [b"S0\r", b"S6\r", b"S7\r", b"s031C\r", b""])
def test_another_bit_rate_is_silence(rate):
    host = LineHost(opened=False)
    host.say(b"C\r" + rate + b"O\r")
    assert host.say(POLL) == b"" and host.adapter.counts["wrong bit rate"] == 1


def test_lines_may_come_in_pieces():
    host = LineHost()
    for byte in POLL[:-1]:
        assert host.say(bytes([byte])) == b""
    assert host.say(POLL[-1:]) == REPLY


def test_long_identifiers_are_noted_and_not_answered():
    host = LineHost()
    assert host.say(b"T0000007A0\rR0000007A0\r") == b""
    assert host.adapter.gripper.violations["long identifier"] == 2


def test_traffic_of_another_master_is_seen_and_obeyed():
    host = LineHost()
    host.adapter.put_on_bus(CanMessage(id=0x07A, data=bytes.fromhex("80 1E 01 F4 80")))
    assert host.say(b"") == b"t07A5801E01F480\rt0784000000B0\r"
    assert host.say(POLL) == b"t078400000080\r"


def test_replies_come_after_the_latency():
    adapter = EmulatedAdapter(EmulatedGripper(), latency=0.003)
    adapter.write(b"S8\rO\r" + POLL)
    adapter.step(0.002)
    assert adapter.read() == b"" and adapter.has_output
    adapter.step(0.001)
    assert adapter.read() == REPLY and not adapter.has_output


def test_unplugged_adapter_is_mute_and_comes_back_closed():
    host = LineHost()
    host.adapter.unplug()
    assert host.say(POLL) == b""
    host.adapter.replug()
    assert host.say(POLL) == b""
    host.say(b"S8\rO\r")
    assert host.say(POLL) == REPLY


def test_unknown_acknowledgement_is_refused():
    with pytest.raises(TargetError, match="none, lawicel"):
        EmulatedAdapter(EmulatedGripper(), "both")


@given(st.integers(0, 0x7FF), st.binary(max_size=8))
def test_reading_inverts_writing_of_lines(identifier, data):
    for message in (CanMessage(id=identifier, data=data), CanMessage(id=identifier, remote=True)):
        assert decode_line(encode_message(message)[:-1], stamped=False) == message


@given(st.binary(max_size=300))
def test_any_bytes_are_survived(data):
    host = LineHost(ack_mode="lawicel")
    host.say(data)
    host.say(b"\rC\rS8\rO\r")
    host.adapter.gripper.reboot()
    host.adapter.step(0.4)
    host.say(b"")
    assert host.adapter.joined
