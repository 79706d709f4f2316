"""Key points by printed or painted dots, with OpenCV and without any training; knows no depth."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from finforce_camera import CameraIntrinsics, project
from finforce_keypoints.dot_image import Dots, DotSettings, find_dots
from finforce_keypoints.finder import PixelFinding
from finforce_keypoints.gripper_geometry import ROBOT_CAMERA, OpeningRange
from finforce_keypoints.optional import import_cv2

if TYPE_CHECKING:
    from finforce_ifea.jaw import Jaw
    from finforce_keypoints.images import RgbdImage

LEAST_DOTS = 4  # of a jaw that is there
_SEARCH_STEP = 4e-3  # m, between the places where a lost jaw is tried
_MARGIN = 0.02  # m, around the undeformed points, that is searched for dots
# How far up from the base dots are assigned, as parts of the length: the base hardly moves, and what is known so far
# lets expect the next.
_GROWTH = (0.3, 0.5, 0.7, 0.85, 1.0, 1.0)
# Standard deviations [m] of the field of displacements 1, s, s^2, x / length, s^3 (s the height over the length), and
# of a dot off it: a finger bends by up to 20 mm at its tip.
_FIELD_STDDEV = np.array([2e-3, 8e-3, 15e-3, 5e-3, 8e-3])
_DOT_STDDEV = 0.7e-3
_CENTROID_STDDEV = 0.1  # px, of a whole dot
_AREA_STDDEV = 0.35  # of the logarithm of a whole dot's area


@dataclass(frozen=True, kw_only=True, eq=False)
class _Pattern:
    """One jaw's points as they would be without load, in the image.

    Attributes:
        pixels: (n, 2) [px].
        scale: (n,) pixels per metre on the jaw's side, mean of the directions.
        basis: (n, 5) the field's functions at the points.
        height: (n,) over the base, parts of the length.
    """

    pixels: NDArray
    scale: NDArray
    basis: NDArray
    height: NDArray


@dataclass(frozen=True, kw_only=True, eq=False)
class _Match:
    """Which dot is which point: (n,) numbers of dots, -1 for none; the field (5, 2) [m]; cost, 1 per missing dot."""

    dots: NDArray
    field: NDArray
    cost: float


class DotFinder:
    """Finds dots and tells by their expected places and by their neighbours which is which; a `PixelFinder`.

    The displacements of a jaw's dots from their undeformed places are taken for a smooth field, found from the base to
    the tip: a dot that is hidden stays without a dot, and its neighbours' dots stay theirs.
    """

    def __init__(
        self,
        jaws: Mapping[str, Jaw],
        settings: DotSettings | None = None,
        T_gripper_camera: NDArray | None = None,
        opening: OpeningRange | None = None,
    ) -> None:
        """Take jaws with dots on their key points and reference points.

        Args:
            jaws: side -> jaw.
            settings: how the dots look.
            T_gripper_camera: (4, 4) camera optical frame in the gripper base, for the search of lost jaws.
            opening: where the jaws can be.

        Raises:
            MissingDependencyError: OpenCV is not installed.
        """
        import_cv2()
        self._settings, self._opening = settings or DotSettings(), opening or OpeningRange()
        self._T_gripper_camera = ROBOT_CAMERA if T_gripper_camera is None else np.asarray(T_gripper_camera)
        self._points = {side: np.vstack((jaw.keypoints, jaw.reference_point)) for side, jaw in jaws.items()}
        self._fields: dict[str, NDArray] = {}

    def find(self, image: RgbdImage, expected: Mapping[str, NDArray | None]) -> Mapping[str, PixelFinding]:
        """Return the dots of every jaw; see `PixelFinder`."""
        candidates = {side: self._place(side, pose, image.camera) for side, pose in expected.items()}
        dots = self._see(np.asarray(image.color), [pattern for some in candidates.values() for pattern in some])
        chosen, matches = {}, {}
        for side, patterns in candidates.items():
            if len(patterns) > 1 or expected.get(side) is None:
                self._fields.pop(side, None)
            tried = [self._follow(pattern, dots, self._fields.get(side)) for pattern in patterns]
            if tried:
                best = int(np.argmin([match.cost for match in tried]))
                chosen[side], matches[side] = patterns[best], tried[best]
        matches = _settle(chosen, matches, dots)
        findings = {}
        for side, match in matches.items():
            if (match.dots >= 0).sum() >= LEAST_DOTS:
                findings[side] = self._describe(chosen[side], match, dots)
                self._fields[side] = match.field
            else:
                self._fields.pop(side, None)
        return findings

    def _place(self, side: str, T_camera_jaw: NDArray | None, camera: CameraIntrinsics) -> list[_Pattern]:
        """Return where a jaw is expected, or all places where a lost one can be; none behind the camera."""
        poses = [T_camera_jaw]
        if T_camera_jaw is None:
            poses = self._opening.place_jaw(self._T_gripper_camera, side, _SEARCH_STEP)
        patterns = [_build_pattern(self._points[side], np.asarray(T, dtype=float), camera) for T in poses]
        return [pattern for pattern in patterns if np.isfinite(pattern.pixels).all()]

    def _see(self, color: NDArray, patterns: Sequence[_Pattern]) -> Dots:
        """Return the dots in the part of an image that can hold the patterns."""
        if not patterns:
            return Dots(pixels=np.empty((0, 2)), areas=np.empty(0), fills=np.empty(0))
        pixels = np.vstack([pattern.pixels for pattern in patterns])
        scale = float(np.median(np.concatenate([pattern.scale for pattern in patterns])))
        size = (color.shape[1], color.shape[0])
        low = np.clip(np.floor(pixels.min(axis=0) - _MARGIN * scale), 0, size).astype(int)
        high = np.clip(np.ceil(pixels.max(axis=0) + _MARGIN * scale), 0, size).astype(int)
        part = np.ascontiguousarray(color[low[1] : high[1], low[0] : high[0]])
        if part.size == 0:
            return Dots(pixels=np.empty((0, 2)), areas=np.empty(0), fills=np.empty(0))
        dots = find_dots(part, self._settings, self._settings.diameter * scale)
        return Dots(pixels=dots.pixels + low, areas=dots.areas, fills=dots.fills)

    def _follow(self, pattern: _Pattern, dots: Dots, field: NDArray | None) -> _Match:
        """Return the best match, from the last image's field or, where that fails, grown from the base."""
        gate = self._settings.gate
        if field is not None:
            match = _grow(pattern, dots.pixels, gate, field, (1.0, 1.0))
            if match.cost < 0.5 * len(match.dots):
                return match
        return _grow(pattern, dots.pixels, gate, np.zeros((len(_FIELD_STDDEV), 2)), _GROWTH)

    def _describe(self, pattern: _Pattern, match: _Match, dots: Dots) -> PixelFinding:
        """Return the finding of one jaw: likely are dots of the right size and shape.

        A dot that is partly hidden is smaller, and its centroid is off by up to the part that is hidden.
        """
        found = match.dots >= 0
        index = np.where(found, match.dots, 0)
        diameter = self._settings.diameter * pattern.scale
        ratio = np.where(found, dots.areas[index] / (0.25 * np.pi * diameter**2), np.nan)
        limit = self._settings.size_tolerance
        ratio /= np.clip(np.nanmedian(ratio), 1.0 / limit, limit)  # paint runs, lenses blur
        odd = np.log(ratio) / _AREA_STDDEV
        shape = np.clip(dots.fills[index], 0.0, 1.0)
        likelihood = np.where(found, np.exp(-0.5 * odd**2) * shape, 0.0)
        hidden = 0.5 * diameter * np.abs(1.0 - np.minimum(ratio, 1.0))
        return PixelFinding(
            pixels=np.where(found[:, None], dots.pixels[index], np.nan),
            likelihood=likelihood,
            stddev=np.where(found, np.hypot(_CENTROID_STDDEV, hidden), np.inf),
        )


def _build_pattern(points: NDArray, T_camera_jaw: NDArray, camera: CameraIntrinsics) -> _Pattern:
    """Return points (n, 3) [m] of a jaw in the image."""
    step = 1e-3
    corners = [
        project(p @ T_camera_jaw[:3, :3].T + T_camera_jaw[:3, 3], camera)
        for p in (points, points + (step, 0.0, 0.0), points + (0.0, 0.0, step))
    ]
    across, along = (corners[1] - corners[0]) / step, (corners[2] - corners[0]) / step
    scale = np.sqrt(np.abs(across[:, 0] * along[:, 1] - across[:, 1] * along[:, 0]))
    length = points[:, 2].max()
    s = np.clip(points[:, 2] / length, 0.0, None)
    basis = np.column_stack((np.ones_like(s), s, s**2, points[:, 0] / length, s**3))
    return _Pattern(pixels=corners[0], scale=scale, basis=basis, height=s)


def _grow(pattern: _Pattern, dots: NDArray, gate: float, field: NDArray, growth: Sequence[float]) -> _Match:
    """Return the match of points and dots (m, 2) [px], from the base to the tip."""
    chosen, cost = np.full(len(pattern.pixels), -1), float(len(pattern.pixels))
    for stage, height in enumerate(growth, start=1):
        reach = pattern.height <= height
        predicted = pattern.pixels + pattern.scale[:, None] * (pattern.basis @ field)
        # In the end the neighbours are known, and another thing of the dots' colour is not to be taken.
        radius = pattern.scale * (0.5 * gate if stage == len(growth) else gate)
        distances = np.hypot(*np.moveaxis(predicted[:, None] - dots[None], -1, 0)) / radius[:, None]
        chosen, cost = _assign(np.where(reach[:, None], distances, np.inf))
        field = _fit_field(pattern, dots, chosen)
    return _Match(dots=chosen, field=field, cost=cost)


def _assign(distances: NDArray) -> tuple[NDArray, float]:
    """Return the dot of each point (n,), -1 for none, of distances (n, m) in gates, and the cost, 1 per missing dot."""
    count = len(distances)
    costs = np.minimum(np.nan_to_num(distances, nan=np.inf), 1.0) ** 2
    rows, columns = linear_sum_assignment(np.hstack((costs, np.ones((count, count)))))
    chosen = np.full(count, -1)
    is_dot = columns < distances.shape[1]
    rows, columns = rows[is_dot], columns[is_dot]
    near = distances[rows, columns] < 1.0
    chosen[rows[near]] = columns[near]
    missing = count - near.sum()
    return chosen, float(missing + costs[rows[near], columns[near]].sum())


def _fit_field(pattern: _Pattern, dots: NDArray, chosen: NDArray) -> NDArray:
    """Return the field (5, 2) [m] through the displacements of the dots that are known, with its priors."""
    known = chosen >= 0
    basis = pattern.basis[known]
    moved = (dots[chosen[known]] - pattern.pixels[known]) / pattern.scale[known, None]
    weight = np.ones(len(moved))
    normal = np.diag((_DOT_STDDEV / _FIELD_STDDEV) ** 2)
    field = np.zeros((len(_FIELD_STDDEV), 2))
    for _ in range(3):
        weighted = basis * weight[:, None]
        field = np.linalg.solve(weighted.T @ basis + normal, weighted.T @ moved)
        off = np.hypot(*(moved - basis @ field).T) / (2.0 * _DOT_STDDEV)
        weight = 1.0 / np.maximum(off, 1.0) ** 2  # a dot of another point pulls little
    return field


def _settle(patterns: Mapping[str, _Pattern], matches: Mapping[str, _Match], dots: Dots) -> dict[str, _Match]:
    """Return the matches after each dot that several jaws claim was given to the nearest point."""
    claims = []
    for side, match in matches.items():
        pattern = patterns[side]
        predicted = pattern.pixels + pattern.scale[:, None] * (pattern.basis @ match.field)
        for row in np.flatnonzero(match.dots >= 0):
            claims.append((np.hypot(*(predicted[row] - dots.pixels[match.dots[row]])), side, row))
    settled = {side: match.dots.copy() for side, match in matches.items()}
    taken: set[int] = set()
    for _, side, row in sorted(claims):
        dot = int(settled[side][row])
        if dot in taken:
            settled[side][row] = -1
        taken.add(dot)
    return {side: _Match(dots=settled[side], field=match.field, cost=match.cost) for side, match in matches.items()}
