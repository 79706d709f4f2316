"""Claims about which replies are believed."""

from dataclasses import replace

import pytest
from emulator_fakes import reply
from hypothesis import given
from hypothesis import strategies as st

from finforce_driver.can.protocol import CanMessage, decode_reply
from finforce_driver.machine.status_tracker import MOST_UNCONFIRMED, ReplyFilter

REST = (0.0, 100.0)  # speed and greatest speed that is possible [counts/s]
SOON, POLL = 0.0015, 0.02  # [s]


def settled(first, time=0.0):
    """A filter that believes a reply."""
    judge = ReplyFilter(0.05)
    for index in range(4):
        judge.take(replace(first, time=time - (3 - index) * SOON), *REST)
    return judge


def feed(judge, replies, start=POLL, step=SOON, expected=REST):
    believed = [judge.take(replace(item, time=start + index * step), *expected) for index, item in enumerate(replies)]
    return [None if item is None else replace(item, time=0.0) for item in believed]


def test_the_first_reply_is_believed_when_three_others_repeat_it():
    judge = ReplyFilter(0.05)
    assert feed(judge, [reply()] * 4) == [None, None, None, reply()]


@pytest.mark.parametrize("change, alarming", [({"position": 90}, False), ({"error": True}, True), ({"code": 0}, False)])
def test_a_doubt_is_alarming_when_what_the_gripper_may_be_told_is_at_stake(change, alarming):
    judge = settled(reply())
    feed(judge, [reply(**change)])
    assert (judge.wants_reply, judge.alarming) == (True, alarming)


def test_what_goes_on_is_believed_at_once():
    assert feed(settled(reply()), [reply(current_mA=-60)], POLL) == [reply(current_mA=-60)]


def test_a_doubted_reply_asks_for_another_at_once():
    judge = settled(reply())
    feed(judge, [reply(position=90)])
    assert judge.wants_reply
    feed(judge, [reply()], POLL + SOON)
    assert not judge.wants_reply


@given(
    position=st.integers(0, 255),
    current=st.integers(-600, 600),
    status=st.integers(0, 255),
    error=st.booleans(),
    place=st.integers(0, 10),
    digit=st.integers(0, 15),
)
def test_a_flipped_digit_never_becomes_a_state(position, current, status, error, place, digit):
    data = bytes([position, *current.to_bytes(2, "big", signed=True), status])
    line = f"{0x079 if error else 0x078:03X}{data.hex()}"
    flipped = line[:place] + f"{digit:X}" + line[place + 1 :]
    true = decode_reply(CanMessage(id=int(line[:3], 16), data=data), 0.0)
    if int(flipped[:3], 16) & 0x7FE != 0x078:
        return  # another node's or command's message, which no filter sees
    wrong = decode_reply(CanMessage(id=int(flipped[:3], 16), data=bytes.fromhex(flipped[3:])), 0.0)
    for believed in feed(settled(true), [wrong, true]):
        if believed is not None:
            # the current may be off by what it may change between two replies
            assert abs(believed.current_mA - true.current_mA) <= 100
            assert replace(believed, current_mA=0) == replace(true, current_mA=0)


@pytest.mark.parametrize(
    "change", [{"position": 90}, {"calibrated": False}, {"error": True}, {"code": 1}, {"current_mA": -500}]
)
def test_a_true_change_is_believed_three_replies_later(change):
    after = reply(**change)
    assert feed(settled(reply()), [after] * 4) == [None, None, None, after]


def test_three_different_lies_are_not_believed():
    lies = [reply(position=5), reply(error=True), reply(position=200)]
    assert feed(settled(reply()), lies) == [None] * 3


def test_motion_at_the_known_speed_is_believed_at_once():
    moving = (50.0, 75.0)
    assert feed(settled(reply()), [reply(position=101)], POLL, expected=moving) == [reply(position=101)]
    assert feed(settled(reply()), [reply(position=108)], POLL, expected=moving) == [None]


def test_fast_motion_is_always_confirmed_since_the_jaws_may_have_stopped():
    fast = (500.0, 750.0)
    places = [reply(position=110 + index) for index in range(4)]
    assert feed(settled(reply()), places, POLL, expected=fast) == [None, None, None, places[-1]]


def test_after_a_long_gap_even_the_same_reply_is_confirmed():
    assert feed(settled(reply()), [reply()] * 4, 1.0) == [None, None, None, reply()]


def test_a_noisy_current_ends_with_its_middle():
    noisy = [reply(current_mA=(-400, 400, 0)[index % 3]) for index in range(1, MOST_UNCONFIRMED + 2)]
    judge = settled(reply(current_mA=-1000))
    believed = [item for item in feed(judge, noisy) if item is not None]
    assert believed and believed[0].current_mA == 0


def test_a_current_beyond_the_power_stage_is_never_believed():
    assert feed(settled(reply()), [reply(current_mA=3000)] * 30) == [None] * 30


def test_two_replies_far_apart_do_not_confirm_each_other():
    after = reply(position=90)
    assert feed(settled(reply()), [after] * 4, step=0.06) == [None] * 4
