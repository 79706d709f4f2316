"""The inner face of a jaw at rest: the line that it is in the x-z plane."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from finforce_ifea.jaw.section import Section

# A point this close to the line [m] is on it; a face that leaves its plane by no more is one.
ON_FACE = 1e-4
# Spacing of the places [m] at which a curved face is read.
_SPACING = 0.1e-3
# Where a face falls away towards the tip more steeply than this [-] it has ended.
_STEEPEST = 1.0


@dataclass(frozen=True, kw_only=True, eq=False)
class FaceLine:
    """The undeformed inner face as x over z, the same all along y.

    Attributes:
        heights: z (n,) [m], rising.
        x: at the heights (n,) [m], linear in between.
        plane: x [m] of the plane from which an object's depth is counted; that of a flat face.
        is_flat: whether it is a plane x = const.
    """

    heights: NDArray
    x: NDArray
    plane: float
    is_flat: bool

    @classmethod
    def flat(cls, x: float) -> FaceLine:
        """Return the plane x [m]."""
        return cls(heights=np.array([-10.0, 10.0]), x=np.full(2, float(x)), plane=float(x), is_flat=True)

    def read(self, z: float | NDArray) -> float | NDArray:
        """Return x [m] at heights z [m]."""
        return np.interp(z, self.heights, self.x)

    def holds(self, points: NDArray, tolerance: float = ON_FACE) -> NDArray:
        """Return which of points (n, 3) [m] are on the face within a tolerance [m], (n,) bool."""
        z = points[:, 2]
        within = (z >= self.heights[0] - ON_FACE) & (z <= self.heights[-1] + ON_FACE)
        return within & (np.abs(points[:, 0] - self.read(z)) < tolerance)


def find_face(section: Section, face_x: float) -> FaceLine:
    """Return the inner face of a section: the plane x = face_x [m] where most of it is on that, else what is in front.

    It begins at the clamp and ends where it falls away towards the tip.
    """
    low = section.rings[0][:, 1].min() if section.clamped_z is None else section.clamped_z
    z = np.arange(low, section.length - 0.5 * _SPACING, _SPACING)
    x = section.reach(z)
    near = np.abs(x - face_x) < ON_FACE
    if near.mean() > 0.5 and x[: int(0.8 * len(x))].max() < face_x + ON_FACE:
        return FaceLine.flat(face_x)
    # from the middle on upwards, where it stays in front
    upper = np.flatnonzero((np.diff(x) < -_STEEPEST * _SPACING) & (z[:-1] > 0.5 * (low + section.length)))
    end = len(z)
    while len(upper) and upper[-1] >= end - 2:
        end, upper = int(upper[-1]) + 1, upper[:-1]
    return FaceLine(heights=z[:end], x=x[:end], plane=float(face_x), is_flat=False)
