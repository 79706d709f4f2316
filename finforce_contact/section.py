"""The outline of an object in the jaw's plane, and its distances from a line along the jaw."""

from dataclasses import dataclass
from functools import cached_property
from math import asin, atan2, sqrt

import numpy as np
from numpy.typing import ArrayLike, NDArray

from finforce.compiled import njit
from finforce.errors import PoseError
from finforce.optional import import_manifold3d
from finforce.triangle_surface import chain_loops
from finforce_contact.mesh.object_mesh import ObjectMesh
from finforce_ifea.contact_mechanics.indenter import CELL

_OPTIONS = {"cache": True, "error_model": "numpy"}
# A wall whose far side lies no deeper than this in the jaw is still taken for what the jaw touches [m].
_THROUGH = 2e-3
_MOST_CROSSINGS = 64
_RECUT_ANGLE = 0.0175  # [rad], turn out of the finger's plane that needs a new outline
_RECUT_SHIFT = 1e-3  # [m], shift along the width that needs a new outline
_RECUT_TILT = 0.35  # [rad], turn in that plane, about half of what the solver allows an outline to turn


def edges_of(polygons: tuple[NDArray, ...]) -> NDArray:
    """Return the edges (e, 2, 2) [m], start and end, of closed polygons (n, 2) [m]."""
    edges = [np.stack([polygon, np.roll(polygon, -1, axis=0)], axis=1) for polygon in polygons]
    return np.concatenate([np.empty((0, 2, 2)), *edges])


def place_edges(edges: NDArray, origin: NDArray, tilt: float) -> NDArray:
    """Return edges (e, 2, 2) turned by a tilt [rad], positive from x to z, and moved to an origin (2,) [m]."""
    c, s = np.cos(tilt), np.sin(tilt)
    return edges @ np.array([[c, s], [-s, c]]) + origin


def distances_to(line: NDArray, edges: NDArray) -> NDArray:
    """Return the distance of each point of a line (h, 2) [m] to an outline's edges (e, 2, 2): (h,) [m]."""
    along = edges[:, 1] - edges[:, 0]
    offset = line[:, None] - edges[:, 0]
    share = np.clip((offset * along).sum(-1) / np.maximum((along**2).sum(-1), 1e-30), 0.0, 1.0)
    return np.sqrt(((offset - share[..., None] * along) ** 2).sum(-1).min(axis=1))


@njit(**_OPTIONS)
def _cross(z, edges, crossings):
    """Fill in the sorted x where the outline crosses the height z; return their number."""
    count = 0
    for e in range(len(edges)):
        z0, z1 = edges[e, 0, 1], edges[e, 1, 1]
        if (z0 <= z) == (z1 <= z) or count == _MOST_CROSSINGS:
            continue
        x = edges[e, 0, 0] + (z - z0) / (z1 - z0) * (edges[e, 1, 0] - edges[e, 0, 0])
        k = count
        while k > 0 and crossings[k - 1] > x:
            crossings[k] = crossings[k - 1]
            k -= 1
        crossings[k] = x
        count += 1
    return count


@njit(**_OPTIONS)
def compute_gaps(line, edges):
    """Return the way along x from a line (h, 2) [m] to the near side (h,) [m] of an outline's edges (e, 2, 2).

    Negative where the point lies in the object, infinite where nothing of the object stands before the point. What
    lies behind the point by more than a wall's thickness, as the far wall of a cup around the finger, does not count.
    """
    gaps, crossings = np.full(len(line), np.inf), np.empty(_MOST_CROSSINGS)
    for h in range(len(line)):
        count = _cross(line[h, 1], edges, crossings)
        for k in range(0, count - 1, 2):
            if crossings[k + 1] > line[h, 0] - _THROUGH:
                gaps[h] = crossings[k] - line[h, 0]
                break
    return gaps


@njit(**_OPTIONS)
def count_inside(points, edges):
    """Return how many of points (p, 2) [m] lie within an outline's edges (e, 2, 2), by the even-odd rule."""
    inside, crossings = 0, np.empty(_MOST_CROSSINGS)
    for p in range(len(points)):
        count, before = _cross(points[p, 1], edges, crossings), 0
        for k in range(count):
            before += crossings[k] <= points[p, 0]
        inside += before % 2
    return inside


SIMPLIFICATION = 2e-5  # [m], far below the error of any pose
_SLIVER = 1e-9  # [m^2], areas that rounding leaves
_SCALE = 1e3  # polygons are united in millimetres, in which the rounding of the library is 1e-8 mm


def cut_outline(
    mesh: ObjectMesh, R_jaw_object: ArrayLike, half_width: float, centre_y: float = 0.0
) -> tuple[NDArray, ...]:
    """Return the silhouette, in the jaw's x-z plane, of the part of an object with |y| <= half_width.

    Seen along y, the part is covered by its surface and by its section with the side y = -half_width. The edges of
    all triangles that face the observer and those of the section, each triangle's edges run along in its sense,
    cancel but for the outline, and a point is covered where the loops of the outline wind around it. A surface that
    is not closed has no sense and no inside: all its triangles count, and its sections with both sides are closed by
    the shortest chords.

    Args:
        mesh: the object.
        R_jaw_object: (3, 3), turns object axes to jaw axes.
        half_width: [m], of the slab that is kept.
        centre_y: [m], y of the object's origin in the jaw frame.

    Returns:
        Polygons (n, 2) [m] of x and z about the object's origin along the jaw's axes, closed implicitly; outer ones
        counterclockwise (x to z), holes clockwise. None where the slab misses the object.

    Raises:
        PoseError: R_jaw_object is no rotation, half_width is not positive, or a number is not finite.
        MissingDependencyError: manifold3d is not installed.
    """
    R = _check_placement(R_jaw_object, half_width, centre_y)
    points = mesh.vertices @ R.T
    points[:, 1] += centre_y
    if points[:, 1].min() >= half_width or points[:, 1].max() <= -half_width:
        return ()
    slab = _Slab(mesh=mesh, points=points, half_width=half_width)
    layers = _cover_solid(slab) if mesh.watertight else _cover_open(slab)
    return _unite([slab.trace(edges) for edges in layers])


@dataclass(frozen=True, kw_only=True, eq=False)
class _Slab:
    """An object between two planes across y, with a node where an edge meets a plane.

    Nodes are the vertices, then the edges at the lower plane, then the edges at the upper one. As they go by edges
    and not by coordinates, loops close whatever the rounding.
    """

    mesh: ObjectMesh
    points: NDArray
    half_width: float

    @cached_property
    def side(self) -> NDArray:
        """The side (n,) on which vertices lie: -1 below the slab, 0 in it, 1 above."""
        y = self.points[:, 1]
        return (y >= self.half_width).astype(np.int8) - (y < -self.half_width)

    @cached_property
    def facing(self) -> NDArray:
        """The triangles (m,) that turn from x to z, seen along y; their outside then is on the side of -y."""
        x, z = self.points[:, 0][self.mesh.triangles].T, self.points[:, 2][self.mesh.triangles].T
        return (x[1] - x[0]) * (z[2] - z[0]) > (x[2] - x[0]) * (z[1] - z[0])

    def keep_edges(self, times: NDArray) -> NDArray:
        """Return node pairs (k, 2) of the edges' parts in the slab, each so many times (e,), reversed if < 0."""
        side = self.side[self.mesh.edges.ends]
        kept = np.flatnonzero((times != 0.0) & ((side[:, 0] == 0) | (side[:, 0] != side[:, 1])))
        nodes = np.where(side[kept] == 0, self.mesh.edges.ends[kept], self._node(kept[:, None], side[kept]))
        nodes = np.where(times[kept, None] > 0.0, nodes, nodes[:, ::-1])
        return np.repeat(nodes, np.abs(times[kept]).astype(int), axis=0)

    def cut_triangles(self, plane: int) -> tuple[NDArray, NDArray]:
        """Return where triangles leave the slab over the plane on a side, -1 or 1, and come back: nodes (k, 2).

        And which of them (k,) turn from x to z.
        """
        beyond = (self.side == plane)[self.mesh.triangles]
        crossing = np.flatnonzero((beyond[:, 0] != beyond[:, 1]) | (beyond[:, 1] != beyond[:, 2]))
        here = beyond[crossing]
        following = np.roll(here, -1, axis=1)
        edges = self.mesh.edges.of_triangles[crossing]
        leaving = np.take_along_axis(edges, np.argmax(~here & following, axis=1)[:, None], axis=1)
        entering = np.take_along_axis(edges, np.argmax(here & ~following, axis=1)[:, None], axis=1)
        return self._node(np.hstack([leaving, entering]), plane), self.facing[crossing]

    def locate(self, nodes: NDArray) -> NDArray:
        """Return x and z (k, 2) [m] of nodes (k,)."""
        vertices, ends = len(self.points), self.mesh.edges.ends
        cut = np.maximum(nodes - vertices, 0)
        start, stop = self.points[ends[cut % len(ends)]].transpose(1, 0, 2)
        height = np.where(cut < len(ends), -self.half_width, self.half_width)
        with np.errstate(divide="ignore", invalid="ignore"):  # nodes that are vertices have no cut
            share = ((height - start[:, 1]) / (stop[:, 1] - start[:, 1]))[:, None]
            crossings = start + share * (stop - start)
        is_vertex = (nodes < vertices)[:, None]
        return np.where(is_vertex, self.points[np.minimum(nodes, vertices - 1)], crossings)[:, [0, 2]]

    def trace(self, edges: NDArray) -> list[NDArray]:
        """Return the loops (n, 2) [mm] of x and z that edges (k, 2) between nodes make."""
        loops = [loop for loop in chain_loops(edges[:, 0], edges[:, 1]) if len(loop) > 2]
        if not loops:
            return []
        places = _SCALE * self.locate(np.concatenate(loops))
        return np.split(places, np.cumsum([len(loop) for loop in loops])[:-1])

    def _node(self, edges: NDArray, plane: NDArray | int) -> NDArray:
        return len(self.points) + edges + np.where(np.asarray(plane) > 0, len(self.mesh.edges.ends), 0)


def _cover_solid(slab: _Slab) -> list[NDArray]:
    """Return the edges (k, 2) around what faces -y of a solid in the slab: its surface and its lower section."""
    times = slab.mesh.edges.sum_along(slab.facing.astype(float))
    (lower, below), (upper, above) = slab.cut_triangles(-1), slab.cut_triangles(1)
    # The section runs against the triangles, and so cancels the cut edges of those that face -y.
    return [np.concatenate([slab.keep_edges(times), lower[~below][:, ::-1], upper[above]])]


def _cover_open(slab: _Slab) -> list[NDArray]:
    """Return the edges (k, 2) around all triangles in the slab, and around each section, closed."""
    sense = np.where(slab.facing, 1.0, -1.0)
    surface, sections = [slab.keep_edges(slab.mesh.edges.sum_along(sense))], []
    for plane in (-1, 1):
        nodes, facing = slab.cut_triangles(plane)
        surface.append(np.where(facing[:, None], nodes, nodes[:, ::-1]))
        sections.append(np.concatenate([nodes, _bridge(slab, nodes)]))
    return [np.concatenate(surface), *sections]


def _bridge(slab: _Slab, edges: NDArray) -> NDArray:
    """Return the shortest edges (k, 2) that make closed loops of directed edges with loose ends."""
    nodes, place = np.unique(edges, return_inverse=True)
    surplus = np.bincount(place.reshape(-1, 2)[:, 1], minlength=len(nodes))
    surplus -= np.bincount(place.reshape(-1, 2)[:, 0], minlength=len(nodes))
    stops, starts = np.repeat(nodes, np.maximum(surplus, 0)), np.repeat(nodes, np.maximum(-surplus, 0))
    if not len(stops):
        return np.empty((0, 2), dtype=int)
    from scipy.optimize import linear_sum_assignment  # half a second that a given contact need not wait
    from scipy.spatial.distance import cdist

    rows, columns = linear_sum_assignment(cdist(slab.locate(stops), slab.locate(starts)))
    return np.stack([stops[rows], starts[columns]], axis=1)


def _unite(layers: list[list[NDArray]]) -> tuple[NDArray, ...]:
    """Return the outline (n, 2) [m] of all that loops (n, 2) [mm] wind around."""
    manifold3d = import_manifold3d()
    areas = [manifold3d.CrossSection(loops, manifold3d.FillRule.NonZero) for loops in layers if loops]
    whole = manifold3d.CrossSection.batch_boolean(areas, manifold3d.OpType.Add)
    polygons = [polygon / _SCALE for polygon in whole.simplify(SIMPLIFICATION * _SCALE).to_polygons()]
    return tuple(polygon for polygon in polygons if abs(_signed_area(polygon)) > _SLIVER)


def _signed_area(polygon: NDArray) -> float:
    x, z = polygon.T
    return 0.5 * float(np.dot(x, np.roll(z, -1)) - np.dot(z, np.roll(x, -1)))


def _check_placement(R_jaw_object: ArrayLike, half_width: float, centre_y: float) -> NDArray:
    """Return the rotation as an array after having refused what is none, and a slab that is none."""
    R = np.asarray(R_jaw_object, dtype=float)
    turns = R.shape == (3, 3) and np.abs(R @ R.T - np.eye(3)).max() < 1e-3 and np.linalg.det(R) > 0.0
    if not turns:  # NaN compares as false
        raise PoseError(f"R_jaw_object: got {R.tolist()}, expected a rotation (3, 3); check the pose first")
    if not (np.isfinite(half_width) and half_width > 0.0 and np.isfinite(centre_y)):
        raise PoseError(
            f"slab: got half_width {half_width} m and centre_y {centre_y} m, expected finite, the first > 0"
        )
    return R


@dataclass(frozen=True, kw_only=True, eq=False)
class ObjectSection:
    """An object's outline and where it is.

    Attributes:
        polygons: (n, 2) each, x and z [m] about the object's origin as cut.
        origin: (2,) x and z [m] of the object's origin in the jaw frame.
        tilt: turn since the cut [rad], positive from x to z.
        cut_edges: of the polygons (e, 2, 2) [m].
        across: middle and standard deviation along y of where the object stands nearest (2,) [m].
    """

    polygons: tuple[NDArray, ...]
    origin: NDArray
    tilt: float
    cut_edges: NDArray
    across: NDArray

    @cached_property
    def edges(self) -> NDArray:
        """The edges (e, 2, 2) [m], in the jaw frame now."""
        return place_edges(self.cut_edges, self.origin, self.tilt)


_SAMPLES, _PRESSED = 21, 1e-3


def find_lateral_contact(mesh: ObjectMesh, T: NDArray, half_width: float, span: tuple[float, float]) -> NDArray:
    """Return middle and standard deviation (2,) [m] along y of where an object stands nearest to the finger.

    It is taken where it would be sunk in by a millimetre, less than which turns by chance would tip it to one side.

    Args:
        mesh: the object.
        T: T_jaw_object (4, 4).
        half_width: of the finger [m].
        span: lowest and highest z of the finger [m].
    """
    points = mesh.vertices @ T[:3, :3].T + T[:3, 3]
    start, stop = points[mesh.edges.ends[:, 0]], points[mesh.edges.ends[:, 1]]
    lateral, near = half_width * np.linspace(-1.0, 1.0, _SAMPLES), np.full(_SAMPLES, np.inf)
    for row, y in enumerate(lateral):
        cut = np.flatnonzero((start[:, 1] <= y) != (stop[:, 1] <= y))
        share = (y - start[cut, 1]) / (stop[cut, 1] - start[cut, 1])
        x, z = (start[cut][:, ::2] + share[:, None] * (stop[cut] - start[cut])[:, ::2]).T
        near[row] = x[(z >= span[0]) & (z <= span[1])].min(initial=np.inf)
    if not np.isfinite(near).any():
        return np.array([0.0, half_width])
    overlap = np.maximum(0.0, near.min() + _PRESSED - near)
    overlap /= overlap.sum()
    middle = float(overlap @ lateral)
    return np.array([middle, float(np.sqrt(overlap @ (lateral - middle) ** 2))])


class SectionKeeper:
    """Cuts an object's outline anew when it turned out of the plane or moved across it, and tilts it in between.

    One that turned far in the plane is cut anew, too, unless it touches: a new outline is a new contact.
    """

    def __init__(self, mesh: ObjectMesh, half_width: float, span: tuple[float, float] = (-1.0, 1.0)) -> None:
        """Keep the mesh, half the width of the finger, which the outline is that of, and its lowest and highest z."""
        self._mesh, self._half_width, self._span = mesh, half_width, span
        self._R: NDArray | None = None
        self.cuts = 0

    def at(self, T: NDArray, *, touching: bool = False) -> ObjectSection:
        """Return the outline at T_jaw_object (4, 4), of an object that touches the jaw or not."""
        tilt = 0.0
        if self._R is None:
            self._cut(T)
        else:
            tilt, swing = split_turn(T[:3, :3] @ self._R.T)
            is_turned = abs(tilt) > _RECUT_TILT and not touching
            if swing > _RECUT_ANGLE or abs(T[1, 3] - self._y) > _RECUT_SHIFT or is_turned:
                self._cut(T)
                tilt = 0.0
        return ObjectSection(
            polygons=self._polygons, origin=T[0:3:2, 3].copy(), tilt=tilt, cut_edges=self._edges, across=self._across
        )

    def _cut(self, T: NDArray) -> None:
        self._R, self._y = T[:3, :3].copy(), float(T[1, 3])
        polygons = cut_outline(self._mesh, self._R, self._half_width, self._y)
        is_thin = bool(polygons) and (np.ptp(np.concatenate(polygons), axis=0) < CELL).any()
        self._polygons = () if is_thin and self._find_overlap() < CELL else polygons
        self._edges = edges_of(self._polygons)
        self._across = find_lateral_contact(self._mesh, T, self._half_width, self._span)
        self.cuts += 1

    def _find_overlap(self) -> float:
        """Return how far the object lies within the finger's width [m]."""
        lateral = self._mesh.vertices @ self._R[1] + self._y
        return min(float(lateral.max()), self._half_width) - max(float(lateral.min()), -self._half_width)


def split_turn(R: NDArray) -> tuple[float, float]:
    """Return a rotation's turn in the x-z plane, positive from x to z, and the angle by which it tips y, [rad].

    With the quaternion (x, y, z, w): R_02 - R_20 = 4 w y and R_00 + R_22 = 2 (w^2 - y^2), so that their quotient is the
    tangent of the twist about y, 2 atan2(y, w).
    """
    turn = -atan2(R[0, 2] - R[2, 0], R[0, 0] + R[2, 2])
    return turn, 2.0 * asin(sqrt(min(max(0.5 * (1.0 - R[1, 1]), 0.0), 1.0)))
