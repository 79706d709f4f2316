from dataclasses import replace

import numpy as np
import pytest
from keypoint_scene_fakes import CAMERA, FakeScene

from finforce.camera import rays_from_pixels
from finforce_keypoints.geometry.depth import (
    DepthScale,
    SideModel,
    compute_stddev,
    fit_side,
    look_along,
)

SCENE = FakeScene("robot")
SIDES = ("left", "right")
UNSURE = DepthScale(error=0.0, stddev=0.015)
PLACES = SCENE.keypoints("left")[:, ::2]
MODEL = SideModel(places=PLACES, offset=0.2e-3, tilt=0.02, bow=0.2, relief=0.06e-3)


def sights():
    pixels, poses = SCENE.pixels(), SCENE.poses()
    return {side: look_along(rays_from_pixels(pixels[side], CAMERA), poses[side]) for side in SIDES}


@pytest.mark.parametrize("side", SIDES)
def test_rays_through_the_pixels_meet_the_side_in_the_key_points(side):
    points = SCENE.keypoints(side)
    np.testing.assert_allclose(sights()[side].points_at(points[:, 1]), points, atol=1e-9)


def test_rays_away_from_the_side_meet_it_nowhere():
    sight = sights()["left"]
    assert np.isnan(sight.depths_at(np.full(16, 0.2))).all()


@pytest.mark.parametrize("side", SIDES)
def test_standard_deviations_are_those_of_the_errors(side):
    rng, T, sight = np.random.default_rng(0), SCENE.poses()[side], sights()[side]
    pixels, y = SCENE.pixels()[side], SCENE.keypoints(side)[:, 1]
    drawn = []
    for _ in range(600):
        errs = look_along(rays_from_pixels(pixels + 0.5 * rng.standard_normal(pixels.shape), CAMERA), T)
        drawn.append(errs.points_at(y + 0.2e-3 * rng.standard_normal(16)))
    stated = compute_stddev(sight, sight.depths_at(y), np.full(16, 0.2e-3), np.full(16, 0.5 / 430.6))
    np.testing.assert_allclose(np.std(drawn, axis=0), stated, rtol=0.12)  # 600 samples: 3 % each, 48 of them


def measure(shape, scale, seed=0, noise=0.1e-3, missing=()):
    """Fit the side of a bent jaw with bad depths; returns the fit and the true y (16,)."""
    rng = np.random.default_rng(seed)
    true = np.append(shape(*PLACES[:-1].T), 0.0)
    sight = sights()["left"]
    lever = sight.depths_at(np.full(16, 0.01)) * sight.rays[:, 1]
    measured = true + scale * lever + noise * rng.standard_normal(16)
    measured[list(missing)] = np.nan
    return fit_side(MODEL, measured, np.full(16, noise), lever, UNSURE), true


def leaning(x, z):
    return 1e-4 + 0.01 * x + 0.2 * z**2


@pytest.mark.parametrize("scale", [0.0, 0.02, -0.02])
def test_a_wrong_depth_scale_is_told_from_a_leaning_jaw_by_the_reference_point(scale):
    fits = [measure(leaning, scale, seed) for seed in range(40)]
    errors = np.array([fit.y - true for fit, true in fits])
    assert np.sqrt((errors**2).mean()) < 0.12e-3
    assert np.mean([fit.scale.error for fit, _ in fits]) == pytest.approx(scale, abs=5e-4)


def test_the_shared_plane_shrinks_the_noise_of_single_depths():
    lever, rng = np.full(16, -0.12), np.random.default_rng(0)
    known = DepthScale(error=0.0, stddev=5e-4)
    spread = {}
    for relief in (0.06e-3, 1e-3):
        model = replace(MODEL, relief=relief)
        noisy = 0.15e-3 * rng.standard_normal((40, 16))
        spread[relief] = np.std([fit_side(model, row, np.full(16, 0.15e-3), lever, known).y[:-1] for row in noisy])
    assert spread[0.06e-3] < 0.6 * 0.15e-3 < 0.9 * 0.15e-3 < spread[1e-3]


def test_errors_are_as_large_as_stated():
    rng = np.random.default_rng(1)
    standard = []
    for seed in range(60):
        tilt, bow = rng.normal(0.0, 0.02, 2), rng.normal(0.0, 0.2)
        relief = rng.normal(0.0, 0.06e-3, 15)
        fit, true = measure(
            lambda x, z, t=tilt, b=bow, r=relief: t[0] * x + t[1] * z + b * z**2 + r, rng.normal(0.0, 0.015), seed
        )
        standard.append(((fit.y - true) / np.maximum(fit.stddev, 1e-9))[:-1])
    assert 0.88 < np.sqrt(np.mean(np.square(standard))) < 1.1  # 60 images of one scale and 15 points each


def test_without_the_reference_point_the_known_plane_wins_over_a_bad_scale():
    fit, true = measure(lambda x, z: 0.0 * x, 0.02, missing=[15])
    assert np.abs(fit.y - true).max() < 0.5e-3  # the raw depths are 2 to 3 mm off
    assert fit.scale.error == pytest.approx(0.02, abs=5e-3)


def test_an_outlier_is_found_and_moves_no_other_point():
    sight = sights()["left"]
    lever = sight.depths_at(np.full(16, 0.01)) * sight.rays[:, 1]
    measured = np.append(leaning(*PLACES[:-1].T), 0.0)
    measured[4] += 1.8e-3
    fit = fit_side(MODEL, measured, np.full(16, 1e-4), lever, UNSURE)
    assert fit.misfit[4] > 5.0 and np.abs(np.delete(fit.misfit, 4)).max() < 3.0
    assert np.abs(np.delete(fit.y - np.append(leaning(*PLACES[:-1].T), 0.0), 4)).max() < 0.15e-3


def test_a_point_without_depth_lies_on_the_shared_plane_and_is_less_sure():
    fit, true = measure(leaning, 0.01, missing=[3])
    assert abs(fit.y[3] - true[3]) < 0.2e-3 and np.isnan(fit.misfit[3])
    assert fit.stddev[3] > fit.stddev[2]


def test_without_any_depth_the_priors_remain():
    fit, _ = measure(leaning, 0.0, missing=range(16))
    np.testing.assert_array_equal(fit.y, 0.0)
    assert fit.stddev[14] > 1e-3 and fit.stddev[15] == pytest.approx(0.0, abs=1e-9)
    assert fit.scale.stddev == pytest.approx(UNSURE.stddev)
