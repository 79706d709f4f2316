"""The inner surface of a jaw's mesh as a dense line of heights, at rest and deformed."""

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from finforce_contact.errors import to_floats
from finforce_ifea.errors import MeshError
from finforce_ifea.jaw.jaw import Jaw
from finforce_ifea.jaw.mesh import VolumeMesh

_SPACING = 0.5e-3
_ON_FACE = 1e-4
# No jaw bends by more than this share of its length.
_MOST_BENT = 0.6
# Where across the width the line is averaged, as shares of the half width.
_ACROSS = np.array([-0.8, 0.0, 0.8])


@dataclass(frozen=True, kw_only=True, eq=False)
class InnerFace:
    """A line along the inner surface, averaged over the width.

    Attributes:
        mesh: of the jaw, undeformed.
        heights: (h,) [m] on the undeformed surface, rising.
        x: [m], the plane of the undeformed surface.
        half_width: [m], along y.
        nodes: (h, m) mesh nodes that carry each height.
        weights: (h, m) of these nodes [-], rows sum to one.
    """

    mesh: VolumeMesh
    heights: NDArray
    x: float
    half_width: float
    nodes: NDArray
    weights: NDArray

    def check_surface(self, surface: NDArray) -> NDArray:
        """Returns a deformed surface (n, 3) [m] as floats after having refused what does not belong to the mesh.

        Raises:
            MeshError: Another number of vertices than the mesh has, coordinates that are not finite, or vertices
                farther from their places at rest than a jaw can bend.
        """
        surface = np.ascontiguousarray(to_floats(surface, "a deformed surface", MeshError))
        if surface.shape != self.mesh.nodes.shape:
            raise MeshError(
                f"a deformed surface of shape {surface.shape}, expected {self.mesh.nodes.shape}, the jaw's mesh; "
                "give both sides the same jaw file, calibration and mesh setting (coarse, default or fine)"
            )
        if not np.isfinite(surface).all():
            raise MeshError("a deformed surface with vertices that are not finite; drop it at its source")
        moved, most = np.abs(surface - self.mesh.nodes).max(), _MOST_BENT * np.ptp(self.mesh.nodes, axis=0).max()
        if moved > most:
            raise MeshError(
                f"a deformed surface with a vertex {1e3 * moved:.3g} mm from its place at rest, expected "
                f"{1e3 * most:.0f} mm at most; is it in metres, in the frame of the jaw and in the order of the mesh?"
            )
        return surface

    def deform(self, surface: NDArray) -> NDArray:
        """Returns x and z (h, 2) [m] of the line on a deformed surface (n, 3) [m] in mesh order."""
        return _average(surface, self.nodes, self.weights)


def build_inner_face(jaw: Jaw, density: str) -> InnerFace:
    """Builds the line every half millimetre along the inner surface of a jaw's mesh.

    Args:
        jaw: the jaw, with its calibration applied if the solver has one.
        density: "coarse", "default" or "fine"; a jaw with a mesh file of its own knows "default" alone.

    Raises:
        MeshError: The mesh has no triangles on the plane of the inner face.
    """
    mesh = jaw.build_mesh(density)
    on_face = np.abs(mesh.nodes[:, 0] - jaw.inner_face_x) < _ON_FACE
    triangles = mesh.surface[on_face[mesh.surface].all(axis=1)]
    if not len(triangles):
        raise MeshError(f"the mesh has no triangles on the inner face x = {jaw.inner_face_x:g} m; check inner_face_x")
    places = mesh.nodes[np.unique(triangles)][:, 1:]
    (low_y, low), (high_y, high) = places.min(axis=0), places.max(axis=0)
    heights = np.arange(low + 0.5 * _SPACING, high, _SPACING)
    middle, half_width = 0.5 * (low_y + high_y), 0.5 * (high_y - low_y)
    samples = np.stack(np.meshgrid(middle + half_width * _ACROSS, heights), axis=-1).reshape(-1, 2)
    chosen, shares = _locate(mesh.nodes[triangles][:, :, 1:], samples)
    return InnerFace(
        mesh=mesh,
        heights=heights,
        x=jaw.inner_face_x,
        half_width=half_width,
        nodes=triangles[chosen].reshape(len(heights), -1),
        weights=shares.reshape(len(heights), -1) / len(_ACROSS),
    )


def _locate(corners: NDArray, samples: NDArray) -> tuple[NDArray, NDArray]:
    """Returns the triangle of corners (t, 3, 2) that each sample (p, 2) is in, and its shares of the corners (p, 3)."""
    origin, first, second = corners[:, 0], corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    area = first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0]
    offset = samples[:, None] - origin
    b = (offset[..., 0] * second[:, 1] - offset[..., 1] * second[:, 0]) / area
    c = (first[:, 0] * offset[..., 1] - first[:, 1] * offset[..., 0]) / area
    shares = np.stack([1.0 - b - c, b, c], axis=-1)
    chosen = shares.min(axis=-1).argmax(axis=1)
    return chosen, shares[np.arange(len(samples)), chosen]


@njit(cache=True, error_model="numpy")
def _average(surface, nodes, weights):
    """Returns the weighted x and z (h, 2) of nodes (h, m)."""
    line = np.zeros((len(nodes), 2))
    for h in range(len(nodes)):
        for k in range(nodes.shape[1]):
            line[h, 0] += weights[h, k] * surface[nodes[h, k], 0]
            line[h, 1] += weights[h, k] * surface[nodes[h, k], 2]
    return line
