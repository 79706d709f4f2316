"""Claims about python-can as a bus: frames pass, rubbish is survived, and every way to fail says what would help."""

from types import SimpleNamespace

import pytest
from link_fakes import LONG, POLL, REPLY, REPLY_LINE, FakeAdapter, receive_until

from finforce.errors import MissingDependencyError
from finforce_driver.can import python_can as can_bus
from finforce_driver.can.bus import Frame
from finforce_driver.can.python_can import PythonCanBus, check_version
from finforce_driver.errors import LinkError


@pytest.fixture
def adapter(tmp_path):
    fake = FakeAdapter(tmp_path)
    yield fake
    fake.unplug()


@pytest.fixture
def pair():
    ends = [PythonCanBus("virtual", "finforce-test") for _ in range(2)]
    for end in ends:
        end.open()
    yield ends
    for end in ends:
        end.close()


@pytest.mark.parametrize("frame", [POLL, REPLY, Frame(id=0x034, remote=True), Frame(id=0x7FF, data=b"12345678")])
def test_frames_pass_a_virtual_bus(pair, frame):
    pair[0].send(frame)
    assert pair[1].receive(LONG) == frame
    assert pair[1].receive(0.0) is None
    assert (pair[0].counts["sent"], pair[1].counts["frames"]) == (1, 1)


def test_messages_that_are_no_classic_frames_are_dropped_and_counted(pair):
    import can

    for message in (
        can.Message(arbitration_id=0x78, is_extended_id=True, data=b"1234"),
        can.Message(arbitration_id=0x78, is_extended_id=False, is_error_frame=True),
        can.Message(arbitration_id=0x78, is_extended_id=False, is_fd=True, data=b"1234"),
    ):
        pair[0]._bus.send(message)
    assert pair[1].receive(0.0) is None
    assert pair[1].receive(0.0) is None
    assert pair[1].receive(0.0) is None
    assert [pair[1].counts[name] for name in ("extended", "bus_errors", "garbage")] == [1, 1, 1]
    assert "only errors" in pair[1].suspicion


@pytest.fixture
def can_slcan(adapter, monkeypatch):
    monkeypatch.setattr(can_bus, "_SLEEP_AFTER_OPEN", 0.0)
    link = PythonCanBus("slcan", adapter.link)
    link.open()
    adapter.read(b"O\r")
    yield link
    link.close()


def test_frames_pass_python_cans_slcan(adapter, can_slcan):
    can_slcan.send(POLL)
    assert adapter.read(b"t07A0\r").endswith(b"t07A0\r")
    adapter.write(b"z\r\a" + REPLY_LINE)
    assert can_slcan.receive(LONG) == REPLY


@pytest.mark.parametrize("line", [b"\xff\xfet078\r", b"t07\r", b"t0784zzzz\r", b"t0784FE\r", b"t0789\r"])
def test_python_can_recovers_after_garbage(adapter, can_slcan, line):
    adapter.write(line)
    assert receive_until(can_slcan, lambda: can_slcan.counts["garbage"] == 1) == []
    adapter.write(REPLY_LINE)
    assert can_slcan.receive(LONG) == REPLY


def test_a_python_can_interface_that_fails_again_and_again_is_given_up(adapter, can_slcan):
    for number in range(1, 9):
        adapter.write(b"t07\r")
        receive_until(can_slcan, lambda expected=number: can_slcan.counts["garbage"] == expected)
        if number == 4:  # one frame, and the failures are no longer in a row
            adapter.write(REPLY_LINE)
            assert can_slcan.receive(LONG) == REPLY
    adapter.write(b"t07\r")
    with pytest.raises(LinkError):
        can_slcan.receive(LONG)


@pytest.mark.parametrize(
    "act", [lambda link: link.receive(LONG), lambda link: link.send(POLL)], ids=["receive", "send"]
)
def test_an_unplugged_adapter_is_noticed_through_python_can(adapter, can_slcan, act):
    adapter.unplug()
    with pytest.raises(LinkError, match="slcan .*plugged in"):
        act(can_slcan)
    can_slcan.close()
    with pytest.raises(LinkError, match="not open"):
        act(can_slcan)


@pytest.mark.parametrize(
    "interface, channel, advice",
    [
        ("bogus", "x", "check interface"),
        ("slcan", "/dev/nothing", "plugged in"),
        ("socketcan", "can77", "ip link set can77"),
    ],
)
def test_interfaces_that_cannot_be_opened_say_what_would_help(interface, channel, advice):
    with pytest.raises(LinkError, match=advice) as caught:
        PythonCanBus(interface, channel).open()
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "version, works", [("4.2.2", False), ("4.3.1", True), ("4.6.0", False), ("4.6.1", True), ("3.3.4", False)]
)
def test_versions_of_python_can_that_do_not_work_are_refused(version, works):
    if works:
        check_version(version)
    else:
        with pytest.raises(MissingDependencyError, match=f"{version} does not work.*4.3"):
            check_version(version)


def test_a_version_that_does_not_work_is_refused_on_opening(monkeypatch):
    monkeypatch.setattr(can_bus, "import_library", lambda *_: SimpleNamespace(__version__="4.6.0"))
    with pytest.raises(MissingDependencyError, match="4.6.0"):
        PythonCanBus("virtual", "x").open()
