"""The contact location by the paper's Algorithm 1 and Eq. 2: the intersection of deformed jaw and object."""

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from finforce.triangle_surface import solid_from_triangles, triangles_of_solid
from finforce_contact.errors import ObjectMeshError
from finforce_contact.location import ContactLocation, InnerFace, Localizer
from finforce_contact.mesh.object_mesh import ObjectMesh, to_manifold
from finforce_contact.section import ObjectSection
from finforce_ifea.errors import MeshError
from finforce_ifea.jaw.jaw import Jaw
from finforce_ifea.jaw.mesh import VolumeMesh

if TYPE_CHECKING:
    from manifold3d import Manifold


OFFSET = 1e-3  # [m] by which the object is pushed into the surface before contact (Eq. 2)
_MOST_BENT = 0.6  # no jaw bends by more than this share of its length


class IntersectionLocalizer(Localizer):
    """Algorithm 1 of the paper.

    While status S is false the object is brought along x into slight contact (Eq. 2); the intersection's centre leads
    to the nearest deformed vertex, from there to the undeformed one, its projection on the inner surface and the
    nearest candidate. S is true after an intersection and false after none, so that before contact every other
    image keeps the last location, as in the paper. An object that is deeper than slight contact stays where it is: to
    draw it back to the surface as it was before it bent would part the two for good.
    """

    needs_surface = True

    def __init__(self, jaw: Jaw, face: InnerFace, mesh: ObjectMesh) -> None:
        """Build the object's solid.

        Raises:
            ObjectMeshError: The mesh is not watertight.
            MissingDependencyError: manifold3d is not installed.
        """
        solid = to_manifold(mesh)
        if solid is None:
            raise ObjectMeshError(
                f"the mesh of {mesh.name} is not watertight, and mode 'paper' intersects solids; repair it, or choose "
                "mode 'estimate'"
            )
        self._candidates = jaw.candidates[:, 1:]
        self._mesh, self._front = face.mesh, face.front
        self._object = solid
        self._vertices = np.ascontiguousarray(mesh.vertices)
        self.reset()

    def reset(self) -> None:
        """Start anew, apart."""
        self._status = False
        self._height: float | None = None

    def locate(self, T: NDArray, section: ObjectSection | None, surface: NDArray | None) -> ContactLocation | None:
        """Return the contact, None before any was found; see `Localizer.locate`.

        Raises:
            MeshError: The surface is not that of the jaw's mesh.
        """
        surface = self._mesh.nodes if surface is None else check_surface(surface, self._mesh)
        shift = self._slight_contact(T) - T[0, 3] if not self._status else 0.0
        T = T.copy()
        T[0, 3] += min(shift, 0.0)
        centre = intersect(self._object, T, surface, self._mesh.surface)
        self._status = centre is not None
        if centre is not None:
            nearest = int(((surface - centre) ** 2).sum(axis=1).argmin())
            projected = self._mesh.nodes[nearest, 1:]
            chosen = int(((self._candidates - projected) ** 2).sum(axis=1).argmin())
            self._height = float(self._candidates[chosen, 1])
        if self._height is None:
            return None
        return ContactLocation(height=self._height, touching=bool(self._status and shift >= 0.0), gap=-shift)

    def _slight_contact(self, T: NDArray) -> float:
        """Return t_x = l_0 + l_bd / 2 [m] (Eq. 2), corrected for objects whose origin is not in their middle."""
        turned = self._vertices @ T[0, :3]
        low, high = turned.min(), turned.max()
        return float(self._front - OFFSET + 0.5 * (high - low) - 0.5 * (high + low))


def check_surface(surface: NDArray, mesh: VolumeMesh) -> NDArray:
    """Return a deformed surface (n, 3) [m] as floats, if it belongs to the jaw's mesh.

    Raises:
        MeshError: Another number of vertices than the mesh has, coordinates that are not finite, or vertices
            farther from their places at rest than a jaw can bend.
    """
    surface = np.ascontiguousarray(surface, dtype=float)
    if surface.shape != mesh.nodes.shape:
        raise MeshError(
            f"a deformed surface of shape {surface.shape}, expected {mesh.nodes.shape}, the jaw's mesh; "
            "give both sides the same jaw file, calibration and mesh setting (coarse, default or fine)"
        )
    moved = np.abs(surface - mesh.nodes).max()
    most = _MOST_BENT * float(np.ptp(mesh.nodes, axis=0).max())
    if not moved <= most:  # neither is what is not a number
        if not np.isfinite(surface).all():
            raise MeshError("a deformed surface with vertices that are not finite; drop it at its source")
        raise MeshError(
            f"a deformed surface with a vertex {1e3 * moved:.3g} mm from its place at rest, expected "
            f"{1e3 * most:.0f} mm at most; is it in metres, in the frame of the jaw and in the order of the mesh?"
        )
    return surface


def intersect(solid: "Manifold", T: NDArray, surface: NDArray, triangles: NDArray) -> NDArray | None:
    """Return the centre of volume (3,) [m, jaw frame] of the intersection of an object and a jaw, None if empty.

    Args:
        solid: the object's solid, object frame.
        T: T_jaw_object (4, 4).
        surface: (n, 3) [m] vertices of the jaw.
        triangles: (t, 3) of its surface.
    """
    jaw = solid_from_triangles(surface, triangles)
    if jaw is None:
        return None
    common = jaw ^ solid.transform(np.ascontiguousarray(T[:3]))
    if common.is_empty():
        return None
    vertices, faces = triangles_of_solid(common)
    return centre_of_volume(vertices, faces)


def centre_of_volume(vertices: NDArray, triangles: NDArray) -> NDArray:
    """Return the centre (3,) [m] of the volume that triangles bound: the mean of tetrahedra from a vertex."""
    a, b, c = np.moveaxis(vertices[triangles] - vertices[0], 1, 0)
    volumes = np.einsum("ij,ij->i", a, np.cross(b, c))
    total = volumes.sum()
    if total <= 0.0:
        return vertices.mean(axis=0)
    return vertices[0] + volumes @ (a + b + c) / (4.0 * total)
