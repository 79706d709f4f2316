"""The benchmark of an hour: grasps are told apart, the truth goes on relaxing, losses and drift are found."""

from types import SimpleNamespace

import numpy as np
import pytest

from finforce.stamps import NANOSECONDS
from finforce_eval.errors import OptionError
from finforce_eval.recordings.tracks import WrenchTrack
from finforce_eval.replay.live import ReplayLog
from finforce_eval.replay.synthetic_stream import START
from finforce_ifea.relaxation import RelaxationTerm, apply_relaxation
from lab.bench import endurance
from lab.bench.chain import TARE, TrueGrasp

RATE, IMAGES, GRASPS = 30, 150, 4
PERIOD = IMAGES * NANOSECONDS // RATE
TERMS = (RelaxationTerm(share=0.3, time_constant=2.0), RelaxationTerm(share=0.2, time_constant=20.0))
ONCE = START + (np.arange(IMAGES) * NANOSECONDS) // RATE
ELASTIC = np.concatenate([np.zeros(60), np.linspace(0.0, 5.0, 30), np.full(40, 5.0), np.zeros(20)])


class Stream(SimpleNamespace):
    """A stream of images of which only the stamps matter."""

    def __init__(self):
        first = SimpleNamespace(stamp=int(ONCE[0]), time=int(ONCE[0]))
        super().__init__(messages=[first], repeats=GRASPS, period=PERIOD, begin=int(ONCE[0]))


def recording_of(force):
    track = WrenchTrack(stamps=ONCE, force=np.outer(force, [1.0, 0.0, 0.0]), torque=np.zeros((IMAGES, 3)))
    return SimpleNamespace(truth=lambda side: track)


def all_stamps():
    return (ONCE[None] + PERIOD * np.arange(GRASPS)[:, None]).ravel()


def test_the_true_hour_is_that_of_a_finger_that_never_begins_anew():
    first = apply_relaxation(ELASTIC, 1e-9 * (ONCE - ONCE[0]), TERMS)
    truth = endurance.true_hour(recording_of(first), TERMS, Stream())
    whole = apply_relaxation(np.tile(ELASTIC, GRASPS), 1e-9 * (all_stamps() - START), TERMS)
    assert truth.force == pytest.approx(whole, abs=1e-9)
    assert truth.force[:IMAGES] == pytest.approx(first, abs=1e-9)
    # which the first grasp, played again, is not
    assert abs(truth.force[-IMAGES:] - first).max() > 0.05


def test_losses_and_errors_belong_to_their_grasps():
    stamps, truth = all_stamps(), TrueGrasp(stamps=all_stamps(), force=np.tile(ELASTIC, GRASPS))
    log, lost = ReplayLog(("left", "right")), set(stamps[[200, 201, 310]].tolist())
    for index, stamp in enumerate(stamps.tolist()):
        log.jaws["left"].sent[stamp] = 0.0
        if stamp not in lost:
            log.grasp[stamp] = float(truth.force[index]) + 0.1 * (index // IMAGES)
    rows = endurance.divide_grasps(log, truth, Stream(), [500.0, 510.0, 511.0, 511.5])
    assert rows["images"].tolist() == [IMAGES - round(TARE * RATE), IMAGES, IMAGES, IMAGES]
    assert (rows["images"] - rows["answered"]).tolist() == [0, 2, 1, 0]
    assert rows["bias/N"].tolist() == pytest.approx([0.0, 0.1, 0.2, 0.3])
    assert rows["RMSE/N"].tolist() == pytest.approx([0.0, 0.1, 0.2, 0.3])
    summary = endurance.summarise(rows)
    assert (summary["lost"], summary["images"], summary["growth/MB"]) == (3, 546, 0.5)
    assert summary["drift/N"] == pytest.approx(0.2)


@pytest.mark.parametrize("minutes", [0.0, -1.0, np.inf, np.nan])
def test_a_time_that_is_none_is_refused(minutes):
    with pytest.raises(OptionError, match="--minutes .*expected a duration above zero"):
        endurance.measure(False, minutes=minutes)
