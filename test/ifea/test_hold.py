"""Key points tell whether only the jaws hold an object; where they do not, the deviation covers both answers."""

import numpy as np
import pytest

from finforce_ifea.settings import EstimatorSettings
from finforce_ifea.tracking.contact_search import ContactSearch
from finforce_ifea.tracking.contact_state import AVERAGE, KEYPOINT, blank_contact_state
from finforce_ifea.tracking.friction import Coefficient
from finforce_ifea.tracking.hold import HoldHypotheses, measure_traction

POINTS, DT = 12, 1.0 / 30.0
PRIOR = np.array([0.3, 0.7e-3]) ** 2
MODES = np.random.default_rng(7).normal(0.0, [[[0.5, 5e-5, 0.3, 3e-3]]], (POINTS, 2, 4))
HELD, FIXED = Coefficient(0.4, 0.1), Coefficient(0.0, 0.08)


def image(ratio, counted=0.0, noise=0.05e-3, deeper=0.0, count=30.0, pressed=1.0):
    """Averaged key points of a true traction ratio, of which so much is counted already; the noise [m] of an image.

    On average over the images, the finger was pressed by a share of what it is now.
    """
    points, average, state = np.zeros(POINTS, KEYPOINT), np.zeros(POINTS, AVERAGE), blank_contact_state()
    points["modes"], points["noise"], points["bias"] = MODES, noise**2 * np.eye(2), 0.02e-3**2
    average["modes"], average["count"] = pressed * MODES, count
    average["residual"] = pressed * (MODES[:, :, 3] * (ratio - counted) + MODES[:, :, 0] * deeper)
    state["traction_ratio"] = counted
    return points, average, state


def weigh(images, hold=None):
    """What follows from the images, one after the other."""
    hold = hold or HoldHypotheses()
    for points, average, state in images:
        hold.update(measure_traction(points, average, PRIOR)[:2], state, (HELD, FIXED), DT)
    return hold


@pytest.mark.parametrize("counted", [0.0, 0.2, 0.4])
@pytest.mark.parametrize("deeper", [0.0, 0.3e-3])
@pytest.mark.parametrize("pressed", [1.0, 0.5])
def test_the_ratio_is_seen_whatever_is_counted_already_and_however_deep_the_object_is(counted, deeper, pressed):
    points, average, _ = image(0.3, counted, deeper=deeper, pressed=pressed)
    asked, variance, _ = measure_traction(points, average, PRIOR)
    assert counted + asked == pytest.approx(0.3, abs=0.01)
    assert 0.0 < variance < 0.1**2


def test_what_was_counted_is_not_asked_for_again():
    points, average, _ = image(0.3)
    search = ContactSearch(POINTS, EstimatorSettings())
    search.points[:], search.average[:] = points, average
    before = measure_traction(search.points, search.average, PRIOR)[0]
    search.explain(0.2)
    assert measure_traction(search.points, search.average, PRIOR)[0] == pytest.approx(before - 0.2, abs=1e-9)


def test_each_hypothesis_is_found_where_it_is_true():
    held, fixed = weigh([image(HELD.mean, 0.2)]), weigh([image(FIXED.mean, 0.2)])
    assert held.held > 0.9
    assert fixed.held < 0.1
    assert held.ratio.mean == pytest.approx(HELD.mean, abs=0.08)
    assert fixed.ratio.mean == pytest.approx(FIXED.mean, abs=0.08)
    assert max(held.ratio.stddev, fixed.ratio.stddev) < 0.15


@pytest.mark.parametrize("blind", [{"noise": 0.1}, {"count": 0.0}])
def test_where_nothing_is_seen_the_deviation_covers_both(blind):
    hold = weigh([image(HELD.mean, **blind)])
    assert hold.held == pytest.approx(0.5, abs=0.1)
    for each in (HELD, FIXED):
        assert abs(hold.ratio.mean - each.mean) < 1.5 * hold.ratio.stddev


def test_what_was_seen_when_the_jaw_was_pressed_most_is_remembered_and_fades():
    hold = weigh([image(FIXED.mean), *[image(FIXED.mean, noise=0.1)] * 30])
    assert hold.held < 0.1
    assert weigh([image(FIXED.mean, noise=0.1)] * 3000, hold).held > 0.3
    hold.reset()
    assert hold.held == 0.5
