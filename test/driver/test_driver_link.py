"""Claims about the serial port: messages pass at once, and every way to fail says what would help."""

import os
import threading
from time import sleep

import pytest
from emulator_fakes import LONG, POLL, REPLY, REPLY_LINE, receive_until

from finforce.errors import MissingDependencyError
from finforce_driver.can import build_bus, slcan
from finforce_driver.can.python_can import PythonCanBus
from finforce_driver.can.slcan import SerialBus
from finforce_driver.errors import LinkError

GREETING = b"\rC\rS8\rO\r"


@pytest.fixture
def bus(adapter):
    link = SerialBus(adapter.link)
    link.open()
    assert adapter.read(b"O\r") == GREETING
    yield link
    link.close()


def test_a_request_goes_out_and_its_reply_comes_in(adapter, bus):
    bus.send(POLL)
    assert adapter.read() == b"t07A0\r"
    adapter.write(REPLY_LINE)
    assert bus.receive(LONG) == REPLY
    assert bus.receive(0.0) is None
    assert (bus.counts["sent"], bus.counts["messages"], bus.counts["opened"]) == (1, 1, 1)


def test_messages_that_come_together_are_returned_one_by_one(adapter, bus):
    adapter.write(3 * REPLY_LINE)
    assert [bus.receive(LONG) for _ in range(3)] == [REPLY] * 3
    assert bus.receive(0.0) is None


@pytest.mark.parametrize("answers", [b"", b"\r\r\r", b"\a\r\r", b"z\r"])
def test_silent_and_acknowledging_adapters_are_alike(adapter, bus, answers):
    adapter.write(answers)
    bus.send(POLL)
    adapter.write(b"z\r" if answers else b"")
    adapter.write(REPLY_LINE)
    assert bus.receive(LONG) == REPLY
    assert bus.suspicion == ""


def test_a_reply_in_two_pieces_is_waited_for(adapter, bus):
    adapter.write(REPLY_LINE[:5])
    assert bus.receive(0.0) is None
    adapter.write(REPLY_LINE[5:])
    assert bus.receive(LONG) == REPLY


def test_what_came_before_opening_is_forgotten(adapter):
    adapter.write_and_wait(REPLY_LINE + b"t078")
    link = SerialBus(adapter.link)
    link.open()
    adapter.write(b"4800000C1\r")
    assert receive_until(link, lambda: link.counts["garbage"] == 1) == []
    link.close()


def test_what_an_open_channel_still_sends_while_it_is_closed_is_forgotten(adapter, monkeypatch):
    monkeypatch.setattr(slcan, "sleep", lambda _: adapter.write_and_wait(REPLY_LINE))
    link = SerialBus(adapter.link)
    link.open()
    adapter.write(b"z\r")
    assert receive_until(link, lambda: link.counts["acknowledgements"] == 1) == []
    assert link.counts["messages"] == 0
    link.close()


def test_a_line_does_not_go_on_after_opening_anew(adapter, bus):
    adapter.write(REPLY_LINE[:5] + b"0" * 40)
    receive_until(bus, lambda: bus.suspicion != "")
    bus.open()
    assert bus.suspicion == ""
    adapter.write(REPLY_LINE)
    assert bus.receive(LONG) == REPLY
    assert bus.counts["garbage"] == 0


def test_a_busy_port_is_refused_and_the_first_program_keeps_it(adapter, bus):
    with pytest.raises(LinkError, match="in use by another program.*fuser"):
        SerialBus(adapter.link).open()
    bus.send(POLL)
    assert adapter.read() == b"t07A0\r"


def test_a_missing_library_says_what_to_install(monkeypatch, adapter):
    monkeypatch.setitem(__import__("sys").modules, "serial", None)
    with pytest.raises(MissingDependencyError, match="pip install pyserial"):
        SerialBus(adapter.link).open()


@pytest.mark.parametrize(
    "act", [lambda link: link.receive(LONG), lambda link: link.send(POLL)], ids=["receive", "send"]
)
def test_an_unplugged_adapter_is_noticed(adapter, bus, act):
    adapter.unplug()
    with pytest.raises(LinkError, match=r"is gone.*unplugged\?"):
        act(bus)


def test_an_adapter_that_is_plugged_in_again_works(adapter, bus):
    adapter.unplug()
    with pytest.raises(LinkError):
        bus.receive(0.0)
    with pytest.raises(LinkError, match="there is no port"):
        bus.open()
    adapter.plug()
    bus.open()
    assert adapter.read(b"O\r") == GREETING
    adapter.write(REPLY_LINE)
    assert bus.receive(LONG) == REPLY
    assert bus.counts["opened"] == 2


def test_closing_leaves_the_bus_and_frees_the_port(adapter, bus):
    bus.close()
    assert adapter.read_rest() == b"\rC\r"
    other = SerialBus(adapter.link)
    other.open()
    other.close()


def test_closing_never_raises(adapter, bus):
    adapter.unplug()
    bus.close()
    bus.close()
    SerialBus("/dev/nothing").close()


@pytest.mark.parametrize("act", [lambda link: link.receive(0.0), lambda link: link.send(POLL)], ids=["receive", "send"])
def test_a_closed_bus_refuses(adapter, bus, act):
    bus.close()
    with pytest.raises(LinkError, match="not open: expected open"):
        act(bus)


def test_messages_that_nobody_took_are_gone_with_the_port(adapter, bus):
    adapter.write(2 * REPLY_LINE)
    assert bus.receive(LONG) == REPLY
    bus.close()
    with pytest.raises(LinkError, match="not open"):
        bus.receive(0.0)


def test_a_receive_under_way_ends_before_the_port_is_closed(bus):
    entered, leave, results = threading.Event(), threading.Event(), []

    class Waiting:
        def poll(self, _):
            entered.set()
            leave.wait(LONG)
            return []

    bus._poll = Waiting()
    receiving = threading.Thread(target=lambda: results.append(bus.receive(0.0)))
    closing = threading.Thread(target=bus.close)
    receiving.start()
    assert entered.wait(LONG)
    closing.start()
    closing.join(0.05)
    assert closing.is_alive()
    leave.set()
    for thread in (receiving, closing):
        thread.join(LONG)
    assert results == [None]
    with pytest.raises(LinkError, match="expected open"):
        bus.send(POLL)


def test_lines_of_two_threads_stay_whole(monkeypatch, bus):
    halves = []

    def write_slowly(_, data):
        halves.append(data[:3])
        sleep(0.001)  # lets the other thread in
        halves.append(data[3:])

    monkeypatch.setattr(slcan, "write_all", write_slowly)
    threads = [
        threading.Thread(target=lambda one=message: [bus.send(one) for _ in range(10)]) for message in (POLL, REPLY)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(LONG)
    monkeypatch.undo()
    lines = b"".join(halves).split(b"\r")[:-1]
    assert sorted(lines) == 10 * [REPLY_LINE[:-1]] + 10 * [b"t07A0"]


def test_a_sender_does_not_wait_for_a_receiver(adapter, bus):
    waiting = threading.Thread(target=bus.receive, args=(LONG,))
    waiting.start()
    bus.send(POLL)
    assert adapter.read() == b"t07A0\r"
    assert waiting.is_alive()
    adapter.write(REPLY_LINE)
    waiting.join(LONG)
    assert not waiting.is_alive()


def test_an_adapter_that_takes_nothing_is_told_from_one_that_is_gone(adapter, bus):
    with pytest.raises(LinkError, match="took nothing for 0.1 s"):
        for _ in range(100_000):  # the pseudo terminal holds some thousand bytes
            bus.send(POLL)


def test_a_line_that_is_out_is_sent_however_busy_the_machine_was(monkeypatch, adapter, bus):
    write = os.write

    def write_and_be_away(descriptor, data):
        count = write(descriptor, data)
        sleep(0.15)  # longer than a port may take nothing
        return count

    monkeypatch.setattr(os, "write", write_and_be_away)
    bus.send(POLL)
    assert adapter.read() == b"t07A0\r"


def test_a_line_that_is_taken_piece_by_piece_goes_out_whole(monkeypatch, adapter, bus):
    write = os.write
    monkeypatch.setattr(os, "write", lambda descriptor, data: write(descriptor, data[:2]))
    bus.send(POLL)
    assert adapter.read() == b"t07A0\r"


def test_a_line_that_went_out_in_part_spoils_no_other(monkeypatch, bus):
    written = []

    def write(_, data):
        written.append(data)
        if len(written) == 1:
            raise TimeoutError("the port takes no more")

    monkeypatch.setattr(slcan, "write_all", write)
    with pytest.raises(LinkError):
        bus.send(POLL)
    bus.send(POLL)
    bus.send(POLL)
    assert written == [b"t07A0\r", b"\rt07A0\r", b"t07A0\r"]
    monkeypatch.undo()


def test_garbage_alone_makes_the_adapter_suspect_until_a_message_comes(adapter, bus):
    adapter.write(b"\xf0\x00\x87" * 20)
    assert receive_until(bus, lambda: bus.suspicion != "") == []
    assert "wrong adapter speed?" in bus.suspicion
    assert "115200" in bus.suspicion
    adapter.write(b"\r" + REPLY_LINE)
    assert bus.receive(LONG) == REPLY
    assert bus.suspicion == ""


def test_an_adapter_that_refuses_everything_is_suspect(adapter, bus):
    adapter.write(b"\a" * 4)
    receive_until(bus, lambda: bus.counts["bells"] == 4)
    assert bus.suspicion == ""
    adapter.write(b"\a")
    receive_until(bus, lambda: bus.counts["bells"] == 5)
    assert "refuses" in bus.suspicion
    assert "24 V" in bus.suspicion


def test_an_adapter_that_greets_before_its_messages_is_not_suspect(adapter, bus):
    adapter.write(b"CAN adapter 1.0, at your service, built for tests\r" + REPLY_LINE)
    assert bus.receive(LONG) == REPLY
    assert bus.suspicion == ""


def test_slcan_is_ours_and_every_other_interface_is_python_can():
    assert isinstance(build_bus("/dev/ttyACM0"), SerialBus)
    assert isinstance(build_bus("can0", "socketcan"), PythonCanBus)
