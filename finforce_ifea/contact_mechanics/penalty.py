"""Frictionless contact of surface points with a rigid object by a smoothed penalty."""

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from finforce_ifea.contact_mechanics.distance_field import CELL, DistanceField, read_depth

# The penalty rises quadratically over this depth [m] before it is linear, so that Newton's method sees no kink.
_SMOOTH_DEPTH = 2e-5


@dataclass(frozen=True, kw_only=True, eq=False)
class PenaltyContact:
    """Contact at surface points.

    Attributes:
        forces: on the points (p, 3) [N].
        springs: negative derivatives of the forces by the points' positions (p, 3, 3) [N/m].
        by_shape: derivatives of the forces by the object's size (p, 3) [N/m], its centre held, or by its tilt [N/rad].
    """

    forces: NDArray
    springs: NDArray
    by_shape: NDArray


@njit(cache=True, error_model="numpy")
def _resist(depth, stiffness, smooth):
    """Returns force [N] and its derivative [N/m] at a depth above zero [m]."""
    if depth < smooth:
        return 0.5 * stiffness * depth * depth / smooth, stiffness * depth / smooth
    return stiffness * (depth - 0.5 * smooth), stiffness


@njit(cache=True, error_model="numpy")
def _press_cylinder(points, stiffness, centre_x, centre_z, radius, smooth):
    count = len(points)
    forces, springs, by_shape = np.zeros((count, 3)), np.zeros((count, 3, 3)), np.zeros((count, 3))
    for p in range(count):
        dx, dz = points[p, 0] - centre_x, points[p, 2] - centre_z
        r = np.sqrt(dx * dx + dz * dz)
        depth = radius - r
        if depth <= 0.0 or r < 1e-12:
            continue
        nx, nz = dx / r, dz / r
        push, slope = _resist(depth, stiffness[p], smooth)
        forces[p, 0], forces[p, 2] = push * nx, push * nz
        by_shape[p, 0], by_shape[p, 2] = slope * nx, slope * nz
        side = push / r
        springs[p, 0, 0] = slope * nx * nx - side * nz * nz
        springs[p, 2, 2] = slope * nz * nz - side * nx * nx
        springs[p, 0, 2] = springs[p, 2, 0] = (slope + side) * nx * nz
    return forces, springs, by_shape


def measure_penalty_energy(forces: NDArray, stiffness: NDArray) -> float:
    """Returns the energy [J] that the penalty stores where it pushes with forces (p, 3) [N].

    With k = stiffness (p,) [N/m], s = 20 um and d the depth that belongs to a force it is k d^3 / (6 s) up to s, and
    k (d^2 - s^2) / 2 - k s (d - s) / 2 more beyond.
    """
    push, smooth = np.linalg.norm(forces, axis=1) / stiffness, _SMOOTH_DEPTH
    depth = np.where(push < 0.5 * smooth, np.sqrt(2.0 * smooth * push), push + 0.5 * smooth)
    beyond = np.maximum(depth - smooth, 0.0)
    cubic = np.minimum(depth, smooth) ** 3 / (6.0 * smooth)
    return float((stiffness * (cubic + 0.5 * beyond * (depth + smooth) - 0.5 * smooth * beyond)).sum())


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
    forces, springs, by_shape = _press_cylinder(points, stiffness, centre_x, centre_z, radius, _SMOOTH_DEPTH)
    return PenaltyContact(forces=forces, springs=springs, by_shape=by_shape)


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
        push, slope = _resist(depth, stiffness[p], smooth)
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
    return PenaltyContact(forces=forces, springs=springs, by_shape=np.zeros_like(forces))


@njit(cache=True, error_model="numpy")
def _press_field(points, stiffness, coefficients, low, cell, origin, c, s, smooth):
    count = len(points)
    forces, springs, by_tilt = np.zeros((count, 3)), np.zeros((count, 3, 3)), np.zeros((count, 3))
    local = np.empty((count, 2))
    for p in range(count):
        rx, rz = points[p, 0] - origin[0], points[p, 2] - origin[1]
        local[p, 0], local[p, 1] = c * rx + s * rz, c * rz - s * rx
    field = read_depth(coefficients, low, cell, local)
    for p in range(count):
        if field[p, 0] <= 0.0:
            continue
        push, slope = _resist(field[p, 0], stiffness[p], smooth)
        gx, gz = c * field[p, 1] - s * field[p, 2], s * field[p, 1] + c * field[p, 2]
        a, b, d = field[p, 3], field[p, 4], field[p, 5]
        hxx = c * c * a - 2.0 * c * s * b + s * s * d
        hzz = s * s * a + 2.0 * c * s * b + c * c * d
        hxz = c * s * (a - d) + (c * c - s * s) * b
        forces[p, 0], forces[p, 2] = -push * gx, -push * gz
        springs[p, 0, 0] = slope * gx * gx + push * hxx
        springs[p, 2, 2] = slope * gz * gz + push * hzz
        springs[p, 0, 2] = springs[p, 2, 0] = slope * gx * gz + push * hxz
        # the object turns: its force turns along, and the point slides against it
        rx, rz = points[p, 0] - origin[0], points[p, 2] - origin[1]
        by_tilt[p, 0] = -forces[p, 2] - springs[p, 0, 0] * rz + springs[p, 0, 2] * rx
        by_tilt[p, 2] = forces[p, 0] - springs[p, 2, 0] * rz + springs[p, 2, 2] * rx
    return forces, springs, by_tilt


def press_field(
    points: NDArray, stiffness: NDArray, field: DistanceField, origin: NDArray, tilt: float
) -> PenaltyContact:
    """Presses a rigid outline, endless along y, on surface points; see `press_cylinder`.

    With the depth d(p) below the outline the force is -stiffness d grad d, and its springs follow from d's second
    derivatives; `by_shape` is the derivative by the tilt [N/rad].

    Args:
        points: deformed positions (p, 3) [m].
        stiffness: of each point (p,) [N/m].
        field: of the outline.
        origin: of the outline (x, z) [m].
        tilt: turn of the outline about its origin [rad], positive from x towards z.
    """
    c, s = np.cos(tilt), np.sin(tilt)
    forces, springs, by_tilt = _press_field(
        points, stiffness, field.coefficients, field.low, CELL, np.asarray(origin), c, s, _SMOOTH_DEPTH
    )
    return PenaltyContact(forces=forces, springs=springs, by_shape=by_tilt)
