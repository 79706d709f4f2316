"""The location at which an outline would touch the undeformed inner face."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from finforce_contact.section import ObjectSection, compute_gaps, distances_to
from finforce_ifea.errors import MeshError
from finforce_ifea.jaw.jaw import Jaw
from finforce_ifea.jaw.mesh import VolumeMesh

_SPACING = 0.5e-3  # [m] between the heights at which gaps are measured
_OVERLAP = 0.2e-3  # [m] by which the object overlaps the face where it touches


@dataclass(frozen=True, kw_only=True, eq=False)
class InnerFace:
    """A line along the undeformed inner surface.

    Attributes:
        mesh: of the jaw.
        line: x and z (h, 2) [m], z rising.
        half_width: [m], along y.
    """

    mesh: VolumeMesh
    line: NDArray
    half_width: float

    @property
    def heights(self) -> NDArray:
        """Heights (h,) [m] of the line's points."""
        return self.line[:, 1]

    @cached_property
    def front(self) -> float:
        """The x of the surface where it stands out most [m]."""
        return float(self.line[:, 0].max())


def build_inner_face(jaw: Jaw, density: str) -> InnerFace:
    """Build the line every half millimetre along the inner surface of a jaw's mesh.

    Args:
        jaw: the jaw, with its calibration applied if the solver has one.
        density: "coarse", "default" or "fine"; a jaw with a mesh file of its own knows "default" alone.

    Raises:
        MeshError: The mesh has no triangles on the plane of the inner face.
    """
    mesh = jaw.build_mesh(density)
    on_face = jaw.face.holds(mesh.nodes)
    triangles = mesh.surface[on_face[mesh.surface].all(axis=1)]
    if not len(triangles):
        raise MeshError(f"the mesh has no triangles on the inner face x = {jaw.inner_face_x:g} m; check inner_face_x")
    places = mesh.nodes[np.unique(triangles)][:, 1:]
    (low_y, low), (high_y, high) = places.min(axis=0), places.max(axis=0)
    heights = np.arange(low + 0.5 * _SPACING, high, _SPACING)
    line = np.stack([jaw.face.read(heights), heights], axis=1)
    return InnerFace(mesh=mesh, line=line, half_width=0.5 * (high_y - low_y))


@dataclass(frozen=True, kw_only=True, eq=False)
class ContactLocation:
    """The location at which the object touches, or would touch first.

    Attributes:
        height: on the undeformed inner surface [m].
        touching: True if the meshes of object and jaw intersect.
        gap: from that surface to the object along x [m], negative where they intersect.
    """

    height: float
    touching: bool
    gap: float


class Localizer(Protocol):
    """Finds where an object touches."""

    needs_surface: bool
    """Whether it looks at the deformed surface."""

    def reset(self) -> None:
        """Forget earlier images, where any are remembered."""

    def locate(self, T: NDArray, section: ObjectSection, surface: NDArray | None) -> ContactLocation | None:
        """Return the contact, None when the object does not stand before the inner surface.

        Args:
            T: T_jaw_object (4, 4).
            section: the object's outline there.
            surface: vertices of the deformed jaw (n, 3) [m]; None: it is undeformed.
        """


class OutlineLocalizer(Localizer):
    """Takes the middle of the overlap, with the object brought along x until it overlaps the face by 0.2 mm.

    Whatever its pose errs along x drops out.
    """

    needs_surface = False

    def __init__(self, face: InnerFace) -> None:
        self._face = face

    def locate(self, T: NDArray, section: ObjectSection, surface: NDArray | None = None) -> ContactLocation | None:
        """Return the contact, None when the object does not stand before the inner surface."""
        gaps = compute_gaps(self._face.line, section.edges)
        nearest = gaps.min()
        if not np.isfinite(nearest):
            return None
        overlap = np.maximum(0.0, _OVERLAP + nearest - gaps)
        height = float(self._face.heights @ overlap / overlap.sum())
        return ContactLocation(height=height, touching=bool(nearest < 0.0), gap=float(nearest))


class ClosestLocalizer(Localizer):
    """Takes the candidate nearest to the point of the undeformed inner surface that is nearest to the object.

    Where the object is in the undeformed jaw, the deepest point counts.
    """

    needs_surface = False

    def __init__(self, jaw: Jaw, face: InnerFace) -> None:
        self._candidates = jaw.candidates[:, 2]
        self._face = face

    def locate(self, T: NDArray, section: ObjectSection, surface: NDArray | None = None) -> ContactLocation | None:
        """Return the contact, None when the object does not stand before the inner surface."""
        gaps = compute_gaps(self._face.line, section.edges)
        if not np.isfinite(gaps).any():
            return None
        gap = float(gaps.min())
        nearest = gaps if gap < 0.0 else distances_to(self._face.line, section.edges)
        height = self._face.heights[nearest.argmin()]
        candidate = self._candidates[np.abs(self._candidates - height).argmin()]
        return ContactLocation(height=float(candidate), touching=gap < 0.0, gap=gap)
