"""Heatmaps and offsets to pixels, against DeepLabCut's formula written out and against known places."""

import numpy as np
import pytest

from finforce_keypoints.networks.model import (
    DEFAULT_STDDEV,
    DecodingRule,
    decode,
    stddev_from_likelihood,
    stride_from_shapes,
)

RULE = DecodingRule(stride=8.0)


def noise_maps(seed=0, batch=2, parts=5, cells=(61, 81)):
    rng = np.random.default_rng(seed)
    heatmap = rng.uniform(-0.2, 0.9, (batch, parts, *cells)).astype(np.float32)
    locref = rng.normal(0.0, 0.6, (batch, 2 * parts, *cells)).astype(np.float32)
    return heatmap, locref


def gaussian(place, cells, stride, width=2.0 * 17.0 / 3.0):
    """DeepLabCut's target: a Gaussian of unit height around a place (column, row) [px]."""
    rows, columns = ((np.arange(n) + 0.5) * stride for n in cells)
    return np.exp(-((columns - place[0]) ** 2 + (rows[:, None] - place[1]) ** 2) / (2.0 * width**2))


def offsets_to(place, cells, stride):
    """The offsets (2, h, w) of a network that knows the place."""
    rows, columns = ((np.arange(n) + 0.5) * stride for n in cells)
    dx, dy = np.broadcast_arrays(place[0] - columns, (place[1] - rows)[:, None])
    return np.stack((dx, dy)) / 7.2801


def test_places_are_those_of_deeplabcuts_formula():
    heatmap, locref = noise_maps()
    heatmap[:, :, 58:], heatmap[:, :, :, 78:], heatmap[:, :, :2], heatmap[:, :, :, :2] = 0, 0, 0, 0
    peaks = decode(heatmap, locref, RULE, (480, 640))
    for image, part in np.ndindex(2, 5):
        r, c = np.unravel_index(heatmap[image, part].argmax(), (61, 81))
        x = (c + 0.5) * 8 + locref[image, 2 * part, r, c] * 7.2801
        y = (r + 0.5) * 8 + locref[image, 2 * part + 1, r, c] * 7.2801
        assert np.abs(peaks.pixels[image, part] - (x, y)).max() < 1e-4  # float32 offsets
        assert peaks.likelihood[image, part] == pytest.approx(heatmap[image, part].max())


def test_offsets_are_interleaved_x_then_y():
    heatmap = np.zeros((1, 2, 5, 5), np.float32)
    heatmap[0, :, 2, 2] = 1.0
    locref = np.zeros((1, 4, 5, 5), np.float32)
    locref[0, 1] = 0.5  # y of the first
    locref[0, 2] = -0.25  # x of the second
    peaks = decode(heatmap, locref, RULE, (40, 40))
    assert peaks.pixels[0, 0] == pytest.approx((20.0, 20.0 + 0.5 * 7.2801))
    assert peaks.pixels[0, 1] == pytest.approx((20.0 - 0.25 * 7.2801, 20.0))


def test_scores_become_likelihoods_from_zero_to_one():
    heatmap = np.full((1, 3, 4, 4), -2.0, np.float32)
    heatmap[0, 0, 1, 1], heatmap[0, 1, 1, 1] = 3.0, 0.4
    peaks = decode(heatmap, None, RULE, (32, 32))
    assert peaks.likelihood[0] == pytest.approx((1.0, 0.4, 0.0))
    logits = decode(heatmap, None, DecodingRule(stride=8.0, apply_sigmoid=True), (32, 32))
    assert logits.likelihood[0] == pytest.approx(1.0 / (1.0 + np.exp(-np.array([3.0, 0.4, -2.0]))), abs=1e-6)


def test_without_offsets_a_gaussian_is_placed_between_the_cells():
    places = np.array([[100.3, 71.9], [55.0, 40.0], [250.7, 133.2]])
    heatmap = np.stack([gaussian(place, (25, 40), 8) for place in places])[None].astype(np.float32)
    assert np.abs(decode(heatmap, None, RULE, (192, 320)).pixels[0] - places).max() < 1e-3  # float32 logarithms


def test_a_flat_map_or_one_at_the_border_stays_in_its_cell():
    heatmap = np.zeros((1, 2, 6, 6), np.float32)
    heatmap[0, 1] = gaussian((1.0, 47.0), (6, 6), 8)
    peaks = decode(heatmap, None, RULE, (48, 48))
    assert peaks.likelihood[0, 0] == 0.0
    assert np.abs(peaks.pixels[0, 1] - (4.0, 44.0)).max() <= 4.0


def test_cells_outside_the_image_are_not_searched():
    heatmap = np.zeros((1, 1, 9, 9), np.float32)
    heatmap[0, 0, 2, 3], heatmap[0, 0, 8, 8] = 0.7, 1.0
    peaks = decode(heatmap, None, RULE, (40, 48))
    assert peaks.pixels[0, 0] == pytest.approx((28.0, 20.0)) and peaks.likelihood[0, 0] == pytest.approx(0.7)


def test_a_place_just_outside_the_image_is_moved_to_the_border_and_one_farther_out_is_dropped():
    heatmap = np.zeros((1, 2, 7, 7), np.float32)
    heatmap[0, 0, 3, 6], heatmap[0, 1, 3, 6] = 0.9, 0.9  # the border cell of a picture of 48 px, its middle at 52
    locref = np.zeros((1, 4, 7, 7), np.float32)
    locref[0, 0], locref[0, 2] = -1.0 / 7.2801, 3.0 / 7.2801
    peaks = decode(heatmap, locref, RULE, (48, 48))
    assert peaks.pixels[0, 0] == pytest.approx((47.0, 28.0)) and peaks.likelihood[0, 0] == pytest.approx(0.9)
    assert np.isnan(peaks.pixels[0, 1]).all() and peaks.likelihood[0, 1] == 0.0 and peaks.stddev[0, 1] == np.inf


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_what_is_not_finite_is_dropped(bad):
    heatmap, locref = noise_maps()
    heatmap[0, 0] = bad
    r, c = np.unravel_index(heatmap[1, 2].argmax(), (61, 81))
    locref[1, 4, r, c] = bad
    peaks = decode(heatmap, locref, RULE, (480, 640))
    for image, part in ((0, 0), (1, 2)):
        assert np.isnan(peaks.pixels[image, part]).all()
        assert peaks.likelihood[image, part] == 0.0 and peaks.stddev[image, part] == np.inf
    pooled = decode(heatmap, locref, DecodingRule(stride=8.0, pooled=True), (480, 640))
    assert np.isnan(pooled.pixels[1, 2]).all()
    assert np.isfinite(peaks.pixels[0, 1]).all()


def test_offsets_longer_than_training_gives_drop_the_point_and_are_told():
    heatmap, locref = np.zeros((1, 1, 9, 9), np.float32), np.full((1, 2, 9, 9), 2.5, np.float32)
    heatmap[0, 0, 4, 4] = 0.8
    peaks = decode(heatmap, locref, RULE, (72, 72))
    assert np.isnan(peaks.pixels).all() and peaks.likelihood[0, 0] == 0.0
    assert peaks.astray[0, 0] == pytest.approx(0.8)
    assert decode(heatmap, 0.1 * locref, RULE, (72, 72)).astray[0, 0] == 0.0


def test_agreeing_votes_have_no_spread_and_contradicting_ones_raise_the_deviation():
    place, cells = (101.0, 77.0), (25, 40)
    heatmap = gaussian(place, cells, 8)[None, None].astype(np.float32)
    locref = offsets_to(place, cells, 8)[None]
    peaks = decode(heatmap, locref, RULE, (192, 320))
    assert peaks.spread[0, 0] < 1e-6 and peaks.pixels[0, 0] == pytest.approx(place)
    assert peaks.stddev[0, 0] == pytest.approx(DEFAULT_STDDEV[-1, 1])
    noisy = locref + np.random.default_rng(1).normal(0.0, 1.0, locref.shape)  # 7.3 px
    doubtful = decode(heatmap, noisy, RULE, (192, 320))
    assert 3.0 < doubtful.spread[0, 0] < 12.0 and doubtful.stddev[0, 0] == doubtful.spread[0, 0]
    assert np.isnan(decode(heatmap, None, RULE, (192, 320)).spread).all()


def test_pooled_votes_are_nearer_than_a_single_one():
    place, cells = (101.0, 77.0), (25, 40)
    heatmap = gaussian(place, cells, 8)[None, None].astype(np.float32)
    rng, errors = np.random.default_rng(2), {True: [], False: []}
    for _ in range(50):
        locref = offsets_to(place, cells, 8)[None] + rng.normal(0.0, 0.1, (1, 2, *cells))
        for pooled, found in errors.items():
            pixels = decode(heatmap, locref, DecodingRule(stride=8.0, pooled=pooled), (192, 320)).pixels
            found.append(np.hypot(*(pixels[0, 0] - place)))
    assert np.mean(errors[True]) < 0.5 * np.mean(errors[False])  # nine votes: about a third


def test_the_deviation_falls_with_the_likelihood_along_the_table():
    table = np.array([[0.2, 8.0], [0.6, 2.0], [0.9, 0.5]])
    assert stddev_from_likelihood(np.array([0.0, 0.2, 0.4, 0.6, 1.0]), table) == pytest.approx([8, 8, 4, 2, 0.5])
    heatmap = np.zeros((1, 2, 5, 5), np.float32)
    heatmap[0, 0, 2, 2], heatmap[0, 1, 2, 2] = 0.6, 0.95
    rule = DecodingRule(stride=8.0, likelihood_stddev=table)
    assert decode(heatmap, None, rule, (40, 40)).stddev[0] == pytest.approx([2.0, 0.5])


@pytest.mark.parametrize(
    ("cells", "pixels", "stride"),
    [(57, 448, 8), (61, 480, 8), (81, 640, 8), (107, 848, 8), (47, 360, 8), (241, 480, 2), (120, 480, 4)],
)
def test_the_stride_of_every_architecture_is_a_power_of_two(cells, pixels, stride):
    assert stride_from_shapes(cells, pixels) == stride
