"""The triangles of an object and their edges as records, and the solids that manifold3d makes of them."""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from finforce.optional import import_manifold3d


@dataclass(frozen=True, kw_only=True, eq=False)
class EdgeTable:
    """The edges of a triangle mesh and the triangles along each.

    Attributes:
        ends: (e, 2) vertex indices, the smaller first.
        of_triangles: (m, 3) edge index; edge k of a triangle runs from its corner k to the next.
        directions: (m, 3) int8, +1 where a triangle runs along an edge from its smaller to its larger end, else -1.
    """

    ends: NDArray
    of_triangles: NDArray
    directions: NDArray

    @cached_property
    def is_balanced(self) -> bool:
        """Each edge is run along as often one way as the other, so that the triangles bound solids."""
        return not self.surplus.any()

    @cached_property
    def is_branching(self) -> bool:
        """More than two triangles meet at some edge."""
        return bool(np.bincount(self.of_triangles.ravel()).max(initial=0) > 2)

    @cached_property
    def open_share(self) -> float:
        """Share [-] of the edges that belong to one triangle only, 1 where no two triangles are neighbours."""
        uses = np.bincount(self.of_triangles.ravel(), minlength=len(self.ends))
        return float((uses == 1).mean()) if len(uses) else 0.0

    @cached_property
    def is_consistent(self) -> bool:
        """Neighbours run along their common edge in opposite ways; holes do not matter."""
        return bool(np.abs(self.surplus).max(initial=0.0) <= 1.0)

    @cached_property
    def surplus(self) -> NDArray:
        """How often (e,) triangles run along each edge, less how often against it."""
        return self.sum_along(np.ones(len(self.of_triangles)))

    def sum_along(self, weights: NDArray) -> NDArray:
        """Return the same with each triangle counted by a weight (m,)."""
        signed = self.directions * weights[:, None]
        return np.bincount(self.of_triangles.ravel(), weights=signed.ravel(), minlength=len(self.ends))


@dataclass(frozen=True, kw_only=True, eq=False)
class ObjectMesh:
    """The surface of an object in its own frame.

    Attributes:
        vertices: (n, 3) [m], object frame.
        triangles: (m, 3) int32, counterclockwise seen from outside.
        watertight: the triangles bound solids without a gap.
        name: what messages call the object.
        notes: what was repaired or decimated, a sentence each.
    """

    vertices: NDArray
    triangles: NDArray
    watertight: bool
    name: str
    notes: tuple[str, ...] = ()

    @cached_property
    def edges(self) -> EdgeTable:
        """The edges of the triangles, found once."""
        return build_edge_table(self.triangles)

    @cached_property
    def bounds(self) -> NDArray:
        """Least and greatest coordinates (2, 3) [m]."""
        return np.array([self.vertices.min(axis=0), self.vertices.max(axis=0)])

    @property
    def middle(self) -> NDArray:
        """The middle of the bounding box (3,) [m]."""
        return 0.5 * (self.bounds[0] + self.bounds[1])

    def with_triangles(self, vertices: NDArray, triangles: NDArray, note: str = "") -> "ObjectMesh":
        """Return the object with other triangles (m, 3), on those of the vertices (n, 3) that they use, and a note."""
        used, compact = np.unique(triangles, return_inverse=True)
        return replace(
            self,
            vertices=np.ascontiguousarray(vertices[used]),
            triangles=compact.reshape(-1, 3).astype(np.int32),
            notes=(*self.notes, note) if note else self.notes,
        )


def build_edge_table(triangles: NDArray) -> EdgeTable:
    """Return the edges of triangles (m, 3), each edge once."""
    starts = triangles.astype(np.int64)
    stops = np.roll(starts, -1, axis=1)
    low, high = np.minimum(starts, stops), np.maximum(starts, stops)
    base = int(high.max(initial=0)) + 1
    keys, of_triangles = np.unique(low * base + high, return_inverse=True)
    return EdgeTable(
        ends=np.stack([keys // base, keys % base], axis=1),
        of_triangles=of_triangles.reshape(-1, 3),
        directions=np.where(starts < stops, 1, -1).astype(np.int8),
    )


def compute_areas(vertices: NDArray, triangles: NDArray) -> NDArray:
    """Return the areas (m,) [m^2] of triangles (m, 3) on vertices (n, 3) [m]."""
    first, second, third = vertices[triangles].transpose(1, 0, 2)
    return 0.5 * np.linalg.norm(np.cross(second - first, third - first), axis=1)


def compute_volumes(vertices: NDArray, triangles: NDArray) -> NDArray:
    """Return the volumes (m,) [m^3] from the mean vertex to the triangles, det(a, b, c) / 6; inward ones negative."""
    first, second, third = (vertices - vertices.mean(axis=0))[triangles].transpose(1, 0, 2)
    return np.einsum("ij,ij->i", first, np.cross(second, third)) / 6.0


if TYPE_CHECKING:
    from manifold3d import Manifold


def to_manifold(mesh: "ObjectMesh") -> "Manifold | None":
    """Return the solid that a mesh bounds, in metres and in the object frame; None where it is not watertight.

    Building it takes some 0.7 ms per thousand triangles: keep it.

    Raises:
        MissingDependencyError: manifold3d is not installed.
    """
    return solid_from_triangles(mesh.vertices, mesh.triangles) if mesh.watertight else None


def solid_from_triangles(vertices: NDArray, triangles: NDArray) -> "Manifold | None":
    """Return the solid that triangles (m, 3) on vertices (n, 3) [m] bound, or None where they bound none."""
    manifold3d = import_manifold3d()
    corners = np.ascontiguousarray(vertices, dtype=np.float64)
    solid = manifold3d.Manifold(manifold3d.Mesh64(corners, np.ascontiguousarray(triangles, dtype=np.uint64)))
    sound = solid.status() == manifold3d.Error.NoError and not solid.is_empty()
    return solid if sound else None


def triangles_of_solid(solid: "Manifold") -> tuple[NDArray, NDArray]:
    """Return the vertices (n, 3) [m] and the triangles (m, 3) int32 of a solid."""
    mesh = solid.to_mesh64()
    return np.array(mesh.vert_properties[:, :3]), np.array(mesh.tri_verts, dtype=np.int32)
