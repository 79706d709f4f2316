"""The section of a finger, extruded along its width: polygons, their file, where they are held, and the inner face."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from functools import cached_property, lru_cache, reduce
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import shapely
from numpy.typing import NDArray

from finforce.files import parse_json, read_text
from finforce_ifea.errors import JawFileError

UNITS = {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "um": 1e-6, "inch": 25.4e-3}
_LARGEST_FILE = 5_000_000  # [bytes]
_MOST_VERTICES = 100_000
_AT = 1e-4  # [m], largest distance of points of a layer
_GRID = 1e-5  # [m], grid on which lines of layers meet


@dataclass(frozen=True, kw_only=True, eq=False)
class Layer:
    """A part of a finger's width, from `low` to `high` along y [m], with a section of its own, `area` [m]."""

    low: float
    high: float
    area: shapely.Geometry

    @cached_property
    def reached(self) -> shapely.Geometry:
        """The section, and what is close to it."""
        grown = self.area.buffer(_AT)
        shapely.prepare(grown)
        return grown


@dataclass(frozen=True, kw_only=True, eq=False)
class Section:
    """A finger as its section in the x-z plane and its width along y.

    Attributes:
        rings: (n, 2) each, x and z [m, jaw frame]: the outline counterclockwise, then the holes clockwise.
        width: [m], along y, at x = z = 0; the finger is symmetric about y = 0.
        taper: (2,) [-], change of the width along x and z; its sides are planes.
        clamped_z: [m], everything up to this height at x = 0 is clamped; None where circles alone do.
        clamp_slope: [-], rise of that height with x.
        clamped_circles: (c, 3), x, z and radius [m] about bolts: everything within is clamped.
        size: [m], of the elements in the section; None for what the thinnest parts ask for.
        layers: of a finger that is no prism, lowest y first; its rings bound all of them together.
    """

    rings: tuple[NDArray, ...]
    width: float
    clamped_z: float | None = 0.0
    clamped_circles: NDArray
    clamp_slope: float = 0.0
    size: float | None = None
    taper: NDArray = field(default_factory=lambda: np.zeros(2))
    layers: tuple[Layer, ...] = ()

    def read_width(self, points: NDArray) -> NDArray:
        """Return the width (...) [m] at points (..., 2) [m] of the section, of all layers together."""
        if not self.layers:
            return self.width + points @ self.taper
        there = [shapely.intersects_xy(layer.area, points[..., 0], points[..., 1]) for layer in self.layers]
        return np.tensordot([layer.high - layer.low for layer in self.layers], np.array(there, float), 1)

    def place_across(self, points: NDArray) -> NDArray:
        """Return the y (n,) [m] that is nearest to that of points (n, 3) [m] and within the finger."""
        half = 0.5 * (self.width + points[:, [0, 2]] @ self.taper)
        y = np.clip(points[:, 1], -half, half)
        nearest = np.full(len(points), np.inf)
        for layer in self.layers:
            inside = np.clip(points[:, 1], layer.low, layer.high)
            away = np.abs(inside - points[:, 1])
            better = shapely.intersects_xy(layer.reached, points[:, 0], points[:, 2]) & (away < nearest)
            y, nearest = np.where(better, inside, y), np.where(better, away, nearest)
        return y

    @cached_property
    def widest(self) -> float:
        """The largest width [m]."""
        return self.width if self.layers else float(self.read_width(self.rings[0]).max())

    @cached_property
    def lines(self) -> list[tuple[NDArray, bool]]:
        """The bounds of the section and its layers: lines (n, 2) [m] that meet at their ends alone; True if closed."""
        if not self.layers:
            return [(ring, True) for ring in self.rings]
        bounds = shapely.union_all([layer.area.boundary for layer in self.layers], grid_size=_GRID)
        lines = [np.array(line.coords) for line in shapely.get_parts(shapely.line_merge(bounds))]
        return [(line[:-1], True) if (line[0] == line[-1]).all() else (line, False) for line in lines]

    @cached_property
    def polygon(self) -> shapely.Polygon:
        """The section as one polygon with holes."""
        return shapely.Polygon(self.rings[0], self.rings[1:])

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Section) and (self.content, self.size) == (other.content, other.size)

    def __hash__(self) -> int:
        return hash((self.content, self.size))

    @cached_property
    def content(self) -> bytes:
        """All that makes the finger's shape and clamp, to a micrometre; sections with the same are equal."""
        numbers = [self.width, np.nan if self.clamped_z is None else self.clamped_z, *self.clamped_circles.ravel()]
        numbers += self.taper.tolist() if self.taper.any() else []
        numbers += [self.clamp_slope] if self.clamp_slope else []
        rings = [np.round(1e6 * ring).astype(np.int64).tobytes() for ring in self.rings]
        for layer in self.layers:
            numbers += [layer.low, layer.high]
            rings.append(np.round(1e6 * shapely.get_coordinates(layer.area)).astype(np.int64).tobytes())
        return b"|".join([np.round(1e6 * np.array(numbers)).tobytes(), *rings])

    @cached_property
    def free_area(self) -> float:
        """The area [m^2] above the clamp."""
        held = 0.0 if self.clamped_z is None else cut_below(self.polygon, self.clamped_z, self.clamp_slope).area
        return float(self.polygon.area - held)

    @property
    def inner_face_x(self) -> float:
        """The plane x [m] of the inner face unless another is named: the largest x."""
        return float(self.rings[0][:, 0].max())

    @property
    def length(self) -> float:
        """The largest z [m]."""
        return float(self.rings[0][:, 1].max())

    def clamp_height(self, x: float | NDArray) -> float | NDArray:
        """Return up to which height [m] everything is clamped at x [m], -inf where circles alone are."""
        return -np.inf + 0.0 * x if self.clamped_z is None else self.clamped_z + self.clamp_slope * x

    def find_clamped(self, points: NDArray) -> NDArray:
        """Return which of points (n, 2) [m] are clamped, (n,) bool."""
        held = points[:, 1] <= self.clamp_height(points[:, 0]) + 1e-9
        for x, z, radius in self.clamped_circles:
            held |= np.hypot(points[:, 0] - x, points[:, 1] - z) <= radius + 1e-9
        return held

    def distance_to(self, points: NDArray) -> NDArray:
        """Compute the distances (n,) [m] of points (n, 3) [m, jaw frame] from the finger, 0 inside."""
        lateral = np.abs(points[:, 1] - self.place_across(points))
        in_plane = shapely.distance(self.polygon, shapely.points(points[:, [0, 2]]))
        return np.hypot(lateral, in_plane)


def cut_below(polygon: shapely.Polygon, height: float, slope: float = 0.0) -> shapely.Geometry:
    """Return the part of a section below a line: a height [m] at x = 0, and its rise with x [-]."""
    low_x, low_z, high_x, high_z = polygon.bounds
    deep = low_z - np.ptp(polygon.bounds)
    corners = [(x, z) for x in (low_x, high_x) for z in (deep, max(height + slope * x, deep))]
    return polygon.intersection(shapely.MultiPoint(corners).convex_hull)


def find_reach(polygon: shapely.Polygon, z: NDArray) -> NDArray:
    """Return the largest x (n,) [m] of a section at heights z (n,) [m], NaN where there is none."""
    low, _, high, _ = polygon.bounds
    lines = shapely.linestrings([[(low - 1.0, height), (high + 1.0, height)] for height in z])
    return shapely.bounds(shapely.intersection(polygon, lines))[:, 2]


def order_rings(polygon: shapely.Polygon) -> tuple[NDArray, ...]:
    """Return a polygon's rings (n, 2) without the closing point: counterclockwise outline, clockwise holes."""
    turned = shapely.geometry.polygon.orient(polygon)
    return tuple(np.array(ring.coords)[:-1] for ring in (turned.exterior, *turned.interiors))


def join_loops(loops: list[NDArray]) -> shapely.Polygon:
    """Return the one polygon that closed loops (n, 2) bound, whatever their order and sense.

    Raises:
        JawFileError: The loops bound no area or several areas, cross themselves or each other.
    """
    polygons = [shapely.Polygon(loop) for loop in loops]
    for number, polygon in enumerate(polygons):
        if not polygon.is_valid:
            reason = shapely.is_valid_reason(polygon)
            raise JawFileError(f"loop {number} of the section touches or crosses itself: {reason} m")
    polygons.sort(key=lambda polygon: -polygon.area)
    outer = polygons[0]
    for number, hole in enumerate(polygons[1:], start=1):
        if not outer.covers(hole):
            raise JawFileError(
                f"the section has {len(polygons)} loops, and number {number} by size is not inside the largest: "
                "expected one body with its holes"
            )
    whole = shapely.Polygon(outer.exterior, [hole.exterior for hole in polygons[1:]])
    if not whole.is_valid:
        reason = shapely.is_valid_reason(whole)
        raise JawFileError(f"holes of the section touch each other or the outline: {reason} m")
    return whole


class SectionFile(NamedTuple):
    """A section file: its loops (n, 2) [m], the width [m] if it names one, and the layers of what is no prism."""

    loops: list[NDArray]
    width: float | None
    layers: tuple[Layer, ...]


def read_section_file(path: Path) -> SectionFile:
    """Read a section file.

    It is JSON: `unit` ("m", "mm", "inch"), `loops`, a list of lists of [x, z], and perhaps `width` or `width_mm`, and
    `layers`, each with `y`, from and to, and `loops`.

    Raises:
        JawFileError: The file is missing, too large, or not of that form.
    """
    if not path.is_file():
        raise JawFileError(f"there is no section file {path.name}; the path is relative to the jaw file")
    try:
        content = parse_json(read_text(path, _LARGEST_FILE))
        unit = UNITS[content["unit"]]
        loops = [np.array(loop, float) * unit for loop in content["loops"]]
        width = content.get("width", content["width_mm"] * 1e-3 / unit if "width_mm" in content else None)
        width = None if width is None else float(width) * unit
    except (KeyError, TypeError, ValueError, AttributeError, RecursionError) as error:
        raise JawFileError(
            f"{path.name}: expected JSON with unit ({', '.join(UNITS)}) and loops, lists of [x, z] "
            f"({type(error).__name__}: {error})"
        ) from error
    check_loops(loops, path.name)
    return SectionFile(loops, width, _build_layers(content.get("layers", ()), unit, path.name))


def _build_layers(entries: Iterable[Any], unit: float, name: str) -> tuple[Layer, ...]:
    """Return the layers of a section file; raises JawFileError where an entry has another form."""
    layers = []
    try:
        for entry in entries:
            loops = [np.array(loop, float) * unit for loop in entry["loops"]]
            check_loops(loops, name)
            low, high = (float(value) * unit for value in entry["y"])
            # what lies within an odd number of loops
            area = reduce(shapely.symmetric_difference, map(shapely.Polygon, loops))
            layers.append(Layer(low=low, high=high, area=area))
    except (KeyError, TypeError, ValueError, shapely.errors.GEOSException) as error:
        raise JawFileError(f"{name}: layers: expected y: [from, to] and loops ({error})") from error
    ends = np.array([(layer.low, layer.high) for layer in layers]).reshape(-1, 2)
    if not (np.diff(ends, axis=1) > 0.0).all() or not np.allclose(ends[1:, 0], ends[:-1, 1], atol=1e-9):
        raise JawFileError(f"{name}: layers: expected one upon another, lowest y first")
    return tuple(layers)


def check_loops(loops: list[NDArray], name: str) -> None:
    """Refuse loops that are no lists of points.

    Raises:
        JawFileError: None, of another shape, not finite, or too many points.
    """
    for number, loop in enumerate(loops):
        if loop.ndim != 2 or loop.shape[1:] != (2,) or len(loop) < 3 or not np.isfinite(loop).all():
            raise JawFileError(f"{name}: loops[{number}] has shape {loop.shape}, expected (n, 2), finite, n >= 3")
    if not loops or sum(map(len, loops)) > _MOST_VERTICES:
        raise JawFileError(
            f"{name}: {len(loops)} loops, {sum(map(len, loops))} points; expected 1 to {_MOST_VERTICES} points"
        )


# A point this close to the line [m] is on it; a face that leaves its plane by no more is one.
_ON_FACE = 1e-4
# Spacing of the places [m] at which a curved face is read.
_FACE_SPACING = 0.1e-3
# Where a face falls away towards the tip more steeply than this [-] it has ended.
_STEEPEST = 1.0


@dataclass(frozen=True, kw_only=True, eq=False)
class FaceLine:
    """The undeformed inner face as x over z, the same all along y.

    Attributes:
        heights: z (n,) [m], rising.
        x: at the heights (n,) [m], linear in between.
        plane: x [m] of the plane from which an object's depth is counted; that of a flat face.
        is_flat: True if it is a plane x = const.
    """

    heights: NDArray
    x: NDArray
    plane: float
    is_flat: bool

    @classmethod
    def flat(cls, x: float) -> FaceLine:
        """Return the plane x [m]."""
        return cls(heights=np.array([-10.0, 10.0]), x=np.full(2, float(x)), plane=float(x), is_flat=True)

    def read(self, z: float | NDArray) -> float | NDArray:
        """Return x [m] at heights z [m]."""
        return np.interp(z, self.heights, self.x)

    def holds(self, points: NDArray, tolerance: float = _ON_FACE) -> NDArray:
        """Return which of points (n, 3) [m] are on the face within a tolerance [m], (n,) bool."""
        z = points[:, 2]
        within = (z >= self.heights[0] - _ON_FACE) & (z <= self.heights[-1] + _ON_FACE)
        return within & (np.abs(points[:, 0] - self.read(z)) < tolerance)


@lru_cache(maxsize=16)  # of the fingers at hand, each loaded once for either side
def find_face(section: Section, face_x: float) -> FaceLine:
    """Return the inner face of a section: the plane x = face_x [m] where most of it is on that, else what is in front.

    It begins at the clamp and ends where it falls away towards the tip.
    """
    low = max(section.rings[0][:, 1].min(), float(section.clamp_height(face_x)))
    z = np.arange(low, section.length - 0.5 * _FACE_SPACING, _FACE_SPACING)
    x = find_reach(section.polygon, z)
    near = np.abs(x - face_x) < _ON_FACE
    if near.mean() > 0.5 and x[: int(0.8 * len(x))].max() < face_x + _ON_FACE:
        return FaceLine.flat(face_x)
    # from the middle on upwards, where it stays in front
    upper = np.flatnonzero((np.diff(x) < -_STEEPEST * _FACE_SPACING) & (z[:-1] > 0.5 * (low + section.length)))
    end = len(z)
    while len(upper) and upper[-1] >= end - 2:
        end, upper = int(upper[-1]) + 1, upper[:-1]
    return FaceLine(heights=z[:end], x=x[:end], plane=float(face_x), is_flat=False)
