"""The jaw as a planar frame of co-rotational beams, clamped at the base, with its compiled loops.

A rotation about y is positive from z to x: R(a) (x, z) = (x cos a + z sin a, z cos a - x sin a). A right
angle turns (x, z) into (z, -x): the normal of a direction, and the derivative of a vector by its rotation.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from finforce.compiled import njit
from finforce_ifea.errors import MeshError
from finforce_ifea.fem.model import (
    LARGEST_MOVE,
    LARGEST_TURN,
    Across,
    Factor,
    Linearization,
    SparseFactor,
    factorise_banded,
    sparse_from_banded,
)
from finforce_ifea.jaw.attachment import check_distances
from finforce_ifea.jaw.drawing import Drawing
from finforce_ifea.jaw.jaw_file import Material
from finforce_ifea.jaw.mesh import VolumeMesh

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
    """Return q with one more entry, the zero of everything that is held."""
    full = np.zeros(len(q) + 1)
    full[: len(q)] = q
    return full


@njit(**_OPTIONS)
def _place_ends(beams, e, q, ends):
    """Fill ends (2, 6) of beam e: position, tangent, derivative of the position by the arm's rotation."""
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
    """Fill strain = (d, s, a) of `add_beams`; return chord and smallest stretch along an end's tangent."""
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
    """Fill the derivatives (4, 8) by the unknowns of chord length, motion across the chord, a, and d."""
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
def add_beams(beams: Beams, q: NDArray, force: NDArray, storage: NDArray) -> tuple[float, float]:
    """Add internal forces to force (n + 1,) and tangents to lower banded storage.

    With the chord's length l, the rotations p_1 and p_2 of the ends from the chord, s = (p_1 - p_2) / 2 and
    a = (p_1 + p_2) / 2 (Argyris's natural modes), the energy is (k_n d^2 + k_s s^2 + k_a a^2) / 2 with
    d = l - L + (b_s s^2 + b_a a^2) / 2: b is what bending takes from the chord. A Timoshenko beam has
    k_n = EA / L, k_s = 4 EI / L, k_a = 12 EI / (L (1 + P)), b_s = L / 3, b_a = L / (5 (1 + P)^2) with
    P = 12 EI / (GA' L^2); a bar has k_n alone.

    Args:
        beams: the beams.
        q: unknowns (n,) [m or rad].
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
        weights[:] = k_n, K_s, K_a, N / chord, K_a * a / (chord * chord)
        _fill_tangent(forms, weights, f, ends, H)
        _add_block(beams.dof[e], H, storage)
    return energy, smallest


@njit(**_OPTIONS)
def _fill_tangent(forms, weights, f, ends, H):
    """Fill the second derivatives H (8, 8) of a beam's energy; f (8,) are its first derivatives."""
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
    """Add a symmetric H (8, 8) at unknowns dof (2, 4), which may occur twice, to lower banded storage."""
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
    """Fill the derivatives J (2, 8) of a point's place by its beam's unknowns; return the place (x, z).

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
    """Return the deformed positions (p, 3) [m]; y stays."""
    full, ends, J = _with_held(q), np.empty((2, 6)), np.empty((2, 8))
    out = points.points.copy()
    for p in range(len(out)):
        if p == 0 or points.beam[p] != points.beam[p - 1]:
            _place_ends(beams, points.beam[p], full, ends)
        out[p, 0], out[p, 2] = _map_point(points, p, ends, J)
    return out


@njit(**_OPTIONS)
def point_motions(beams, points, q, modes):
    """Return the motions (p, 3, k) [m] of the points for changes modes (n, k) of the unknowns."""
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
    """Return the generalised load (n,) of forces (p, 3) [N]; what acts along y is held."""
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
    """Add sum_p J_p^T D_p J_p, D_p = blocks (p, 3, 3) [N/m], symmetric, to lower banded storage."""
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
    """Return the weights (p, 2, 4) of ends and tangents at xi (p,): Hermite's cubics, linear in bars."""
    step, slope, one, none = xi**2 * (3 - 2 * xi), 6 * xi * (1 - xi), np.ones_like(xi), np.zeros_like(xi)
    cubic = [
        [1 - step, length * xi * (1 - xi) ** 2, step, length * xi**2 * (xi - 1)],
        [-slope, length * (1 - xi) * (1 - 3 * xi), slope, length * xi * (3 * xi - 2)],
    ]
    linear = [[1 - xi, none, xi, none], [-one, none, one, none]]
    return np.ascontiguousarray(np.where(bends, cubic, linear).transpose(2, 0, 1))


_SHEAR_CORRECTION = 5.0 / 6.0
# At a stiff joint the band does not bend over a share of the rib's thickness, and the rib bends into the band
# by a share of its own. Plane finite elements of a T, the rib 0.4 to 1 times as thick as the band, nu = 0.45,
# give 0.32 and 0.35 with sharp corners, 0.53 and 0.12 with one quadratic element per thickness.
_OVERLAP, _ROOT = 0.53, 0.12


class FrameModel:
    """A planar co-rotational frame; see `finforce_ifea.fem.model.JawModel` for what its methods take and return.

    The unknowns q (size,) are u_x, u_z [m] and the rotation [rad] of each joint, and own rotations of hinged
    beams, in an order of small bandwidth. A rotation about y is positive from z to x. Bands and ribs are wide
    and thin: they bend in plane strain, but narrow as they stretch. No point's y changes.

    Attributes:
        size, rotations, reach: see there.
    """

    across: Across = "middle"

    def __init__(
        self,
        drawing: Drawing,
        material: Material,
        *,
        mesh: VolumeMesh | None = None,
        between_ribs: int = 4,
        along_rib: int = 3,
    ) -> None:
        """Divide the drawing into beams.

        Args:
            drawing: the finger [m], jaw frame.
            material: Young's modulus [Pa] and Poisson's ratio.
            mesh: whose nodes `vertices` moves; without one there are no vertices.
            between_ribs: beams along the bands, between two ribs, below the first and above the last.
            along_rib: beams along each elastic rib.
        """
        sketch = _Sketch(drawing, between_ribs, along_rib)
        self.drawing, self.size = drawing, sketch.count
        self.beams, self._parts = sketch.number_beams(material), sketch.parts
        dof = self.beams.dof.reshape(-1, 8)
        self.bandwidth = int(np.where(dof < self.size, dof - dof.min(1, keepdims=True), 0).max())
        self.rotations = np.isin(np.arange(self.size), self.beams.dof[:, :, 2:])
        self.reach = np.where(self.rotations, LARGEST_TURN, LARGEST_MOVE)
        self._vertices = None if mesh is None else self.attach(mesh.nodes)

    def linearize(self, q: NDArray) -> Linearization:
        """Evaluate internal force, energy and tangent stiffness at q."""
        force, storage = np.zeros(self.size + 1), np.zeros((self.bandwidth + 1, self.size), order="F")
        energy, smallest = add_beams(self.beams, q, force, storage)
        return Linearization(force=force[:-1], energy=energy, smallest_det=smallest, tangent=storage)

    def factorise(self, tangent: NDArray) -> Factor:
        """Factorise a stored tangent; Cholesky, or LU where the state is not stable."""
        return factorise_banded(tangent) or SparseFactor(sparse_from_banded(tangent))

    def attach(self, points: NDArray, max_distance: float = 1e-3) -> BeamPoints:
        """Return a probe of undeformed points (p, 3) [m]; raises MeshError when one is off the finger."""
        points = np.array(points, float)
        check_distances(points, self.drawing.distance_to(points), max_distance, "finger")
        return _attach_to_beams(self.beams, self._parts, points)

    def positions(self, probe: BeamPoints, q: NDArray) -> NDArray:
        """Return the deformed positions (p, 3) [m] of a probe."""
        return point_positions(self.beams, probe, q)

    def project(self, probe: BeamPoints, q: NDArray, modes: NDArray) -> NDArray:
        """Return the motions (p, 3, k) [m] of a probe for changes modes (size, k) of the unknowns."""
        return point_motions(self.beams, probe, q, np.ascontiguousarray(modes))

    def load(self, probe: BeamPoints, q: NDArray, forces: NDArray) -> NDArray:
        """Return the generalised load (size,) of forces (p, 3) [N] at a probe's points."""
        return point_loads(self.beams, probe, q, np.ascontiguousarray(forces))

    def stiffen(self, tangent: NDArray, probe: BeamPoints, q: NDArray, blocks: NDArray) -> None:
        """Add springs blocks (p, 3, 3) [N/m] at a probe's points to a stored tangent, in place.

        J^T D J alone: that a force's lever changes as the beam below it turns, f . d2x/dq2, is left out. For
        10 N half a band's thickness off its centre line that is some percent of a beam's bending stiffness.
        """
        add_point_springs(self.beams, probe, q, np.ascontiguousarray(blocks), tangent)

    def vertices(self, q: NDArray) -> NDArray:
        """Return the deformed mesh vertices (v, 3) [m], in mesh order; raises MeshError without a mesh."""
        if self._vertices is None:
            raise MeshError("the frame has no vertices, since it was built without a mesh: give mesh=...")
        return point_positions(self.beams, self._vertices, q)


class _Joint(NamedTuple):
    """A rigid body that beams hang on: a point (x, z) [m] and its three unknowns, -1 where it is held."""

    point: NDArray
    dof: NDArray


class _Part(NamedTuple):
    """A band or a rib: its centre line, thickness [m], and beams; points use low <= xi <= 1 of them."""

    axis: NDArray
    thickness: float
    beams: NDArray
    low: float = 0.0


class _Sketch:
    """The growing frame: unknowns, beams between joints, and the parts of the drawing that they are."""

    def __init__(self, drawing: Drawing, between_ribs: int, along_rib: int) -> None:
        self.drawing, self._between_ribs, self._along_rib = drawing, between_ribs, along_rib
        self.count = 0
        self.parts: list[_Part] = []
        self._dof, self._ends, self._arms, self._thickness = [], [], [], []
        self._welded = drawing.bars == "rigid" and drawing.joints == "stiff"
        self._bands = (drawing.inner, drawing.outer)
        middle = np.mean([band.centre_x(drawing.length) for band in self._bands])
        self._tip = self._add_joint(np.array([middle, drawing.length]))
        inner = [self._add_joint(point) for point in drawing.junctions[0]]
        outer = inner if self._welded else [self._add_joint(point) for point in drawing.junctions[1]]
        self._add_band(0, inner)
        self._add_band(1, outer)
        for number, joints in enumerate(zip(inner, outer, strict=True)):
            self._add_rib(number, joints)

    def _add_unknowns(self, count: int) -> NDArray:
        self.count += count
        return np.arange(self.count - count, self.count)

    def _add_joint(self, point: NDArray) -> _Joint:
        return _Joint(point, self._add_unknowns(3))

    def _add_chain(
        self, joints: tuple, ends: NDArray, thickness: float, count: int, turns: tuple = (None, None)
    ) -> NDArray:
        """Add `count` beams between two ends (2, 2) on two joints; return their numbers.

        An end turns with its joint, or by the unknown in `turns` that is not None. A bar's thickness is 0.
        """
        points = np.linspace(ends[0], ends[1], count + 1)
        chain = [joints[0], *(self._add_joint(point) for point in points[1:-1]), joints[1]]
        turns = [turns[0], *[None] * (count - 1), turns[1]]
        own = [joint.dof[2] if turn is None else turn for joint, turn in zip(chain, turns, strict=True)]
        dof = [[*joint.dof, turn] for joint, turn in zip(chain, own, strict=True)]
        arms = points - [joint.point for joint in chain]
        self._dof += zip(dof[:-1], dof[1:], strict=True)
        self._ends += zip(points[:-1], points[1:], strict=True)
        self._arms += zip(arms[:-1], arms[1:], strict=True)
        self._thickness += [thickness] * count
        return np.arange(len(self._dof) - count, len(self._dof))

    def _add_band(self, side: int, joints: list[_Joint]) -> None:
        """Add a band from the clamped height over its junctions to the tip."""
        drawing, band = self.drawing, self._bands[side]
        thickness, count = band.normal_thickness, self._between_ribs
        top = drawing.length if drawing.tip_z is None else drawing.tip_z
        heights = (drawing.clamped_z, top, 0.0, drawing.length)
        base, top, start, end = (np.array([band.centre_x(z), z]) for z in heights)
        joint, beams = _Joint(base, np.full(3, -1)), []
        # so far from a junction a band does not bend; the foot of a rigid bar clamps it
        share = 1.0 if drawing.bars == "rigid" else _OVERLAP * (drawing.joints == "stiff")
        for rib, upper, point in zip(drawing.ribs, joints, drawing.junctions[side], strict=True):
            rigid = 0.5 * share * float(np.linalg.norm(np.ptp(drawing.rib_edges(rib)[:, side], axis=0)))
            half = rigid * (end - start) / np.linalg.norm(end - start)
            beams.append(self._add_chain((joint, upper), (base, point - half), thickness, count))
            joint, base = upper, point + half
        beams.append(self._add_chain((joint, self._tip), (base, top), thickness, count))
        self.parts.append(_Part(np.stack([start, end]), thickness, np.concatenate(beams)))

    def _add_rib(self, number: int, joints: tuple[_Joint, _Joint]) -> None:
        """Add a rib from back to back of the bands, or the bar that stands for it."""
        rib, hinged = self.drawing.ribs[number], self.drawing.joints == "hinged"
        axis = self.drawing.junctions[:, number]
        if self._welded:
            below = self.parts[0].beams[[(number + 1) * self._between_ribs - 1]]
            self.parts.append(_Part(axis, rib.thickness, below, low=1.0))
            return
        along = (axis[1] - axis[0]) / np.linalg.norm(axis[1] - axis[0])
        root = 0.0 if hinged else _ROOT * rib.thickness
        backs = [0.5 * band.thickness / abs(along[0] - band.slope * along[1]) for band in self._bands]
        arms = [max(back - root, 0.0) if rib.thickness > 0.0 else 0.0 for back in backs]
        ends = (axis[0] + arms[0] * along, axis[1] - arms[1] * along)
        if self.drawing.bars == "rigid":
            beams = self._add_chain(joints, ends, 0.0, 1)
        else:
            turns = tuple(self._add_unknowns(2)) if hinged else (None, None)
            beams = self._add_chain(joints, ends, rib.thickness, self._along_rib, turns)
        self.parts.append(_Part(axis, rib.thickness, beams))

    def number_beams(self, material: Material) -> Beams:
        """Return the beams with their unknowns in an order of small bandwidth."""
        ends, arms, thickness = np.array(self._ends), np.array(self._arms), np.array(self._thickness)
        return build_beams(np.array(self._dof), ends, arms, thickness, self.drawing.width, material)


def build_beams(
    dof: NDArray, ends: NDArray, arms: NDArray, thickness: NDArray, width: float, material: Material
) -> Beams:
    """Return beams with their unknowns in reverse Cuthill-McKee order.

    Args:
        dof: unknowns of both ends (m, 2, 4), see `Beams`, numbered in any order; -1 for what is held.
        ends: undeformed (m, 2, 2), (x, z) [m].
        arms: from the joints to the ends (m, 2, 2) [m].
        thickness: (m,) [m], 0 for a bar.
        width: of all [m].
        material: of all.
    """
    from scipy.sparse.csgraph import reverse_cuthill_mckee

    count = int(dof.max()) + 1
    rows = dof.reshape(len(dof), -1)
    row, col = (index.ravel() for index in np.broadcast_arrays(rows[:, :, None], rows[:, None, :]))
    free = (row >= 0) & (col >= 0)
    graph = sparse.coo_matrix((np.ones(free.sum()), (row[free], col[free])), (count, count))
    number = np.full(count + 1, count)
    number[reverse_cuthill_mckee(graph.tocsr(), symmetric_mode=True)] = np.arange(count)
    along = ends[:, 1] - ends[:, 0]
    length = np.linalg.norm(along, axis=1)
    stiffness = _beam_stiffness(length, thickness, width, material)
    return Beams(number[dof], ends, arms, along / length[:, None], length, stiffness)


def _beam_stiffness(length: NDArray, thickness: NDArray, width: float, material: Material) -> NDArray:
    """Return the stiffness (m, 5) of Timoshenko beams that bend in plane strain; see `add_beams`.

    A beam without thickness is a bar, made as stiff as the thickest band is along itself, so that no larger
    number enters: the steel finger's stretch by 0.5 um under 10 N; its strips bend 10,000 times as easily.
    """
    ratio, bar = material.poisson_ratio, thickness == 0.0
    EA = material.young_modulus * np.where(bar, thickness.max(), thickness) * width
    EI = EA * thickness**2 / (12.0 * (1.0 - ratio**2))
    GA = _SHEAR_CORRECTION * EA / (2.0 * (1.0 + ratio))
    shear = 1.0 + 12.0 * EI / (GA * length**2)
    bends = np.where(bar, 0.0, length)
    k_n, k_s, k_a = EA / length, 4.0 * EI / length, 12.0 * EI / (length * shear)
    return np.stack([k_n, k_s, k_a, bends / 3.0, bends / (5.0 * shear**2)], axis=1)


def _attach_to_beams(beams: Beams, parts: list[_Part], points: NDArray) -> BeamPoints:
    """Return what carries points (p, 3): the nearest place on the centre line of the part they lie in."""
    xz = points[:, [0, 2]]
    # rounded, so that a point where two parts meet belongs to the first of them, the band, on every machine
    nearest = np.argmin([_distance_to_part(part, xz).round(12) for part in parts], axis=0)
    beam, xi = np.zeros(len(xz), np.int64), np.zeros(len(xz))
    for number, part in enumerate(parts):
        rows = np.flatnonzero(nearest == number)
        start, along = beams.ends[part.beams, 0], beams.direction[part.beams]
        length = beams.length[part.beams]
        share = np.clip(((xz[rows, None] - start) * along).sum(2) / length, part.low, 1.0)
        feet = start + (share * length)[:, :, None] * along
        best = np.linalg.norm(xz[rows, None] - feet, axis=2).round(12).argmin(1)
        beam[rows], xi[rows] = part.beams[best], share[np.arange(len(rows)), best]
    along, length = beams.direction[beam], beams.length[beam]
    rest = xz - beams.ends[beam, 0] - (xi * length)[:, None] * along
    offset = np.stack([(rest * along).sum(1), rest[:, 0] * along[:, 1] - rest[:, 1] * along[:, 0]], axis=1)
    shape = shape_weights(xi, length, beams.stiffness[beam, 1] > 0.0)
    return BeamPoints(points=points, beam=beam, shape=shape, offset=offset)


def _distance_to_part(part: _Part, xz: NDArray) -> NDArray:
    """Return how far points (p, 2) lie outside the rectangle around a part's centre line (p,) [m]."""
    length = np.linalg.norm(part.axis[1] - part.axis[0])
    along, rest = (part.axis[1] - part.axis[0]) / length, xz - part.axis[0]
    place, side = rest @ along, np.abs(rest[:, 0] * along[1] - rest[:, 1] * along[0])
    beyond = np.maximum(np.abs(place - 0.5 * length) - 0.5 * length, 0.0)
    return np.hypot(np.maximum(side - 0.5 * part.thickness, 0.0), beyond)
