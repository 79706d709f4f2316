"""Claims about levels, stamps and the figures of a node's health."""

import pytest

from finforce.errors import ObservationError
from finforce.health import Health, Level, Outcome, StaleError, StampError, StampGate

SECOND = 1_000_000_000
GOOD = Outcome(level=Level.OK, reason="ok", text="ok")
BAD = Outcome.of_error(ObservationError("9 key points; expected 15"))
POOR = Outcome(level=Level.WARN, reason="not_enough_points", text="3 points")


def test_silence_counts_from_when_messages_were_to_come(monkeypatch):
    now, health = 100.0, Health(source="left/keypoints", stale_after=0.5)
    monkeypatch.setattr("finforce.health.monotonic", lambda: now)
    health.arrive()
    health.publish(GOOD, latency=0.01, age=0.02)
    now = 700.0
    assert health.report(unheard="wrench").level == Level.OK
    assert health.report().level == Level.STALE
    health.resume()
    now = 700.4
    assert health.report().level == Level.OK
    now = 700.6
    assert "for 0.6 s" in health.report().message


def gate():
    return StampGate(max_age=0.2)


def test_fresh_samples_in_order_pass():
    stamps = gate()
    assert [stamps.enter(k * SECOND, k * SECOND + SECOND // 10) for k in range(1, 5)] == [False] * 4


@pytest.mark.parametrize(("age", "passes"), [(SECOND // 5, True), (SECOND // 5 + 1, False)])
def test_the_greatest_age_is_exact(age, passes):
    stamps = gate()
    if passes:
        stamps.enter(10 * SECOND, 10 * SECOND + age)
    else:
        with pytest.raises(StaleError, match="0.200 s old"):
            stamps.enter(10 * SECOND, 10 * SECOND + age)


def test_a_stamp_ahead_of_the_clock_says_so():
    with pytest.raises(StampError, match="synchronised"):
        gate().enter(11 * SECOND, 10 * SECOND)
    with pytest.raises(StampError, match="without /clock"):
        gate().enter(11 * SECOND, 0)


def test_very_old_data_hint_at_a_recording():
    with pytest.raises(StaleError, match="use_sim_time"):
        gate().enter(1000 * SECOND, 1_700_000_000 * SECOND)


def test_a_stamp_passes_once():
    stamps = gate()
    stamps.enter(SECOND, SECOND)
    with pytest.raises(StampError, match="stand still"):
        stamps.enter(SECOND, SECOND)
    with pytest.raises(StampError, match="go back by 0.100 s"):
        stamps.enter(SECOND - SECOND // 10, SECOND)


def test_a_refused_stamp_leaves_no_trace():
    stamps = gate()
    with pytest.raises(StampError):
        stamps.enter(20 * SECOND, SECOND)
    assert stamps.enter(2 * SECOND, 2 * SECOND) is False


def test_a_leap_back_begins_a_new_recording():
    stamps = gate()
    stamps.enter(100 * SECOND, 100 * SECOND)
    assert stamps.enter(10 * SECOND, 10 * SECOND) is True
    assert stamps.enter(11 * SECOND, 11 * SECOND) is False


def health():
    return Health(source="left/keypoints", stale_after=60.0)


def after(*outcomes):
    """The health after some outcomes, the last one's report taken."""
    state = health()
    for outcome in outcomes:
        state.arrive()
        if outcome.level == Level.OK:
            state.publish(outcome, latency=0.002, age=0.010)
        else:
            state.refuse(outcome)
    return state


def test_a_node_that_has_heard_nothing_is_stale():
    report = health().report()
    assert report.level == Level.STALE and "left/keypoints" in report.message


@pytest.mark.parametrize(
    ("outcomes", "level"),
    [
        ([GOOD], Level.OK),
        ([POOR], Level.WARN),
        ([BAD], Level.ERROR),
        ([POOR, GOOD], Level.WARN),
        ([BAD, GOOD], Level.ERROR),
    ],
)
def test_the_level_is_the_worst_since_the_last_report(outcomes, level):
    assert after(*outcomes).report().level == level


def test_a_fault_is_forgotten_with_the_report_and_the_next_good_image():
    state = after(BAD)
    assert "9 key points" in state.report().message
    state.arrive()
    state.publish(GOOD, latency=0.002, age=0.010)
    assert state.report().level == Level.OK
    assert state.report().values["refused"] == "1 observation"


def test_silence_is_stale_but_an_error_goes_before_it():
    state = Health(source="left/keypoints", stale_after=0.0)
    state.arrive()
    state.refuse(BAD)
    assert state.report().level == Level.ERROR
    assert state.report().level == Level.STALE


def test_alarms_raise_the_level_and_come_first():
    alarm = Outcome(level=Level.ERROR, reason="qos", text="the services differ")
    report = after(GOOD).report([alarm])
    assert report.level == Level.ERROR and report.message.startswith("the services differ")


def test_latencies_and_counts_are_shown():
    state = after(GOOD, GOOD, POOR)
    state.arrive()
    values = state.report(values={"tared": "True"}).values
    assert values["callback to published p50 [ms]"] == "2.00"
    assert values["image to published p95 [ms]"] == "10.00"
    assert (values["arrived"], values["published"], values["tared"]) == ("4", "2", "True")
    assert values["refused"] == "1 not_enough_points"
