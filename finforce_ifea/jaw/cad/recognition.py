"""Recognition of a fin-ray finger in a section: its frame, cells, bands, ribs, bolt holes and clamp."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from itertools import combinations

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely import affinity

from finforce_ifea.errors import JawFileError
from finforce_ifea.jaw.section import Section, cut_below, find_reach, order_rings

# A hole is a bolt's when its area is this share of the circle's with its outline: a round one, or one that is the same
# after half a turn, as the seat of a nut or a slot; cells narrow towards the tip. Square seats and long slots are told
# from cells, whose walls are springs, by walls thicker than this share of their size.
_ROUND, _ROUND_POINTS = 0.955, 8
_COMPACT, _SYMMETRIC, _ALONE = 0.8, 0.98, 0.35
# A slot whose roundness is less is over six times as long as wide: nobody moves a bolt so far.
_LONG_SLOT = 0.4
# Points closer to the line between their neighbours than this [m] say nothing.
_CHORD = 4e-6
# Spacing of the places [m] where walls are measured.
_SPACING = 3e-4
# A side is straight where it leaves its line by less than this share of its length.
_STRAIGHT = 4e-3
# Gaps between teeth [m] are narrower than twice this.
_TEETH = 3e-3
# The section narrows towards the tip, to less than this share of its width at the base.
_NARROWER = 0.75
# A bolt holds about so many of its radii above its middle, and around it. Two of these washers fit side by side between
# the bands, and bolts of one base are alike: a hole with a larger share of that distance, or so many times as large as
# another one, is a window.
_GRIP, _WASHER, _LARGEST, _UNLIKE = 3.0, 2.0, 0.125, 2.0
# So is what lies below all cells, where it is so many times as far from the outline as they are.
_APART = 2.0
# A slot in a band.
_OBLONG = 0.75  # [-], least fraction of the rectangle around it
_NARROW = 0.5  # [-], largest width over that of the cell beside it
_ALONG = 0.15  # [-], largest change of its distance from the outline over its length
# Least cosine between a cell's side and the face of the band beyond it.
_FACES = 0.7
_NEIGHBOURS, _LONGER = 3e-3, 1.4
# Cells that see each other through so many times the thickness of ribs do so where several ribs end side by side.
_MERGED = 2.0
_FEWEST, _FLAT = 5, 1e-4
_CHORDS = 24  # points through whose pairs lines are tried
_SIDE = 5e-5  # [m], largest distance of points on a line
# Cosines to the base that differ by less are alike.
_EQUAL = 0.02
_HELD = 0.5  # [-], least span of the clamp over the distance between the bands
_SPANNED = 0.7  # [-], the same of the edge of a tilted base
_TILTED = 0.02  # [-], least slope of a tilted base
# Heights of clamps from here on [m] are given in half millimetres.
_THIN = 2e-3
# Share of the length up to which there may be a base.
_LOW = 0.35


@dataclass(frozen=True, kw_only=True, eq=False)
class Wall:
    """A band or a rib.

    Attributes:
        line: its centre line (n, 2), x and z [m], base to tip, or inner to outer band.
        thickness: across it (n,) [m].
    """

    line: NDArray
    thickness: NDArray

    @property
    def usual(self) -> float:
        """The median thickness [m]."""
        return float(np.median(self.thickness))

    def moved(self, move: NDArray) -> Wall:
        """Return the wall elsewhere, by x and z (2,) [m]."""
        return Wall(line=self.line + move, thickness=self.thickness)


@dataclass(frozen=True, kw_only=True, eq=False)
class RecognizedRib:
    """A rib between two neighbouring cells.

    Attributes:
        wall: its centre line and thickness.
        inner: where its centre line meets that of the inner band (2,) [m].
        outer: where it meets that of the outer band (2,) [m].
    """

    wall: Wall
    inner: NDArray
    outer: NDArray

    def moved(self, move: NDArray) -> RecognizedRib:
        """Return the rib elsewhere, by x and z (2,) [m]."""
        return RecognizedRib(wall=self.wall.moved(move), inner=self.inner + move, outer=self.outer + move)


@dataclass(frozen=True, kw_only=True, eq=False)
class RecognizedFinger(Section):
    """A section in the jaw frame, its lowest point at z = 0, and its parts.

    Attributes:
        bolts: bolt holes (b, 3): x, z, radius [m].
        inner: the band that touches objects.
        outer: the other one.
        ribs: base to tip.
        face_x: plane of the inner face, x [m].
        face_deviation: largest distance of the inner face from its plane [m].
        frame: of the jaw in the section that was read: a rotation, perhaps mirrored, and a shift (2, 3) [m].
        notes: findings and guesses, a line each.
    """

    bolts: NDArray
    inner: Wall
    outer: Wall
    ribs: list[RecognizedRib]
    face_x: float
    face_deviation: float
    frame: NDArray
    notes: list[str] = field(default_factory=list)

    def moved(self, shift: float) -> RecognizedFinger:
        """Return the finger farther along x [m]."""
        move = np.array([shift, 0.0])
        return replace(
            self,
            rings=tuple(ring + move for ring in self.rings),
            width=self.width - float(self.taper @ move),
            bolts=self.bolts + [shift, 0.0, 0.0],
            inner=self.inner.moved(move),
            outer=self.outer.moved(move),
            ribs=[rib.moved(move) for rib in self.ribs],
            clamped_z=self.clamped_z - self.clamp_slope * shift,
            clamped_circles=self.clamped_circles + [shift, 0.0, 0.0],
            face_x=self.face_x + shift,
            frame=self.frame + [[0.0, 0.0, shift], [0.0, 0.0, 0.0]],
        )


@dataclass(frozen=True, kw_only=True)
class Overrides:
    """Values that a user states in place of the guesses.

    Attributes:
        name: of the finger; empty for that of the file.
        unit: of the file; None to guess it; of a photograph its scale.
        body: number of the body among several, from 1.
        width: along y [m]; needed for drawings and photographs.
        solid: take a closed solid as it is, as layers along its width, whatever its shape.
        flip: True if the wider end is the tip, where both ends are about as wide; None: not stated.
        other_face: the other side is the inner face.
        clamp_z: height of the clamp [m].
        face_x: x of the inner face [m].
    """

    name: str = ""
    unit: str | None = None
    body: int | None = None
    width: float | None = None
    solid: bool = False
    flip: bool | None = None
    other_face: bool = False
    clamp_z: float | None = None
    face_x: float | None = None


def recognize(
    polygon: shapely.Polygon,
    width: float,
    overrides: Overrides,
    taper: NDArray | None = None,
    base: shapely.Geometry | None = None,
    unlike: str = "",
) -> RecognizedFinger:
    """Find the parts of a fin-ray finger in its section.

    Args:
        polygon: the section [m], anyhow turned.
        width: of the finger [m], where its sides are no parallel planes that at the origin of the section.
        overrides: values stated by the user.
        taper: (2,) [-], change of the width along the section's axes; None for none.
        base: where the body is no prism of this section, which the clamp has to hold; None for nowhere.
        unlike: kind of the part there, unless it is wider and thus clamped as far up as that.

    Raises:
        JawFileError: The section shows no fin-ray finger; the message says what it shows and what to do.
    """
    notes: list[str] = []
    turned, frame = _turn_upright(polygon, overrides, notes)
    bolts, cells = _split_holes(turned)
    bolts, cells = _fit_bolts(bolts), _drop_windows(turned, cells, notes)
    walls, ribs = _measure_walls(turned, cells)
    slope, edge = _find_floor(turned, walls)
    clamped_z, circles = _propose_clamp(cells, bolts, walls, (slope, edge), overrides, notes)
    if base is not None:
        heights = (shapely.get_coordinates(base) @ frame[:, :2].T + frame[:, 2]) @ [-slope, 1.0]
        floor = min(float((cell @ [-slope, 1.0]).min()) for cell in cells)
        clamped_z = _raise_clamp(clamped_z, heights, (floor, turned.bounds[3]), unlike, notes)
    face_x, deviation = _measure_face(turned, cells, clamped_z, slope, notes)
    taper = np.zeros(2) if taper is None else frame[:, :2] @ taper
    finger = RecognizedFinger(
        rings=order_rings(turned),
        width=width - float(taper @ frame[:, 2]),
        taper=taper,
        bolts=bolts,
        inner=walls[0],
        outer=walls[1],
        ribs=ribs,
        clamped_z=clamped_z,
        clamp_slope=slope,
        clamped_circles=circles,
        face_x=face_x,
        face_deviation=deviation,
        frame=frame,
        notes=notes,
    )
    finger = finger.moved(_choose_origin(finger, overrides))
    notes.append(f"{len(cells)} cells, {_describe_walls(finger)}")
    return finger


def _describe_walls(finger: RecognizedFinger) -> str:
    """Say how thick ribs and the free parts of bands are, and how wide bolt holes."""
    bands = (finger.inner, finger.outer)
    free = [band.thickness[band.line[:, 1] > finger.clamp_height(band.line[:, 0])] for band in bands]
    return (
        f"{len(finger.ribs)} ribs of {say_range([rib.wall.usual for rib in finger.ribs])} mm, inner band "
        f"{say_range(free[0])} mm, outer band {say_range(free[1])} mm; {len(finger.bolts)} bolt holes"
        + (f" of {say_range(2.0 * finger.bolts[:, 2])} mm" if len(finger.bolts) else "")
    )


def _raise_clamp(clamped_z: float, base: NDArray, ends: tuple[float, float], unlike: str, notes: list[str]) -> float:
    """Return the height of a clamp [m] that holds a base, given by heights (n,) [m].

    Args:
        clamped_z: height of the clamp without it [m].
        base: heights (n,) [m] of what has to be held.
        ends: of the finger [m]: the lowest point of its cells, and its length.
        unlike: kind of the base, if no wider than the blade.
        notes: findings, a line each.

    Raises:
        JawFileError: No clamp holds that, as it is far up; or it is unlike the blade, and no wider, beside its cells.
    """
    floor, length = ends
    top = float(base.max())
    if top <= clamped_z + _SIDE:
        return max(top, clamped_z)
    if unlike and top > floor + _SIDE:
        raise JawFileError(unlike)
    if top > _LOW * length:
        raise JawFileError(
            f"it is wider than its blade up to z = {1e3 * top:.3g} of {1e3 * length:.3g} mm: more than a base; export "
            "the blade alone, or use a volume mesh (`mesh:` in the jaw file)"
        )
    what = "its sections differ" if unlike else "it is wider than the blade"
    notes.append(f"clamped up to z = {1e3 * top:.4g} mm, as far as {what}")
    return top


def _measure_stance(bands: tuple[Wall, Wall]) -> float:
    """Return how far apart bands start, along x [m]."""
    feet = [float(band.line[band.line[:, 1].argmin(), 0]) for band in bands]
    return abs(feet[0] - feet[1])


def _find_floor(polygon: shapely.Polygon, bands: tuple[Wall, Wall]) -> tuple[float, float]:
    """Return the edge that is the base of a finger: its rise with x [-], and its height at x = 0 [m].

    That is (0, 0), the lowest point, where no edge reaches from one band to the other.
    """
    start, along = _find_base(polygon, np.array([0.0, 1.0]))
    if abs(along[0]) < _SPANNED * _measure_stance(bands):
        return 0.0, 0.0
    slope = float(along[1] / along[0])
    slope = slope if abs(slope) > _TILTED else 0.0
    return slope, float(start[1] - slope * start[0])


def say_range(values) -> str:
    """Return the middle of some lengths [m] in millimetres, with their range where they differ."""
    low, middle, high = 1e3 * np.percentile(values, [5, 50, 95]) if len(values) else (np.nan,) * 3
    return f"{middle:.2f}" if high - low < 0.15 * middle else f"{middle:.2f} ({low:.2f} to {high:.2f})"


def _split_holes(polygon: shapely.Polygon) -> tuple[list[NDArray], list[NDArray]]:
    """Return the holes (n, 2) of a section: the round ones, and the others, which are cells."""
    kinds: dict[bool, list[NDArray]] = {True: [], False: []}
    for ring in polygon.interiors:
        hole = np.array(ring.coords)[:-1]
        kinds[_is_round(hole, polygon)].append(hole)
    return kinds[True], kinds[False]


def count_cells(polygon: shapely.Polygon) -> int:
    """Return how many holes a section has that are no bolts': cells between ribs, if there are some."""
    return len(_split_holes(polygon)[1])


def _is_round(hole: NDArray, polygon: shapely.Polygon) -> bool:
    """Return True if a hole of a section is a bolt's: a circle of some corners, the seat of a nut, a slot."""
    shape = shapely.Polygon(hole)
    roundness = 4.0 * np.pi * shape.area / shape.length**2
    if roundness > _ROUND:
        return len(hole) >= _ROUND_POINTS
    turned = affinity.rotate(shape, 180.0, origin=shape.centroid)
    if shape.intersection(turned).area < _SYMMETRIC * shape.area:
        return False
    is_alone = shape.buffer(_ALONE * np.sqrt(shape.area)).difference(shape).within(polygon)
    return roundness > _COMPACT or (roundness > _LONG_SLOT and is_alone)


def _fit_bolts(holes: list[NDArray]) -> NDArray:
    """Return the middles and radii (b, 3) [m] of bolt holes, of a slot across it, lowest first."""
    rows = []
    for hole in holes:
        shape = shapely.Polygon(hole)
        across = shape.exterior.distance(shape.centroid) / np.cos(np.pi / len(hole))
        rows.append((*shape.centroid.coords[0], min(float(np.sqrt(shape.area / np.pi)), across)))
    return np.array(sorted(rows, key=lambda row: row[1])).reshape(-1, 3)


def _drop_windows(polygon: shapely.Polygon, cells: list[NDArray], notes: list[str]) -> list[NDArray]:
    """Return the cells, lowest first, without windows in the base, whose walls are no bands, and slots in bands.

    And without holes around which no rib could be measured, as the corners that slanted ribs leave.
    """
    cells = sorted(cells, key=lambda cell: shapely.Polygon(cell).centroid.y)
    shapes = [shapely.Polygon(cell) for cell in cells]
    is_corner = [shape.length < 2.0 * _FEWEST * _SPACING for shape in shapes]
    cells, shapes = ([item for item, out in zip(items, is_corner, strict=True) if not out] for items in (cells, shapes))
    walls = [shape.distance(polygon.exterior) for shape in shapes]
    is_window = [
        wall > max(_APART * np.median(walls), _ALONE * np.sqrt(shape.area))
        for wall, shape in zip(walls, shapes, strict=True)
    ]
    count = is_window.index(False)
    kept = [not _is_slot(shape, shapes, polygon.exterior) for shape in shapes[count:]]
    left_out = ((count, "window", "in its base"), (kept.count(False), "slot", "in its bands"))
    for number, name, where in (
        *left_out,
        (sum(is_corner), "hole", f"less than {2e3 * _FEWEST * _SPACING:g} mm around"),
    ):
        if number:
            notes.append(f"{number} {name}{'s' * (number > 1)} {where}: no cell")
    return [cell for cell, is_kept in zip(cells[count:], kept, strict=True) if is_kept]


def _is_slot(shape: shapely.Polygon, cells: list[shapely.Polygon], outline: shapely.LinearRing) -> bool:
    """Return True if a hole is an oblong along the outline, beside a much wider cell or the end of a rib."""
    left, _, right, _ = shapely.MultiPolygon(cells).bounds
    _, low, _, high = shape.bounds
    levels = [shapely.LineString([(left, z), (right, z)]) for z in low + np.array([0.25, 0.5, 0.75]) * (high - low)]
    widest = shapely.length(shapely.intersection(np.array(cells)[:, None], levels)).max()
    around = shape.minimum_rotated_rectangle
    is_oblong = shape.area > _OBLONG * around.area
    sides = shapely.get_coordinates(around)
    longest = max(zip(sides[:2], sides[1:3], strict=True), key=lambda ends: np.hypot(*(ends[1] - ends[0])))
    line = shapely.LineString(longest)
    wall = [outline.distance(line.interpolate(share, normalized=True)) for share in (0.1, 0.5, 0.9)]
    is_along = np.ptp(wall) < _ALONG * line.length
    return bool(is_oblong and is_along and shape.intersection(levels[1]).length < _NARROW * widest)


def _turn_upright(polygon: shapely.Polygon, overrides: Overrides, notes: list[str]) -> tuple[shapely.Polygon, NDArray]:
    """Return the section with its inner face upright at the largest x, and its lowest point at z = 0.

    And how it got there: a rotation, perhaps mirrored, and a shift (2, 3).
    """
    _, cells = _split_holes(polygon)
    middles = np.array([shapely.Polygon(cell).centroid.coords[0] for cell in cells])
    direction = _find_direction(polygon, middles, overrides)
    side = np.array([-direction[1], direction[0]])
    straight = _STRAIGHT * np.ptp(np.concatenate(cells) @ direction)
    outlines = (polygon, shapely.Polygon(polygon.exterior).buffer(_TEETH).buffer(-_TEETH))
    fits = [_fit_sides(outline, np.concatenate(cells), middles, direction) for outline in outlines]
    # a side with teeth is as straight as their tips
    faces = [filled if filled[2] < straight <= plain[2] else plain for plain, filled in zip(*fits, strict=True)]
    chosen = min(faces, key=lambda face: face[2])
    if all(face[2] < straight for face in faces):
        # both are straight: the inner face stands at right angles on the base
        _, base = _find_base(polygon, direction)
        lean = [abs(face[1] @ base) / np.linalg.norm(base) for face in faces]
        chosen = faces[int(np.argmin(lean))]
        if abs(lean[0] - lean[1]) < _EQUAL:
            # the face from which ribs fall is many times stiffer next to the base, where the other could not hold much
            chosen = faces[0] if _measure_rise(cells, direction, side) > 0.0 else faces[1]
            notes.append("both sides meet the base alike: that from which ribs fall is taken as inner (--other-face)")
    if overrides.other_face:
        chosen = faces[1] if chosen is faces[0] else faces[0]
    sign, up, deviation = chosen
    outward = sign * np.array([-up[1], up[0]])
    notes.append(
        f"inner face along ({up[0]:.3f}, {up[1]:.3f}) of the section, straight within {1e3 * deviation:.2f} mm, tip at "
        "its far end (--flip, --other-face)"
    )
    turned = affinity.affine_transform(polygon, [outward[0], outward[1], up[0], up[1], 0.0, 0.0])
    shift = np.array([-turned.bounds[2], -turned.bounds[1]])
    turned = affinity.translate(turned, *shift).simplify(_CHORD)
    return turned, np.column_stack([np.stack([outward, up]), shift])


def _find_direction(polygon: shapely.Polygon, middles: NDArray, overrides: Overrides) -> NDArray:
    """Return the unit vector (2,) from base to tip along the middles (n, 2) of the cells.

    Raises:
        JawFileError: There are fewer than two cells, or which end is the tip is not sure, or stated wrongly.
    """
    if len(middles) < 2:
        raise JawFileError(
            f"its section has {len(middles)} cells between ribs and {len(polygon.interiors) - len(middles)} round "
            "holes, expected at least two cells: ribs that come from a slicer's infill are not in the file; model "
            "them, take a closed solid as it is (--solid) and calibrate its modulus, or describe it as a drawing"
        )
    along = np.linalg.svd(middles - middles.mean(axis=0), full_matrices=False)[2][0]
    # widths are those of the box around the finger: of a chain of slanted cells the middles lean
    sides = np.diff(shapely.get_coordinates(polygon.minimum_rotated_rectangle)[:3], axis=0)
    sides /= np.linalg.norm(sides, axis=1, keepdims=True)
    axis = max(sides, key=lambda side: abs(side @ along))
    axis = axis if axis @ along > 0.0 else -axis
    found = [(_measure_widths(polygon, sense * axis), sense * along) for sense in (1.0, -1.0)]
    narrow, direction = min(found, key=lambda end: end[0][1] / end[0][0])
    sizes = f"its section is {1e3 * narrow[0]:.3g} mm wide at one end and {1e3 * narrow[1]:.3g} mm at the other"
    is_sure = narrow[1] <= _NARROWER * narrow[0]
    if not is_sure and overrides.flip is None:
        raise JawFileError(
            f"{sizes}, expected a tip that is narrower than the base: no fin-ray finger, or --flip or --no-flip says "
            f"whether the wider end is the tip"
        )
    if is_sure and overrides.flip:
        raise JawFileError(f"{sizes}: --flip would hold it by its tip, expected the wider end to be the base")
    return -direction if overrides.flip else direction


def _fit_sides(
    polygon: shapely.Polygon, corners: NDArray, middles: NDArray, direction: NDArray
) -> list[tuple[float, NDArray, float]]:
    """Return for both sides of a chain of cells their sign, the line upwards (2,), and how far they leave it [m]."""
    side = np.array([-direction[1], direction[0]])
    ring = _sample_ring(np.array(polygon.exterior.coords)[:-1])
    low, high = np.sort(corners @ direction)[[0, -1]]
    along, height = ring @ direction, middles @ direction
    order = np.argsort(height)
    chain = np.interp(along, height[order], (middles @ side)[order])
    within = (along > low + 0.05 * (high - low)) & (along < high - 0.05 * (high - low))
    return [(sign, *_fit_line(ring[within & (sign * (ring @ side - chain) > 0.0)], direction)) for sign in (1.0, -1.0)]


def _measure_rise(cells: list[NDArray], direction: NDArray, side: NDArray) -> float:
    """Return by how much [m] cells lie higher along a direction on one side of their middles than on the other."""
    rises = []
    for cell in cells:
        ring = _sample_ring(cell)
        is_there = (ring - ring.mean(axis=0)) @ side > 0.0
        rises.append(np.mean(ring[is_there] @ direction) - np.mean(ring[~is_there] @ direction))
    return float(np.median(rises))


def _measure_widths(polygon: shapely.Polygon, direction: NDArray) -> tuple[float, float]:
    """Return how wide the outline is near its ends, at the lower and the upper end of a direction [m]."""
    side = np.array([-direction[1], direction[0]])
    ring = _sample_ring(np.array(polygon.exterior.coords)[:-1])
    share = ring @ direction
    share = (share - share.min()) / np.ptp(share)
    across = ring @ side
    return tuple(float(np.ptp(across[(share >= low) & (share <= high)])) for low, high in ((0.05, 0.3), (0.85, 0.95)))


def _sample_ring(ring: NDArray) -> NDArray:
    """Return points (n, 2) along a closed ring."""
    line = shapely.LinearRing(ring)
    at = np.linspace(0.0, line.length, max(int(line.length / _SPACING), 8), endpoint=False)
    return shapely.get_coordinates(shapely.line_interpolate_point(line, at))


def _fit_line(points: NDArray, direction: NDArray) -> tuple[NDArray, float]:
    """Return the unit vector of the line through points (n, 2), towards a direction, and how far they leave it [m].

    Of a straight side what lies off the line is left out, as a step of the base; of a curved one the largest deviations
    are: knobs and lugs are no bend.
    """
    if len(points) < _FEWEST:
        return direction, np.inf
    straight = _find_straight(points)
    kept = points[straight]
    for _ in range(4):
        middle = kept.mean(axis=0)
        up = np.linalg.svd(kept - middle, full_matrices=False)[2][0]
        off = np.abs((points - middle) @ [-up[1], up[0]])
        limit = max(2.5 * float(np.median(off)), 1e-5)
        kept = points[off <= limit]
        if len(kept) < _FEWEST:
            return direction, np.inf
    up = up if up @ direction > 0.0 else -up
    bent = off if straight.all() else off[off <= limit]
    return up, float(np.sqrt(np.mean(bent**2)))


def _find_straight(points: NDArray) -> NDArray:
    """Return which of points (n, 2) are on the line that most of them are on, all where that is less than half."""
    ends = points[np.linspace(0, len(points) - 1, min(_CHORDS, len(points))).astype(int)]
    best = np.ones(len(points), bool)
    most = 0.5 * len(points)
    for start, end in combinations(ends, 2):
        way = end - start
        near = np.abs((points - start) @ [-way[1], way[0]]) < _SIDE * np.linalg.norm(way)
        if near.sum() > most and np.linalg.norm(way) > 0.0:
            best, most = near, near.sum()
    return best


def _find_base(polygon: shapely.Polygon, direction: NDArray) -> tuple[NDArray, NDArray]:
    """Return the start of the longest straight edge at the base (2,) [m], and the way to its end.

    One that rises by more than 45 degrees is a side, wherever there is another.
    """
    ring = np.array(polygon.exterior.simplify(2e-5).coords)
    begin, end = ring[:-1], ring[1:]
    height = 0.5 * (begin + end) @ direction
    low = height < height.min() + 0.25 * np.ptp(height)
    along = end - begin
    across, rise = np.abs(along @ [-direction[1], direction[0]]), np.abs(along @ direction)
    longest = max(np.flatnonzero(low), key=lambda edge: (across[edge] > rise[edge], across[edge]))
    return begin[longest], along[longest]


def _choose_origin(finger: RecognizedFinger, overrides: Overrides) -> float:
    """Return by how much [m] a finger is moved along x: what the clamp holds is half on either side of x = 0.

    Raises:
        JawFileError: The clamp does not reach from one band to the other: on one leg it is many times too soft.
    """
    polygon = finger.polygon
    around = [shapely.Point(x, z).buffer(radius) for x, z, radius in finger.clamped_circles]
    held = polygon.intersection(shapely.union_all([cut_below(polygon, finger.clamped_z, finger.clamp_slope), *around]))
    apart = _measure_stance((finger.inner, finger.outer))
    reach = 0.0 if held.is_empty else held.bounds[2] - held.bounds[0]
    if reach < _HELD * apart:
        raise JawFileError(
            f"what lies below z = {1e3 * finger.clamped_z:.3g} mm is {1e3 * reach:.3g} mm wide, and its bands start "
            f"{1e3 * apart:.3g} mm apart: one of them would not be held; state the clamp's height (--clamp), or export "
            "the finger with its base across the inner face"
        )
    if overrides.face_x is not None:
        return overrides.face_x - finger.face_x
    base = held.union(cut_below(polygon, 0.02 * polygon.bounds[3]))
    return -0.5 * (base.bounds[0] + base.bounds[2])


def _propose_clamp(
    cells: list[NDArray],
    bolts: NDArray,
    bands: tuple[Wall, Wall],
    base: tuple[float, float],
    overrides: Overrides,
    notes: list[str],
) -> tuple[float, NDArray]:
    """Return the height at x = 0 below which everything is clamped, and circles about bolts farther up (c, 3) [m].

    Heights are counted along z from a line that is as tilted as the base (rise with x, height at x = 0). A bolt belongs
    to the base unless a whole cell lies below it; a window and a hole beyond all cells are none: the tip is free.
    """
    slope, floor = base
    lows, tops = (np.array([pick(cell[:, 1] - slope * cell[:, 0]) for cell in cells]) for pick in (np.min, np.max))
    height_of = bolts[:, 1] - slope * bolts[:, 0]
    smallest = bolts[height_of <= tops.min(), 2].min(initial=np.inf)
    largest = min(_LARGEST * _measure_stance(bands), _UNLIKE * smallest)
    is_bolt = (bolts[:, 2] < largest) & (height_of < tops.max())
    is_base = is_bolt & (height_of <= tops.min())
    circles = bolts[is_bolt & ~is_base] * [1.0, 1.0, _WASHER]
    off = f", along its base, {np.degrees(np.arctan(slope)):.0f} degrees off the face's normal" if slope else ""
    if overrides.clamp_z is not None:
        at = " at the inner face" if slope else ""
        notes.append(f"clamped below z = {1e3 * overrides.clamp_z:.4g} mm{at}{off}, as given")
        return overrides.clamp_z, circles[circles[:, 1] > overrides.clamp_z]
    if is_base.any():
        height = float((height_of + _GRIP * bolts[:, 2])[is_base].max())
        reason = f"a radius of its {is_base.sum()} base bolts above their heads"
    else:
        least = 0.5 * (floor + float(lows.min()))  # of a base as thin as a band half of it
        height = max(float(lows.min()) - bands[0].usual * np.hypot(1.0, slope), least)
        reason = "the solid base below its first cell"
    height = height if slope or floor > _FLAT or height < _THIN else round(2e3 * height) / 2e3
    around = "".join(f", and around the bolt at z = {1e3 * z:.4g} mm" for _, z, _ in circles)
    at = " at x = 0" if slope else ""
    notes.append(f"clamped below z = {1e3 * height:.4g} mm{at}{off}, {reason}{around} (--clamp)")
    return height, circles


def _measure_face(
    polygon: shapely.Polygon, cells: list[NDArray], clamped_z: float, slope: float, notes: list[str]
) -> tuple[float, float]:
    """Return the plane x [m] of the inner face and how far it leaves that, between the clamp and the last cell [m]."""
    low = max(clamped_z + slope * polygon.bounds[2], min(float(cell[:, 1].min()) for cell in cells))
    high = max(float(cell[:, 1].max()) for cell in cells)
    reach = find_reach(polygon, np.linspace(low, high, 80)[1:-1])
    face = float(np.median(reach))
    deviation = float(np.abs(reach - face).max())
    if deviation <= _FLAT:
        return face, deviation
    notes.append(f"inner face curved: it leaves its plane by {1e3 * deviation:.2g} mm")
    return float(reach.max()), deviation  # the place that is farthest in front


def _measure_walls(polygon: shapely.Polygon, cells: list[NDArray]) -> tuple[tuple[Wall, Wall], list[RecognizedRib]]:
    """Return inner band, outer band and ribs: what lies between the cells and around them.

    From places along the sides of each cell a ray goes straight into the material. What it meets says which wall it
    went through, half its way is a point of the wall's centre line, all of it the thickness.
    """
    middles = np.array([shapely.Polygon(cell).centroid.coords[0] for cell in cells])
    bands: dict[str, list] = {"inner": [], "outer": []}
    between: dict[tuple[int, int], list] = {}
    for number, place, normal, far, other in _shoot(polygon, cells):
        found = (*(place + 0.5 * far * normal), far)
        if other >= 0:
            between.setdefault((min(number, other), max(number, other)), []).append(found)
            continue
        x, z = place + far * normal
        is_inner = x > np.interp(z, middles[:, 1], middles[:, 0])
        if is_inner and normal[0] > _FACES:
            bands["inner"].append(found)
        elif not is_inner and normal[0] < 0.5 * _FACES and normal[1] > -_FACES:
            bands["outer"].append(found)
    inner, outer = (_string_up(np.array(bands[name]).reshape(-1, 3), name) for name in ("inner", "outer"))
    walls = {pair: np.array(found) for pair, found in between.items() if len(found) >= _FEWEST}
    return (inner, outer), [_string_rib(walls[pair], inner, outer) for pair in _find_ribs(walls, polygon, cells)]


def _find_ribs(
    walls: dict[tuple[int, int], NDArray], polygon: shapely.Polygon, cells: list[NDArray]
) -> list[tuple[int, int]]:
    """Return the pairs of cells between which there are ribs, base to tip: those that join all cells without a round.

    Args:
        walls: between pairs of cells, points of their centre lines with thickness (n, 3) [m].
        polygon: the section, whose picture numbers its holes.
        cells: lowest first.

    Raises:
        JawFileError: No rib joins a cell to the others, or ribs cross.
    """
    number_of = {shapely.Polygon(hole).bounds: number for number, hole in enumerate(polygon.interiors, start=1)}
    numbers = [number_of[shapely.Polygon(cell).bounds] for cell in cells]
    advice = "leave out what crosses, or take a closed solid as it is (--solid)"
    group, ribs = np.arange(len(cells)), []
    thickness = {pair: float(np.median(found[:, 2])) for pair, found in walls.items()}
    for one, two in sorted(walls, key=thickness.__getitem__):
        if group[one] != group[two]:
            group[group == group[two]] = group[one]
            ribs.append((one, two))
        elif thickness[one, two] < _MERGED * np.median([thickness[pair] for pair in ribs]):
            raise JawFileError(f"ribs cross next to its cells {numbers[one]} and {numbers[two]}: {advice}")
    if len(ribs) < len(cells) - 1:
        lost = int(np.flatnonzero(group != group[0])[0])
        raise JawFileError(f"between its cell {numbers[lost]} and the others there is no rib to be measured: {advice}")
    return sorted(ribs, key=sum)


def _shoot(polygon: shapely.Polygon, cells: list[NDArray]) -> Iterator[tuple[int, NDArray, NDArray, float, int]]:
    """Yield cell, place (2,), direction (2,), way [m] and the other cell that is met, or -1, all along the cells."""
    rings = order_rings(polygon)
    begin, along = np.concatenate(rings), np.concatenate([np.roll(ring, -1, axis=0) - ring for ring in rings])
    numbers = {shapely.Polygon(cell).bounds: number for number, cell in enumerate(cells)}
    cell_of = np.concatenate([np.full(len(ring), numbers.get(shapely.Polygon(ring).bounds, -1)) for ring in rings])
    for number, cell in enumerate(cells):
        for place, normal in zip(*_walk_sides(cell), strict=True):
            far, side = _cast(place, normal, begin, along)
            if np.isfinite(far) and cell_of[side] != number:
                yield number, place, normal, far, int(cell_of[side])


def _walk_sides(cell: NDArray) -> tuple[NDArray, NDArray]:
    """Return places (p, 2) along the sides of a cell and the directions (p, 2) from there into the material."""
    ring = shapely.get_coordinates(shapely.geometry.polygon.orient(shapely.Polygon(cell), -1.0).exterior)
    way = np.diff(ring, axis=0)
    size = np.hypot(*way.T)
    count = np.where(size > 1e-9, np.maximum((size / _SPACING).astype(int), 1), 0)
    side = np.repeat(np.arange(len(way)), count)
    share = (np.arange(len(side)) - np.repeat(np.cumsum(count) - count, count) + 0.5) / count[side]
    normals = np.stack([-way[side, 1], way[side, 0]], axis=1) / size[side, None]
    return ring[side] + share[:, None] * way[side], normals


def _cast(place: NDArray, normal: NDArray, begin: NDArray, along: NDArray) -> tuple[float, int]:
    """Return how far [m] it is from a place in a direction to the first of some sides, inf for none, and its number."""
    (gap_x, gap_z), (x, z) = (begin - place).T, along.T
    with np.errstate(divide="ignore", invalid="ignore"):
        across = normal[1] * x - normal[0] * z
        far, share = (gap_z * x - gap_x * z) / across, (normal[0] * gap_z - normal[1] * gap_x) / across
    far = np.where((far > 1e-6) & (share >= 0.0) & (share <= 1.0), far, np.inf)
    return float(far.min()), int(far.argmin())


def _string_up(found: NDArray, name: str) -> Wall:
    """Return a band from points of its centre line with thickness (n, 3), base to tip.

    Raises:
        JawFileError: There are too few.
    """
    if len(found) < _FEWEST:
        raise JawFileError(f"next to its cells no {name} band could be measured")
    found = found[np.argsort(found[:, 1])]
    # rays through knobs, lugs and the ends of ribs are longer than their neighbours
    near = [found[np.abs(found[:, 1] - z) < _NEIGHBOURS, 2] for z in found[:, 1]]
    found = found[found[:, 2] <= _LONGER * np.array([np.percentile(ways, 25) for ways in near])]
    return _thin_out(found)


def _thin_out(found: NDArray) -> Wall:
    """Return a wall with the medians of points (n, 3), sorted along it, over stretches of about a millimetre."""
    arc = found[:, 1] - found[0, 1]
    number = np.floor(arc / 1e-3).astype(int)
    rows = np.array([np.median(found[number == k], axis=0) for k in np.unique(number)])
    return Wall(line=rows[:, :2], thickness=rows[:, 2])


def _string_rib(found: NDArray, inner: Wall, outer: Wall) -> RecognizedRib:
    """Return a rib from points of its centre line with thickness (n, 3)."""
    usual = np.median(found[:, 2])
    found = found[found[:, 2] < 2.0 * usual]
    middle = np.median(found[:, :2], axis=0)
    along = np.linalg.svd(found[:, :2] - found[:, :2].mean(axis=0), full_matrices=False)[2][0]
    along = along if along[0] < 0.0 else -along
    found = found[np.argsort((found[:, :2] - middle) @ along)]
    count = max(len(found) // 8, 1)
    ends = [_meet(found[:count, :2], middle, inner), _meet(found[-count:, :2], middle, outer)]
    return RecognizedRib(wall=Wall(line=found[:, :2], thickness=found[:, 2]), inner=ends[0], outer=ends[1])


def _meet(end: NDArray, middle: NDArray, band: Wall) -> NDArray:
    """Return where a rib, running on straight from its middle through its end, meets a band's centre line (2,) [m].

    A rib that ends elsewhere, as on the base, ends where it does.
    """
    tip = end.mean(axis=0)
    direction = (tip - middle) / max(np.linalg.norm(tip - middle), 1e-9)
    line = band.line
    longer = np.vstack([2.0 * line[0] - line[1], line, 2.0 * line[-1] - line[-2]])
    crossing = shapely.LineString([tip - 2e-3 * direction, tip + 15e-3 * direction]).intersection(
        shapely.LineString(longer)
    )
    places = np.array(
        [(point.x, point.y) for point in getattr(crossing, "geoms", [crossing]) if point.geom_type == "Point"]
    ).reshape(-1, 2)
    if len(places):
        return places[np.linalg.norm(places - tip, axis=1).argmin()]
    beyond = tip + 0.5 * band.usual * direction
    far = np.linalg.norm(line - beyond, axis=1)
    return line[far.argmin()] if far.min() < _NEIGHBOURS else beyond
