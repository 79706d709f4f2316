"""Claims about the lines of SLCAN: what is written, what is read, and what is not taken for a message."""

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from finforce_driver.can.protocol import CanMessage
from finforce_driver.can.slcan import LONGEST_LINE, SlcanParser, decode_line, encode_message

# CanMessages that a gripper's maker's own library writes, and replies that it reads.
VECTORS = {
    b"t07A0": CanMessage(id=0x07A),
    b"t07A5001E012CC0": CanMessage(id=0x07A, data=bytes.fromhex("001E012CC0")),
    b"t07A5801E01F4E0": CanMessage(id=0x07A, data=bytes.fromhex("801E01F4E0")),
    b"t07C0": CanMessage(id=0x07C),
    b"t0000": CanMessage(id=0),
    b"t016103": CanMessage(id=0x016, data=b"\x03"),
    b"r0340": CanMessage(id=0x034, remote=True),
    b"t0784800000C1": CanMessage(id=0x078, data=bytes.fromhex("800000C1")),
    b"t0794800003C9": CanMessage(id=0x079, data=bytes.fromhex("800003C9")),
    b"t7FF8FFFFFFFFFFFFFFFF": CanMessage(id=0x7FF, data=b"\xff" * 8),
}
REPLY = b"t078478FE64E1"
HEX = b"0123456789ABCDEFabcdef"

messages = st.one_of(
    st.builds(CanMessage, id=st.integers(0, 0x7FF), data=st.binary(max_size=8)),
    st.builds(CanMessage, id=st.integers(0, 0x7FF), remote=st.just(True)),
)
pieces = st.one_of(
    st.binary(max_size=80),
    st.lists(st.sampled_from(list(b"trTRz\r\a" + HEX)), max_size=80).map(bytes),
    messages.map(encode_message),
)


def could_say(line: bytes, message: CanMessage) -> bool:
    """Whether a line is a message's own, in any case of the letters, with or without a time stamp."""
    own = encode_message(message)[:-1]
    line = line.upper()
    if message.remote:
        return line[:1] == b"R" and line[1:4] == own[1:4] and len(line) in (5, 9)
    return line[:1] == b"T" and line[1:].startswith(own[1:]) and len(line) - len(own) in (0, 4)


@pytest.mark.parametrize("line", VECTORS, ids=bytes.decode)
def test_known_lines_are_written_and_read(line):
    assert encode_message(VECTORS[line]) == line + b"\r"
    assert decode_line(line) == VECTORS[line]


@given(messages)
def test_decode_inverts_encode(message):
    assert SlcanParser().feed(encode_message(message)) == [message]


@given(st.lists(messages, max_size=6), st.data())
def test_messages_arrive_however_the_bytes_are_cut(sent, data):
    stream = b"".join(map(encode_message, sent))
    parser, found = SlcanParser(), []
    while stream:
        size = data.draw(st.integers(1, len(stream)))
        found += parser.feed(stream[:size])
        stream = stream[size:]
    assert found == sent
    assert parser.counts["messages"] == len(sent)


@settings(max_examples=300)
@given(st.lists(pieces, max_size=12).map(b"".join))
def test_no_bytes_raise_and_every_message_is_a_line_of_its_own(stream):
    found = SlcanParser().feed(stream)
    lines = iter(stream.replace(b"\a", b"\r").split(b"\r")[:-1])
    # each message has its line, in order; `any` uses the lines up as it goes
    assert all(any(could_say(line, message) for line in lines) for message in found)


def test_a_changed_letter_makes_another_message_or_none():
    for place in range(len(REPLY)):
        for byte in set(range(256)) - {13, 7}:
            line = REPLY[:place] + bytes([byte]) + REPLY[place + 1 :]
            found = SlcanParser().feed(line + b"\r")
            in_identifier_or_data = place in (2, 3) or place > 4
            if place == 0:
                readable = byte == ord("t")
            elif place == 1:
                readable = byte in b"01234567"
            elif place == 4:
                # two bytes less and the rest could be a time stamp: who reads it must look at the length
                readable = byte in b"42"
            else:
                readable = in_identifier_or_data and byte in HEX
            assert len(found) == readable, line


@pytest.mark.parametrize("place", range(len(REPLY)))
def test_a_lost_or_doubled_letter_makes_no_message(place):
    assert SlcanParser().feed(REPLY[:place] + REPLY[place + 1 :] + b"\r") == []
    assert SlcanParser().feed(REPLY[:place] + REPLY[place : place + 1] + REPLY[place:] + b"\r") == []


@pytest.mark.parametrize(
    "line",
    [
        b"t0784_800000C1",
        b"t078 4800000C1",
        b"t0784+80000C1",
        b"t8784800000C1",
        b"t0789" + b"00" * 9,
        b"t0780\n",
        b"t078",
    ]
    + [b"\xfft0780", b"t07\xb20", b"t0784800000C1 ", b"r0340001", b"x0784800000C1", b"T078480"],
)
def test_lines_that_are_nearly_messages_are_garbage(line):
    parser = SlcanParser()
    assert parser.feed(line + b"\r") == []
    assert parser.counts["garbage"] == 1


def test_time_stamps_are_read_over():
    parser = SlcanParser()
    assert parser.feed(REPLY + b"EA5F\rr0340EA5F\r") == [decode_line(REPLY), CanMessage(id=0x034, remote=True)]


def test_a_refusal_stands_between_messages_without_an_end():
    parser = SlcanParser()
    assert parser.feed(b"\a" + REPLY + b"\r\a\a" + REPLY + b"\r") == [decode_line(REPLY)] * 2
    assert parser.counts == {"messages": 2, "bells": 3}


def test_a_refusal_in_a_line_spoils_it():
    assert SlcanParser().feed(REPLY[:6] + b"\a" + REPLY[6:] + b"\r") == []


def test_acknowledgements_are_counted_and_explained():
    parser = SlcanParser()
    assert parser.feed(b"\r\rz\rZ\r") == []
    assert parser.counts["acknowledgements"] == 4
    assert parser.unexplained == 0


def test_long_identifiers_are_dropped_and_counted():
    parser = SlcanParser()
    assert parser.feed(b"T1FFFFFFF20011\rR000000780\r") == []
    assert parser.counts["extended"] == 2
    assert parser.counts["garbage"] == 0


def test_a_line_without_an_end_takes_no_memory_and_spoils_no_other():
    parser = SlcanParser()
    for _ in range(1000):
        assert parser.feed(b"0" * 1000) == []
    assert len(parser._line) <= LONGEST_LINE + 1
    assert parser.feed(b"\r" + REPLY + b"\r") == [decode_line(REPLY)]
    assert parser.counts["overlong"] == 1


def test_the_end_of_an_overlong_line_is_no_message():
    assert SlcanParser().feed(b"0" * 100 + REPLY + b"\r") == []


def test_garbage_stays_unexplained_until_a_message_comes():
    parser = SlcanParser()
    parser.feed(b"\xff\x00" * 10 + b"\r\a")
    assert (parser.unexplained, parser.refused) == (20, 1)
    parser.feed(REPLY + b"\r")
    assert (parser.unexplained, parser.refused) == (0, 0)


def test_a_port_opened_anew_starts_a_new_line():
    parser = SlcanParser()
    parser.feed(b"t0784")
    parser.discard()
    assert parser.feed(b"800000C1\r") == []
    assert parser.unexplained == 8
