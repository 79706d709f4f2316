"""The benchmark of the chain: what was dropped where, how late and how wrong, in counts that are known."""

import numpy as np
import pytest

from finforce.messages import NANOSECONDS
from finforce_eval.replay.answers import ReplayLog
from finforce_eval.replay.node_run import NodeRun
from finforce_sim.simulated_recording import START
from lab.bench.chain import (
    IMAGES,
    TOGETHER,
    TrueGrasp,
    describe_run,
    error_now,
    find_delays,
)

FIRST = 10**12
PERIOD = NANOSECONDS // 10
EARLY, COUNT = 20, 40  # images at 10 Hz before the one that is counted as 0, and from it; of these 22 after the tare


def stamp_of(index):
    return FIRST + index * PERIOD


@pytest.fixture
def truth():
    """A force that grows by 1 N a second."""
    stamps = np.array([stamp_of(index) for index in range(-EARLY, COUNT)])
    return TrueGrasp(stamps_ns=stamps, force=(stamps - FIRST) / NANOSECONDS)


@pytest.fixture
def run(truth):
    """Every image is answered 30 ms late and 0.2 N too high."""
    log = ReplayLog(("left", "right"))
    for index, stamp in enumerate(truth.stamps_ns.tolist(), -EARLY):
        for side in ("left", "right"):
            log.sent[side][stamp] = 0.0
        log.grasp[stamp], log.grasp_latency[stamp] = 0.1 * index + 0.2, 0.03
    return NodeRun(log=log, cpu={"solver": 12.0, "other": 3.0}, memory={"solver": 3e8}, others=1.0)


def test_everything_answered_is_nothing_dropped(run, truth):
    row = describe_run(IMAGES, TOGETHER, 10, run, truth)
    assert (row["images"], row["answered/%"], row["memory/MB"]) == (22, 100.0, 300.0)
    assert row["latency p50/ms"] == row["latency max/ms"] == pytest.approx(30.0)
    assert row["error/N"] == pytest.approx(0.2)


def test_what_was_dropped_is_counted_and_not_during_the_tare(run, truth):
    log = run.log
    for index in (2, 20, 21, 22, 30, 31, 33):
        del log.grasp[stamp_of(index)], log.grasp_latency[stamp_of(index)]
    row = describe_run(IMAGES, TOGETHER, 10, run, truth)
    assert (row["images"], row["answered/%"]) == (22, pytest.approx(100.0 * 16 / 22))


def test_error_now_is_that_of_the_newest_force_that_has_arrived(run, truth):
    sent = truth.stamps_ns
    # a force of 0.2 N too much that is used from 30 to 130 ms after its image, while the truth grows by 1 N/s
    late = error_now(run.log, truth, sent)
    assert late.max() == pytest.approx(0.17, abs=2e-3) and late.min() == pytest.approx(0.07, abs=2e-3)


def test_an_image_that_is_dropped_makes_the_error_now_larger_and_not_that_of_the_images(run, truth):
    full = describe_run(IMAGES, TOGETHER, 10, run, truth)
    for index in range(20, 39, 2):
        del run.log.grasp[stamp_of(index)], run.log.grasp_latency[stamp_of(index)]
    half = describe_run(IMAGES, TOGETHER, 10, run, truth)
    assert half["error/N"] == pytest.approx(full["error/N"])
    assert error_now(run.log, truth, truth.stamps_ns).min() == pytest.approx(-0.03, abs=2e-3)


def test_force_that_overtakes_an_older_one_is_the_newest():
    truth = TrueGrasp(stamps_ns=np.array([stamp_of(0), stamp_of(39)]), force=np.zeros(2))
    log = ReplayLog(("left", "right"))
    log.grasp = {stamp_of(0): 1.0, stamp_of(25): 2.0}
    log.grasp_latency = {stamp_of(0): 3.5, stamp_of(25): 0.5}
    errors = error_now(log, truth, truth.stamps_ns)
    # at 3.0 s the second one, at 3.5 s the first, which is older than what is known
    assert errors[0] == 2.0 and errors[-1] == 2.0


def test_nothing_answered_is_no_error_and_not_zero(run, truth):
    run.log.grasp.clear()
    run.log.grasp_latency.clear()
    row = describe_run(IMAGES, TOGETHER, 10, run, truth)
    assert row["answered/%"] == 0.0
    assert all(np.isnan(row[name]) for name in ("error/N", "error now/N", "latency p50/ms"))


@pytest.mark.parametrize("phase", [0.0, 0.3, 0.9])
@pytest.mark.parametrize("late", [0, 2])
def test_a_force_shows_with_the_first_image_beyond_a_tenth_of_a_newton_and_its_latency(phase, late):
    """The force sets in after 4 s, and grows by 1 N in each tenth of a second."""
    rate, latency, begin = 30, 0.02, 4.0
    stamps = START + ((np.arange(150) + phase) * NANOSECONDS / rate).astype(np.int64)
    times = 1e-9 * (stamps - START)
    fine = np.linspace(0.0, 5.0, 50_001)
    truth = TrueGrasp(stamps_ns=START + (fine * 1e9).astype(np.int64), force=np.maximum(0.0, 10.0 * (fine - begin)))
    log = ReplayLog(("left", "right"))
    for index, stamp in enumerate(stamps.tolist()):
        log.sent["left"][stamp] = 0.0
        log.grasp[stamp] = float(truth.at(stamps)[max(0, index - late)])
        log.grasp_latency[stamp] = latency
    ((delay, _),) = find_delays(log, truth)
    shown = times[np.flatnonzero(truth.at(stamps) > 0.1)[0] + late]
    # the onset is told between two images, along a line that begins with the one before the force
    assert delay == pytest.approx(shown + latency - begin, abs=1.0 / rate)
    assert delay >= latency + late / rate
