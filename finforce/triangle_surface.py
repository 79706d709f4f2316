"""A surface of triangles: its edges, bodies, volume and cuts, and the repair of what files leave open."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, TypeVar

import numpy as np
from numpy.typing import NDArray

from finforce.optional import import_manifold3d

if TYPE_CHECKING:
    from manifold3d import Manifold

_GRID_BITS = 21  # three coordinates in one integer of 64 bits
_OVERLAP = 1e-3  # [-], share of its volume in others of a part that overlaps them; parts that touch have none

SurfaceT = TypeVar("SurfaceT", bound="Surface")


@dataclass(frozen=True, kw_only=True, eq=False)
class EdgeTable:
    """The edges of a surface and the triangles along each.

    Attributes:
        ends: (e, 2) vertex indices, the smaller first.
        of_triangles: (m, 3) edge index; edge k of a triangle runs from its corner k to the next.
        directions: (m, 3) int8, +1 where a triangle runs along an edge from its smaller to its larger end, else -1.
    """

    ends: NDArray
    of_triangles: NDArray
    directions: NDArray

    @cached_property
    def uses(self) -> NDArray:
        """The number of triangles at each edge (e,): two wherever the surface is closed."""
        return np.bincount(self.of_triangles.ravel(), minlength=len(self.ends))

    @cached_property
    def pairs(self) -> NDArray:
        """The two sides (k, 2) that each edge of two triangles is: three times the triangle plus the side's number."""
        order = np.argsort(self.of_triangles, axis=None, kind="stable")
        return order[self.uses[self.of_triangles.ravel()[order]] == 2].reshape(-1, 2)

    @cached_property
    def surplus(self) -> NDArray:
        """The number (e,) of triangles that run along each edge, less those that run against it."""
        return self.sum_along(np.ones(len(self.of_triangles)))

    @cached_property
    def is_balanced(self) -> bool:
        """Each edge is run along as often one way as the other, so that the triangles bound solids."""
        return not self.surplus.any()

    def sum_along(self, weights: NDArray) -> NDArray:
        """Return the surplus (e,) with each triangle counted by a weight (m,)."""
        signed = self.directions * weights[:, None]
        return np.bincount(self.of_triangles.ravel(), weights=signed.ravel(), minlength=len(self.ends))


@dataclass(frozen=True, kw_only=True, eq=False)
class Surface:
    """Triangles that share their vertices.

    Attributes:
        vertices: (n, 3) [m], each of a triangle.
        triangles: (m, 3) indices, counterclockwise as seen from outside.
        notes: changes made to it, a sentence each.
    """

    vertices: NDArray
    triangles: NDArray
    notes: tuple[str, ...] = ()

    @cached_property
    def edges(self) -> EdgeTable:
        """The edges of the triangles."""
        starts = self.triangles.astype(np.int64)
        stops = np.roll(starts, -1, axis=1)
        low, high = np.minimum(starts, stops), np.maximum(starts, stops)
        keys, of_triangles = np.unique(low * len(self.vertices) + high, return_inverse=True)
        return EdgeTable(
            ends=np.stack(np.divmod(keys, len(self.vertices)), axis=1),
            of_triangles=of_triangles.reshape(-1, 3),
            directions=np.where(starts < stops, 1, -1).astype(np.int8),
        )

    @cached_property
    def _crosses(self) -> NDArray:
        """Twice the areas [m^2] times the normals (m, 3)."""
        first, second, third = self.vertices[self.triangles.T]
        return np.cross(second - first, third - first)

    @cached_property
    def areas(self) -> NDArray:
        """The areas (m,) [m^2]."""
        return 0.5 * np.linalg.norm(self._crosses, axis=1)

    @cached_property
    def normals(self) -> NDArray:
        """The unit normals (m, 3), zero of triangles without an area."""
        size = 2.0 * self.areas[:, None]
        return np.divide(self._crosses, size, out=np.zeros_like(self._crosses), where=size > 0.0)

    @cached_property
    def volumes(self) -> NDArray:
        """The volumes (m,) [m^3] from the mean vertex to the triangles; inward ones negative."""
        from_middle = self.vertices[self.triangles[:, 0]] - self.vertices.mean(axis=0)
        return np.einsum("mi,mi->m", from_middle, self._crosses) / 6.0

    @property
    def volume(self) -> float:
        """The volume [m^3] within, negative where the surface is inside out."""
        return float(self.volumes.sum())

    @cached_property
    def bounds(self) -> NDArray:
        """The least and the greatest coordinates (2, 3) [m]."""
        return np.stack([self.vertices.min(axis=0), self.vertices.max(axis=0)])

    @property
    def middle(self) -> NDArray:
        """The middle of the bounding box (3,) [m]."""
        return self.bounds.mean(axis=0)

    @property
    def extents(self) -> NDArray:
        """The size (3,) [m] along each axis."""
        return np.ptp(self.bounds, axis=0)

    def noted(self: SurfaceT, note: str) -> SurfaceT:
        """Return the surface with one note more."""
        return replace(self, notes=(*self.notes, note))

    def with_triangles(self: SurfaceT, vertices: NDArray, triangles: NDArray) -> SurfaceT:
        """Return the surface with other triangles (m, 3), on those of the vertices (n, 3) [m] that they use."""
        used, compact = np.unique(triangles, return_inverse=True)
        vertices = np.ascontiguousarray(vertices[used])
        return replace(self, vertices=vertices, triangles=compact.reshape(-1, 3).astype(np.int32))

    def take(self: SurfaceT, kept: NDArray | slice) -> SurfaceT:
        """Return the part of some triangles: indices, (m,) bool, or a slice."""
        return self.with_triangles(self.vertices, self.triangles[kept])

    def turn(self: SurfaceT, turned: NDArray | bool = True) -> SurfaceT:
        """Return the surface with some triangles, (m,) bool, or all of them inside out."""
        return replace(self, triangles=np.where(np.reshape(turned, (-1, 1)), self.triangles[:, ::-1], self.triangles))

    def merge_vertices(self: SurfaceT) -> SurfaceT:
        """Return the surface with vertices in one place as one, without the triangles that have a corner twice."""
        used = self.take(slice(None))
        # An even number of cells: the middle, where symmetric objects have their poles, is no rounding boundary.
        cell = used.extents.max() / (2**_GRID_BITS - 2)
        x, y, z = np.round((used.vertices - used.bounds[0]) / cell).astype(np.int64).T
        return used._merge((x << 2 * _GRID_BITS) | (y << _GRID_BITS) | z)

    def close_cracks(self: SurfaceT, reach: float) -> SurfaceT:
        """Return the surface with vertices of open edges that are within a reach [m] of each other as one."""
        from scipy.spatial import cKDTree

        loose = np.unique(self.edges.ends[self.edges.uses == 1])
        near = cKDTree(self.vertices[loose]).query_pairs(reach, output_type="ndarray")
        return self._merge(number_pieces(loose[near.T].ravel(), np.tile(np.arange(len(near)), 2), len(self.vertices)))

    def _merge(self: SurfaceT, places: NDArray) -> SurfaceT:
        """Return the surface with the vertices of one place, a number (n,), as the first of them."""
        _, first, number = np.unique(places, return_index=True, return_inverse=True)
        merged = first[number][self.triangles]
        return self.with_triangles(self.vertices, merged[(merged != np.roll(merged, 1, axis=1)).all(axis=1)])

    def drop_doubles(self: SurfaceT) -> SurfaceT:
        """Return the surface without triangles that were there before."""
        return self.take(np.sort(np.unique(np.sort(self.triangles, axis=1), axis=0, return_index=True)[1]))

    def drop_flaps(self: SurfaceT) -> SurfaceT:
        """Return the surface without triangles that are there in both senses and bound nothing; of others one each."""
        order = np.argsort(self.triangles, axis=1)
        sense = np.where(np.isin(order[:, 0] + 3 * order[:, 1], (3, 7, 2)), 1, -1)  # 0 1 2, 1 2 0 and 2 0 1
        _, place = np.unique(np.sort(self.triangles, axis=1), axis=0, return_inverse=True)
        surplus = np.bincount(place.ravel(), weights=sense)[place.ravel()]
        return self.take(sense * surplus > 0.0).drop_doubles()

    def orient(self: SurfaceT) -> SurfaceT | None:
        """Return the surface with neighbours in one sense, that of most of them; None where it has one side only.

        Of two states of each triangle, as it is and turned, those of neighbours that agree hang together.
        """
        count, sides = len(self.triangles), self.edges.pairs
        one, two = (sides // 3).T
        differs = self.edges.directions.ravel()[sides].sum(axis=1) != 0
        states = np.r_[one, one + count, two + count * differs, two + count * ~differs]
        kept, turned = number_pieces(states, np.tile(np.arange(2 * len(one)), 2), 2 * count).reshape(2, -1)
        votes = 2 * np.bincount(kept, minlength=2 * count)
        votes[np.maximum(kept, turned)] -= 1  # of as many for either, the first
        return None if (kept == turned).any() else self.turn(votes[kept] < votes[turned])

    def fill_holes(self: SurfaceT, is_small: Callable[[NDArray], bool]) -> tuple[SurfaceT, int, int]:
        """Return the surface with a fan of triangles in each hole of which the edge (k, 3) [m] is small.

        And how many were filled, and how many were left.
        """
        is_open = self.edges.uses == 1
        # A fan runs against its neighbour, whose sense is the sign of the surplus.
        against = self.edges.surplus[is_open, None] > 0.0
        loops = chain_loops(*np.where(against, self.edges.ends[is_open][:, ::-1], self.edges.ends[is_open]).T)
        holes = [loop for loop in loops if is_small(self.vertices[loop])]
        middles = [self.vertices[hole].mean(axis=0, keepdims=True) for hole in holes]
        fans = [
            np.stack([hole, np.roll(hole, -1), np.full(len(hole), len(self.vertices) + number)], axis=1)
            for number, hole in enumerate(holes)
        ]
        vertices, triangles = np.concatenate([self.vertices, *middles]), np.concatenate([self.triangles, *fans])
        return self.with_triangles(vertices, triangles), len(holes), len(loops) - len(holes)

    def label_bodies(self, most: float = 2) -> NDArray:
        """Return for each triangle the number (m,) of its body: what hangs together by edges of so many at most."""
        triangle, side = np.nonzero(self.edges.uses[self.edges.of_triangles] <= most)
        return number_pieces(triangle, self.edges.of_triangles[triangle, side], len(self.triangles))

    def split(self: SurfaceT) -> list[SurfaceT]:
        """Return the bodies."""
        body = self.label_bodies()
        order = np.argsort(body, kind="stable")
        return [self.take(part) for part in np.split(order, np.flatnonzero(np.diff(body[order])) + 1)]

    def find_crossed(self, axis: NDArray, height: float) -> NDArray:
        """Return which triangles a plane across an axis (3,) meets at a height [m] along that, (m,) bool."""
        above = (self.vertices @ axis > height)[self.triangles]
        return above.any(axis=1) & ~above.all(axis=1)

    def cut(self, axis: NDArray, height: float) -> NDArray:
        """Return the lines (k, 2, 3) [m] in which a plane across an axis (3,) cuts it, at a height [m] along that.

        What lies on the plane counts as below: lines of a closed surface always close.
        """
        away = self.vertices @ axis - height
        above = (away > 0.0)[self.triangles]
        sides = self.triangles[:, [[0, 1], [1, 2], [2, 0]]]
        # both triangles of an edge place its cut alike, to the bit
        first, second = np.sort(sides[above != np.roll(above, -1, axis=1)], axis=1).T
        share = (away[first] / (away[first] - away[second]))[:, None]
        return (self.vertices[first] + share * (self.vertices[second] - self.vertices[first])).reshape(-1, 2, 3)


def join_surfaces(parts: Sequence[Surface]) -> Surface:
    """Return separate surfaces as one."""
    first = np.cumsum([0, *(len(part.vertices) for part in parts[:-1])])
    triangles = [part.triangles + start for part, start in zip(parts, first, strict=True)]
    vertices = np.concatenate([part.vertices for part in parts])
    return replace(parts[0], vertices=vertices, triangles=np.concatenate(triangles))


def solid_from_triangles(vertices: NDArray, triangles: NDArray) -> Manifold | None:
    """Return the solid that triangles (m, 3) on vertices (n, 3) [m] bound, or None where they bound none."""
    manifold3d = import_manifold3d()
    corners = np.ascontiguousarray(vertices, dtype=np.float64)
    solid = manifold3d.Manifold(manifold3d.Mesh64(corners, np.ascontiguousarray(triangles, dtype=np.uint64)))
    sound = solid.status() == manifold3d.Error.NoError and not solid.is_empty()
    return solid if sound else None


def triangles_of_solid(solid: Manifold) -> tuple[NDArray, NDArray]:
    """Return the vertices (n, 3) [m] and the triangles (m, 3) int32 of a solid."""
    mesh = solid.to_mesh64()
    return np.array(mesh.vert_properties[:, :3]), np.array(mesh.tri_verts, dtype=np.int32)


def unite(parts: Sequence[Surface]) -> Surface | None:
    """Return surfaces that all overlap others as the one that bounds all; None where one of them does not."""
    solids = [solid_from_triangles(part.vertices, part.triangles) for part in parts]
    if len(parts) < 2 or any(solid is None for solid in solids):
        return None
    manifold3d = import_manifold3d()
    whole = manifold3d.Manifold.batch_boolean(solids, manifold3d.OpType.Add)
    for number, solid in enumerate(solids):
        others = manifold3d.Manifold.batch_boolean(solids[:number] + solids[number + 1 :], manifold3d.OpType.Add)
        if whole.volume() > others.volume() + (1.0 - _OVERLAP) * solid.volume():
            return None
    vertices, triangles = triangles_of_solid(whole)
    return Surface(vertices=vertices, triangles=triangles)


def number_pieces(rows: NDArray, columns: NDArray, count: int) -> NDArray:
    """Return for each of so many rows the number of its piece: rows (k,) hang together that share a column (k,)."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    size = count + int(columns.max(initial=-1)) + 1
    graph = coo_array((np.ones(len(rows), bool), (rows, count + columns)), shape=(size, size))
    return np.unique(connected_components(graph, directed=False)[1][:count], return_inverse=True)[1]


def chain_loops(starts: NDArray, stops: NDArray) -> list[NDArray]:
    """Return closed loops that together run along each edge once.

    Edges that do not close are left out; where every node has as many edges in as out, none is.

    Args:
        starts: (e,) node at which each edge begins.
        stops: (e,) node at which it ends.

    Returns:
        Node indices (n,) of each loop in its order; the last is joined to the first.
    """
    ways: dict[int, list[int]] = {}
    for start, stop in zip(starts.tolist(), stops.tolist(), strict=True):
        ways.setdefault(start, []).append(stop)
    loops = []
    for start in list(ways):
        while ways[start]:
            loop = _follow(ways, start)
            if loop:
                loops.append(np.array(loop))
    return loops


def _follow(ways: dict[int, list[int]], start: int) -> list[int]:
    """Take edges from the ways until back at the start; nothing when the way ends before."""
    loop, node = [], start
    while True:
        loop.append(node)
        onward = ways.get(node)
        if not onward:
            return []
        node = onward.pop()
        if node == start:
            return loop
