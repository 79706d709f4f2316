"""Claims about which key points of a frame may be used."""

import numpy as np
import pytest
from mechanics_fakes import BENCH

from finforce.errors import ObservationError
from finforce_ifea.estimator import KeypointGate
from finforce_ifea.observation import Observation
from finforce_ifea.settings import EstimatorSettings


def make_gate(**options):
    return KeypointGate(BENCH, EstimatorSettings(**options))


def observe(likelihood=1.0, points=None):
    points = BENCH.keypoints.copy() if points is None else points
    return Observation(stamp=0.0, points=points, likelihood=np.broadcast_to(likelihood, (15,)).astype(float))


def accepted(gate, observation):
    return np.isfinite(gate.accept(observation)).all(axis=1)


def only(index, value, rest=1.0):
    likelihood = np.full(15, rest)
    likelihood[index] = value
    return likelihood


def test_visible_points_pass_unchanged():
    points = BENCH.keypoints + 1e-3
    np.testing.assert_array_equal(make_gate().accept(observe(points=points)), points)


def test_observation_itself_is_left_alone():
    observation = observe(0.1)
    make_gate().accept(observation)
    assert np.isfinite(observation.points).all()


@pytest.mark.parametrize(("likelihood", "passes"), [(0.0, False), (0.5999, False), (0.6, True), (1.0, True)])
def test_likelihood_decides_at_its_threshold(likelihood, passes):
    expected = np.ones(15, bool)
    expected[4] = passes
    np.testing.assert_array_equal(accepted(make_gate(), observe(only(4, likelihood))), expected)


def test_threshold_is_a_setting():
    assert accepted(make_gate(likelihood_threshold=0.2), observe(0.3)).all()
    assert not accepted(make_gate(likelihood_threshold=0.9), observe(0.8)).any()


@pytest.mark.parametrize(
    ("axis", "way", "passes"), [(0, 0.029, True), (0, 0.031, False), (1, -0.031, False), (2, 0.031, False)]
)
def test_points_outside_the_box_about_their_place_at_rest_are_refused(axis, way, passes):
    points = BENCH.keypoints.copy()
    points[9, axis] += way
    assert accepted(make_gate(), observe(points=points))[9] == passes


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_point_without_depth_is_refused_whole(axis):
    points = BENCH.keypoints.copy()
    points[3, axis] = np.nan
    found = make_gate().accept(observe(points=points))
    assert np.isnan(found[3]).all()
    assert np.isfinite(np.delete(found, 3, axis=0)).all()


def test_named_points_are_ignored():
    names = f" {BENCH.keypoint_names[0]},{BENCH.keypoint_names[14]} "
    expected = np.ones(15, bool)
    expected[[0, 14]] = False
    np.testing.assert_array_equal(accepted(make_gate(ignored_keypoints=names), observe()), expected)


def test_unknown_name_is_refused_with_the_name():
    with pytest.raises(ObservationError, match="'elbow'.*'bench'"):
        make_gate(ignored_keypoints="elbow")


def test_point_that_comes_back_is_used_at_once():
    gate = make_gate()
    assert not accepted(gate, observe(only(5, 0.1)))[5]
    assert accepted(gate, observe())[5]
