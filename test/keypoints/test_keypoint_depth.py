import numpy as np
import pytest
from keypoint_scene_fakes import CAMERA, FakeScene

from finforce_ifea.jaw.jaw import list_shipped_jaws, load_jaw
from finforce_keypoints.geometry.depth import build_side_samples, sample_depths, weigh_depths
from finforce_keypoints.geometry.jaw_localizer import LEAST_DEPTHS

JAW = load_jaw("bench")
SAMPLES = build_side_samples(JAW, 3e-3, 0.4e-3)


def test_samples_lie_on_the_finger_off_its_edges():
    for row, point in enumerate(JAW.keypoints):
        places = point + SAMPLES.offsets[row][SAMPLES.used[row]]
        assert len(places) >= 20
        assert np.linalg.norm(places - point, axis=1).max() <= 3e-3
        for shift in (0.25e-3, -0.25e-3):  # of the 0.4 mm, what the raster of 0.15 mm leaves
            for axis in ([1, 0, 0], [0, 0, 1]):
                assert JAW.drawing.distance_to(places + shift * np.array(axis)).max() == 0.0


def test_a_wider_margin_at_the_edges_leaves_fewer_samples():
    assert build_side_samples(JAW, 3e-3, 0.6e-3).used.sum() < SAMPLES.used.sum()


def test_a_jaw_without_a_flat_side_is_sampled_next_to_its_key_points():
    jaw = load_jaw("steel")
    samples = build_side_samples(jaw, 3e-3, 0.4e-3)
    assert (samples.used.sum(axis=1) >= 4).all()
    assert np.linalg.norm(samples.offsets[:-1], axis=2).max() <= 0.5e-3


@pytest.mark.parametrize("name", list_shipped_jaws())
def test_thin_bands_have_samples_enough_to_be_believed_with_holes_in_the_depth(name):
    assert (build_side_samples(load_jaw(name)).used.sum(axis=1) >= 4 * LEAST_DEPTHS).all()


def test_the_right_jaw_is_sampled_like_the_left():
    right = build_side_samples(load_jaw("bench", "right"), 3e-3, 0.4e-3)
    np.testing.assert_allclose(right.offsets, SAMPLES.offsets, atol=1e-12)


def test_true_depths_of_the_side_are_as_expected():
    scene = FakeScene("bench")
    T = scene.poses()["left"]
    excess = sample_depths(scene.depth(), CAMERA, scene.keypoints("left"), SAMPLES, T)
    assert np.isfinite(excess[SAMPLES.used]).all()
    assert np.abs(excess[SAMPLES.used]).max() < 0.4e-3  # half a pixel on a side seen at 45 degrees
    assert np.abs(np.nanmean(excess, axis=1)).max() < 0.06e-3


def test_points_outside_the_picture_or_without_depth_give_nothing():
    scene = FakeScene("bench")
    T, points = scene.poses()["left"], scene.keypoints("left")
    points[0] = np.nan
    points[1] += [0.5, 0.0, 0.0]
    excess = sample_depths(np.full((480, 640), 0.1, np.float32), CAMERA, points, SAMPLES, T)
    assert np.isnan(excess[:2]).all() and np.isfinite(excess[2:][SAMPLES.used[2:]]).all()
    nothing = sample_depths(np.full((480, 640), np.nan, np.float32), CAMERA, points, SAMPLES, T)
    assert np.isnan(nothing).all()


def weigh(rows, gate=2e-3):
    rows = np.array(rows, dtype=float) * 1e-3
    return weigh_depths(rows, np.zeros(len(rows)), gate, 1e-3)


def test_far_and_flying_pixels_do_not_move_the_depth():
    finger = [0.1, -0.1, 0.0, 0.2, -0.2, 0.0, 0.1, -0.1]
    clean, dirty = weigh([finger + [np.nan] * 3]), weigh([finger + [1.9, 40.0, -30.0]])
    assert dirty.excess[0] == pytest.approx(clean.excess[0], abs=1e-9) == pytest.approx(0.0, abs=1e-9)
    assert dirty.count[0] == clean.count[0] == 8
    assert dirty.share[0] == pytest.approx(8 / 11)


def test_rows_without_any_depth_of_the_finger_are_nan_and_count_nothing():
    weighed = weigh([[np.nan] * 4, [30.0] * 4])
    assert np.isnan(weighed.excess).all() and (weighed.count == 0).all() and (weighed.share == 0).all()
    np.testing.assert_array_equal(weighed.known, [0, 4])


def test_more_samples_make_the_depth_surer():
    rng = np.random.default_rng(0)
    rows = rng.normal(0.0, 0.2, (2, 60))
    rows[1, 10:] = np.nan
    few = weigh(rows).stddev
    assert few[0] < 0.6 * few[1]


def test_the_gate_follows_the_expected_centre():
    rows = np.full((1, 10), 4e-3)
    assert weigh_depths(rows, np.zeros(1), 2e-3, 1e-3).count[0] == 0
    assert weigh_depths(rows, np.full(1, 3.5e-3), 2e-3, 1e-3).excess[0] == pytest.approx(4e-3)
