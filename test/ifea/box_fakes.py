"""A rigid box, endless along y, that tests press into a jaw."""

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from finforce_ifea.contact_mechanics.indenter import PenaltyContact, resist


@njit(cache=True, error_model="numpy")
def _press_box(points, stiffness, centre_x, centre_z, half_x, half_z, edge):
    count = len(points)
    forces, springs = np.zeros((count, 3)), np.zeros((count, 3, 3))
    for p in range(count):
        dx, dz = points[p, 0] - centre_x, points[p, 2] - centre_z
        sx, sz = (1.0 if dx >= 0 else -1.0), (1.0 if dz >= 0 else -1.0)
        ox, oz = abs(dx) - (half_x - edge), abs(dz) - (half_z - edge)
        curved = ox > 0 and oz > 0
        if curved:
            r = np.sqrt(ox * ox + oz * oz)
            nx, nz, depth = sx * ox / r, sz * oz / r, edge - r
        elif ox > oz:
            r, nx, nz, depth = 1.0, sx, 0.0, edge - ox
        else:
            r, nx, nz, depth = 1.0, 0.0, sz, edge - oz
        if depth <= 0.0:
            continue
        push, slope = resist(depth, stiffness[p])
        side = push / r if curved else 0.0
        forces[p, 0], forces[p, 2] = push * nx, push * nz
        springs[p, 0, 0] = slope * nx * nx - side * nz * nz
        springs[p, 2, 2] = slope * nz * nz - side * nx * nx
        springs[p, 0, 2] = springs[p, 2, 0] = (slope + side) * nx * nz
    return forces, springs


def press_box(
    points: NDArray, stiffness: NDArray, centre: tuple[float, float], half: tuple[float, float], edge: float
) -> PenaltyContact:
    """Press a rigid box, endless along y, with rounded edges on surface points.

    Args:
        points: deformed positions (p, 3) [m].
        stiffness: of each point (p,) [N/m].
        centre: of the box (x, z) [m].
        half: half sizes along x and z [m].
        edge: radius of the edges [m], above zero.
    """
    return PenaltyContact(*_press_box(points, stiffness, *centre, *half, edge))


@dataclass(frozen=True, kw_only=True)
class RigidBox:
    """A box with rounded edges, its faces along the jaw's axes; sizes along x and z and edge radius [m]."""

    size_x: float
    size_z: float
    edge_radius: float

    def press(self, points: NDArray, stiffness: NDArray, face_x: float, depth: float, height: float) -> PenaltyContact:
        """See `lab.presses.RigidCylinder`."""
        half = (0.5 * self.size_x, 0.5 * self.size_z)
        return press_box(points, stiffness, (face_x + half[0] - depth, height), half, self.edge_radius)
