"""What the side of a finger looks like at rest, on the same grid as the pictures of its side plane."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from finforce_keypoints.geometry.side_picture import PlaneGrid

if TYPE_CHECKING:
    import shapely

    from finforce_ifea.jaw.jaw import Jaw

FINER = 4  # times as many pixels are drawn each way, before they are averaged
BAR, SCREW_RADIUS = 3e-3, 1.3e-3  # [m] of bars that are only lines, and of what they turn on
MARK_RADIUS = 1.9e-3  # [m] of the dot at the reference point
BELOW, ABOVE, ASIDE, BESIDE = 0.07, 0.10, 0.27, 0.20  # free space around the finger, in lengths: z down and up, -x, +x
ROOM = 1.05  # of the width that a finger takes with its free space


@dataclass(frozen=True, kw_only=True, eq=False)
class SideShape:
    """A finger at rest as seen from its side; all lengths in metres, x and z of the jaw frame.

    Attributes:
        rings: closed lines (n, 2) that bound its material; within an odd number of them there is some.
        clamped_z: everything up to this height is held.
        reference: (2,) the mark on what is held.
        bolts: (b, 3) x, z and radius of round things to be seen on its side.
    """

    rings: Sequence[NDArray]
    clamped_z: float
    reference: NDArray
    bolts: NDArray = field(default_factory=lambda: np.zeros((0, 3)))

    @property
    def bounds(self) -> tuple[NDArray, NDArray]:
        """The least and the largest x and z (2,) of its material and its mark."""
        points = np.vstack((*self.rings, self.reference))
        return points.min(axis=0), points.max(axis=0)


def fit_grid(shape: SideShape, width: int = 176, height: int = 224) -> PlaneGrid:
    """Return the grid of width x height pixels in which a finger has room to bend."""
    low, high = shape.bounds
    length = high[1] - low[1]
    scale = max((1.0 + BELOW + ABOVE) * length / height, ROOM * (high[0] - low[0] + (ASIDE + BESIDE) * length) / width)
    middle_x = 0.5 * (low[0] + high[0]) + 0.5 * (BESIDE - ASIDE) * length
    middle_z = 0.5 * (low[1] + high[1]) + 0.5 * (ABOVE - BELOW) * length
    x, z = middle_x - 0.5 * (width - 1) * scale, middle_z - 0.5 * (height - 1) * scale
    return PlaneGrid(scale=float(scale), x=float(x), z=float(z), width=width, height=height)


def draw_template(shape: SideShape, grid: PlaneGrid) -> NDArray[np.uint8]:
    """Return the picture (height, width, 3) of a finger at rest: its material, what is held, its mark and bolts."""
    from finforce.optional import import_cv2

    cv2 = import_cv2()
    fine = np.zeros((3, FINER * grid.height, FINER * grid.width), np.uint8)

    def place(points: NDArray) -> NDArray:
        # fillPoly takes 1/16 px; the centre of a pixel lies at half its finer ones
        return np.round(16.0 * (FINER * (grid.pixels(points) + 0.5) - 0.5)).astype(np.int32)

    cv2.fillPoly(fine[0], [place(ring) for ring in shape.rings], 255, shift=4)
    held = grid.places(np.stack((np.zeros(grid.height), np.arange(grid.height)), axis=1))[:, 1] <= shape.clamped_z
    fine[1] = np.where(np.repeat(held, FINER), 255, 0)[:, None]
    for x, z, radius in ((*shape.reference, MARK_RADIUS), *shape.bolts):
        centre = place(np.array([[x, z]]))[0]
        cv2.circle(fine[2], tuple(centre.tolist()), round(16 * FINER * radius / grid.scale), 255, -1, shift=4)
    small = [cv2.resize(layer, (grid.width, grid.height), interpolation=cv2.INTER_AREA) for layer in fine]
    return np.stack(small, axis=-1)


def find_shape(jaw: Jaw) -> SideShape:
    """Return what a jaw looks like from its side, whatever describes it.

    Strips and bars without a thickness of their own are drawn as thick as bars usually are, and what joins them as the
    heads of screws at the key points.
    """
    import shapely

    bolts = np.zeros((0, 3))
    if jaw.section is not None:
        rings: Sequence[NDArray] = jaw.section.rings
        lowest = min(float(ring[:, 1].min()) for ring in rings)
        clamped_z = lowest if jaw.section.clamped_z is None else jaw.section.clamped_z
        bolts = jaw.section.clamped_circles
    elif jaw.drawing is not None:
        rings, clamped_z = _rings_of(_draw_bars(jaw)), jaw.drawing.clamped_z
        if jaw.drawing.joints == "hinged":
            bolts = np.column_stack((jaw.keypoints[:, [0, 2]], np.full(len(jaw.keypoints), SCREW_RADIUS)))
    else:
        mesh = jaw.build_mesh()
        corners = mesh.nodes[mesh.surface[:, :3]]
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        facing = np.abs(normals[:, 1]) > 0.9 * np.linalg.norm(normals, axis=1)
        triangles = [shapely.Polygon(triangle) for triangle in corners[facing][:, :, [0, 2]]]
        rings = _rings_of(shapely.union_all([triangle.buffer(1e-6) for triangle in triangles]))
        clamped_z = float(mesh.nodes[mesh.clamped, 2].max())
    return SideShape(
        rings=tuple(rings),
        clamped_z=float(clamped_z),
        reference=jaw.reference_point[[0, 2]],
        bolts=bolts,
    )


def _draw_bars(jaw: Jaw) -> shapely.Geometry:
    """Return the material of a drawing; a bar without thickness joins the screws of its rib, if they are key points."""
    import shapely

    drawing, bars = jaw.drawing, []
    places = dict(zip(jaw.keypoint_names, jaw.keypoints[:, [0, 2]], strict=True))
    for number, (rib, ends) in enumerate(zip(drawing.ribs, drawing.junctions.swapaxes(0, 1), strict=True), start=1):
        if rib.thickness == 0.0:
            screws = [places.get(f"{band}_{number}", end) for band, end in zip(("inner", "outer"), ends, strict=True)]
            bars.append(shapely.LineString(screws).buffer(0.5 * BAR, cap_style="flat"))
    parts = [shapely.Polygon(part).buffer(1e-6, join_style="mitre") for part in drawing.outlines()]
    return shapely.union_all([*parts, *bars])


def _rings_of(area: shapely.Geometry) -> list[NDArray]:
    """Return the rings (n, 2) that bound an area."""
    polygons = getattr(area, "geoms", [area])
    return [np.array(ring.coords)[:-1] for polygon in polygons for ring in (polygon.exterior, *polygon.interiors)]
