"""Claims about the time that a force takes to show."""

import numpy as np
import pytest

from finforce_eval.evaluation.scoring import delay_stats, force_delays

PERIOD = 1 / 30
TIMES = PERIOD * np.arange(60)
# one newton per ten images, from image 20 on
RISE = np.clip(0.1 * (np.arange(60) - 20), 0.0, 1.0)


def delays(estimate, truth=RISE, lag=0.0):
    return force_delays(TIMES, np.asarray(truth), np.asarray(estimate), np.full(60, lag))


def test_the_onset_lies_between_the_images():
    ((shown, risen),) = delays(RISE)
    # 0.02 N at image 20.2; the first image above 0.1 N is number 22; the truth itself is at 0.1 N at image 21
    assert shown == pytest.approx(1.8 * PERIOD)
    assert risen == pytest.approx(0.8 * PERIOD)


def test_the_time_of_computing_is_part_of_the_delay():
    ((shown, _),) = delays(RISE, lag=0.020)
    assert shown == pytest.approx(1.8 * PERIOD + 0.020)


def test_a_late_estimate_is_late_and_one_that_never_comes_is_missed():
    ((late, _),) = delays(np.roll(RISE, 3) * (np.arange(60) > 3))
    assert late == pytest.approx(4.8 * PERIOD)
    stats = delay_stats([delays(np.full(60, np.nan))])
    assert (stats["n"], stats["missed"], stats["median_ms"]) == (0, 1, None)


def test_an_estimate_that_was_never_let_go_shows_with_the_first_loaded_image():
    ((shown, _),) = delays(np.ones(60))
    assert shown == pytest.approx(0.8 * PERIOD)


def test_a_force_without_a_pause_before_it_is_no_onset():
    assert len(delays(RISE, truth=np.ones(60))) == 0
    flicker = np.where(np.arange(60) % 4 < 2, 0.5, 0.0)
    assert len(delays(RISE, truth=flicker)) == 0


def test_onsets_of_several_cases_are_counted_together():
    stats = delay_stats([delays(RISE), delays(RISE, lag=0.010)])
    assert stats["n"] == 2 and stats["median_ms"] == pytest.approx(1e3 * 1.8 * PERIOD + 5.0)
    assert stats["max_ms"] == pytest.approx(1e3 * 1.8 * PERIOD + 10.0)
    assert stats["rise_ms"] == pytest.approx(800 * PERIOD)
