"""Claims about python-can as a bus: messages pass, others are counted, and every way to fail says what would help."""

import pytest
from emulator_fakes import LONG, POLL, REPLY

from finforce_driver.can.protocol import CanMessage
from finforce_driver.can.python_can import PythonCanBus
from finforce_driver.can.slcan import encode_message
from finforce_driver.errors import LinkError


@pytest.fixture
def pair():
    ends = [PythonCanBus("virtual", "finforce-test") for _ in range(2)]
    for end in ends:
        end.open()
    yield ends
    for end in ends:
        end.close()


@pytest.mark.parametrize(
    "message", [POLL, REPLY, CanMessage(id=0x034, remote=True), CanMessage(id=0x7FF, data=b"12345678")]
)
def test_messages_pass_a_virtual_bus(pair, message):
    pair[0].send(message)
    assert pair[1].receive(LONG) == message
    assert pair[1].receive(0.0) is None
    assert (pair[0].counts["sent"], pair[1].counts["messages"]) == (1, 1)


def test_messages_that_are_no_classic_messages_are_dropped_and_counted(pair):
    import can

    for message in (
        can.Message(arbitration_id=0x78, is_extended_id=True, data=b"1234"),
        can.Message(arbitration_id=0x78, is_extended_id=False, is_error_frame=True),
        can.Message(arbitration_id=0x78, is_extended_id=False, is_fd=True, data=b"1234"),
    ):
        pair[0]._port.send(message)
    assert pair[1].receive(0.0) is None
    assert pair[1].receive(0.0) is None
    assert pair[1].receive(0.0) is None
    assert [pair[1].counts[name] for name in ("extended", "bus_errors", "garbage")] == [1, 1, 1]
    assert "only errors" in pair[1].suspicion


@pytest.mark.parametrize(
    "act", [lambda link: link.receive(LONG), lambda link: link.send(POLL)], ids=["receive", "send"]
)
def test_a_bus_that_fails_is_named_with_advice_and_can_be_closed(pair, monkeypatch, act):
    def fail(*_, **__):
        raise OSError("network is down")

    for name in ("recv", "send"):
        monkeypatch.setattr(pair[0]._port, name, fail)
    with pytest.raises(LinkError, match="CAN interface virtual.*network is down.*check interface"):
        act(pair[0])
    pair[0].close()
    with pytest.raises(LinkError, match="not open"):
        act(pair[0])


def test_our_lines_are_those_of_python_cans_slcan(adapter):
    import can

    bus = can.Bus(interface="slcan", channel=adapter.link, bitrate=1_000_000, sleep_after_open=0.0)
    adapter.read(b"O\r")
    bus.send(can.Message(arbitration_id=REPLY.id, data=REPLY.data, is_extended_id=False))
    line = encode_message(REPLY)
    assert adapter.read(least=len(line)).endswith(line)
    adapter.write(line)
    got = bus.recv(LONG)
    assert (got.arbitration_id, bytes(got.data)) == (REPLY.id, REPLY.data)
    bus.shutdown()


@pytest.mark.parametrize(
    "interface, channel, advice",
    [
        ("bogus", "x", "check interface"),
        ("socketcan", "can77", "ip link set can77"),
    ],
)
def test_interfaces_that_cannot_be_opened_say_what_would_help(interface, channel, advice):
    with pytest.raises(LinkError, match=advice) as caught:
        PythonCanBus(interface, channel).open()
    assert "\n" not in str(caught.value)
