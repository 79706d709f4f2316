"""Claims about the probability that an object touches."""

from types import SimpleNamespace

import numpy as np
import pytest

from finforce_ifea.observation import ObjectOutline
from finforce_ifea.touch import contact_probability, find_touch_probability
from finforce_ifea.tracking.contact_state import blank_contact_state

MM = 1e-3


def probability_of(depth, gap=None):
    """The probability of a depth that is known within 0.05 mm, with the object's pose a gap away [mm]."""
    state = blank_contact_state()
    state["depth"], state["depth_variance"] = depth * MM, (0.05 * MM) ** 2
    outline = None
    if gap is not None:
        square = 0.01 * np.array([[0.0, -1.0], [2.0, -1.0], [2.0, 1.0], [0.0, 1.0]])
        origin = np.array([0.014 + gap * MM, 0.04])
        outline = ObjectOutline(polygons=(square,), origin=origin, tilt=0.0, stddev=np.array([0.5 * MM, MM, 0.1]))
    return find_touch_probability(state, SimpleNamespace(outline=outline), 0.014)


def test_probability_rises_with_bend_and_with_depth():
    bends = [contact_probability(0.0, 0.5 * MM, bend * MM, 0.035 * MM) for bend in (0.0, 0.05, 0.1, 0.15, 2.0)]
    depths = [contact_probability(depth * MM, 0.5 * MM, 0.1 * MM, 0.035 * MM) for depth in (-3.0, -1.0, 0.0)]
    assert bends == sorted(bends) and bends[0] < 0.2 and bends[3] > 0.95
    assert depths == sorted(depths) and depths[0] < 0.1


def test_probability_is_that_of_a_simulation():
    random = np.random.default_rng(0)
    depth, s, t = -0.1, 0.3, 0.05
    true = depth + s * random.standard_normal(2_000_000)
    bend = np.maximum(true, 0.0) + t * random.standard_normal(len(true))
    seen = np.abs(bend - 0.07) < 0.005
    expected = (true[seen] > 0.0).mean()
    # 70,000 of the drawn bends fall into the interval
    assert contact_probability(depth, s, 0.07, t) == pytest.approx(expected, abs=0.01)


@pytest.mark.parametrize("depth", [-1.0, 1.0])
def test_probability_is_finite_far_from_everything(depth):
    assert contact_probability(depth, 1e-5, 0.5, 1e-5) in (0.0, 1.0)


def test_an_object_whose_pose_is_away_touches_less_probably():
    here, near, away = (probability_of(0.2, gap) for gap in (-0.2, 0.5, 5.0))
    assert here > near > away and here > 0.95 and away < 0.01


def test_a_pressed_jaw_is_touched_whatever_the_pose_errs():
    assert probability_of(1.0, gap=0.5) > 0.999


def test_without_a_pose_the_depth_alone_tells():
    assert probability_of(0.0) == pytest.approx(0.5)
    assert probability_of(0.2) > 0.999


def test_of_a_given_contact_the_force_alone_tells():
    state = blank_contact_state()
    state["magnitude"], state["stddev"] = 0.1, 0.05
    assert find_touch_probability(state, SimpleNamespace(outline=None), 0.014) == pytest.approx(0.977, abs=1e-3)
