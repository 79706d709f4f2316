"""One coordinate at rest or in motion."""

import numpy as np
import pytest

from finforce.kalman import MotionNoise, Track, expect_position

NOISE = MotionNoise(drift=1e-10, acceleration=1.6e-5, start=2.5e-5, rest_time=3.0, motion_time=1.0)
PERIOD, SIGMA = 1.0 / 30.0, 0.1e-3


def follow(path, seed=0, noise=NOISE):
    """The track of a path (n,) [m] seen with noise: positions, standard deviations, probabilities of rest (n, 3)."""
    random, track, rows = np.random.default_rng(seed), Track(noise, path[0], SIGMA**2), []
    for x in path:
        track.predict(PERIOD)
        track.update(x + SIGMA * random.standard_normal(), SIGMA**2)
        rows.append((track.x, np.sqrt(track.variance), track.rests))
    return np.array(rows).T


def test_noise_at_rest_averages_out_as_far_as_the_deviation_says():
    runs = [follow(np.zeros(400), seed) for seed in range(20)]
    errors, stated = [x[200:] for x, _, _ in runs], [stddev[200:] for _, stddev, _ in runs]
    error, stated = np.sqrt(np.mean(np.square(errors))), np.mean(stated)
    assert error < 0.35 * SIGMA
    assert error == pytest.approx(stated, rel=0.5)


def test_a_steady_motion_is_followed_without_lag():
    path = np.r_[np.zeros(60), 2e-3 * PERIOD * np.arange(120)]
    errors = [follow(path, seed)[0][90:] - path[90:] for seed in range(20)]
    assert abs(np.mean(errors)) < 0.1 * SIGMA


def test_rest_and_motion_are_told_apart():
    _, _, rests = follow(np.r_[np.zeros(90), 3e-3 * PERIOD * np.arange(90)])
    assert rests[60:90].mean() > 0.9
    assert rests[120:].mean() < 0.1


def test_a_coordinate_that_never_starts_is_a_random_walk():
    still = NOISE._replace(rest_time=1e12, motion_time=1e-9)
    x, stddev, _ = follow(np.zeros(50), noise=still)
    mean, variance, random = 0.0, SIGMA**2, np.random.default_rng(0)
    for _ in range(50):
        variance += NOISE.drift * PERIOD
        gain = variance / (variance + SIGMA**2)
        mean += gain * (SIGMA * random.standard_normal() - mean)
        variance *= 1.0 - gain
    assert x[-1] == pytest.approx(mean, rel=1e-6)
    assert stddev[-1] == pytest.approx(np.sqrt(variance), rel=1e-6)


def test_an_expected_position_changes_nothing_until_it_is_measured():
    track = Track(NOISE, 0.0, SIGMA**2)
    track.predict(PERIOD)
    expected = expect_position(track.state, 1e-3, SIGMA**2, NOISE)
    assert track.x == 0.0
    track.update(1e-3, SIGMA**2)
    assert track.x == expected


def test_another_origin_moves_the_position_alone():
    track = Track(NOISE, 0.0, SIGMA**2)
    track.predict(PERIOD)
    track.update(0.5e-3, SIGMA**2)
    before, variance, speed = track.x, track.variance, track.speed
    track.shift(2e-3)
    assert track.x == pytest.approx(before + 2e-3)
    assert (track.variance, track.speed) == (pytest.approx(variance), speed)


def test_a_jump_is_where_it_is_seen_in_its_first_image():
    jumpy = NOISE._replace(jump=(5e-3) ** 2, jump_probability=1e-3)
    path = np.r_[np.zeros(60), np.full(3, 5e-3)]
    lags = [[follow(path, seed, noise)[0][60] - 5e-3 for seed in range(10)] for noise in (jumpy, NOISE)]
    told, smoothed = np.sqrt(np.mean(np.square(lags), axis=1))
    assert told < 2.0 * SIGMA
    assert smoothed > 5.0 * SIGMA
