"""Key points by printed or painted dots, with OpenCV and without any training."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from finforce.camera import CameraIntrinsics, project
from finforce.gripper_frames import ROBOT_CAMERA, OpeningRange
from finforce.optional import import_cv2
from finforce.settings import Bounded, setting
from finforce_keypoints.errors import DetectorSettingsError
from finforce_keypoints.images import PixelDetection

SIZE_TOLERANCE = 2.5  # factor by which a dot's area may be larger or smaller
GATE = 0.006  # [m] by which a dot may be off where its neighbours let expect it
_LARGEST_ELONGATION = 4.0  # a disc that is seen at 75 degrees off its normal
_DIMMEST = 8  # of 255: darker pixels have no colour
Weigh = Callable[[tuple[slice, slice]], NDArray]  # how much the pixels of a part of an image look like a dot


@dataclass(frozen=True, kw_only=True)
class DotSettings(Bounded):
    """The appearance of dots; one on every key point and on the reference point, on the side that the camera sees.

    Raises:
        DetectorSettingsError: a setting is out of its bounds.
    """

    error = DetectorSettingsError
    kind: str = setting(
        "colored",
        "Kind of dots: of one colour on any jaw, light on a dark jaw, or dark on a light jaw",
        choices=("colored", "light", "dark"),
    )
    hue: float = setting(
        120.0, "Hue of colored dots: 0 red, 60 yellow, 120 green, 240 blue, 300 magenta", "deg", 0.0, 360.0
    )
    hue_tolerance: float = setting(30.0, "Maximum deviation from the hue", "deg", 1.0, 60.0)
    least_saturation: float = setting(
        0.3, "Minimum saturation of colored dots: (strongest - weakest) / strongest channel", "1", 0.05, 1.0
    )
    least_contrast: float = setting(
        0.25, "Minimum contrast of light or dark dots, relative to their surroundings", "1", 0.01, 1.0
    )
    diameter: float = setting(0.003, "Diameter of a dot", "m", 5e-4, 0.02)


@dataclass(frozen=True, kw_only=True, eq=False)
class Dots:
    """Dots of one image.

    Attributes:
        pixels: (m, 2) column and row of the centroids [px].
        areas: (m,) [px^2].
        fills: (m,) area / area of the ellipse of the same moments: 1 of an ellipse, less of anything else.
    """

    pixels: NDArray
    areas: NDArray
    fills: NDArray


def find_dots(color: NDArray, settings: DotSettings, diameter: float) -> Dots:
    """Return the dots of an image.

    Args:
        color: (h, w, 3) uint8 RGB.
        settings: appearance of the dots.
        diameter: of a dot [px], about.

    Returns:
        The dots, in no order; the centroids are weighted by how much a pixel looks like a dot, so that pixels on the
        rim count by the part that the dot covers.
    """
    cv2 = import_cv2()
    is_colored = settings.kind == "colored"
    mask, weigh = _see_colored(color, settings) if is_colored else _see_light(color, settings, diameter)
    count, labels, stats, _ = cv2.connectedComponentsWithStats(mask, connectivity=8, ltype=cv2.CV_16U)
    expected = 0.25 * np.pi * diameter**2
    area = stats[:, cv2.CC_STAT_AREA]
    tolerance = 2.0 * SIZE_TOLERANCE  # the distance of each dot is not known here
    is_wanted = (area >= expected / tolerance) & (area <= expected * tolerance)
    rows = []
    for number in np.flatnonzero(is_wanted[1:]) + 1:
        x, y, width, height = stats[number, :4].tolist()
        part = slice(max(y - 1, 0), y + height + 1), slice(max(x - 1, 0), x + width + 1)
        row = _measure(weigh(part), labels[part], number)
        if row is not None:
            rows.append(np.add(row, (part[1].start, part[0].start, 0.0, 0.0)))
    table = np.array(rows).reshape(-1, 4)
    return Dots(pixels=table[:, :2], areas=table[:, 2], fills=table[:, 3])


def _see_colored(color: NDArray, settings: DotSettings) -> tuple[NDArray, Weigh]:
    """Return where an image (h, w, 3) has the hue (h, w) uint8, and what gives the chroma towards it of a part."""
    cv2, hue = import_cv2(), np.deg2rad(settings.hue)
    hsv = cv2.cvtColor(color, cv2.COLOR_RGB2HSV)
    least = (255.0 * settings.least_saturation, _DIMMEST)
    low, high = (0.5 * (settings.hue + sign * settings.hue_tolerance) for sign in (-1.0, 1.0))  # OpenCV: 180 a turn
    mask = np.zeros(color.shape[:2], np.uint8)
    for turn in (-180.0, 0.0, 180.0):
        if low + turn <= 180.0 and high + turn >= 0.0:
            bounds = max(low + turn, 0.0), min(high + turn, 180.0)
            mask |= cv2.inRange(hsv, (bounds[0], *least), (bounds[1], 255.0, 255.0))
    # a = R - (G + B) / 2, b = sqrt(3) / 2 (G - B): the chroma towards the hue is a cos + b sin.
    red, other = np.array([1.0, -0.5, -0.5]), np.sqrt(0.75) * np.array([0.0, 1.0, -1.0])
    direction = red * np.cos(hue) + other * np.sin(hue)
    return mask, lambda part: np.maximum(color[part] @ direction, 0.0)


def _see_light(color: NDArray, settings: DotSettings, diameter: float) -> tuple[NDArray, Weigh]:
    """Return where an image (h, w, 3) is lighter, or darker, than around (h, w) uint8, and what tells by how much."""
    cv2 = import_cv2()
    grey = cv2.cvtColor(color, cv2.COLOR_RGB2GRAY)
    # Scaled until a dot has two pixels, the median of five by five does not see it, and is OpenCV's fastest.
    scale = min(1.0, 2.0 / diameter)
    small = cv2.resize(grey, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    around = cv2.resize(cv2.medianBlur(small, 5), grey.shape[::-1])
    above = cv2.subtract(*((grey, around) if settings.kind == "light" else (around, grey)))
    limit = cv2.multiply(cv2.max(around, _DIMMEST), settings.least_contrast)
    return cv2.compare(above, limit, cv2.CMP_GT), lambda part: above[part].astype(float)


def _measure(weight: NDArray, labels: NDArray, number: int) -> tuple | None:
    """Return column, row, area and fill of one component of a cut-out, None when it is too long for a dot."""
    cv2 = import_cv2()
    whole = cv2.moments(np.where((labels == number) | (labels == 0), weight, 0.0))
    shape = cv2.moments((labels == number).astype(np.uint8), binaryImage=True)
    area = shape["m00"]
    # A pixel has a moment of its own, 1/12 px^2.
    xx, yy, xy = (shape[name] / area for name in ("mu20", "mu02", "mu11"))
    mean, half = 0.5 * (xx + yy) + 1.0 / 12.0, np.hypot(0.5 * (xx - yy), xy)
    if mean + half > _LARGEST_ELONGATION**2 * (mean - half) or whole["m00"] <= 0.0:
        return None
    fill = area / (4.0 * np.pi * np.sqrt(mean**2 - half**2))
    return whole["m10"] / whole["m00"], whole["m01"] / whole["m00"], area, fill


if TYPE_CHECKING:
    from finforce_ifea.jaw.jaw import Jaw
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
    """The assignment of dots to points: (n,) dots, -1 for none; the field (5, 2) [m]; cost, 1 per missing dot."""

    dots: NDArray
    field: NDArray
    cost: float


class DotDetector:
    """Finds dots and tells by their expected places and by their neighbours which is which; a `PixelDetector`.

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
            settings: appearance of the dots.
            T_gripper_camera: (4, 4) camera optical frame in the gripper base, for the search of lost jaws.
            opening: where the jaws can be.

        Raises:
            MissingDependencyError: OpenCV is not installed.
        """
        import_cv2()
        self.name, self.sha256 = "dots", ""
        self._settings, self._opening = settings or DotSettings(), opening or OpeningRange()
        self._T_gripper_camera = ROBOT_CAMERA if T_gripper_camera is None else np.asarray(T_gripper_camera)
        self._points = {side: np.vstack((jaw.keypoints, jaw.reference_point)) for side, jaw in jaws.items()}
        self._fields: dict[str, NDArray] = {}

    def detect(self, image: RgbdImage, expected: Mapping[str, NDArray | None]) -> Mapping[str, PixelDetection]:
        """Return the dots of every jaw; see `PixelDetector`."""
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
        detections = {}
        for side, match in matches.items():
            if (match.dots >= 0).sum() >= LEAST_DOTS:
                detections[side] = self._describe(chosen[side], match, dots)
                self._fields[side] = match.field
            else:
                self._fields.pop(side, None)
        return detections

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
        gate = GATE
        if field is not None:
            match = _grow(pattern, dots.pixels, gate, field, (1.0, 1.0))
            if match.cost < 0.5 * len(match.dots):
                return match
        return _grow(pattern, dots.pixels, gate, np.zeros((len(_FIELD_STDDEV), 2)), _GROWTH)

    def _describe(self, pattern: _Pattern, match: _Match, dots: Dots) -> PixelDetection:
        """Return the detection of one jaw: likely are dots of the right size and shape.

        A dot that is partly hidden is smaller, and its centroid is off by up to the part that is hidden.
        """
        found = match.dots >= 0
        index = np.where(found, match.dots, 0)
        diameter = self._settings.diameter * pattern.scale
        ratio = np.where(found, dots.areas[index] / (0.25 * np.pi * diameter**2), np.nan)
        limit = SIZE_TOLERANCE
        ratio /= np.clip(np.nanmedian(ratio), 1.0 / limit, limit)  # paint runs, lenses blur
        odd = np.log(ratio) / _AREA_STDDEV
        shape = np.clip(dots.fills[index], 0.0, 1.0)
        likelihood = np.where(found, np.exp(-0.5 * odd**2) * shape, 0.0)
        hidden = 0.5 * diameter * np.abs(1.0 - np.minimum(ratio, 1.0))
        return PixelDetection(
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
    from scipy.optimize import linear_sum_assignment  # 7 MB that a detector with a network need not have

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
