"""The section of a prismatic finger out of the files that people print: surfaces, STEP, DXF, SVG, JSON."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import numpy as np
import shapely
from numpy.typing import NDArray

from finforce.camera import ImageError
from finforce.files import FileError
from finforce.sandbox import SandboxError, run_limited
from finforce.surfaces import read_surface
from finforce.triangle_surface import Surface, join_surfaces, unite
from finforce_ifea.errors import JawFileError
from finforce_ifea.jaw.cad.curves import read_dxf, read_svg
from finforce_ifea.jaw.cad.layers import find_layers
from finforce_ifea.jaw.cad.photo import PHOTOS, SCALE, Photo, read_photo
from finforce_ifea.jaw.section import UNITS, Layer, SectionFile, check_loops, join_loops, read_section_file

SURFACES = (".stl", ".obj", ".ply", ".off", ".3mf", ".glb")
SUFFIXES = (*SURFACES, ".step", ".stp", ".dxf", ".svg", ".json", *PHOTOS)
_PLAUSIBLE = (0.015, 0.25)  # [m], range of a finger's largest size
_POSSIBLE = (0.005, 1.0)  # [m], the same where a unit was stated
# What encloses less than this share of the largest body is no part of a finger.
_CRUMB = 1e-4
# So many shells, as of ribs and raised letters, are looked at for whether they overlap.
_MOST_SHELLS = 40
_CRACK = 1e-5  # [m], largest distance of vertices of open edges that are merged
_MISSING = 4  # sides of a hole that counts as two missing triangles
_MOST_TRIANGLES = 2_000_000
_LARGEST_FILE = 200_000_000  # [bytes]
_UPRIGHT = 0.02  # [-], largest cosine of a normal that stands upright on the direction of extrusion
_PRISMATIC = 0.97  # [-], fraction of a prismatic surface that stands upright or lies across
# Of a tapered one the normals of walls have less than this along its direction, those of sides more; a side is plane
# within so much [m].
_ASIDE, _SIDE, _RULINGS = 0.5, 1e-4, 4
# Cuts across a surface, evenly over the width; differences as fractions of the area of the usual cut.
_CUTS = 25
_ALIKE = 0.02  # [-], largest mean difference of one section
_SEEN = 0.01  # [-], difference that is seen
_RARE = 0.2  # [-], largest fraction of the cuts that differ by that
_OTHER = 0.1  # [-], difference of another section
_ROUNDING = 1e-4  # [-], difference of the same section
_SMALL = 5e-3  # [-], largest mean area of a small hole
# Cuts of the same walls are one where these move by less than this [m] over the width.
_ALONG = 2e-6
_SHORT = 0.67  # [-], largest circle around a base over that around the blade on it
_LOCAL = 0.4  # [-], the same of what is in a base
# Ends of cut triangles are joined on a grid of this size [m].
_GRID = 2e-7
_CHORD = 2e-5


@dataclass(frozen=True, kw_only=True, eq=False)
class RawSection:
    """A finger's section as it stands in its file.

    Attributes:
        polygon: in metres, in a plane of the file's.
        width: along the extrusion [m], of a tapered finger at the section's origin; None where the file is flat.
        taper: (2,) [-], change of the width along the section's axes.
        base: where the body is no prism of this section, which the clamp has to hold; None for nowhere.
        unlike: kind of the part there, unless it is wider.
        notes: findings and guesses, a line each.
        photo: photograph that it was traced from, if any.
    """

    polygon: shapely.Polygon
    width: float | None
    notes: list[str] = field(default_factory=list)
    taper: NDArray = field(default_factory=lambda: np.zeros(2))
    base: shapely.Geometry | None = None
    unlike: str = ""
    layers: tuple[Layer, ...] = ()
    photo: Photo | None = None


class UnlikeSectionsError(JawFileError):
    """A solid has other sections than its usual one, `section` [m]."""

    def __init__(self, message: str, section: shapely.Polygon) -> None:
        super().__init__(message)
        self.section = section


def read_section(path: Path, *, unit: str | None = None, body: int | None = None, layered: bool = False) -> RawSection:
    """Read the section of a finger.

    Args:
        path: a surface (.stl and others), a solid (.step), a drawing (.dxf, .svg), a section (.json), or a photograph.
        unit: one of `UNITS`; None for the only one in which it has a finger's size; of a photograph see `SCALE`.
        body: number of the body among several, from 1.
        layered: take a solid as layers along its width, whatever its shape.

    Raises:
        JawFileError: The file cannot be read, or holds no finger; the message says what it holds and what to do.
        MissingDependencyError: An optional reader is not installed.
    """
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES:
        raise JawFileError(f"{path.name}: files of this kind are not read; expected one of {', '.join(SUFFIXES)}")
    if not path.is_file():
        raise JawFileError(f"there is no file {path}")
    if path.stat().st_size > _LARGEST_FILE:
        raise JawFileError(
            f"{path.name}: {path.stat().st_size // 1_000_000} MB, expected at most "
            f"{_LARGEST_FILE // 1_000_000} MB: export it with fewer triangles"
        )
    if unit is not None and (unit in UNITS) == (suffix in PHOTOS):
        raise JawFileError(f"{path.name}: expected --unit, or of a photograph {SCALE}")
    try:
        if suffix == ".json":
            return _take_section(read_section_file(path))
        if suffix in PHOTOS:
            photo = run_limited(read_photo, path, unit, memory=2 << 30, seconds=60)
            notes = [f"traced at {1e-3 / photo.pixel:.3g} pixels a millimetre"]
            return RawSection(polygon=join_loops(photo.loops), width=None, notes=notes, photo=photo)
        if suffix in (".dxf", ".svg"):
            loops, named = run_limited(read_dxf if suffix == ".dxf" else read_svg, path)
            check_loops(loops, path.name)
            extent = np.ptp(np.concatenate(loops), axis=0).max()
            scale, note = _choose_unit(float(extent), unit or named)
            polygon = _one_piece(_fill_lines([scale * loop for loop in loops]))
            return RawSection(polygon=polygon, width=None, notes=[note])
        notes = []
        return _cut_surface(_load_surface(path, unit, notes), body, layered, notes)
    except (JawFileError, FileError, ImageError, SandboxError) as error:
        prefix = "" if str(error).startswith(path.name) else f"{path.name}: "
        raise JawFileError(f"{prefix}{error}") from error


def _take_section(content: SectionFile) -> RawSection:
    """Return what a section file holds, its layers along the axis of x and z rather than along y."""
    notes = ["a section file"]
    if not content.layers:
        return RawSection(polygon=join_loops(content.loops), width=content.width, notes=notes)
    layers = tuple(Layer(low=-layer.high, high=-layer.low, area=layer.area) for layer in reversed(content.layers))
    return RawSection(polygon=_find_usual(layers), width=layers[-1].high - layers[0].low, notes=notes, layers=layers)


def _find_usual(layers: Sequence[Layer]) -> shapely.Polygon:
    """Return the area of the layer in one piece of which most is holes, as cells are; without holes, most solid.

    Raises:
        JawFileError: none is, or all together are not.
    """
    whole = [layer for layer in layers if layer.area.geom_type == "Polygon"]
    if not whole:
        raise JawFileError("none of its layers is in one piece, expected one finger")
    _one_piece(shapely.union_all([layer.area for layer in layers]))
    holes = [
        (layer.high - layer.low) * (shapely.Polygon(layer.area.exterior).area - layer.area.area) for layer in whole
    ]
    solid = [(layer.high - layer.low) * layer.area.area for layer in whole]
    return whole[max(range(len(whole)), key=lambda number: (holes[number], solid[number]))].area


def _choose_unit(extent: float, unit: str | None) -> tuple[float, str]:
    """Return the metres of a file's unit, and a line that says which one it is."""
    sizes = {name: extent * scale for name, scale in UNITS.items()}
    if unit is not None:
        if not _POSSIBLE[0] <= sizes[unit] <= _POSSIBLE[1]:
            raise JawFileError(
                f"is {1e3 * sizes[unit]:.4g} mm long in the unit {unit}, expected a finger of "
                f"{1e3 * _POSSIBLE[0]:g} to {1e3 * _POSSIBLE[1]:g} mm"
            )
        return UNITS[unit], f"unit: {unit}, {1e3 * sizes[unit]:.4g} mm in its largest direction"
    likely = [name for name, size in sizes.items() if _PLAUSIBLE[0] <= size <= _PLAUSIBLE[1]]
    if len(likely) != 1:
        choices = " or ".join(f"--unit {name} ({1e3 * sizes[name]:.4g} mm)" for name in likely or UNITS)
        raise JawFileError(f"its largest size is {extent:.4g} and its unit not sure, expected {choices}")
    (guess,) = likely
    size = f"the largest size is {extent:.4g}, thus {1e3 * sizes[guess]:.4g} mm"
    return UNITS[guess], f"unit: {guess}, since {size} (--unit)"


def _load_surface(path: Path, unit: str | None, notes: list[str]) -> Surface:
    """Load the triangles of a file, in metres."""
    vertices, triangles = read_surface(path)
    if not 0 < len(triangles) <= _MOST_TRIANGLES:
        raise JawFileError(
            f"{len(triangles)} triangles, expected 1 to {_MOST_TRIANGLES} of a whole {path.suffix} file: export it "
            "again, or coarser"
        )
    if not np.isfinite(vertices).all():
        raise JawFileError("has coordinates that are not finite")
    scale, note = _choose_unit(float(np.ptp(vertices[triangles], axis=(0, 1)).max()), unit)
    notes.append(note)
    return Surface(vertices=scale * vertices, triangles=triangles).merge_vertices()


def _cut_surface(mesh: Surface, body: int | None, layered: bool, notes: list[str]) -> RawSection:
    """Return the section of a closed surface across the direction in which it was extruded, or its layers."""
    mesh = _choose_body(_mend(mesh, notes), body, notes)
    uses = mesh.edges.uses
    if (uses % 2).any():  # of parts that touch along an edge four faces meet there
        raise JawFileError(
            f"its surface has {int((uses == 1).sum())} open and {int((uses > 2).sum())} doubled edges, expected a "
            "closed one: repair it in the program that it comes from, or in a slicer"
        )
    if mesh.volume < 0.0:
        mesh = mesh.turn()
        notes.append("its surface was inside out and has been turned")
    axis, share = _find_axis(mesh)
    if layered:
        return _cut_layers(mesh, axis, notes)
    cuts = _cut_often(mesh, axis)
    if share < _PRISMATIC and not cuts.is_one:
        return _try_tapered(mesh, axis, cuts.section, notes)
    letters = np.round(axis, 3).tolist()
    base, width, unlike, section = None, cuts.width, "", cuts.section
    if not cuts.is_one:
        unlike = f"is not prismatic along {letters}: {cuts.describe()}"
        if (base := cuts.find_local()) is not None:
            notes.append("its sections differ within the base, which the clamp has to hold")
            section = cuts.fill(base)
        elif (beside := cuts.find_beside()) is not None:
            width, unlike = _measure_blade(mesh, axis, beside), ""
            base = None if cuts.is_mark else beside
            what = "raised marks, which are left out" if base is None else f"a base of {1e3 * cuts.width:.4g} mm"
            notes.append(f"a blade {1e3 * width:.4g} mm wide, {'on' if base is not None else 'with'} {what}")
        else:
            raise UnlikeSectionsError(unlike, section)
    notes.append(f"prismatic along {letters} of the file, {1e3 * width:.4g} mm wide")
    if share < _PRISMATIC:
        notes.append(f"edges that are chamfered or rounded are left out: {1.0 - share:.0%} of its surface")
    if pieces := int((shapely.get_num_geometries(cuts.found) > 1).sum()):
        notes.append(f"a hole across it is left out: it parts {pieces} of {_CUTS} cuts")
    return RawSection(polygon=section, width=width, notes=notes, base=base, unlike=unlike)


def _cut_layers(mesh: Surface, axis: NDArray, notes: list[str]) -> RawSection:
    """Return the layers of a closed surface along an axis, and of its cuts in one piece the one that is most usual."""
    height = mesh.vertices @ axis
    low, high = float(height.min()), float(height.max())
    flat = np.abs(mesh.normals @ axis) > 1.0 - _UPRIGHT**2
    steps = np.unique(np.round(height[mesh.triangles[flat]].mean(axis=1), 5))
    layers = find_layers(lambda at: _cut(mesh, axis, at), (low, high), steps[(steps > low) & (steps < high)].tolist())
    usual = _find_usual(layers)
    across = f"along {np.round(axis, 3).tolist()} of the file, {1e3 * (high - low):.4g} mm in all"
    notes.append(f"{len(layers)} layer{'s' * (len(layers) > 1)} {across}")
    return RawSection(polygon=usual, width=high - low, notes=notes, layers=tuple(layers))


def _measure_blade(mesh: Surface, axis: NDArray, base: shapely.Geometry) -> float:
    """Return the width [m] along an axis of what stands out of a wider base."""
    flat = mesh.vertices @ np.stack(_span(axis)).T
    return float(np.ptp((mesh.vertices @ axis)[~shapely.contains_xy(base.buffer(_CHORD), *flat.T)]))


def _mend(mesh: Surface, notes: list[str]) -> Surface:
    """Return a surface without doubled faces, in one sense, its cracks and small holes closed."""
    single = mesh.drop_doubles()
    if not single.edges.is_balanced and (solid := mesh.drop_flaps()).edges.is_balanced:
        single = solid
    if single.edges.is_balanced:
        mended, filled = single, 0
    else:
        merged = single.close_cracks(_CRACK).drop_doubles()
        mended, filled, _ = (merged.orient() or merged).fill_holes(lambda hole: len(hole) <= _MISSING)
        if count := len(single.vertices) - len(merged.vertices):
            notes.append(f"mended: {count} vertices merged with others within {1e3 * _CRACK:g} mm")
    if count := len(mesh.triangles) - len(single.triangles):
        notes.append(f"mended: {count} doubled faces left out")
    if filled:
        notes.append(f"mended: {filled} hole{'s' * (filled > 1)} of a missing triangle or two closed")
    return mended


@dataclass(frozen=True, kw_only=True, eq=False)
class _Cuts:
    """Cuts of a body, evenly over its width [m].

    Attributes:
        section: the one that is most like all others, in one piece.
        found: the cuts (n,).
        difference: (n,) of each from that section, as a share of its area.
        width: of the body.
    """

    section: shapely.Polygon
    found: NDArray
    difference: NDArray
    width: float

    @cached_property
    def areas(self) -> NDArray:
        """Of the cuts (n,) [m^2]."""
        return shapely.area(self.found)

    def is_short(self, area: shapely.Geometry, share: float) -> bool:
        """Return True if the circle around an area is less than a share of that around the section."""
        return shapely.minimum_bounding_radius(area) < share * shapely.minimum_bounding_radius(self.section)

    def find_local(self) -> shapely.Geometry | None:
        """Return where cuts differ from the section, if that is short: a fork, a bore or a void of the base.

        Small holes across a few of the cuts are left out.
        """
        seen = self.found[self.difference > _SEEN]
        differing = shapely.symmetric_difference(seen, self.section, grid_size=_GRID)
        differing = shapely.buffer(differing, 0.0)
        apart = shapely.union_all(differing, grid_size=_GRID)  # lines among areas cannot be united
        parts = shapely.get_parts(apart.buffer(-_CHORD).buffer(_CHORD))  # without what rounding leaves along outlines
        shares = shapely.area(shapely.intersection(parts[:, None], differing, grid_size=_GRID)) / self.section.area
        is_rare = (shares > _ROUNDING).sum(axis=1) <= _RARE * len(self.found)
        added = shapely.area(shapely.difference(parts, self.section.buffer(_CHORD)))
        is_hole = is_rare & (shares.sum(axis=1) <= _SMALL * len(self.found)) & (added <= _SEEN * self.section.area)
        apart = shapely.union_all(parts[~is_hole])
        return apart if not apart.is_empty and self.is_short(apart, _LOCAL) else None

    def fill(self, base: shapely.Geometry) -> shapely.Polygon:
        """Return the section with all that any cut has within a base, which is held and thus as good as solid."""
        within = shapely.buffer(shapely.intersection(self.found, base.buffer(2.0 * _CHORD), grid_size=_GRID), 0.0)
        return _one_piece(shapely.union_all([self.section, *within], grid_size=_GRID))

    def find_beside(self) -> shapely.Geometry | None:
        """Return the section of what stands out beside a blade: a base, or marks on it; None where it is neither."""
        is_other = self.difference > _OTHER
        beside = shapely.union_all(self.found[is_other], grid_size=_GRID)
        is_beside = is_other.any() and (self.is_mark or self.is_short(beside, _SHORT))
        return beside if is_beside and self.are_alike(~is_other) else None

    @property
    def is_mark(self) -> bool:
        """True if what is another section is too little to matter, as raised letters."""
        return bool(self.areas[self.difference > _OTHER].sum() <= _ALIKE * self.areas.sum())

    @property
    def is_one(self) -> bool:
        """True if they are one section, but for holes, rounded edges and the like."""
        return self.are_alike(np.full(len(self.found), True))

    def are_alike(self, chosen: NDArray) -> bool:
        """Return True if chosen ones, (n,) bool, are the section but for holes and rounded edges, without floors."""
        seen = self.found[chosen & (self.difference > _SEEN)]
        more = shapely.difference(seen, self.section, grid_size=_GRID)
        inside = shapely.intersection(
            shapely.buffer(more, 0.0), shapely.Polygon(self.section.exterior), grid_size=_GRID
        )
        floor = shapely.area(inside).max(initial=0.0)
        is_little = self.difference[chosen].mean() <= _ALIKE and len(seen) <= _RARE * chosen.sum()
        return bool(is_little and floor <= _SEEN * self.section.area)

    def describe(self) -> str:
        """Say where the section changes, and what would do."""
        other = self.difference > (_OTHER if (self.difference > _OTHER).any() else _SEEN)
        where = 1e3 * self.width * (np.flatnonzero(other) + 0.5) / len(other)
        areas = 1e6 * self.areas[other]
        width, rest = 1e3 * self.width, 1.0 - other.mean()
        return (
            f"{other.mean():.0%} of its {width:.3g} mm, at {where[0]:.3g} to {where[-1]:.3g} mm, have another section "
            f"({areas.min():.4g} to {areas.max():.4g} mm^2) than the other {width * rest:.3g} mm "
            f"({1e6 * self.section.area:.4g} mm^2): a floor, a slot, or a base wider than the blade; expected one "
            "section: export the blade alone, or take the solid as it is (--solid)"
        )


def _cut_often(mesh: Surface, axis: NDArray) -> _Cuts:
    """Return cuts of a body across an axis.

    Raises:
        JawFileError: no cut is in one piece.
    """
    low, high = np.sort(mesh.vertices @ axis)[[0, -1]]
    upright = np.abs(mesh.normals @ axis) < _ALONG / (high - low)
    found: list[shapely.Geometry] = []
    crossed = np.zeros(len(mesh.triangles), bool)
    for height in low + (np.arange(_CUTS) + 0.5) / _CUTS * (high - low):
        before, crossed = crossed, mesh.find_crossed(axis, height)
        is_same = found and (crossed == before).all() and upright[crossed].all()
        found.append(found[-1] if is_same else _cut(mesh, axis, height))
    whole = [cut for cut in found if cut.geom_type == "Polygon"]
    if not whole:
        raise JawFileError(f"its section has {len(found[_CUTS // 2].geoms)} separate areas, expected one finger")
    typical = float(np.median([cut.area for cut in found]))
    section = min(whole, key=lambda cut: abs(cut.area - typical))
    differing = [0.0 if cut is section else cut.symmetric_difference(section).area for cut in found]
    difference = np.array(differing) / section.area
    return _Cuts(section=section, found=np.array(found), difference=difference, width=float(high - low))


def _choose_body(mesh: Surface, body: int | None, notes: list[str]) -> Surface:
    """Return the one body of a file, or the one that is asked for."""
    parts = [part for part in mesh.split() if len(part.triangles) >= 4]
    least = _CRUMB * max((abs(part.volume) for part in parts), default=0.0)
    bodies = sorted((part for part in parts if abs(part.volume) > least), key=lambda item: -np.prod(item.extents))
    voids = [item for item in bodies[1:] if _is_void(item, bodies[0])]
    if len(bodies) - len(voids) <= 1 and body in (None, 1):
        if voids:
            notes.append(f"{len(voids)} closed voids inside")
        if crumbs := len(parts) - len(bodies):
            notes.append(f"{crumbs} crumb{'s' * (crumbs > 1)} of its surface left out")
            return join_surfaces([bodies[0], *voids])
        return mesh
    shells = [item.turn(item.volume < 0.0) for item in bodies if item not in voids]
    if body is None and len(shells) <= _MOST_SHELLS and (united := unite(shells)) is not None:
        notes.append(f"{len(shells)} bodies that overlap are one, as printed (--body)")
        return join_surfaces([united, *voids])
    sizes = "; ".join(
        f"{number}: " + " x ".join(f"{1e3 * value:.3g}" for value in item.extents)
        for number, item in enumerate(bodies[:8], start=1)
    )
    if body is None or not 1 <= body <= len(bodies):
        asked = "" if body is None else f" and no number {body}"
        raise JawFileError(
            f"holds {len(bodies)} bodies{asked}, expected one; choose the finger with --body N (mm, {sizes})"
        )
    notes.append(f"body {body} of {len(bodies)}")
    return bodies[body - 1]


def _is_void(body: Surface, other: Surface) -> bool:
    """Return True if a body lies inside another one with its surface turned inwards."""
    inside = (body.bounds[0] > other.bounds[0]).all() and (body.bounds[1] < other.bounds[1]).all()
    return bool(inside and body.volume * other.volume < 0.0)


def _find_axis(mesh: Surface) -> tuple[NDArray, float]:
    """Return the direction (3,) that most of a surface goes with, upright on it or across it, and that share."""
    normals, areas = mesh.normals, mesh.areas
    turned = normals * np.where(normals[:, [2]] + 1e-3 * normals[:, [1]] + 1e-6 * normals[:, [0]] < 0.0, -1.0, 1.0)
    _, number = np.unique(np.round(turned, 2), axis=0, return_inverse=True)
    number = number.ravel()
    weight = np.bincount(number, areas)
    found: list[tuple[float, float, NDArray]] = [(-1.0, 0.0, np.array([0.0, 0.0, 1.0]))]
    for cluster in np.argsort(-weight)[:20]:
        axis = (turned * (areas * (number == cluster))[:, None]).sum(axis=0)
        length = np.linalg.norm(axis)
        if not length > 0.0:  # triangles without an area
            break
        axis = axis / length
        along = np.abs(normals @ axis)
        across = along > 1.0 - _UPRIGHT**2
        height = (mesh.vertices @ axis)[mesh.triangles].mean(axis=1)
        is_step = across & (np.minimum(height - height.min(), height.max() - height) > _SIDE)
        found.append((float(areas[(along < _UPRIGHT) | across].sum() / areas.sum()), float(areas[is_step].sum()), axis))
    # what stands on a box goes with all three of its directions: it was extruded along the one without steps
    most = max(share for share, _, _ in found)
    share, _, axis = min((item for item in found if item[0] > most - 1e-3), key=lambda item: item[1])
    return axis, share


def _try_tapered(mesh: Surface, axis: NDArray, section: shapely.Polygon, notes: list[str]) -> RawSection:
    """Return the section of a tapered body; raises UnlikeSectionsError with its usual section where it is none."""
    try:
        return _cut_tapered(mesh, axis, notes)
    except JawFileError as error:
        advice = "take the solid as it is (--solid); of a finger with its holder, export the finger alone"
        raise UnlikeSectionsError(f"{error}: {advice}", section) from error


def _cut_tapered(mesh: Surface, axis: NDArray, notes: list[str]) -> RawSection:
    """Return the section of a body whose walls all run in one direction between two sides that are any planes.

    Args:
        mesh: the body [m].
        axis: nearly that direction (3,).
        notes: findings, a line each.

    Raises:
        JawFileError: Walls run in several directions, or a side is no plane.
    """
    normals, areas = mesh.normals, mesh.areas
    found = [_find_ruling(mesh, start) for start in (axis, *np.eye(3))]
    axis = max(found, key=lambda axis: areas[np.abs(normals @ axis) < _UPRIGHT].sum())
    slope = normals @ axis
    walls = np.abs(slope) < _UPRIGHT
    sides = [np.flatnonzero(slope < -_ASIDE), np.flatnonzero(slope > _ASIDE)]
    share = float((areas * walls).sum() + sum(areas[side].sum() for side in sides)) / float(areas.sum())
    letters = np.round(axis, 3).tolist()
    if share < _PRISMATIC or not all(map(len, sides)):
        raise JawFileError(
            f"is not prismatic: {np.floor(1e3 * share) / 10.0:.1f} % of its surface are sides, or walls along "
            f"{letters}, expected {_PRISMATIC:.1%}: a finger whose walls all run in one direction, from one plane side "
            "to another"
        )
    across = np.stack(_span(axis))
    low, high = (_fit_side(mesh, side, axis, across) for side in sides)
    taper, width = (high - low)[:2], float((high - low)[2])
    corners = mesh.vertices[np.unique(mesh.triangles[walls])] @ across.T
    widths = corners @ taper + width
    # where both sides are there everywhere
    bottom, top = (corners @ plane[:2] + plane[2] for plane in (low, high))
    if not bottom.max() < top.min():
        raise JawFileError(f"tapers so much that no cut across {letters} meets all of it")
    polygon = _one_piece(_cut(mesh, axis, 0.5 * float(bottom.max() + top.min())))
    notes.append(
        f"tapered: walls along {letters} of the file, {1e3 * widths.min():.3g} to {1e3 * widths.max():.3g} mm wide; "
        "taken as symmetric about its middle"
    )
    return RawSection(polygon=polygon, width=width, notes=notes, taper=taper)


def _find_ruling(mesh: Surface, axis: NDArray) -> NDArray:
    """Return the direction (3,) nearest to an axis that as many walls as possible run along."""
    for _ in range(_RULINGS):
        walls = np.abs(mesh.normals @ axis) < _ASIDE
        normals, areas = mesh.normals[walls], mesh.areas[walls, None]
        # what all walls are across to
        found = np.linalg.eigh((normals * areas).T @ normals)[1][:, 0]
        axis = found if found @ axis > 0.0 else -found
    return axis


def _fit_side(mesh: Surface, faces: NDArray, axis: NDArray, across: NDArray) -> NDArray:
    """Return how high a side is along an axis: by both directions across, and at their origin [m] (3,).

    Raises:
        JawFileError: It is no plane.
    """
    points = mesh.vertices[np.unique(mesh.triangles[faces])]
    design = np.column_stack([points @ across.T, np.ones(len(points))])
    plane, *_ = np.linalg.lstsq(design, points @ axis, rcond=None)
    off = float(np.abs(design @ plane - points @ axis).max())
    if off > _SIDE:
        raise JawFileError(
            f"is not prismatic: a side leaves its plane by {1e3 * off:.2g} mm, expected at most {1e3 * _SIDE:g} mm"
        )
    return plane


def _span(axis: NDArray) -> tuple[NDArray, NDArray]:
    """Return two unit vectors that with an axis make a right-handed frame."""
    first = np.eye(3)[np.abs(axis).argmin()]
    first = first - (first @ axis) * axis
    first = first / np.linalg.norm(first)
    return first, np.cross(axis, first)


def _cut(mesh: Surface, axis: NDArray, height: float) -> shapely.Geometry:
    """Return the cut of a body across an axis at a height [m], a polygon or several."""
    return _fill_lines(mesh.cut(axis, height) @ np.stack(_span(axis)).T)


def _one_piece(area: shapely.Geometry) -> shapely.Polygon:
    """Return a polygon; raises JawFileError for several separate ones."""
    if area.geom_type != "Polygon":
        raise JawFileError(
            f"its section has {len(area.geoms)} separate areas, expected one finger: export it without its holder"
        )
    return area


def _fill_lines(lines: list[NDArray] | NDArray) -> shapely.Geometry:
    """Return what lines (n, 2) [m], open or closed, bound together: a polygon or several; many at once as one array.

    Raises:
        JawFileError: They bound nothing.
    """
    number = np.repeat(np.arange(len(lines)), list(map(len, lines)))
    strings = shapely.linestrings(np.round(np.concatenate(lines) / _GRID) * _GRID, indices=number)
    strings = strings[shapely.length(strings) > 0.0]
    found = shapely.polygonize(shapely.get_parts(shapely.union_all(strings)))
    areas = sorted(found.geoms, key=lambda area: -area.area)
    if not areas:
        raise JawFileError(f"{len(lines)} lines bound no area, expected closed loops: an outline and its holes")
    # a face within an odd number of others' outlines is a hole
    filled = [shapely.Polygon(area.exterior) for area in areas]
    whole = shapely.Polygon()
    for area in areas:
        point = area.representative_point()
        if sum(outline.contains(point) for outline in filled) % 2:
            whole = whole.union(area)
    return whole
