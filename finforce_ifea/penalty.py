"""Frictionless contact of surface points with a rigid object by a smoothed penalty; knows no jaw."""

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

# The penalty rises quadratically over this depth [m] before it is linear, so that Newton's method sees no kink.
_SMOOTH_DEPTH = 2e-5


@dataclass(frozen=True, kw_only=True, eq=False)
class PenaltyContact:
    """Contact at surface points.

    Attributes:
        forces: on the points (p, 3) [N].
        springs: negative derivatives of the forces by the points' positions (p, 3, 3) [N/m].
        by_size: derivatives of the forces by the object's size (p, 3) [N/m], its centre held.
    """

    forces: NDArray
    springs: NDArray
    by_size: NDArray


@njit(cache=True, error_model="numpy")
def _press_cylinder(points, stiffness, centre_x, centre_z, radius, smooth):
    count = len(points)
    forces, springs, by_size = np.zeros((count, 3)), np.zeros((count, 3, 3)), np.zeros((count, 3))
    for p in range(count):
        dx, dz = points[p, 0] - centre_x, points[p, 2] - centre_z
        r = np.sqrt(dx * dx + dz * dz)
        depth = radius - r
        if depth <= 0.0 or r < 1e-12:
            continue
        nx, nz = dx / r, dz / r
        if depth < smooth:
            push, slope = 0.5 * depth * depth / smooth, depth / smooth
        else:
            push, slope = depth - 0.5 * smooth, 1.0
        push, slope = push * stiffness[p], slope * stiffness[p]
        forces[p, 0], forces[p, 2] = push * nx, push * nz
        by_size[p, 0], by_size[p, 2] = slope * nx, slope * nz
        side = push / r
        springs[p, 0, 0] = slope * nx * nx - side * nz * nz
        springs[p, 2, 2] = slope * nz * nz - side * nx * nx
        springs[p, 0, 2] = springs[p, 2, 0] = (slope + side) * nx * nz
    return forces, springs, by_size


def press_cylinder(
    points: NDArray, stiffness: NDArray, centre_x: float, centre_z: float, radius: float
) -> PenaltyContact:
    """Presses a rigid cylinder, axis along y, on surface points.

    With the penetration d = radius - r the force is stiffness d n (quadratic below 20 um), n from the axis outwards.

    Args:
        points: deformed positions (p, 3) [m].
        stiffness: of each point (p,) [N/m].
        centre_x: of the axis [m].
        centre_z: of the axis [m].
        radius: of the cylinder [m].
    """
    forces, springs, by_size = _press_cylinder(points, stiffness, centre_x, centre_z, radius, _SMOOTH_DEPTH)
    return PenaltyContact(forces=forces, springs=springs, by_size=by_size)


@njit(cache=True, error_model="numpy")
def _press_box(points, stiffness, centre_x, centre_z, half_x, half_z, edge, smooth):
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
        if depth < smooth:
            push, slope = 0.5 * depth * depth / smooth, depth / smooth
        else:
            push, slope = depth - 0.5 * smooth, 1.0
        push, slope = push * stiffness[p], slope * stiffness[p]
        side = push / r if curved else 0.0
        forces[p, 0], forces[p, 2] = push * nx, push * nz
        springs[p, 0, 0] = slope * nx * nx - side * nz * nz
        springs[p, 2, 2] = slope * nz * nz - side * nx * nx
        springs[p, 0, 2] = springs[p, 2, 0] = (slope + side) * nx * nz
    return forces, springs


def press_box(
    points: NDArray, stiffness: NDArray, centre: tuple[float, float], half: tuple[float, float], edge: float
) -> PenaltyContact:
    """Presses a rigid box, endless along y, with rounded edges on surface points; see `press_cylinder`.

    Args:
        points: deformed positions (p, 3) [m].
        stiffness: of each point (p,) [N/m].
        centre: of the box (x, z) [m].
        half: half sizes along x and z [m].
        edge: radius of the edges [m], above zero.
    """
    forces, springs = _press_box(points, stiffness, *centre, *half, edge, _SMOOTH_DEPTH)
    return PenaltyContact(forces=forces, springs=springs, by_size=np.zeros_like(forces))
