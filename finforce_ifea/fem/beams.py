"""Compiled loops over planar co-rotational beams and the points that they carry.

A rotation about y is positive from z to x: R(a) (x, z) = (x cos a + z sin a, z cos a - x sin a). A right
angle turns (x, z) into (z, -x): the normal of a direction, and the derivative of a vector by its rotation.
"""

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

_OPTIONS = {"cache": True, "error_model": "numpy"}
# Rows of what a beam's deformation changes by; see `_fill_forms`.
_STRETCH, _ACROSS, _SWAY, _EXTEND = 0, 1, 2, 3


class Beams(NamedTuple):
    """Straight beams between two ends, each of which hangs on a joint by a rigid arm.

    Attributes:
        dof: unknowns of both ends (m, 2, 4): u_x and u_z of the joint [m], its rotation, which turns the arm,
            and the rotation of the beam's end [rad], the same one where the joint is stiff. The number of
            unknowns marks what is held.
        ends: undeformed ends (m, 2, 2), (x, z) [m].
        arms: from the joints to the ends (m, 2, 2), (x, z) [m].
        direction: unit vectors from the first to the second end (m, 2).
        length: undeformed (m,) [m].
        stiffness: k_n [N/m], k_s and k_a [N m], b_s and b_a [m] of `add_beams`, (m, 5).
    """

    dof: NDArray
    ends: NDArray
    arms: NDArray
    direction: NDArray
    length: NDArray
    stiffness: NDArray


class BeamPoints(NamedTuple):
    """Material points carried by beams.

    Attributes:
        points: undeformed positions (p, 3) [m], jaw frame.
        beam: the beam of each point (p,).
        shape: weights of end 1, tangent 1, end 2 and tangent 2 in the centre line and its slope (p, 2, 4).
        offset: from the centre line, along its tangent and its normal (p, 2) [m].
    """

    points: NDArray
    beam: NDArray
    shape: NDArray
    offset: NDArray


@njit(**_OPTIONS)
def _with_held(q):
    """Returns q with one more entry, the zero of everything that is held."""
    full = np.zeros(len(q) + 1)
    full[: len(q)] = q
    return full


@njit(**_OPTIONS)
def _place_ends(beams, e, q, ends):
    """Fills ends (2, 6) of beam e: position, tangent, derivative of the position by the arm's rotation."""
    tx, tz = beams.direction[e, 0], beams.direction[e, 1]
    for k in range(2):
        dof = beams.dof[e, k]
        ax, az = beams.arms[e, k, 0], beams.arms[e, k, 1]
        c, s = np.cos(q[dof[3]]), np.sin(q[dof[3]])
        ends[k, 2], ends[k, 3] = c * tx + s * tz, c * tz - s * tx
        if dof[2] != dof[3]:
            c, s = np.cos(q[dof[2]]), np.sin(q[dof[2]])
        bx, bz = c * ax + s * az, c * az - s * ax
        ends[k, 0] = beams.ends[e, k, 0] + q[dof[0]] + bx - ax
        ends[k, 1] = beams.ends[e, k, 1] + q[dof[1]] + bz - az
        ends[k, 4], ends[k, 5] = bz, -bx


@njit(**_OPTIONS)
def _measure(beams, e, ends, strain):
    """Fills strain = (d, s, a) of `add_beams`; returns chord and smallest stretch along an end's tangent."""
    ex, ez = ends[1, 0] - ends[0, 0], ends[1, 1] - ends[0, 1]
    chord = np.sqrt(ex * ex + ez * ez)
    ex, ez = ex / chord, ez / chord
    first, second = ends[0, 2] * ex + ends[0, 3] * ez, ends[1, 2] * ex + ends[1, 3] * ez
    p_1 = np.arctan2(ends[0, 2] * ez - ends[0, 3] * ex, first)
    p_2 = np.arctan2(ends[1, 2] * ez - ends[1, 3] * ex, second)
    s, a = 0.5 * (p_1 - p_2), 0.5 * (p_1 + p_2)
    bending = 0.5 * (beams.stiffness[e, 3] * s * s + beams.stiffness[e, 4] * a * a)
    strain[0], strain[1], strain[2] = chord - beams.length[e] + bending, s, a
    stretch = chord / beams.length[e]
    return chord, stretch * min(first, second) if beams.stiffness[e, 1] > 0.0 else stretch


@njit(**_OPTIONS)
def _fill_forms(ends, chord, bend_s, bend_a, forms):
    """Fills the derivatives (4, 8) by the unknowns of chord length, motion across the chord, a, and d."""
    ex, ez = (ends[1, 0] - ends[0, 0]) / chord, (ends[1, 1] - ends[0, 1]) / chord
    for k in range(2):
        sign, i = 2.0 * k - 1.0, 4 * k
        vx, vz = ends[k, 4], ends[k, 5]
        forms[_STRETCH, i], forms[_STRETCH, i + 1] = sign * ex, sign * ez
        forms[_STRETCH, i + 2], forms[_STRETCH, i + 3] = sign * (ex * vx + ez * vz), 0.0
        forms[_ACROSS, i], forms[_ACROSS, i + 1] = sign * ez, -sign * ex
        forms[_ACROSS, i + 2], forms[_ACROSS, i + 3] = sign * (ez * vx - ex * vz), 0.0
        for j in range(i, i + 4):
            forms[_SWAY, j] = (0.5 if j == i + 3 else 0.0) - forms[_ACROSS, j] / chord
            forms[_EXTEND, j] = forms[_STRETCH, j] + bend_a * forms[_SWAY, j]
        forms[_EXTEND, i + 3] -= 0.5 * sign * bend_s


@njit(**_OPTIONS)
def add_beams(beams: Beams, q: NDArray, with_tangent: bool, force: NDArray, storage: NDArray) -> tuple[float, float]:
    """Adds internal forces to force (n + 1,) and tangents to lower banded storage.

    With the chord's length l, the rotations p_1 and p_2 of the ends from the chord, s = (p_1 - p_2) / 2 and
    a = (p_1 + p_2) / 2 (Argyris's natural modes), the energy is (k_n d^2 + k_s s^2 + k_a a^2) / 2 with
    d = l - L + (b_s s^2 + b_a a^2) / 2: b is what bending takes from the chord. A Timoshenko beam has
    k_n = EA / L, k_s = 4 EI / L, k_a = 12 EI / (L (1 + P)), b_s = L / 3, b_a = L / (5 (1 + P)^2) with
    P = 12 EI / (GA' L^2); a bar has k_n alone.

    Args:
        beams: the beams.
        q: unknowns (n,) [m or rad].
        with_tangent: whether to fill the storage.
        force: internal forces [N or N m]; its last entry collects what is held.
        storage: tangent stiffness (width + 1, n).

    Returns:
        Elastic energy [J] and the smallest stretch along an end's tangent [-], 0 when an end stands upright.

    Source: Crisfield, Non-linear Finite Element Analysis of Solids and Structures 1 (1991), chapter 7.
    """
    full, energy, smallest = _with_held(q), 0.0, 1e300
    ends, strain, forms, H = np.empty((2, 6)), np.empty(3), np.empty((4, 8)), np.empty((8, 8))
    f, weights = np.empty(8), np.empty(5)
    for e in range(len(beams.length)):
        k_n, k_s, k_a, b_s, b_a = beams.stiffness[e]
        _place_ends(beams, e, full, ends)
        chord, stretch = _measure(beams, e, ends, strain)
        smallest = min(smallest, stretch)
        d, s, a = strain
        energy += 0.5 * (k_n * d * d + k_s * s * s + k_a * a * a)
        _fill_forms(ends, chord, b_s * s, b_a * a, forms)
        N = k_n * d
        K_s, K_a = k_s + N * b_s, k_a + N * b_a
        for i in range(8):
            f[i] = N * forms[_STRETCH, i] + K_a * a * forms[_SWAY, i]
        f[3] += 0.5 * K_s * s
        f[7] -= 0.5 * K_s * s
        for i in range(8):
            force[beams.dof[e, i // 4, i % 4]] += f[i]
        if with_tangent:
            weights[:] = k_n, K_s, K_a, N / chord, K_a * a / (chord * chord)
            _fill_tangent(forms, weights, f, ends, H)
            _add_block(beams.dof[e], H, storage)
    return energy, smallest


@njit(**_OPTIONS)
def _fill_tangent(forms, weights, f, ends, H):
    """Fills the second derivatives H (8, 8) of a beam's energy; f (8,) are its first derivatives."""
    k_n, K_s, K_a, along, twist = weights
    for i in range(8):
        for j in range(i + 1):
            H[i, j] = (
                k_n * forms[_EXTEND, i] * forms[_EXTEND, j]
                + K_a * forms[_SWAY, i] * forms[_SWAY, j]
                + along * forms[_ACROSS, i] * forms[_ACROSS, j]
                + twist * (forms[_STRETCH, i] * forms[_ACROSS, j] + forms[_ACROSS, i] * forms[_STRETCH, j])
            )
            H[j, i] = H[i, j]
    H[3, 3] += 0.25 * K_s
    H[7, 7] += 0.25 * K_s
    H[3, 7] -= 0.25 * K_s
    H[7, 3] -= 0.25 * K_s
    for k in range(2):
        H[4 * k + 2, 4 * k + 2] += f[4 * k] * ends[k, 5] - f[4 * k + 1] * ends[k, 4]


@njit(**_OPTIONS)
def _add_block(dof, H, storage):
    """Adds a symmetric H (8, 8) at unknowns dof (2, 4), which may occur twice, to lower banded storage."""
    n = storage.shape[1]
    for i in range(8):
        row = dof[i // 4, i % 4]
        if row >= n:
            continue
        for j in range(8):
            col = dof[j // 4, j % 4]
            if col <= row:
                storage[row - col, col] += H[i, j]


@njit(**_OPTIONS)
def _map_point(points, p, ends, J):
    """Fills the derivatives J (2, 8) of a point's place by its beam's unknowns; returns the place (x, z).

    The centre line c = shape . (P_1, t_1, P_2, t_2) is Hermite's cubic through the ends with their tangents:
    it runs on from beam to beam with the same derivative. The offset turns with the direction of c'.
    """
    w, dw = points.shape[p, 0], points.shape[p, 1]
    cx = cz = tx = tz = 0.0
    for i in range(4):
        x, z = ends[i // 2, 2 * (i % 2)], ends[i // 2, 2 * (i % 2) + 1]
        cx, cz, tx, tz = cx + w[i] * x, cz + w[i] * z, tx + dw[i] * x, tz + dw[i] * z
    speed = np.sqrt(tx * tx + tz * tz)
    tx, tz = tx / speed, tz / speed
    along, normal = points.offset[p, 0], points.offset[p, 1]
    ox, oz = along * tx + normal * tz, along * tz - normal * tx
    for i in range(8):
        k, column = i // 4, i % 4
        if column < 2:
            vx, vz = 1.0 - column, 0.0 + column
        elif column == 2:
            vx, vz = ends[k, 4], ends[k, 5]
        else:
            vx, vz = ends[k, 3], -ends[k, 2]
        part = 2 * k + column // 3
        turn = dw[part] * (tz * vx - tx * vz) / speed
        J[0, i], J[1, i] = w[part] * vx + turn * oz, w[part] * vz - turn * ox
    return cx + ox, cz + oz


@njit(**_OPTIONS)
def point_positions(beams, points, q):
    """Returns the deformed positions (p, 3) [m]; y stays."""
    full, ends, J = _with_held(q), np.empty((2, 6)), np.empty((2, 8))
    out = points.points.copy()
    for p in range(len(out)):
        if p == 0 or points.beam[p] != points.beam[p - 1]:
            _place_ends(beams, points.beam[p], full, ends)
        out[p, 0], out[p, 2] = _map_point(points, p, ends, J)
    return out


@njit(**_OPTIONS)
def point_motions(beams, points, q, modes):
    """Returns the motions (p, 3, k) [m] of the points for changes modes (n, k) of the unknowns."""
    n, count = modes.shape
    full, ends, J = _with_held(q), np.empty((2, 6)), np.empty((2, 8))
    out = np.zeros((len(points.beam), 3, count))
    for p in range(len(out)):
        if p == 0 or points.beam[p] != points.beam[p - 1]:
            _place_ends(beams, points.beam[p], full, ends)
        _map_point(points, p, ends, J)
        for i in range(8):
            dof = beams.dof[points.beam[p], i // 4, i % 4]
            if dof < n:
                for c in range(count):
                    out[p, 0, c] += J[0, i] * modes[dof, c]
                    out[p, 2, c] += J[1, i] * modes[dof, c]
    return out


@njit(**_OPTIONS)
def point_loads(beams, points, q, forces):
    """Returns the generalised load (n,) of forces (p, 3) [N]; what acts along y is held."""
    full, ends, J = _with_held(q), np.empty((2, 6)), np.empty((2, 8))
    out = np.zeros(len(full))
    for p in range(len(forces)):
        if forces[p, 0] == 0.0 and forces[p, 2] == 0.0:
            continue
        _place_ends(beams, points.beam[p], full, ends)
        _map_point(points, p, ends, J)
        for i in range(8):
            out[beams.dof[points.beam[p], i // 4, i % 4]] += J[0, i] * forces[p, 0] + J[1, i] * forces[p, 2]
    return out[: len(q)]


@njit(**_OPTIONS)
def add_point_springs(beams, points, q, blocks, storage):
    """Adds sum_p J_p^T D_p J_p, D_p = blocks (p, 3, 3) [N/m], symmetric, to lower banded storage."""
    full, ends, J, H = _with_held(q), np.empty((2, 6)), np.empty((2, 8)), np.empty((8, 8))
    for p in range(len(blocks)):
        xx, xz, zz = blocks[p, 0, 0], blocks[p, 0, 2], blocks[p, 2, 2]
        if xx == 0.0 and xz == 0.0 and zz == 0.0:
            continue
        _place_ends(beams, points.beam[p], full, ends)
        _map_point(points, p, ends, J)
        for i in range(8):
            gx, gz = xx * J[0, i] + xz * J[1, i], xz * J[0, i] + zz * J[1, i]
            for j in range(8):
                H[i, j] = gx * J[0, j] + gz * J[1, j]
        _add_block(beams.dof[points.beam[p]], H, storage)


def shape_weights(xi: NDArray, length: NDArray, bends: NDArray) -> NDArray:
    """Returns the weights (p, 2, 4) of ends and tangents at xi (p,): Hermite's cubics, linear in bars."""
    step, slope, one, none = xi**2 * (3 - 2 * xi), 6 * xi * (1 - xi), np.ones_like(xi), np.zeros_like(xi)
    cubic = [
        [1 - step, length * xi * (1 - xi) ** 2, step, length * xi**2 * (xi - 1)],
        [-slope, length * (1 - xi) * (1 - 3 * xi), slope, length * xi * (3 * xi - 2)],
    ]
    linear = [[1 - xi, none, xi, none], [-one, none, one, none]]
    return np.ascontiguousarray(np.where(bends, cubic, linear).transpose(2, 0, 1))
