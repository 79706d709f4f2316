"""A closed solid of any shape as layers: cuts across its width, of which each stands for all that are like it."""

from collections.abc import Callable
from itertools import pairwise

import numpy as np
import shapely
from numpy.typing import NDArray

from finforce_ifea.jaw.section import Layer

# Cuts over the width beside the heights at which it steps; layers at most; and how far outlines of one layer may be
# apart [m], tried in turn: so far where it is this share of the width, more where it is less, up to so many times.
_CUTS, _MOST, _ALIKE = 64, 24, (0.1e-3, 0.2e-3, 0.4e-3, 0.8e-3)
_RUN, _JUMP = 4, 0.2  # cuts in a layer of a finger that changes everywhere, where that is by less than this share
_SHARE, _LARGEST = 0.1, 5.0
# Cuts that differ by less than this share of their area make two halves alike.
_SAME = 2e-3
# Half as far is tried as long as outlines change a layer by more than this share of its area.
_LOST = 0.02
# What an outline leaves as it moves has half of its edge along the rest; a wall has its ends there.
_ALONG = 0.4  # [-], least fraction of the edge
_AT = 1e-6  # [m], largest distance of an edge along the rest
_GRID = 1e-8  # [m], grid on which areas are compared, which keeps them valid
_SPECK = 1e-10  # [m^2], largest area of a part that the grid leaves
# Steps closer to each other than this [m] are one.
_STEP = 2e-5


def find_layers(cut: Callable[[float], shapely.Geometry], ends: tuple[float, float], steps: list[float]) -> list[Layer]:
    """Return a solid's layers, lowest first, their places counted from the middle.

    Args:
        cut: returns the section at a height [m].
        ends: lowest and highest point of the solid [m].
        steps: heights [m] at which its section may change at once.
    """
    low, high = ends
    grid = np.unique([*np.linspace(low, high, _CUTS + 1), *steps])
    far = np.abs(grid[:, None] - np.array([low, high, *steps])).min(axis=1)
    # of the even places those next to a step are left out
    grid = grid[(far == 0.0) | (far > 0.25 * (high - low) / _CUTS)]
    grid = grid[np.r_[True, np.diff(grid) > _STEP]]
    grid[-1] = high
    cuts = [cut(middle) for middle in 0.5 * (grid[1:] + grid[:-1])]
    grid -= 0.5 * (low + high)
    if not _is_even(grid, cuts):
        return _stack(grid, cuts)
    half = (len(cuts) + 1) // 2
    *sides, core = _stack(np.append(grid[:half], 0.0), cuts[:half])
    upper = [Layer(low=-layer.high, high=-layer.low, area=layer.area) for layer in reversed(sides)]
    return [*sides, Layer(low=core.low, high=-core.low, area=core.area), *upper]


def _is_even(grid: NDArray, cuts: list[shapely.Geometry]) -> bool:
    """Return True if cuts between heights (n + 1,) mirror each other about the middle, as then layers do."""
    pairs = zip(cuts, reversed(cuts), strict=True)
    are_alike = all(_compare(one, two).area <= _SAME * one.area for one, two in pairs)
    return are_alike and np.abs(grid + grid[::-1]).max() < _STEP


def _stack(grid: NDArray, cuts: list[shapely.Geometry]) -> list[Layer]:
    """Return the layers, lowest first, of cuts between places (n + 1,) [m]."""
    for apart in _ALIKE:
        runs = _find_runs(cuts, apart)
        if len(runs) <= _MOST * len(cuts) / _CUTS:
            break
    else:  # everywhere, as that of a finger with slanted sides
        runs = _split_evenly(cuts)
    areas: dict[int, shapely.Geometry] = {}
    for number in np.argsort([grid[begin] - grid[end] for begin, end in runs], kind="stable").tolist():
        begin, end = runs[number]
        share = (grid[end] - grid[begin]) / np.ptp(grid)
        cut = cuts[(begin + end - 1) // 2]
        near = apart * np.clip(_SHARE / share, 1.0, _LARGEST)
        while near > _STEP:
            areas[number] = _share_lines(cut, list(areas.values()), near)
            if _compare(areas[number], cut).area <= _LOST * cut.area:  # else walls are there or gone that are thinner
                break
            near *= 0.5
    layers: list[Layer] = []
    for number, (begin, end) in enumerate(runs):
        bottom, area = float(grid[begin]), areas[number]
        if layers and layers[-1].area is area:
            bottom = layers.pop().low
        layers.append(Layer(low=bottom, high=float(grid[end]), area=area))
    return layers


def _split_evenly(cuts: list[shapely.Geometry]) -> list[tuple[int, int]]:
    """Return first and last but one of runs of cuts that are about as long, and end where the section steps."""
    steps = {k for k in range(1, len(cuts)) if _compare(cuts[k - 1], cuts[k]).area > _JUMP * cuts[k].area}
    even = set(range(0, len(cuts), _RUN)) - {step + shift for step in steps for shift in (-1, 1)}
    return list(pairwise(sorted(steps | even | {0, len(cuts)})))


def _find_runs(cuts: list[shapely.Geometry], apart: float) -> list[tuple[int, int]]:
    """Return first and last but one of neighbouring cuts that leave each other by no more than a distance [m]."""
    starts = [0]
    for number, cut in enumerate(cuts):
        if not _thick(_compare(cut, cuts[starts[-1]]), apart).is_empty:
            starts.append(number)
    return list(zip(starts, [*starts[1:], len(cuts)], strict=True))


def _thick(area: shapely.Geometry, apart: float) -> shapely.Geometry:
    """Return the parts of an area that are thicker than a distance [m]."""
    area = area.buffer(0.0)  # without lines
    kept = area.buffer(-0.5 * apart, join_style="mitre").buffer(0.51 * apart, join_style="mitre")
    return shapely.intersection(kept, area, grid_size=_GRID).buffer(0.0)


def _find_other(area: shapely.Geometry, beside: shapely.Geometry, apart: float) -> shapely.Geometry:
    """Return what of an area is no outline moved by less than a distance [m]: what is thicker, and walls of their own.

    Those have less than a share of their edge along what is beside them.
    """
    parts = shapely.get_parts(area.buffer(0.0))
    parts = parts[~shapely.is_empty(parts)]
    edges = shapely.boundary(parts)
    along = shapely.length(shapely.intersection(edges, beside.buffer(_AT))) / shapely.length(edges)
    return shapely.union_all([_thick(area, apart), *parts[along < _ALONG]], grid_size=_GRID)


def _share_lines(cut: shapely.Geometry, others: list[shapely.Geometry], apart: float) -> shapely.Geometry:
    """Return a cut whose outline is that of another one wherever both are closer to each other than a distance [m]."""
    if not others:
        return cut.buffer(0.0)
    like = min(others, key=lambda other: _compare(cut, other).area)
    pairs = ((cut, like), (like, cut))
    added, gone = (_find_other(shapely.difference(one, two, grid_size=_GRID), two, apart) for one, two in pairs)
    if added.is_empty and gone.is_empty:
        return like
    more = shapely.union(like, added, grid_size=_GRID).buffer(0.0)  # without what has no area
    parts = shapely.get_parts(shapely.difference(more, gone, grid_size=_GRID).buffer(0.0))
    return shapely.union_all(parts[shapely.area(parts) > _SPECK])


def _compare(one: shapely.Geometry, two: shapely.Geometry) -> shapely.Geometry:
    return shapely.symmetric_difference(one, two, grid_size=_GRID)
