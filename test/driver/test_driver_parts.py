"""The parts of the driver that decide, one by one."""

import math

import pytest
from emulator_fakes import reply

from finforce_driver.can.protocol import CanMessage, Command, Flag, Move, encode
from finforce_driver.machine.drive import MARKERS, Exchange, Request
from finforce_driver.machine.move import GRACE, Goal, MoveJob, Orders
from finforce_driver.machine.procedures import CalibrationRun, Step
from finforce_driver.machine.status_tracker import History, Telemetry
from finforce_driver.settings import GripperSettings
from finforce_driver.state import MoveOutcome

POLL = Request(message=encode(0, Command.MOVE))
REPLY = CanMessage(id=0x078, data=b"\x00\x00\x00\xf1")
GO = Flag.ACTIVATE | Flag.GO


def job(stepped=False):
    """A move that closes to 100 counts within a second."""
    goal = Goal(opening=0.03, position=100, rate=100.0, byte=3, stepped=stepped, current_mA=500)
    return MoveJob(goal, start=0.0, now=0.0)


def outcome_after(move, newest):
    """What a reply makes of a move."""
    move.take(newest)
    return move.outcome


def temperature(value):
    return CanMessage(id=0x02E, data=value.to_bytes(2, "big"))


def test_after_a_lost_reply_a_late_one_is_not_taken_for_the_next():
    exchange = Exchange(0)
    exchange.begin(POLL, 0.0)
    exchange.miss()
    assert not exchange.in_step
    exchange.begin(exchange.marker(), 0.05)
    assert not exchange.answers(REPLY)
    assert exchange.answers(CanMessage(id=MARKERS[1] << 1, data=b"\x00\x00"))
    exchange.end(0.06)
    assert exchange.in_step and exchange.marker() is None


def test_every_lost_marker_is_followed_by_another_one():
    exchange = Exchange(0)
    exchange.begin(Request(message=encode(0, Command.PING, remote=True)), 0.0)
    exchange.end(0.0)
    asked = []
    for _ in range(6):
        exchange.begin(POLL if not asked else exchange.marker(), 0.0)
        exchange.miss()
        asked.append(exchange.marker().answer)
    assert len(set(asked)) == len(MARKERS)
    assert all(before is not after for before, after in zip(asked, asked[1:], strict=False))


@pytest.mark.parametrize(
    "message", [CanMessage(id=0x0F8, data=bytes(4)), CanMessage(id=0x078, data=bytes(3)), CanMessage(id=0x034)]
)
def test_messages_of_other_nodes_lengths_and_commands_answer_nothing(message):
    exchange = Exchange(0)
    exchange.begin(POLL, 0.0)
    assert exchange.answers(REPLY)
    assert not exchange.answers(message)


def test_a_single_odd_temperature_is_not_believed_and_a_repeated_one_is():
    telemetry = Telemetry(1.0)
    told = []
    for time, value in enumerate((26, 26, 90, 27, 90, 91)):
        telemetry.take(temperature(value), float(time))
        told.append(telemetry.temperature)
    assert told[1:] == [26.0, 26.0, 27.0, 27.0, 91.0]


def test_a_doubted_answer_is_asked_for_again_at_once():
    telemetry = Telemetry(1.0)
    assert telemetry.question(0.0) is Command.TEMPERATURE
    telemetry.take(temperature(26), 0.0)
    assert telemetry.question(0.0) is Command.TEMPERATURE
    telemetry.take(temperature(26), 0.0)
    assert telemetry.question(0.0) is None
    assert telemetry.question(1.0) is Command.SUPPLY


def test_what_comes_soon_after_an_order_speaks_of_the_one_before():
    move = job()
    early = [outcome_after(move, reply(time=GRACE * part)) for part in (0.1, 0.5, 0.9)]
    late = [outcome_after(move, reply(time=GRACE + time)) for time in (0.01, 0.03)]
    assert (early, late) == ([MoveOutcome.NONE] * 3, [MoveOutcome.NONE, MoveOutcome.REACHED])


def test_a_step_on_the_way_is_not_the_end():
    move = job(stepped=True)
    assert {outcome_after(move, reply(time=0.1 + 0.02 * index)) for index in range(10)} == {MoveOutcome.NONE}


def test_a_slow_move_begins_where_the_jaws_are_not_where_they_were_thought_to_be():
    goal = Goal(opening=0.035, position=67, rate=5.0, byte=3, stepped=True, current_mA=500)
    move = MoveJob(goal, start=155.0, now=0.0)
    move.advance(0.05, 105.5, 0.04)
    assert move.position in (105, 106)


def test_the_first_reply_that_says_calibrated_does_not_end_a_calibration():
    run = CalibrationRun(GripperSettings(), calibrated=False, reset=False)
    run.start(0.0)
    for _ in range(3):
        run.travel.miss(0.0)  # it does not tell its encoder
    steps = []
    for time, position, calibrated in ((0.5, 0, False), (1.0, 255, False), (2.0, 255, True), (2.02, 255, True)):
        run.take(reply(time=time, position=position, calibrated=calibrated, current_mA=-400))
        steps.append(run.step)
    assert steps == [Step.WATCH] * 3 + [Step.DONE]


def test_orders_are_pending_until_taken_and_differ_after_an_interruption():
    orders = Orders(salt=5)
    move = Move(position=100, speed=20, current_mA=500, flags=GO)
    orders.want(move)
    first = orders.wanted
    assert orders.pending
    orders.take(first)
    orders.want(move)
    assert not orders.pending
    orders.drop()
    orders.want(move)
    assert orders.pending and orders.wanted != first
    assert orders.wanted.flags & 0xF0 == GO


def test_speed_and_position_come_from_the_last_tenth_of_a_second():
    history = History()
    assert history.speed() == 0.0 and math.isnan(history.last)
    for index in range(20):
        history.add(0.02 * index, 5.0 if index < 10 else 5.0 + (index - 10))
    assert history.speed() == pytest.approx(50.0)
    assert history.position_at(0.37, 0.0) == pytest.approx(13.5)
    assert math.isnan(history.position_at(-0.01, 0.0))
    assert history.position_at(0.40, 0.05) == 14.0


@pytest.mark.parametrize(("position", "outcome"), [(99, "REACHED"), (101, "REACHED"), (97, "TIMED_OUT")])
def test_jaws_that_rest_a_count_beside_the_target_have_reached_it(position, outcome):
    move, found = job(), {}
    for step in range(1, 120):
        now = 0.02 * step
        result = outcome_after(move, reply(time=now, position=min(position, 60 + 4 * step), code=0))
        found.setdefault(result, now)
    assert MoveOutcome[outcome] in found
    if outcome == "REACHED":
        assert found[MoveOutcome.REACHED] == pytest.approx(0.2 + 0.3, abs=0.05)
