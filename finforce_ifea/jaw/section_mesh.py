"""Quadratic triangles in a finger's section, and quadratic tetrahedra in what it becomes when it is extruded."""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import shapely
from numpy.typing import NDArray

from finforce_ifea.errors import MeshError
from finforce_ifea.jaw.mesh import VolumeMesh, build_volume_mesh, to_tet10
from finforce_ifea.jaw.section import Section

_SIZE = 1.0e-3  # [m], size of the elements of the default mesh
_MOST_TRIANGLES = 1500  # more are avoided by larger elements
SHARES = {"coarse": 2.0, "default": 1.0, "fine": 0.6}
_CORNER = np.radians(25.0)  # [rad], turn of the outline from which on it is a corner, not a curve
_PER_TURN = 12  # elements along a full turn of a curve
_LEAST = 2e-4  # [m], least size along a curve
_GROWTH = 0.35  # [-], growth of the size with the distance from it
_EDGE = 3.0  # elements below the edge of the clamp, beyond which the mesh may be coarser
_COARSER = 2.5  # [-], by this factor
_FLAT = 1e-3
_PASSES = 200
_EDGES = ((0, 1), (1, 2), (2, 0))
_EQUILATERAL = 0.433
_MOST_POINTS = 8_000


@dataclass(frozen=True, kw_only=True, eq=False)
class PlaneMesh:
    """Six-node triangles.

    Attributes:
        points: (n, 2) [m], x and z; corners first.
        triangles: (t, 6) indices, corners counterclockwise in (x, z), then the middles of edges 01, 12, 20.
        corners: number of the points that are corners.
    """

    points: NDArray
    triangles: NDArray
    corners: int


@lru_cache(maxsize=4)  # of one finger at two densities, and of another
def mesh_section(section: Section, share: float = 1.0) -> PlaneMesh:
    """Divide a section into quadratic triangles.

    Points stand along all rings, closer where they curve; inside, where there is room, on a lattice. Delaunay's
    triangles of them keep every edge of the rings, which are halved where it takes that. Middles lie on the chords.

    Args:
        section: the finger's section.
        share: of the elements' size: the section's, else 1 mm, or more where that makes more than 1500 triangles.

    Raises:
        MeshError: The section asks for too many elements, or cannot be divided.
    """
    size = section.size or max(_SIZE, float(np.sqrt(section.free_area / (_EQUILATERAL * _MOST_TRIANGLES))))
    field = _SizeField(section, share * size)
    rings = [_resample(line, field, is_closed) for line, is_closed in section.lines]
    points = np.concatenate(rings)
    if len(points) > _MOST_POINTS:
        raise MeshError(
            f"the section asks for {len(points)} points along its outline, expected at most {_MOST_POINTS}: give "
            "`size`, or leave out what is that thin"
        )
    first = np.cumsum([0, *map(len, rings)])
    edges = [_close(start, len(ring)) for start, ring in zip(first, rings, strict=False)]
    edges = np.concatenate([e if closed else e[:-1] for e, (_, closed) in zip(edges, section.lines, strict=True)])
    if section.layers:  # whose lines share their ends
        points, number = np.unique(points, axis=0, return_inverse=True)
        # lines that are closer than elements may be one
        edges, polygon = np.unique(np.sort(number.ravel()[edges], axis=1), axis=0), section.polygon
    else:
        polygon = shapely.Polygon(rings[0], rings[1:])
    inside = _fill(polygon, points, field)
    points, triangles = _triangulate(points, edges, inside)
    centres = points[triangles].mean(axis=1)
    areas = [layer.area for layer in section.layers] or [polygon]
    there = np.any([shapely.contains_xy(area, centres) for area in areas], axis=0)
    corners = points[triangles]
    longest = np.max([np.linalg.norm(corners[:, a] - corners[:, b], axis=1) for a, b in _EDGES], axis=0)
    triangles = triangles[there & (np.abs(_measure_area(corners)) * 2.0 / longest**2 > _FLAT)]
    used, triangles = np.unique(triangles, return_inverse=True)
    return _add_middles(points[used], _turn(points[used], triangles.reshape(-1, 3)))


class _SizeField:
    """The wanted size of elements at any place."""

    def __init__(self, section: Section, size: float) -> None:
        from scipy.spatial import cKDTree

        self.size = size
        self._section = section
        places, sizes = [], []
        for ring, is_closed in section.lines:
            length = np.linalg.norm(np.roll(ring, -1, axis=0) - ring, axis=1)
            turn = _measure_turns(ring)
            if not is_closed:
                turn[[0, -1]] = 0.0
            curve = turn / (0.5 * (length + np.roll(length, 1)))
            curve[turn > _CORNER] = 0.0
            places.append(ring)
            sizes.append(np.maximum(2.0 * np.pi / _PER_TURN / np.maximum(curve, 1.0), _LEAST))
        self._sizes = np.concatenate(sizes)
        self._tree = cKDTree(np.concatenate(places))
        self._count = min(40, len(self._sizes))

    def read(self, points: NDArray) -> NDArray:
        """Return the size (n,) [m] at points (n, 2) [m]."""
        distance, index = self._tree.query(points, k=self._count)
        wanted = (self._sizes[index] + _GROWTH * distance).reshape(len(points), -1)
        still = self._section.clamp_height(points[:, 0]) - _EDGE * self.size
        largest = np.where(points[:, 1] < still, _COARSER * self.size, self.size)
        return np.minimum(wanted.min(axis=1), largest)


def _measure_turns(ring: NDArray) -> NDArray:
    """Return by how much a ring (n, 2) turns at each of its points (n,) [rad], without sign."""
    along = np.roll(ring, -1, axis=0) - ring
    angle = np.arctan2(along[:, 1], along[:, 0])
    return np.abs((angle - np.roll(angle, 1) + np.pi) % (2.0 * np.pi) - np.pi)


def _resample(ring: NDArray, field: _SizeField, is_closed: bool) -> NDArray:
    """Return points (m, 2) along a ring, or a line: its corners, and between them as many as the sizes ask for."""
    length = np.linalg.norm(np.roll(ring, -1, axis=0) - ring, axis=1)
    ring = ring[length > 1e-7]
    length = length[length > 1e-7]
    turns = _measure_turns(ring)
    if not is_closed:
        turns[[0, -1]] = np.pi
    corners = np.flatnonzero(turns > _CORNER)
    corners = corners if len(corners) else np.array([0])
    arc = np.concatenate([[0.0], np.cumsum(length)])
    closed = np.vstack([ring, ring[:1]])
    pieces = []
    for begin, end in list(zip(corners, np.roll(corners, -1), strict=True))[: None if is_closed else -1]:
        start, stop = arc[begin], arc[end] + (arc[-1] if end <= begin else 0.0)
        fine = np.linspace(start, stop, max(int((stop - start) / _LEAST), 2) + 1)
        middles = 0.5 * (fine[1:] + fine[:-1])
        count = np.concatenate([[0.0], np.cumsum(np.diff(fine) / field.read(_walk(middles, arc, closed)))])
        number = max(int(np.ceil(count[-1] - 1e-6)), 1)
        pieces.append(_walk(np.interp(np.arange(number) * count[-1] / number, count, fine), arc, closed))
    return np.concatenate(pieces if is_closed else [*pieces, ring[-1:]])


def _walk(distance: NDArray, arc: NDArray, closed: NDArray) -> NDArray:
    """Return the points (n, 2) at distances (n,) [m] along a closed ring."""
    distance = distance % arc[-1]
    return np.stack([np.interp(distance, arc, closed[:, axis]) for axis in (0, 1)], axis=1)


def _close(first: int, count: int) -> NDArray:
    """Return the edges (n, 2) of a ring of points numbered from `first` on."""
    index = np.arange(count)
    return first + np.stack([index, np.roll(index, -1)], axis=1)


def _fill(polygon: shapely.Polygon, points: NDArray, field: _SizeField) -> NDArray:
    """Return points (n, 2) on a lattice of triangles inside the section, away from those on its rings."""
    from scipy.spatial import cKDTree

    low_x, low_z, high_x, high_z = polygon.bounds
    step = field.size
    x, z = np.arange(low_x, high_x, 0.95 * step), np.arange(low_z, high_z, 0.82 * step)
    lattice = np.stack(np.meshgrid(x, z, indexing="ij"), axis=-1)
    lattice[:, 1::2, 0] += 0.475 * step
    lattice = lattice.reshape(-1, 2)
    lattice = lattice[shapely.contains_xy(polygon, lattice)]
    if len(lattice) == 0:
        return lattice
    return lattice[cKDTree(points).query(lattice)[0] > 0.7 * field.read(lattice)]


def _triangulate(points: NDArray, edges: NDArray, inside: NDArray) -> tuple[NDArray, NDArray]:
    """Return Delaunay's triangles (t, 3) and the points (n, 2); edges that are none of theirs are halved.

    Raises:
        MeshError: An edge stays missing.
    """
    from scipy.spatial import Delaunay

    for _ in range(_PASSES):
        everything = np.vstack([points, inside])
        triangles = Delaunay(everything).simplices
        sides = np.sort(triangles[:, _EDGES].reshape(-1, 2), axis=1)
        stride = len(everything)
        known = np.unique(sides[:, 0] * stride + sides[:, 1])
        wanted = np.sort(edges, axis=1)
        missing = ~np.isin(wanted[:, 0] * stride + wanted[:, 1], known)
        if not missing.any():
            return everything, triangles
        begin, end = edges[missing].T
        middle = len(points) + np.arange(len(begin))
        points = np.vstack([points, 0.5 * (points[begin] + points[end])])
        halves = np.concatenate([np.stack([begin, middle], axis=1), np.stack([middle, end], axis=1)])
        edges = np.concatenate([edges[~missing], halves])
    x, z = 1e3 * points[begin[0]]
    raise MeshError(f"the section cannot be divided near ({x:.3f}, {z:.3f}) mm: its outline folds onto itself there")


def _measure_area(corners: NDArray) -> NDArray:
    """Return the signed area (t,) [m^2] of triangles (t, 3, 2)."""
    first, second = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    return 0.5 * (first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0])


def _turn(points: NDArray, triangles: NDArray) -> NDArray:
    """Return the triangles (t, 3), all counterclockwise."""
    return np.where((_measure_area(points[triangles]) < 0.0)[:, None], triangles[:, [0, 2, 1]], triangles)


def _add_middles(points: NDArray, triangles: NDArray) -> PlaneMesh:
    """Return six-node triangles, with the middles of all edges after the corners."""
    sides = np.sort(triangles[:, _EDGES].reshape(-1, 2), axis=1)
    edges, number = np.unique(sides, axis=0, return_inverse=True)
    middles = points[edges].mean(axis=1)
    return PlaneMesh(
        points=np.vstack([points, middles]),
        triangles=np.hstack([triangles, len(points) + number.reshape(-1, 3)]),
        corners=len(points),
    )


@lru_cache(maxsize=4)
def extrude_section(section: Section, share: float = 1.0) -> VolumeMesh:
    """Return the finger as 10-node tetrahedra, three to a prism.

    A prism or a tapered finger is one layer of prisms on either side of y = 0; others have as many as they have layers.

    Raises:
        MeshError: The section cannot be divided, or nothing of it is clamped.
    """
    plane = mesh_section(section, share)
    corners, triangles = plane.points[: plane.corners], np.sort(plane.triangles[:, :3], axis=1)
    count = len(corners)
    if section.layers:
        ends = np.unique([0.0, *(end for layer in section.layers for end in (layer.low, layer.high))])
        levels = np.repeat(ends[:, None], count, axis=1)
        centres = corners[triangles].mean(axis=1)
        there = [
            shapely.contains_xy(layer.area, *centres.T)
            for middle in 0.5 * (ends[1:] + ends[:-1])
            for layer in section.layers
            if layer.low < middle < layer.high
        ]
    else:
        levels = np.array([-0.5, 0.0, 0.5])[:, None] * section.read_width(corners)
        there = np.ones((2, len(triangles)), bool)
    nodes, tets = np.concatenate([np.insert(corners, 1, y, axis=1) for y in levels]), []
    for number, present in enumerate(there):
        # the diagonals of all sides start at the smallest number of the end towards the middle: both halves mirror each
        # other
        near, far = (number, number + 1) if levels[number].max() >= 0.0 else (number + 1, number)
        (a, b, c), (d, e, f) = (triangles[present].T + count * end for end in (near, far))
        tets += [np.stack(four, axis=1) for four in ((a, b, c, f), (a, b, f, e), (a, e, f, d))]
    used, tets = np.unique(np.concatenate(tets), return_inverse=True)
    nodes, tets = nodes[used], tets.reshape(-1, 4)
    edges = [nodes[tets[:, k]] - nodes[tets[:, 0]] for k in (1, 2, 3)]
    flipped = np.einsum("ij,ij->i", np.cross(edges[0], edges[1]), edges[2]) < 0.0
    tets = np.where(flipped[:, None], tets[:, [0, 2, 1, 3]], tets)
    held = np.flatnonzero(section.find_clamped(nodes[:, [0, 2]]))
    return to_tet10(build_volume_mesh(nodes=nodes, elements=tets, clamped=held))
