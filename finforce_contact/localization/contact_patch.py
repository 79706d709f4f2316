"""Overlap of jaw and object along the finger into a few weighted contact rows."""

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

_OPTIONS = {"cache": True, "error_model": "numpy"}
_BISECTIONS = 40
# Exponents of the tilt over the span of the rows; beyond, all weight is on the last row anyway.
_STEEPEST = 40.0


@dataclass(frozen=True, kw_only=True, eq=False)
class Rows:
    """Contact rows.

    Attributes:
        heights: (n,) [m] on the undeformed inner surface, rising.
        weights: (n,), sum 1.
    """

    heights: NDArray
    weights: NDArray

    @property
    def mean(self) -> float:
        """The weighted mean height [m]."""
        return float(self.heights @ self.weights)


def overlap_of(gaps: NDArray, depth: float) -> NDArray:
    """Returns the overlap (h,) [m] with gaps (h,) [m] closed along x until the deepest overlap is `depth` [m].

    o = max(0, depth + min g - g): whatever the pose errs along x drops out.
    """
    return np.maximum(0.0, depth + gaps.min() - gaps)


def rows_from_overlap(heights: NDArray, overlap: NDArray, spacing: float, narrow: float) -> Rows:
    """Returns rows no farther apart than `spacing` [m], weighted by the overlap that each stands for.

    A contact whose overlap has the spread of an even one no higher than `narrow` [m], 12^0.5 standard deviations,
    is one row at its centre. Heights without overlap between two contacts part them.

    Args:
        heights: (h,) [m], evenly spaced.
        overlap: (h,) [m], somewhere above zero.
        spacing: greatest height per row [m].
        narrow: [m].
    """
    places, weights = _gather(heights, overlap, spacing, narrow)
    return Rows(heights=places, weights=weights / weights.sum())


def tilt_rows(rows: Rows, mean: float) -> Rows:
    """Returns the rows with weights w_i exp(s z_i) whose mean is `mean` [m], or one row there when none has it."""
    if not rows.heights[0] < mean < rows.heights[-1]:
        return Rows(heights=np.array([mean]), weights=np.ones(1))
    return Rows(heights=rows.heights, weights=_tilt(rows.heights, rows.weights, mean))


def cross_line_of_action(line: NDArray, heights: NDArray, force: NDArray, torque: NDArray, near: float) -> float:
    """Returns the undeformed height [m] where the force's line of action cuts the deformed line, NaN if nowhere.

    The cut is where z F_x - x F_z = M_y; of several the one nearest to the height `near` [m] counts.

    Args:
        line: x and z (h, 2) [m] of the deformed surface.
        heights: (h,) [m] of its points on the undeformed surface.
        force: (3,) [N].
        torque: (3,) [N m] about the jaw's origin.
        near: [m].
    """
    miss = line[:, 1] * force[0] - line[:, 0] * force[2] - torque[1]
    before = np.flatnonzero((miss[:-1] <= 0.0) != (miss[1:] <= 0.0))
    if not len(before):
        return float("nan")
    share = miss[before] / (miss[before] - miss[before + 1])
    cuts = heights[before] + share * (heights[before + 1] - heights[before])
    return float(cuts[np.abs(cuts - near).argmin()])


@njit(**_OPTIONS)
def _gather(heights, overlap, spacing, narrow):
    """Returns heights and weights of the rows of every contact."""
    places, weights, count = np.empty(len(heights)), np.empty(len(heights)), 0
    first = 0
    while first < len(heights):
        if overlap[first] <= 0.0:
            first += 1
            continue
        last = first
        while last + 1 < len(heights) and overlap[last + 1] > 0.0:
            last += 1
        h, w = heights[first : last + 1], overlap[first : last + 1]
        centre = (h * w).sum() / w.sum()
        spread = np.sqrt(12.0 * ((h - centre) ** 2 * w).sum() / w.sum())
        rows = 1 if spread <= narrow else int(np.ceil((h[-1] - h[0]) / spacing))
        for r in range(rows):
            start, stop = r * len(h) // rows, (r + 1) * len(h) // rows
            share = w[start:stop].sum()
            if share > 0.0:
                places[count], weights[count] = (h[start:stop] * w[start:stop]).sum() / share, share
                count += 1
        first = last + 1
    return places[:count].copy(), weights[:count].copy()


@njit(**_OPTIONS)
def _tilt(heights, weights, mean):
    """Returns the tilted weights; the slope is found by bisection."""
    span = heights[-1] - heights[0]
    low, high = -_STEEPEST, _STEEPEST
    tilted = weights.copy()
    for _ in range(_BISECTIONS):
        slope = 0.5 * (low + high)
        exponent = slope * (heights - mean) / span
        tilted = weights * np.exp(exponent - exponent.max())
        tilted /= tilted.sum()
        if (tilted * heights).sum() < mean:
            low = slope
        else:
            high = slope
    return tilted
