"""The parametric fin-ray finger as drawn in its x-z plane, and its structured hexahedral meshes."""

from dataclasses import dataclass, fields, replace
from typing import Literal

import numpy as np
import shapely
from numpy.typing import NDArray

from finforce_ifea.errors import JawFileError, MeshError
from finforce_ifea.jaw.mesh import VolumeMesh, build_volume_mesh


@dataclass(frozen=True, kw_only=True)
class Band:
    """A straight band, given by its outer face (the one away from the ribs) and its thickness.

    Attributes:
        base: (x, z) [m] of the outer face at the base.
        tip: (x, z) [m] of the outer face at the tip.
        thickness: [m], measured along x.
        inward: direction along x from the outer face into the finger: -1 inner band, +1 outer band.
    """

    base: tuple[float, float]
    tip: tuple[float, float]
    thickness: float
    inward: Literal[-1, 1]

    @property
    def slope(self) -> float:
        """The change of x per z of the band's lines [-]."""
        return (self.tip[0] - self.base[0]) / (self.tip[1] - self.base[1])

    @property
    def normal_thickness(self) -> float:
        """The thickness normal to the band [m]."""
        return self.thickness / float(np.hypot(1.0, self.slope))

    def line_x(self, z: float | NDArray, depth: float) -> float | NDArray:
        """Return x [m] at the heights z [m]; depth [-]: 0 outer face, 0.5 centre line, 1 back."""
        return self.base[0] + self.slope * (z - self.base[1]) + self.inward * depth * self.thickness

    def face_x(self, z: float | NDArray) -> float | NDArray:
        """Return x [m] of the outer face at the heights z [m]."""
        return self.line_x(z, 0.0)

    def centre_x(self, z: float | NDArray) -> float | NDArray:
        """Return x [m] of the centre line at the heights z [m]."""
        return self.line_x(z, 0.5)

    def back_x(self, z: float | NDArray) -> float | NDArray:
        """Return x [m] of the back, the side of the ribs, at the heights z [m]."""
        return self.line_x(z, 1.0)

    def z_from_arc(self, arc: float | NDArray) -> float | NDArray:
        """Return the height z [m] of a point by its arc length [m] from the base along the centre line."""
        return self.base[1] + arc / np.hypot(1.0, self.slope)


@dataclass(frozen=True, kw_only=True)
class Rib:
    """A straight rib between the two bands.

    Attributes:
        inner_z: [m], the height where its centre line meets the centre line of the inner band.
        outer_z: [m], the height where its centre line meets the centre line of the outer band.
        thickness: [m], normal to its centre line; 0 for a rigid bar that is only a line.
    """

    inner_z: float
    outer_z: float
    thickness: float


@dataclass(frozen=True, kw_only=True)
class Drawing:
    """A fin-ray finger: two bands, ribs between them and a tip, drawn in the x-z plane and extruded along y.

    Attributes:
        length: [m], from the base at z = 0 to the end of the tip.
        width: [m], along y; the finger is symmetric about y = 0.
        inner: the band whose outer face is the contact plane x = const.
        outer: the slanted band.
        ribs: from base to tip; none is allowed.
        tip_z: [m], the height from which the tip is solid; None for a rigid tip that joins the two band ends.
        clamped_z: [m], everything up to this height is clamped.
        joints: joint of ribs and bands, stiff or hinged.
        bars: ribs, elastic or rigid.
    """

    length: float
    width: float
    inner: Band
    outer: Band
    ribs: tuple[Rib, ...] = ()
    tip_z: float | None = None
    clamped_z: float = 0.0
    joints: Literal["stiff", "hinged"] = "stiff"
    bars: Literal["elastic", "rigid"] = "elastic"

    def __post_init__(self) -> None:
        """Refuse what cannot be drawn.

        Raises:
            JawFileError: A length is not positive, or parts overlap or lie outside the finger.
        """
        _check_sizes(self)
        _check_bands(self)
        _check_ribs(self)

    @property
    def widest(self) -> float:
        """The width [m], the same everywhere."""
        return self.width

    @property
    def inner_face_x(self) -> float:
        """The contact plane x [m]."""
        return self.inner.base[0]

    @property
    def is_solid(self) -> bool:
        """True if a solid can describe the finger: a solid tip, elastic ribs, stiff joints."""
        return self.tip_z is not None and self.joints == "stiff" and self.bars == "elastic"

    @property
    def junctions(self) -> NDArray:
        """The rib ends on the centre lines of the inner and outer band, shape (2, ribs, 2), (x, z) [m]."""
        inner_z = np.array([rib.inner_z for rib in self.ribs])
        outer_z = np.array([rib.outer_z for rib in self.ribs])
        inner = np.stack([self.inner.centre_x(inner_z), inner_z], axis=1)
        outer = np.stack([self.outer.centre_x(outer_z), outer_z], axis=1)
        return np.stack([inner, outer])

    def rib_edges(self, rib: Rib) -> NDArray:
        """Compute where the two edges of a rib meet the backs of the bands.

        The edges are parallel to the rib's centre line, so that a tilted rib keeps its thickness.

        Args:
            rib: a rib of this drawing.

        Returns:
            (x, z) [m], shape (2, 2, 2): lower and upper edge, inner and outer band.
        """
        x_inner, x_outer = self.inner.centre_x(rib.inner_z), self.outer.centre_x(rib.outer_z)
        tilt = (rib.outer_z - rib.inner_z) / (x_outer - x_inner)
        half_height = 0.5 * rib.thickness * np.hypot(1.0, tilt)
        edges = np.empty((2, 2, 2))
        for row, offset in enumerate((-half_height, half_height)):
            for column, band in enumerate((self.inner, self.outer)):
                # z = inner_z + offset + tilt (x - x_inner) meets x = back_x(0) + slope z
                rise = rib.inner_z + offset + tilt * (band.back_x(0.0) - x_inner)
                z = rise / (1.0 - tilt * band.slope)
                edges[row, column] = band.back_x(z), z
        return edges

    def outlines(self) -> NDArray:
        """Return bands, ribs and solid tip as quadrilaterals, shape (parts, 4, 2), (x, z) [m]."""
        ends = np.array([0.0, self.length])
        bands = (self.inner, self.outer)
        parts = [_quadrilateral(band.face_x(ends), band.back_x(ends), ends) for band in bands]
        parts += [self.rib_edges(rib)[[0, 0, 1, 1], [0, 1, 1, 0]] for rib in self.ribs]
        if self.tip_z is not None:
            ends = np.array([self.tip_z, self.length])
            parts.append(_quadrilateral(self.inner.face_x(ends), self.outer.face_x(ends), ends))
        return np.stack(parts)

    def distance_to(self, points: NDArray) -> NDArray:
        """Compute the distances (n,) [m] of points (n, 3) [m, jaw frame] from the finger, 0 inside."""
        lateral = np.maximum(np.abs(points[:, 1]) - 0.5 * self.width, 0.0)
        parts = shapely.polygons(self.outlines())
        in_plane = shapely.distance(parts, shapely.points(points[:, [0, 2]])[:, None])
        return np.hypot(lateral, in_plane.min(axis=1))


def _quadrilateral(x_first: NDArray, x_second: NDArray, z: NDArray) -> NDArray:
    """Return the corners (4, 2) of the area between two lines, each given at two heights."""
    return np.array([[x_first[0], z[0]], [x_second[0], z[0]], [x_second[1], z[1]], [x_first[1], z[1]]])


def _check_sizes(drawing: Drawing) -> None:
    """Refuse lengths that are not positive and finite."""
    sizes = {
        "length": drawing.length,
        "width": drawing.width,
        "inner_band.thickness": drawing.inner.thickness,
        "outer_band.thickness": drawing.outer.thickness,
    }
    for name, size in sizes.items():
        if not (np.isfinite(size) and size > 0):
            raise JawFileError(f"drawing.{name}: got {size}, expected a positive length in metres")
    if not 0.0 <= drawing.clamped_z < drawing.length:
        raise JawFileError(
            f"drawing.clamped_z: got {drawing.clamped_z}, expected a height from 0 to below the length "
            f"{drawing.length} m"
        )
    if drawing.tip_z is not None and not drawing.clamped_z < drawing.tip_z < drawing.length:
        raise JawFileError(
            f"drawing.tip: solid from z = {drawing.tip_z} m, expected a height between the clamped part "
            f"({drawing.clamped_z} m) and the length ({drawing.length} m)"
        )


def _check_bands(drawing: Drawing) -> None:
    """Refuse bands that overlap, and an inner band that is not upright."""
    inner, outer = drawing.inner, drawing.outer
    if inner.slope != 0.0:
        raise JawFileError(f"drawing.inner_band: its face leans by {inner.slope:.3g}, expected the plane x = const")
    # A rigid tip joins the two centre lines in one point; below it the bands must stay apart.
    last_rib_z = max((rib.outer_z for rib in drawing.ribs), default=0.0)
    end_z = last_rib_z if drawing.tip_z is None else drawing.length
    for z in (0.0, end_z):
        gap = inner.back_x(z) - outer.back_x(z)
        if not gap > 0.0:
            raise JawFileError(
                f"drawing: the bands overlap by {-1e3 * gap:.3g} mm at z = {1e3 * z:.3g} mm; expected the "
                "back of the outer band at smaller x than the back of the inner band: check face_x and "
                "thickness"
            )
    if outer.centre_x(drawing.length) > inner.centre_x(drawing.length) + 1e-9:
        raise JawFileError("drawing: the bands cross below the tip; expected them to meet there at the earliest")


def _check_ribs(drawing: Drawing) -> None:
    """Refuse ribs that overlap on a band, or do not lie between the clamped part and the tip."""
    if drawing.bars == "elastic" and any(not rib.thickness > 0 for rib in drawing.ribs):
        raise JawFileError("drawing.ribs.thickness: got 0 or less, expected a positive length in metres")
    end = drawing.tip_z if drawing.tip_z is not None else drawing.length
    edges = [drawing.rib_edges(rib) for rib in drawing.ribs]
    for column, name in enumerate(("inner", "outer")):
        floor, below = drawing.clamped_z, "the clamped part"
        for number, edge in enumerate(edges, start=1):
            lower, upper = edge[:, column, 1]
            if not lower > floor:
                raise JawFileError(
                    f"drawing: rib {number} begins at z = {1e3 * lower:.4g} mm on the {name} band, but "
                    f"{below} ends at {1e3 * floor:.4g} mm; list the ribs from base to tip, with room "
                    "between them"
                )
            floor, below = upper, f"rib {number}"
        if not floor < end:
            raise JawFileError(
                f"drawing: {below} reaches z = {1e3 * floor:.4g} mm on the {name} band, but the tip "
                f"begins at {1e3 * end:.4g} mm; move the rib down or the tip up"
            )


@dataclass(frozen=True, kw_only=True)
class MeshDensity:
    """The number of elements of a drawing.

    Attributes:
        between_ribs: along the bands, between two ribs, below the first and above the last.
        through_band: through the thickness of the bands.
        along_rib: along each rib.
        through_rib: through the thickness of each rib.
        tip: in the solid tip, along z and along x.
        across_width: along y.
    """

    between_ribs: int
    through_band: int
    along_rib: int
    through_rib: int
    tip: int
    across_width: int

    def __post_init__(self) -> None:
        """Refuse anything but positive whole numbers.

        Raises:
            MeshError: A number is not a positive integer.
        """
        for field in fields(self):
            number = getattr(self, field.name)
            if not isinstance(number, (int, np.integer)) or isinstance(number, bool) or number < 1:
                raise MeshError(f"mesh density: {field.name} = {number!r}, expected a whole number from 1 on")


PRESETS: dict[str, MeshDensity] = {
    "coarse": MeshDensity(between_ribs=3, through_band=1, along_rib=4, through_rib=1, tip=1, across_width=2),
    "default": MeshDensity(between_ribs=6, through_band=1, along_rib=8, through_rib=1, tip=1, across_width=2),
    "fine": MeshDensity(between_ribs=8, through_band=2, along_rib=10, through_rib=2, tip=2, across_width=4),
}


def mesh_drawing(drawing: Drawing, density: MeshDensity | str = "default") -> VolumeMesh:
    """Divide a drawing into hexahedra.

    The section is a set of grids that share the nodes of their common lines; its nodes are repeated in layers
    along y, symmetric about y = 0. Bars without thickness are left out. The mesh of a drawing that is not
    `is_solid` (hinges, rigid bars, a rigid tip) is its skin, for pictures and for points on its surface.

    Args:
        drawing: the finger.
        density: the number of elements, or the name of a preset.

    Returns:
        Hexahedra in the VTK order with positive Jacobians, clamped up to `drawing.clamped_z`.

    Raises:
        MeshError: The density is unknown, or an element comes out inverted.
    """
    if isinstance(density, str):
        if density not in PRESETS:
            raise MeshError(f"mesh density: got {density!r}, expected one of {', '.join(PRESETS)} or a MeshDensity")
        density = PRESETS[density]
    if drawing.tip_z is None:
        # the centre lines of the bands meet in a rigid tip: nodes on them would coincide
        density = replace(density, through_band=1)
    points, quads = _mesh_section(drawing, density)
    layers = density.across_width
    y = drawing.width * (2 * np.arange(layers + 1) - layers) / (2 * layers)
    nodes = np.empty((layers + 1, len(points), 3))
    nodes[:, :, [0, 2]] = points
    nodes[:, :, 1] = y[:, None]
    layer_quads = quads + len(points) * np.arange(layers)[:, None, None]
    hexes = np.concatenate([layer_quads, layer_quads + len(points)], axis=2).reshape(-1, 8)
    nodes = nodes.reshape(-1, 3)
    clamped = np.flatnonzero(nodes[:, 2] <= drawing.clamped_z + 1e-9 * drawing.length)
    return build_volume_mesh(nodes=nodes, elements=hexes, clamped=clamped)


def _mesh_section(drawing: Drawing, density: MeshDensity) -> tuple[NDArray, NDArray]:
    """Mesh the x-z section: points (n, 2) [m] and quadrilaterals (q, 4), turning from z to x."""
    section = _Section()
    inner_rows = _heights(drawing, drawing.inner, density)
    outer_rows = _heights(drawing, drawing.outer, density)
    depth = np.linspace(0.0, 1.0, density.through_band + 1)
    # every grid has its rows along z and its columns along x, so that all elements turn the same way
    inner = section.add_grid(_band_points(drawing.inner, inner_rows, depth[::-1]))
    outer = section.add_grid(_band_points(drawing.outer, outer_rows, depth))
    step = density.between_ribs
    first = step + (drawing.clamped_z > 0.0)
    for rib in drawing.ribs:
        count = density.through_rib if rib.thickness > 0.0 else 0
        rows = slice(first, first + count + 1)
        if count > 0:
            section.bridge(outer[rows, -1], inner[rows, 0], density.along_rib)
        first += step + count
    if drawing.tip_z is not None:
        rows = slice(-density.tip - 1, None)
        section.bridge(outer[rows, -1], inner[rows, 0], density.tip)
    return section.points, section.quads


def _heights(drawing: Drawing, band: Band, density: MeshDensity) -> NDArray:
    """Return the heights z [m] of a band's element edges, base to tip."""
    side = 0 if band is drawing.inner else 1
    steps = density.between_ribs
    spans = [(drawing.clamped_z, 1)] if drawing.clamped_z > 0.0 else []
    for rib in drawing.ribs:
        lower, upper = drawing.rib_edges(rib)[:, side, 1]
        spans.append((lower, steps))
        if rib.thickness > 0.0:
            spans.append((upper, density.through_rib))
    if drawing.tip_z is None:
        spans.append((drawing.length, steps))
    else:
        spans += [(drawing.tip_z, steps), (drawing.length, density.tip)]
    heights = [np.zeros(1)]
    for end, count in spans:
        heights.append(np.linspace(heights[-1][-1], end, count + 1)[1:])
    return np.concatenate(heights)


def _band_points(band: Band, heights: NDArray, depth: NDArray) -> NDArray:
    """Return the grid (len(heights), len(depth), 2) of a band's points (x, z) [m]."""
    x = band.line_x(heights[:, None], depth[None, :])
    return np.stack([x, np.broadcast_to(heights[:, None], x.shape)], axis=2)


class _Section:
    """The growing plane mesh: points and the quadrilaterals between them."""

    def __init__(self) -> None:
        self.points = np.empty((0, 2))
        self.quads = np.empty((0, 4), dtype=np.int64)

    def add_points(self, points: NDArray) -> NDArray:
        """Append points (..., 2) and return their indices (...)."""
        first = len(self.points)
        self.points = np.concatenate([self.points, points.reshape(-1, 2)])
        return np.arange(first, len(self.points)).reshape(points.shape[:-1])

    def add_quads(self, grid: NDArray) -> None:
        """Append the cells of a grid of point indices, rows along z, columns along x."""
        cells = np.stack([grid[:-1, :-1], grid[1:, :-1], grid[1:, 1:], grid[:-1, 1:]], axis=2)
        self.quads = np.concatenate([self.quads, cells.reshape(-1, 4)])

    def add_grid(self, points: NDArray) -> NDArray:
        """Append a grid of points (rows, columns, 2) with its cells and return its indices."""
        grid = self.add_points(points)
        self.add_quads(grid)
        return grid

    def bridge(self, start: NDArray, end: NDArray, count: int) -> None:
        """Fill the gap between two columns of existing points with `count` cells per row."""
        share = np.linspace(0.0, 1.0, count + 1)[1:-1, None]
        between = self.points[start][:, None] * (1.0 - share) + self.points[end][:, None] * share
        self.add_quads(np.concatenate([start[:, None], self.add_points(between), end[:, None]], axis=1))
