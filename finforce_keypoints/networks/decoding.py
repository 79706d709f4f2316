"""Heatmaps and offsets to pixels, likelihoods and standard deviations."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

# Likelihood and standard deviation [px of the network's input] of a network that was never calibrated: DeepLabCut's
# networks err by 2 to 3 px above its cut-off of 0.6, and by tens of pixels where they see nothing.
DEFAULT_STDDEV = np.array([[0.05, 20.0], [0.2, 10.0], [0.4, 5.0], [0.6, 3.0], [0.8, 2.0], [0.95, 1.5]])
# DeepLabCut trains offsets within 17 px of a label; a longer one at a peak comes of a wrong scale or a wrong network.
LARGEST_OFFSET = 20.0
_LOG_FLOOR = 1e-2  # of the peak: a neighbour below it says nothing of the place between the cells
_STEP_ROWS, _STEP_COLUMNS = (steps.ravel() - 1 for steps in np.indices((3, 3)))
_FEW_CELLS = 36
_LARGEST_PEAK = 0.5  # share of a map's cells that may reach half of its highest score: a map without a peak is no map
_CENTRE = 4  # of the 3 x 3 cells in row order; 3 and 5 are its neighbours in the row, 1 and 7 in the column


@dataclass(frozen=True, kw_only=True, eq=False)
class DecodingRule:
    """How the maps of one network become pixels.

    Attributes:
        stride: input pixels per cell.
        locref_std: scale of the offset channels [px].
        apply_sigmoid: whether the maps are logits.
        sub_cell: whether a peak without offsets is placed between the cells, by a parabola through the logarithms.
        pooled: whether the places that the 3 x 3 cells around a peak vote for are averaged, weighted by their scores;
            DeepLabCut takes the peak's own.
        likelihood_stddev: (n, 2) likelihood, standard deviation [px of the network's input].
    """

    stride: float
    locref_std: float = 7.2801
    apply_sigmoid: bool = False
    sub_cell: bool = True
    pooled: bool = False
    likelihood_stddev: NDArray = field(default_factory=lambda: DEFAULT_STDDEV)


@dataclass(frozen=True, kw_only=True, eq=False)
class Peaks:
    """The best place of every body part in every image of a batch.

    Attributes:
        pixels: (B, K, 2) column and row in the network's input [px]; NaN where there is none.
        likelihood: (B, K) from 0 to 1; 0 where there is none.
        spread: (B, K) standard deviation of the places that the cells around the peak vote for [px], large where the
            offsets contradict each other; NaN without offsets.
        stddev: (B, K) [px], by the calibrated map, at least the spread; inf where there is none.
        astray: (B, K) the score of a peak that was dropped because its offset is longer than training allows, else 0.
    """

    pixels: NDArray
    likelihood: NDArray
    spread: NDArray
    stddev: NDArray
    astray: NDArray


@dataclass(frozen=True, kw_only=True, eq=False)
class _Cells:
    """The 3 x 3 cells around n peaks: rows, columns and scores (n, 9), NaN outside the map; is it a peak (n,)."""

    rows: NDArray
    columns: NDArray
    scores: NDArray
    is_peak: NDArray


@dataclass(frozen=True, kw_only=True, eq=False)
class _Places:
    """Where n peaks are: pixels (n, 2), length of the offset from the cell's centre (n,), spread (n,) [px]."""

    pixels: NDArray
    offset: NDArray
    spread: NDArray


def decode(heatmap: NDArray, locref: NDArray | None, rule: DecodingRule, size: tuple[int, int]) -> Peaks:
    """Return the highest peak of every heatmap, as DeepLabCut's HeatmapPredictor places it.

    x = (c + 0.5) stride + locref[2k, r, c] locref_std,  y = (r + 0.5) stride + locref[2k + 1, r, c] locref_std,
    score = heatmap[k, r, c], or its sigmoid, clipped to 0..1.

    Maps reach beyond the image, by the network's border and by padding: cells that begin outside it are not searched,
    a place up to half a cell outside is moved to the border, one farther out is dropped. So is what is not finite, and
    the highest cell of a map that is about as high everywhere.

    Args:
        heatmap: (B, K, h, w) scores.
        locref: (B, 2K, h, w) offsets, x and y interleaved; None without.
        rule: of the network.
        size: height and width of the image within the network's input [px].

    Returns:
        The peaks.
    """
    batch, count = heatmap.shape[:2]
    cells = _find_cells(heatmap, rule, size)
    places = _place_by_scores(cells, rule) if locref is None else _place_by_offsets(cells, locref, rule)
    scores = cells.scores[:, _CENTRE]
    is_astray = places.offset > max(LARGEST_OFFSET, 1.5 * rule.stride)
    is_good = np.isfinite(scores) & cells.is_peak & ~is_astray & _is_near(places.pixels, 0.5 * rule.stride, size)
    likelihood = np.where(is_good, np.clip(scores, 0.0, 1.0), 0.0)
    stddev = np.fmax(stddev_from_likelihood(likelihood, rule.likelihood_stddev), places.spread)
    pixels = np.clip(places.pixels, 0.0, (size[1] - 1.0, size[0] - 1.0))
    shape = (batch, count)
    return Peaks(
        pixels=np.where(is_good[:, None], pixels, np.nan).reshape(*shape, 2),
        likelihood=likelihood.reshape(shape),
        spread=places.spread.reshape(shape),
        stddev=np.where(is_good, stddev, np.inf).reshape(shape),
        astray=np.where(is_astray, np.clip(scores, 0.0, 1.0), 0.0).reshape(shape),
    )


def stddev_from_likelihood(likelihood: NDArray, table: NDArray) -> NDArray:
    """Return the standard deviations (...) [px] of likelihoods (...), on a calibrated map.

    Between the rows the logarithm is interpolated; outside them the first or the last row holds.

    Args:
        likelihood: (...) from 0 to 1.
        table: (n, 2) rising likelihood, standard deviation [px].
    """
    return np.exp(np.interp(likelihood, table[:, 0], np.log(table[:, 1])))


def stride_from_shapes(cells: int, pixels: int) -> float:
    """Return the power of two that is nearest to input pixels per cell, 2^round(log2(H / h)).

    A network has a border cell more than H / stride, therefore H / h itself is none.
    """
    return float(2.0 ** np.round(np.log2(pixels / cells)))


def _find_cells(heatmap: NDArray, rule: DecodingRule, size: tuple[int, int]) -> _Cells:
    """Return the cells around the highest peak of every map (B, K, h, w), n = B K."""
    rows, columns = (
        min(cells, int(pixels // rule.stride) + 1) for cells, pixels in zip(heatmap.shape[2:], size, strict=True)
    )
    maps = heatmap[:, :, :rows, :columns].reshape(-1, rows * columns)
    best = maps.argmax(axis=1)[:, None]
    r, c = best // columns + _STEP_ROWS, best % columns + _STEP_COLUMNS
    is_inside = (r >= 0) & (r < rows) & (c >= 0) & (c < columns)
    r, c = np.clip(r, 0, rows - 1), np.clip(c, 0, columns - 1)
    scores = np.take_along_axis(maps, r * columns + c, axis=1).astype(float)
    half = 0.5 * scores[:, _CENTRE]
    if rule.apply_sigmoid:
        scores = 1.0 / (1.0 + np.exp(-np.clip(scores, -50.0, 50.0)))
        half = np.log(0.5 * scores[:, _CENTRE] / (1.0 - 0.5 * scores[:, _CENTRE]))
    is_peak = (maps >= half[:, None]).mean(axis=1) <= _LARGEST_PEAK
    # of a negative peak, half is higher than it; a map of a few cells is nearly all peak
    is_peak |= ~(scores[:, _CENTRE] > 0.0) | (maps.shape[1] < _FEW_CELLS)
    return _Cells(rows=r, columns=c, scores=np.where(is_inside, scores, np.nan), is_peak=is_peak)


def _place_by_scores(cells: _Cells, rule: DecodingRule) -> _Places:
    """Return the centres of the peaks' cells, or the tops of parabolas through the logarithms of the scores.

    Half the offset is (a - b) / (a - 2 m + b) of the logarithms a, m, b before, at and after the peak, exact for a
    Gaussian.
    """
    scores, between = cells.scores, np.zeros((len(cells.scores), 2))
    if rule.sub_cell:
        peak = np.maximum(scores[:, _CENTRE], np.finfo(float).tiny)[:, None]
        with np.errstate(invalid="ignore"):
            logs = np.log(np.maximum(scores / peak, _LOG_FLOOR))
        before, after = logs[:, [3, 1]], logs[:, [5, 7]]
        bend = before + after
        between = 0.5 * (before - after) / np.where(bend < 0.0, bend, -np.inf)
        between = np.nan_to_num(np.clip(between, -0.5, 0.5))  # NaN: at the border of the map
    offsets = rule.stride * between
    centres = np.column_stack((cells.columns[:, _CENTRE], cells.rows[:, _CENTRE])) + 0.5
    return _Places(
        pixels=centres * rule.stride + offsets,
        offset=np.hypot(*offsets.T),
        spread=np.full(len(offsets), np.nan),
    )


def _place_by_offsets(cells: _Cells, locref: NDArray, rule: DecodingRule) -> _Places:
    """Return the peaks moved by their offsets, and how far the cells around them agree."""
    count = locref.shape[1] // 2
    image, part = (index[:, None] for index in np.divmod(np.arange(len(cells.scores)), count))
    dx, dy = (locref[image, 2 * part + axis, cells.rows, cells.columns] for axis in (0, 1))
    with np.errstate(invalid="ignore"):
        offsets = rule.locref_std * np.stack((dx, dy), axis=-1).astype(float)
    votes = (np.stack((cells.columns, cells.rows), axis=-1) + 0.5) * rule.stride + offsets
    weights = np.where(np.isfinite(votes).all(axis=-1), np.nan_to_num(np.clip(cells.scores, 0.0, 1.0)), 0.0)
    weights /= np.maximum(weights.sum(axis=1), np.finfo(float).tiny)[:, None]
    votes_known = np.nan_to_num(votes, posinf=0.0, neginf=0.0)
    mean = (weights[..., None] * votes_known).sum(axis=1)
    variance = 0.5 * (weights[..., None] * (votes_known - mean[:, None]) ** 2).sum(axis=(1, 2))
    is_empty = weights.sum(axis=1) == 0.0
    own = votes[:, _CENTRE]
    pixels = np.where((rule.pooled & ~is_empty & np.isfinite(own).all(axis=1))[:, None], mean, own)
    return _Places(
        pixels=pixels,
        offset=np.hypot(*offsets[:, _CENTRE].T),
        spread=np.where(is_empty, np.nan, np.sqrt(variance)),
    )


def _is_near(pixels: NDArray, margin: float, size: tuple[int, int]) -> NDArray:
    """Tell (n,) which pixels (n, 2) are finite and at most a margin outside an image of some height and width."""
    farthest = (size[1] + margin, size[0] + margin)
    return ((pixels >= -margin) & (pixels <= farthest)).all(axis=1)
