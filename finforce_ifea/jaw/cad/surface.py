"""A surface of triangles: its bodies, its repair, and its cuts; trimesh, which takes a second to load, mends it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from finforce.optional import import_trimesh

# Vertices this close [m] are one.
_SAME = 1e-9


@dataclass(frozen=True, kw_only=True, eq=False)
class Surface:
    """Triangles that share their vertices.

    Attributes:
        vertices: (n, 3) [m], each of a triangle.
        triangles: (m, 3) indices, counterclockwise as seen from outside.
    """

    vertices: NDArray
    triangles: NDArray

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
    def bounds(self) -> NDArray:
        """The lowest and the highest coordinates (2, 3) [m]."""
        return np.stack([self.vertices.min(axis=0), self.vertices.max(axis=0)])

    @property
    def extents(self) -> NDArray:
        """The size (3,) [m] along each axis."""
        return np.ptp(self.bounds, axis=0)

    @property
    def volume(self) -> float:
        """The volume [m^3] within, negative where the surface is inside out."""
        from_corner = self.vertices[self.triangles[:, 0]] - self.bounds[0]
        return float(np.einsum("mi,mi->", from_corner, self._crosses)) / 6.0

    def take(self, kept: NDArray) -> Surface:
        """Return the part of some triangles, indices or (m,) bool."""
        used, number = np.unique(self.triangles[kept], return_inverse=True)
        return Surface(vertices=self.vertices[used], triangles=number.reshape(-1, 3))

    def turned(self) -> Surface:
        """Return the surface with its inside out."""
        return Surface(vertices=self.vertices, triangles=self.triangles[:, ::-1])

    def find_doubles(self) -> NDArray:
        """Return which triangles were there before, (m,) bool."""
        _, first = np.unique(np.sort(self.triangles, axis=1), axis=0, return_index=True)
        return ~np.isin(np.arange(len(self.triangles)), first)

    @cached_property
    def _edges(self) -> tuple[NDArray, NDArray]:
        """The number (3 m,) of the edge that each side of each triangle is, and how many sides each edge is (e,)."""
        ends = np.sort(self.triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1).astype(np.int64)
        _, number, count = np.unique(
            ends[:, 0] * len(self.vertices) + ends[:, 1], return_inverse=True, return_counts=True
        )
        return number, count

    @property
    def sides_per_edge(self) -> NDArray:
        """How many triangles meet at each edge (e,): two wherever the surface is closed."""
        return self._edges[1]

    def split(self) -> list[Surface]:
        """Return the parts that hang together by edges of two triangles."""
        from scipy.sparse import coo_matrix
        from scipy.sparse.csgraph import connected_components

        number, count = self._edges
        order = np.argsort(number, kind="stable")
        one, two = (order[count[number[order]] == 2] // 3).reshape(-1, 2).T
        size = len(self.triangles)
        part = connected_components(coo_matrix((np.ones(len(one)), (one, two)), shape=(size, size)), directed=False)[1]
        order = np.argsort(part, kind="stable")
        return [self.take(triangles) for triangles in np.split(order, np.flatnonzero(np.diff(part[order])) + 1)]

    def fill_holes(self) -> Surface:
        """Return the surface with holes of a missing triangle or two closed."""
        trimesh = import_trimesh()
        mesh = trimesh.Trimesh(self.vertices, self.triangles, process=False)
        trimesh.repair.fill_holes(mesh)
        return Surface(vertices=np.array(mesh.vertices), triangles=np.array(mesh.faces))

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


def build_surface(vertices: NDArray, triangles: NDArray) -> Surface:
    """Return triangles (m, 3) of vertices (n, 3) [m], those in one place merged; triangles of fewer are left out."""
    _, first, number = np.unique(np.round(vertices / _SAME), axis=0, return_index=True, return_inverse=True)
    triangles = number.ravel()[triangles]
    has_three = (triangles != np.roll(triangles, 1, axis=1)).all(axis=1)
    return Surface(vertices=vertices[first], triangles=triangles).take(has_three)


def join_surfaces(parts: Sequence[Surface]) -> Surface:
    """Return separate surfaces as one."""
    first = np.cumsum([0, *(len(part.vertices) for part in parts[:-1])])
    triangles = [part.triangles + start for part, start in zip(parts, first, strict=True)]
    return Surface(vertices=np.concatenate([part.vertices for part in parts]), triangles=np.concatenate(triangles))
