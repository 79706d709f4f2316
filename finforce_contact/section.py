"""The outline of an object in the finger's plane, cut when its pose needs it; knows no jaw and no contact."""

from dataclasses import dataclass
from functools import cached_property
from math import asin, atan2, sqrt

from numpy.typing import NDArray

from finforce_contact.gaps import Edges, edges_of, place_edges
from finforce_contact.object_mesh import ObjectMesh
from finforce_contact.outlines import cut_outline
from finforce_contact.settings import ContactSettings


@dataclass(frozen=True, kw_only=True, eq=False)
class Section:
    """An object's outline and where it is.

    Attributes:
        polygons: (n, 2) each, x and z [m] about the object's origin as cut.
        origin: (2,) x and z [m] of the object's origin in the jaw frame.
        tilt: turn since the cut [rad], positive from x to z.
        cut_edges: of the polygons.
    """

    polygons: tuple[NDArray, ...]
    origin: NDArray
    tilt: float
    cut_edges: Edges

    @cached_property
    def edges(self) -> Edges:
        """The edges in the jaw frame now."""
        return place_edges(self.cut_edges, self.origin, self.tilt)


class SectionKeeper:
    """Cuts an object's outline anew when it turned out of the plane or moved across it, and tilts it in between."""

    def __init__(self, mesh: ObjectMesh, half_width: float, settings: ContactSettings) -> None:
        """Keeps the mesh and half the width [m] of the finger, which the outline is that of."""
        self._mesh, self._half_width, self._settings = mesh, half_width, settings
        self._R: NDArray | None = None
        self.cuts = 0

    def at(self, T: NDArray) -> Section:
        """Returns the outline at T_jaw_object (4, 4)."""
        tilt = 0.0
        if self._R is None:
            self._cut(T)
        else:
            tilt, swing = split_turn(T[:3, :3] @ self._R.T)
            if swing > self._settings.recut_angle or abs(T[1, 3] - self._y) > self._settings.recut_shift:
                self._cut(T)
                tilt = 0.0
        return Section(polygons=self._polygons, origin=T[0:3:2, 3].copy(), tilt=tilt, cut_edges=self._edges)

    def _cut(self, T: NDArray) -> None:
        self._R, self._y = T[:3, :3].copy(), float(T[1, 3])
        self._polygons = cut_outline(self._mesh, self._R, self._half_width, self._y)
        self._edges = edges_of(self._polygons)
        self.cuts += 1


def split_turn(R: NDArray) -> tuple[float, float]:
    """Returns a rotation's turn in the x-z plane, positive from x to z, and the angle by which it tips y, [rad].

    With the quaternion (x, y, z, w): R_02 - R_20 = 4 w y and R_00 + R_22 = 2 (w^2 - y^2), so that their quotient is the
    tangent of the twist about y, 2 atan2(y, w).
    """
    turn = -atan2(R[0, 2] - R[2, 0], R[0, 0] + R[2, 2])
    return turn, 2.0 * asin(sqrt(min(max(0.5 * (1.0 - R[1, 1]), 0.0), 1.0)))
