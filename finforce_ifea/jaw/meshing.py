"""Structured hexahedral meshes of a fin-ray drawing."""

from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.typing import NDArray

from finforce_ifea.errors import MeshError
from finforce_ifea.jaw.drawing import Band, Drawing, Rib
from finforce_ifea.jaw.mesh import VolumeMesh, build_volume_mesh


@dataclass(frozen=True, kw_only=True)
class MeshDensity:
    """How many elements a drawing is divided into.

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


def density_from_name(name: str) -> MeshDensity:
    """Return the preset called `name`.

    Raises:
        MeshError: There is no such preset.
    """
    if name not in PRESETS:
        raise MeshError(f"mesh density: got {name!r}, expected one of {', '.join(PRESETS)} or a MeshDensity")
    return PRESETS[name]


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
        density = density_from_name(density)
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
    return build_volume_mesh(nodes=nodes, hexes=hexes, clamped=clamped)


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
        count = _rib_rows(rib, density)
        rows = slice(first, first + count + 1)
        if count > 0:
            section.bridge(outer[rows, -1], inner[rows, 0], density.along_rib)
        first += step + count
    if drawing.tip_z is not None:
        rows = slice(-density.tip - 1, None)
        section.bridge(outer[rows, -1], inner[rows, 0], density.tip)
    return section.points, section.quads


def _rib_rows(rib: Rib, density: MeshDensity) -> int:
    """Return how many elements lie through the thickness of a rib; none in a bar without thickness."""
    return density.through_rib if rib.thickness > 0.0 else 0


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
        """Fill the room between two columns of existing points with `count` cells per row."""
        share = np.linspace(0.0, 1.0, count + 1)[1:-1, None]
        between = self.points[start][:, None] * (1.0 - share) + self.points[end][:, None] * share
        self.add_quads(np.concatenate([start[:, None], self.add_points(between), end[:, None]], axis=1))
