"""The inner surface of a jaw as a dense set of points where an object can touch."""

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from finforce_ifea.errors import MeshError
from finforce_ifea.fem.model import JawModel
from finforce_ifea.jaw.jaw import Jaw
from finforce_ifea.jaw.mesh import VolumeMesh

Across = Literal["middle", "half", "both"]
_SPACING = 0.25e-3
_ON_FACE = 1e-4
# Penalty per height [N/m per m]: soft enough for several points to share a touch, so that the force moves smoothly from
# one to the next; 10 N sink in by 0.07 mm, below what a camera sees.
_STIFFNESS = 5e7


@dataclass(frozen=True, kw_only=True, eq=False)
class ContactSurface:
    """Where an object can touch.

    Attributes:
        points: on the undeformed inner surface (p, 3) [m], rising z, all y of one height together.
        heights: the distinct heights (h,) [m].
        across: points per height.
        stiffness: penalty of each point (p,) [N/m].
        probe: the model's probe of the points; None where the model moves them by itself.
        low: least y and z of the inner face (2,) [m].
        high: largest y and z (2,) [m].
    """

    points: NDArray
    heights: NDArray
    across: int
    stiffness: NDArray
    probe: Any
    low: NDArray
    high: NDArray


def build_contact_surface(jaw: Jaw, mesh: VolumeMesh, model: JawModel, *, across: Across) -> ContactSurface:
    """Returns contact points every quarter millimetre along the inner surface.

    Args:
        jaw: the jaw.
        mesh: its undeformed mesh, whose nodes on the inner face bound the surface.
        model: its mechanics.
        across: where along y the points stand: in the "middle" for a planar model, on "half" of the width where each
            stands for its mirror image too, or on "both" halves.

    Raises:
        MeshError: The mesh has no nodes on the plane of the inner face.
    """
    face = mesh.nodes[np.abs(mesh.nodes[:, 0] - jaw.inner_face_x) < _ON_FACE]
    if len(face) < 2:
        raise MeshError(f"the mesh has no nodes on the inner face x = {jaw.inner_face_x:g} m; check inner_face_x")
    low, high = face[:, 1:].min(0), face[:, 1:].max(0)
    heights = np.arange(low[1] + _SPACING, high[1] - 0.5 * _SPACING, _SPACING)
    gauss = np.array([0.5 - 0.5 / np.sqrt(3), 0.5 + 0.5 / np.sqrt(3)])
    right, left = gauss * high[0], gauss[::-1] * low[0]
    sides = {"middle": np.zeros(1), "half": right, "both": np.r_[left, right]}[across]
    z, y = np.meshgrid(heights, sides, indexing="ij")
    points = np.stack([np.full(z.size, jaw.inner_face_x), y.ravel(), z.ravel()], axis=1)
    stiffness = np.full(len(points), _STIFFNESS * _SPACING / len(sides))
    probe = model.attach(points, 1e-3)
    return ContactSurface(
        points=points, heights=heights, across=len(sides), stiffness=stiffness, probe=probe, low=low, high=high
    )
