"""The benchmark of the onset: delays that are known are found, at any phase of the images."""

import numpy as np
import pytest

from finforce.stamps import NANOSECONDS
from finforce_eval.replay.live import ReplayLog
from lab.bench import onset as bench
from lab.bench.chain import TrueGrasp
from lab.bench.streams import START

RATE, LATENCY, BEGIN = 30, 0.02, 2.0  # [Hz], [s], [s] at which the force sets in, 1 N in each tenth of a second
SLOPE = 10.0


@pytest.mark.parametrize("phase", [0.0, 0.3, 0.9])
@pytest.mark.parametrize("late", [0, 2])
def test_a_force_shows_with_the_first_image_beyond_a_tenth_of_a_newton_and_its_latency(phase, late):
    stamps = START + ((np.arange(90) + phase) * NANOSECONDS / RATE).astype(np.int64)
    times = 1e-9 * (stamps - START)
    fine = np.linspace(0.0, 3.0, 30_001)
    truth = TrueGrasp(stamps=START + (fine * 1e9).astype(np.int64), force=np.maximum(0.0, SLOPE * (fine - BEGIN)))
    log = ReplayLog(("left", "right"))
    for index, stamp in enumerate(stamps.tolist()):
        log.sent["left"][stamp] = 0.0
        log.grasp[stamp] = float(truth.at(stamps)[max(0, index - late)])
        log.grasp_latency[stamp] = LATENCY
    ((delay, _),) = bench.find_delays(log, truth)
    shown = times[np.flatnonzero(truth.at(stamps) > 0.1)[0] + late]
    # the onset is told between two images, along a line that begins with the one before the force
    assert delay == pytest.approx(shown + LATENCY - BEGIN, abs=1.0 / RATE)
    assert delay >= LATENCY + late / RATE
