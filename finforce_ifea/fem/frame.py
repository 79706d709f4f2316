"""The jaw as a planar frame of co-rotational beams, clamped at the base."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.csgraph import reverse_cuthill_mckee

from finforce_ifea.errors import MeshError
from finforce_ifea.fem.beams import (
    BeamPoints,
    Beams,
    add_beams,
    add_point_springs,
    point_loads,
    point_motions,
    point_positions,
    shape_weights,
)
from finforce_ifea.fem.factorisation import Factor, SparseFactor, factorise_banded, sparse_from_banded
from finforce_ifea.fem.model import LARGEST_MOVE, LARGEST_TURN, Linearization
from finforce_ifea.jaw.drawing import Drawing, Rib
from finforce_ifea.jaw.jaw_file import Material
from finforce_ifea.jaw.mesh import VolumeMesh

_SHEAR_CORRECTION = 5.0 / 6.0
# At a stiff joint the band does not bend over a share of the rib's thickness, and the rib bends into the band
# by a share of its own. Plane finite elements of a T, the rib 0.4 to 1 times as thick as the band, nu = 0.45,
# give 0.32 and 0.35 with sharp corners, 0.53 and 0.12 with one quadratic element per thickness.
_OVERLAP, _ROOT = 0.53, 0.12


@dataclass(frozen=True, kw_only=True)
class FrameDivisions:
    """How many beams a drawing is divided into.

    Attributes:
        between_ribs: along the bands, between two ribs, below the first and above the last.
        along_rib: along each elastic rib.
    """

    between_ribs: int = 4
    along_rib: int = 3

    def __post_init__(self) -> None:
        """Refuses less than one beam; raises MeshError."""
        if min(self.between_ribs, self.along_rib) < 1:
            raise MeshError(f"frame divisions: got {self}, expected whole numbers from 1 on")


class FrameModel:
    """A planar co-rotational frame; see `finforce_ifea.fem.model.JawModel` for what its methods take and return.

    The unknowns q (size,) are u_x, u_z [m] and the rotation [rad] of each joint, and own rotations of hinged
    beams, in an order of small bandwidth. A rotation about y is positive from z to x. Bands and ribs are wide
    and thin: they bend in plane strain, but narrow as they stretch. No point's y changes.

    Attributes:
        size, rotations, reach: see there.
    """

    def __init__(
        self,
        drawing: Drawing,
        material: Material,
        *,
        mesh: VolumeMesh | None = None,
        divisions: FrameDivisions | None = None,
    ) -> None:
        """Divides the drawing into beams.

        Args:
            drawing: the finger [m], jaw frame.
            material: Young's modulus [Pa] and Poisson's ratio.
            mesh: whose nodes `vertices` moves; without one there are no vertices.
            divisions: how many beams; None for 4 between ribs and 3 along a rib.
        """
        sketch = _Sketch(drawing, divisions or FrameDivisions())
        self.drawing, self.size = drawing, sketch.count
        self.beams, self._parts = sketch.number_beams(material), sketch.parts
        dof = self.beams.dof.reshape(-1, 8)
        self.bandwidth = int(np.where(dof < self.size, dof - dof.min(1, keepdims=True), 0).max())
        self.rotations = np.isin(np.arange(self.size), self.beams.dof[:, :, 2:])
        self.reach = np.where(self.rotations, LARGEST_TURN, LARGEST_MOVE)
        self._vertices = None if mesh is None else self.attach(mesh.nodes)

    def linearize(self, q: NDArray, *, tangent: bool = True) -> Linearization:
        """Evaluates internal force, energy and, unless `tangent` is False, the tangent stiffness at q."""
        force, storage = np.zeros(self.size + 1), np.zeros((self.bandwidth + 1, self.size), order="F")
        energy, smallest = add_beams(self.beams, q, tangent, force, storage)
        storage = storage if tangent else None
        return Linearization(force=force[:-1], energy=energy, smallest_det=smallest, tangent=storage)

    def factorise(self, tangent: NDArray) -> Factor:
        """Factorises a stored tangent; Cholesky, or LU where the state is not stable."""
        return factorise_banded(tangent) or SparseFactor(sparse_from_banded(tangent))

    def attach(self, points: NDArray, max_distance: float = 1e-3) -> BeamPoints:
        """Returns a probe of undeformed points (p, 3) [m]; raises MeshError when one is off the finger."""
        points = np.array(points, float)
        distances = self.drawing.distance_to(points)
        away = np.flatnonzero(~(distances <= max_distance))
        if len(away):
            row = away[distances[away].argmax()]
            raise MeshError(
                f"point {row} at {np.round(1e3 * points[row], 3).tolist()} mm is {1e3 * distances[row]:.3g} "
                f"mm away from the finger, expected at most {1e3 * max_distance:.3g} mm"
            )
        return _attach_to_beams(self.beams, self._parts, points)

    def positions(self, probe: BeamPoints, q: NDArray) -> NDArray:
        """Returns the deformed positions (p, 3) [m] of a probe."""
        return point_positions(self.beams, probe, q)

    def project(self, probe: BeamPoints, q: NDArray, modes: NDArray) -> NDArray:
        """Returns the motions (p, 3, k) [m] of a probe for changes modes (size, k) of the unknowns."""
        return point_motions(self.beams, probe, q, np.ascontiguousarray(modes))

    def load(self, probe: BeamPoints, q: NDArray, forces: NDArray) -> NDArray:
        """Returns the generalised load (size,) of forces (p, 3) [N] at a probe's points."""
        return point_loads(self.beams, probe, q, np.ascontiguousarray(forces))

    def stiffen(self, tangent: NDArray, probe: BeamPoints, q: NDArray, blocks: NDArray) -> None:
        """Adds springs blocks (p, 3, 3) [N/m] at a probe's points to a stored tangent, in place.

        J^T D J alone: that a force's lever changes as the beam below it turns, f . d2x/dq2, is left out. For
        10 N half a band's thickness off its centre line that is some percent of a beam's bending stiffness.
        """
        add_point_springs(self.beams, probe, q, np.ascontiguousarray(blocks), tangent)

    def vertices(self, q: NDArray) -> NDArray:
        """Returns the deformed mesh vertices (v, 3) [m], in mesh order; raises MeshError without a mesh."""
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

    def __init__(self, drawing: Drawing, divisions: FrameDivisions) -> None:
        self.drawing, self.divisions = drawing, divisions
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
        """Adds `count` beams between two ends (2, 2) on two joints; returns their numbers.

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
        """Adds a band from the clamped height over its junctions to the tip."""
        drawing, band = self.drawing, self._bands[side]
        thickness, count = band.normal_thickness, self.divisions.between_ribs
        top = drawing.length if drawing.tip_z is None else drawing.tip_z
        heights = (drawing.clamped_z, top, 0.0, drawing.length)
        base, top, start, end = (np.array([band.centre_x(z), z]) for z in heights)
        joint, beams = _Joint(base, np.full(3, -1)), []
        for rib, upper, point in zip(drawing.ribs, joints, drawing.junctions[side], strict=True):
            half = self._rigid_half(rib, side) * (end - start) / np.linalg.norm(end - start)
            beams.append(self._add_chain((joint, upper), (base, point - half), thickness, count))
            joint, base = upper, point + half
        beams.append(self._add_chain((joint, self._tip), (base, top), thickness, count))
        self.parts.append(_Part(np.stack([start, end]), thickness, np.concatenate(beams)))

    def _rigid_half(self, rib: Rib, side: int) -> float:
        """Returns how far from a junction a band does not bend [m]; the foot of a rigid bar clamps it."""
        share = 1.0 if self.drawing.bars == "rigid" else _OVERLAP * (self.drawing.joints == "stiff")
        return 0.5 * share * float(np.linalg.norm(np.ptp(self.drawing.rib_edges(rib)[:, side], axis=0)))

    def _add_rib(self, number: int, joints: tuple[_Joint, _Joint]) -> None:
        """Adds a rib from back to back of the bands, or the bar that stands for it."""
        rib, hinged = self.drawing.ribs[number], self.drawing.joints == "hinged"
        axis = self.drawing.junctions[:, number]
        if self._welded:
            below = self.parts[0].beams[[(number + 1) * self.divisions.between_ribs - 1]]
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
            beams = self._add_chain(joints, ends, rib.thickness, self.divisions.along_rib, turns)
        self.parts.append(_Part(axis, rib.thickness, beams))

    def number_beams(self, material: Material) -> Beams:
        """Returns the beams with their unknowns in reverse Cuthill-McKee order."""
        dof = np.array(self._dof)
        rows = dof.reshape(len(dof), -1)
        row, col = (index.ravel() for index in np.broadcast_arrays(rows[:, :, None], rows[:, None, :]))
        free = (row >= 0) & (col >= 0)
        graph = sparse.coo_matrix((np.ones(free.sum()), (row[free], col[free])), (self.count, self.count))
        number = np.full(self.count + 1, self.count)
        number[reverse_cuthill_mckee(graph.tocsr(), symmetric_mode=True)] = np.arange(self.count)
        ends = np.array(self._ends)
        along = ends[:, 1] - ends[:, 0]
        length = np.linalg.norm(along, axis=1)
        stiffness = _beam_stiffness(length, np.array(self._thickness), self.drawing.width, material)
        return Beams(number[dof], ends, np.array(self._arms), along / length[:, None], length, stiffness)


def _beam_stiffness(length: NDArray, thickness: NDArray, width: float, material: Material) -> NDArray:
    """Returns the stiffness (m, 5) of Timoshenko beams that bend in plane strain; see `add_beams`.

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
    """Returns what carries points (p, 3): the nearest place on the centre line of the part they lie in."""
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
    """Returns how far points (p, 2) lie outside the rectangle around a part's centre line (p,) [m]."""
    length = np.linalg.norm(part.axis[1] - part.axis[0])
    along, rest = (part.axis[1] - part.axis[0]) / length, xz - part.axis[0]
    place, side = rest @ along, np.abs(rest[:, 0] * along[1] - rest[:, 1] * along[0])
    beyond = np.maximum(np.abs(place - 0.5 * length) - 0.5 * length, 0.0)
    return np.hypot(np.maximum(side - 0.5 * part.thickness, 0.0), beyond)
