"""Claims about the offsets and the noise that unloaded frames reveal."""

import numpy as np
import pytest
from mechanics_fakes import BENCH

from finforce_ifea.tare import (
    StatedNoise,
    blank_tare,
    compute_point_noise,
    compute_tare,
    find_unloaded,
    measure_correlation,
)
from finforce_ifea.tracking.influence import explain_offsets

REST = BENCH.keypoints
NOISE = np.array([0.2e-3, 0.4e-3, 0.1e-3])


def frames(count=60, *, offsets=None, seed=0, noise=NOISE):
    random = np.random.default_rng(seed)
    constant = 0.3e-3 * random.normal(size=REST.shape) if offsets is None else offsets
    return list(REST + constant + noise * random.normal(size=(count, *REST.shape))), constant


def test_offsets_are_the_mean_deviations():
    seen, constant = frames(300)
    tare = compute_tare(seen, REST)
    # five standard deviations of a mean over 300 frames
    assert (np.abs(tare.offsets - constant) < 5 * NOISE / np.sqrt(300)).all()
    np.testing.assert_array_equal(tare.counts, 300)
    np.testing.assert_allclose(tare.offsets, np.mean(seen, axis=0) - REST, atol=1e-15)


def test_noise_is_measured_with_its_directions():
    random, sight = np.random.default_rng(1), np.array([0.6, 0.8, 0.0])
    constant = 0.3e-3 * random.normal(size=REST.shape)
    scatter = 0.1e-3 * random.normal(size=(200, 15, 3)) + 0.5e-3 * random.normal(size=(200, 15, 1)) * sight
    seen = list(REST + constant + scatter)
    expected = 0.1e-3**2 * np.eye(3) + 0.5e-3**2 * np.outer(sight, sight)
    # 6 %: 3000 samples; the floor of 0.02 mm adds 0.2 %; constant offsets are no noise
    np.testing.assert_allclose(compute_tare(seen, REST).noise, expected, atol=0.06 * expected.max())


DISTANCES = np.linalg.norm(REST[:, None] - REST, axis=2)


def draw_near(correlation, count, seed):
    """Noise (n, K, 3) [m] with a correlation (K, K) between key points."""
    root = np.linalg.cholesky(correlation)
    return NOISE * np.einsum("kj,njc->nkc", root, np.random.default_rng(seed).normal(size=(count, *REST.shape)))


@pytest.mark.parametrize("length", [5e-3, 12e-3, 30e-3])
def test_noise_that_neighbours_share_is_found_at_all_distances(length):
    expected = np.exp(-DISTANCES / length)
    found = np.mean([measure_correlation(draw_near(expected, 45, seed), REST) for seed in range(20)], axis=0)
    np.testing.assert_allclose(found, expected, atol=0.08)


def test_noise_of_each_point_alone_is_not_shared():
    found = [measure_correlation(draw_near(np.eye(len(REST)), 45, seed), REST) for seed in range(100)]
    assert sum(not np.array_equal(each, np.eye(len(REST))) for each in found) <= 2


def test_points_that_are_seen_now_and_then_share_their_noise_with_the_others():
    expected = np.exp(-DISTANCES / 12e-3)
    scatter = draw_near(expected, 300, 0)
    scatter[::2, 4], scatter[:, 9] = np.nan, np.nan
    np.testing.assert_allclose(measure_correlation(scatter, REST), expected, atol=0.08)


def test_no_noise_is_not_shared():
    np.testing.assert_array_equal(measure_correlation(np.zeros((5, *REST.shape)), REST), np.eye(len(REST)))


def test_noise_has_a_floor():
    noise = compute_tare([REST, REST, REST], REST).noise
    assert np.linalg.eigvalsh(noise)[0] == pytest.approx(0.02e-3**2)


def test_gross_errors_do_not_count():
    seen, constant = frames(60)
    for i in range(0, 60, 4):
        seen[i][3] += [0.0, 0.012, 0.0]
        seen[i][8] += [0.0022, 0.0, 0.0]
    tare = compute_tare(seen, REST)
    assert np.linalg.norm(tare.offsets - constant, axis=1).max() < 0.25e-3
    assert tare.counts[3] == 45
    assert tare.counts[[0, 14]].tolist() == [60, 60]


def test_point_that_is_seldom_seen_has_no_offset():
    seen, _ = frames(60)
    for i, points in enumerate(seen):
        points[5] = np.nan if i % 3 else points[5]
        points[6] = np.nan if i % 3 == 0 else points[6]
    tare = compute_tare(seen, REST)
    assert tare.counts[5] == 0
    assert not tare.offsets[5].any()
    assert tare.counts[6] == 40


def test_images_of_a_load_are_found_among_those_without():
    """Gross errors of one key point, and key points that are hidden now and then, look like no load."""
    random = np.random.default_rng(5)
    modes = np.outer((REST[:, 2] / 0.08) ** 2, [-1.0, 0.3])
    seen = np.stack(frames(45)[0])[..., ::2] - REST[:, ::2]
    seen[random.random(seen.shape[:2]) < 0.2] = np.nan
    seen[np.arange(45), random.integers(len(REST), size=45)] += 8e-3
    assert find_unloaded(seen, modes).all()
    loaded = np.arange(45) // 8 % 2 == 1
    seen[loaded] += 1.5e-3 * modes
    np.testing.assert_array_equal(find_unloaded(seen, modes), ~loaded)


def test_fewer_than_three_points_are_no_tare():
    seen, _ = frames(30)
    for points in seen:
        points[2:] = np.nan
    assert compute_tare(seen, REST) is None
    assert compute_tare([np.full_like(REST, np.nan)] * 10, REST) is None


def test_points_far_off_are_no_tare():
    seen, _ = frames(30, offsets=np.tile([0.004, 0.0, 0.0], (15, 1)))
    assert compute_tare(seen, REST) is None


def test_frames_are_left_alone():
    seen, _ = frames(10)
    seen[0][0] += 0.01
    copies = [points.copy() for points in seen]
    compute_tare(seen, REST)
    for points, copy in zip(seen, copies, strict=True):
        np.testing.assert_array_equal(points, copy)


def test_variance_of_an_offset_falls_with_its_frames():
    tare = compute_tare(frames(100)[0], REST)
    expected = np.trace(tare.noise) / 3 / 100
    np.testing.assert_allclose(tare.offset_variance(0.4e-3), expected)
    np.testing.assert_allclose(blank_tare(15, 0.35e-3).offset_variance(0.4e-3), 0.4e-3**2)


def test_blank_tare_knows_nothing():
    tare = blank_tare(15, 0.35e-3)
    assert not tare.offsets.any() and not tare.counts.any()
    np.testing.assert_allclose(tare.noise, 0.35e-3**2 * np.eye(3))


# --- whether offsets look like a load


def bend(size=1.0):
    """A motion (15, 2) along x and z that grows towards the middle of the finger."""
    z = REST[:, 2]
    return size * np.stack([-np.sin(np.pi * z / 0.08), 0.1 * np.cos(np.pi * z / 0.08)], axis=1)


def tare_of(offsets, count=60, seed=0):
    full = np.zeros_like(REST)
    full[:, [0, 2]] = offsets
    return compute_tare(frames(count, offsets=full, seed=seed)[0], REST)


def test_motion_like_a_load_is_significant_and_chance_is_not():
    random = np.random.default_rng(0)
    chance = [
        explain_offsets(bend(), tare_of(0.35e-3 * random.normal(size=(15, 2)), seed=i), 0.4e-3) for i in range(60)
    ]
    assert explain_offsets(bend(), tare_of(bend(2e-3)), 0.4e-3) > 5.0
    assert np.std(chance) == pytest.approx(0.9, abs=0.3)
    assert np.max(np.abs(chance)) < 3.5


def test_motion_out_of_the_jaw_is_significant_with_the_other_sign():
    forward, back = (explain_offsets(bend(), tare_of(bend(sign * 2e-3)), 0.4e-3) for sign in (1, -1))
    assert back == pytest.approx(-forward, rel=0.1)


@pytest.mark.parametrize("shift", [[1.5e-3, 0.0], [0.0, 1.5e-3], [-1.0e-3, 1.0e-3]])
def test_shift_of_all_points_is_no_load(shift):
    """A wrong depth scale moves all key points alike."""
    assert abs(explain_offsets(bend(), tare_of(np.tile(shift, (15, 1))), 0.4e-3)) < 3.5


def test_noise_left_in_the_plane_is_what_the_width_does_not_explain():
    """The finger does not move along y: what it seems to do there tells of the noise along the line of sight."""
    random, sight = np.random.default_rng(0), np.array([0.25, -0.95, 0.18])
    samples = 0.1e-3 * random.normal(size=(200_000, 3)) + 0.5e-3 * random.normal(size=(200_000, 1)) * sight
    covariance = np.cov(samples.T)
    usual = StatedNoise(covariance[None], np.sqrt(np.diag(covariance))[None])
    noise = compute_point_noise(usual, None)
    left, gain = noise.plane[0], noise.gain[0]
    corrected = samples[:, [0, 2]] - samples[:, 1:2] * gain
    np.testing.assert_allclose(np.cov(corrected.T), left, rtol=1e-4, atol=1e-15)
    assert np.trace(left) < 0.5 * np.trace(np.cov(samples[:, [0, 2]].T))
    assert abs(np.cov(corrected[:, 0], samples[:, 1])[0, 1]) < 1e-12
