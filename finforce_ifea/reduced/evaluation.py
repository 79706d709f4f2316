"""The jaw by its stored equilibria: full geometric nonlinearity without an element.

The unknowns q (2 n + 2,) are the loads on the n rows of the inner face (x and z interleaved) [N], whatever presses, and
the grid coordinates of the stored equilibrium that is nearest in shape. See `finforce_ifea.reduced.equilibria`.

A jaw of stored equilibria under a rigid object: the same as `RollingContact`, at the price of a look-up.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from finforce_ifea.contact_mechanics.indenter import Indenter, RoundIndenter
from finforce_ifea.contact_mechanics.pressed_jaw import PressedState, find_share_that_meets
from finforce_ifea.contact_mechanics.surface import ContactSurface
from finforce_ifea.fem.factorisation import Factor
from finforce_ifea.fem.model import LARGEST_MOVE, JawModel, Linearization
from finforce_ifea.reduced.equilibria import LARGEST_GRID_STEP, Manifold, find_grid_step
from finforce_ifea.reduced.kernels import (
    SHALLOW,
    FaceRows,
    follow,
    move_points,
    place_contact,
    place_points,
    step_contact,
)

# The depth on the grid waits until its height is so near.
_BESIDE = 1.0
_ON_FACE = 1e-9


@dataclass(frozen=True, kw_only=True, eq=False)
class ReducedProbe:
    """Material points of a reduced jaw.

    Attributes:
        points: undeformed positions (p, 3) [m].
        shapes: their motions at the stored equilibria (T, Z, 3 p) [m].
        compliance: what loads on the rows do to them (T, Z, 3 p, 2 n) [m/N], in single precision.
        rows: what share each row has in a point (p, n), for loads.
    """

    points: NDArray
    shapes: NDArray
    compliance: NDArray
    rows: NDArray


@dataclass(frozen=True, kw_only=True, eq=False)
class FacePoints:
    """Points of the inner face, which the rows beside them move.

    Attributes:
        points: undeformed positions (p, 3) [m].
        rows: what share each row has in a point (p, n).
    """

    points: NDArray
    rows: NDArray

    def spread(self, moves: NDArray) -> NDArray:
        """Returns the motions (p, 3) [m] of the points for those of the rows (2 n,) [m]."""
        out = np.zeros(self.points.shape)
        out[:, ::2] = self.rows @ moves.reshape(-1, 2)
        return out


class _Identity:
    """The factor of loads that are unknowns themselves."""

    def solve(self, b: NDArray) -> NDArray:
        """Returns b."""
        return np.asarray(b)


class ReducedModel:
    """A jaw of stored equilibria; see `finforce_ifea.fem.model.JawModel`. No springs can be added to its tangent.

    Attributes:
        size: number of unknowns.
        reach: largest change of each unknown at once (size,).
    """

    rotations = None

    def __init__(self, manifold: Manifold, full: JawModel, young_modulus: float, face_x: float) -> None:
        """Scales a manifold to a modulus [Pa] of the jaw that `full` describes, its inner face in the plane x [m]."""
        self._face_x = face_x
        factor = young_modulus / manifold.young_modulus
        self.manifold, self._full = scale_manifold(manifold, factor), full
        self.rows = manifold.loads.shape[2]
        self.size = self.rows + 2
        self.loads, self.compliance = self.manifold.loads, self.manifold.compliance
        self.shape_compliance = self.manifold.shape_compliance
        stiffness = LARGEST_MOVE / np.abs(np.diagonal(self.compliance[0, 0]))
        self.reach = np.r_[stiffness, LARGEST_GRID_STEP, manifold.loads.shape[1]]

    def linearize(self, q: NDArray, *, tangent: bool = True) -> Linearization:
        """Returns the loads that q (size,) holds, and how far its grid coordinates are from the nearest equilibrium."""
        moves = self.moves(q)
        step = find_grid_step(self.manifold.moves, moves, q[-2:])[:2]
        if q[-2] < SHALLOW:
            step = self._find_shallow_step(q, step[0])
        force = np.r_[q[:-2], -step]
        return Linearization(force=force, energy=0.5 * float(moves @ q[:-2]), smallest_det=1.0, tangent=None)

    def _find_shallow_step(self, q: NDArray, by_depth: float) -> NDArray:
        """Returns the step (2,) of grid coordinates where the loads tell the height: that first, then the depth."""
        sizes, rods = np.abs(q[:-2:2]), self.manifold.rods
        if not sizes.any():
            return np.array([by_depth, 0.0])
        height = float(sizes @ self.manifold.heights[1:] / sizes.sum())
        by_height = np.interp(height, rods, np.arange(len(rods))) - q[-1]
        return np.array([by_depth if abs(by_height) < _BESIDE else 0.0, by_height])

    def moves(self, q: NDArray) -> NDArray:
        """Returns the motions of the rows (2 n,) [m], x and z interleaved."""
        return follow(self.manifold.moves, self.compliance, self.loads, q)

    def attach(self, points: NDArray, max_distance: float = 1e-3) -> ReducedProbe | FacePoints:
        """Returns a probe of material points (p, 3) [m, undeformed]; raises MeshError when one is off the jaw."""
        points = np.array(points, float)
        low, high = self.manifold.heights[[0, -1]]
        on_face = (np.abs(points[:, 0] - self._face_x) < _ON_FACE) & (points[:, 2] >= low) & (points[:, 2] <= high)
        if on_face.all():
            return FacePoints(points=points, rows=share_rows(self.manifold.heights, points[:, 2]))
        full, basis, zero = self._full, self.manifold.basis, np.zeros(self._full.size)
        motion = full.project(full.attach(points, max_distance), zero, basis).reshape(3 * len(points), -1)
        return ReducedProbe(
            points=points,
            shapes=self.manifold.shapes @ motion.T,
            compliance=np.ascontiguousarray(motion.astype(np.float32) @ self.shape_compliance),
            rows=share_rows(self.manifold.heights, points[:, 2]),
        )

    def positions(self, probe: ReducedProbe | FacePoints, q: NDArray) -> NDArray:
        """Returns the deformed positions (p, 3) [m] of a probe."""
        if isinstance(probe, FacePoints):
            return probe.points + probe.spread(self.moves(q))
        return place_points(probe.points, probe.shapes, probe.compliance, self.loads, q)

    def project(self, probe: ReducedProbe | FacePoints, q: NDArray, modes: NDArray) -> NDArray:
        """Returns the motions (p, 3, k) [m] of a probe for changes modes (size, k) of the loads alone."""
        if isinstance(probe, FacePoints):
            now = self.moves(q)
            return np.stack([probe.spread(self.moves(q + mode) - now) for mode in modes.T], axis=2)
        return move_points(probe.compliance, q, np.ascontiguousarray(modes))

    def load(self, probe: ReducedProbe | FacePoints, q: NDArray, forces: NDArray) -> NDArray:
        """Returns the loads (size,) [N] at the rows of forces (p, 3) [N] at points of the inner face."""
        return np.r_[(probe.rows.T @ forces[:, [0, 2]]).ravel(), 0.0, 0.0]

    def factorise(self, tangent: None) -> Factor:
        """Returns the factor of the unknowns, which are loads."""
        return _Identity()

    def vertices(self, q: NDArray) -> NDArray:
        """Returns the deformed mesh vertices (v, 3) [m], in mesh order."""
        still = np.zeros((self.manifold.basis.shape[1], 1))
        shape = place_points(still, self.manifold.shapes, self.shape_compliance, self.loads, q)
        return self._full.vertices(self.manifold.basis @ shape.ravel())


def scale_manifold(manifold: Manifold, factor: float) -> Manifold:
    """Returns the manifold of a jaw whose modulus is `factor` times as large."""
    if factor == 1.0:
        return manifold
    soft = np.float32(1.0 / factor)
    return replace(
        manifold,
        young_modulus=manifold.young_modulus * factor,
        loads=manifold.loads * factor,
        compliance=manifold.compliance * soft,
        shape_compliance=manifold.shape_compliance * soft,
    )


def share_rows(heights: NDArray, places: NDArray) -> NDArray:
    """Returns what share each row has in points at `places` (p,) [m] along the face, (p, n), linear between rows.

    Args:
        heights: of the clamp, where the jaw is held, and of the rows (n + 1,) [m].
        places: of the points (p,) [m].
    """
    below = np.clip(np.searchsorted(heights, places) - 1, 0, len(heights) - 2)
    upper = np.clip((places - heights[below]) / (heights[below + 1] - heights[below]), 0.0, 1.0)
    shares, points = np.zeros((len(places), len(heights))), np.arange(len(places))
    shares[points, below], shares[points, below + 1] = 1.0 - upper, upper
    return shares[:, 1:]


# A shape this share of the finger's length from a stored one has an error of about a per cent of its force.
_FARTHEST_SHAPE = 0.0056
# A step larger than this share of what is allowed is cut where the energy rises by this share of the fall at its start.
_LARGE_STEP, _TOO_FAR, _BISECTIONS = 0.3, 0.5, 6


class ReducedContact:
    """A reduced model, its contact surface, and the object pressed into it."""

    def __init__(self, model: ReducedModel, surface: ContactSurface, face_x: float) -> None:
        """Keeps the model, its contact surface, one point per height, and the plane x = face_x [m]."""
        self.model, self.surface, self.face_x = model, surface, face_x
        self.indenter: Indenter = RoundIndenter()
        shares = share_rows(model.manifold.heights, surface.heights)
        upper = np.clip(np.searchsorted(model.manifold.heights, surface.heights) - 1, 0, shares.shape[1] - 1)
        share = shares[np.arange(len(upper)), upper]
        self._face = FaceRows(surface.points, upper - 1, share, model.manifold.rods)
        length = surface.heights[-1] - surface.heights[0]
        # the rest alone is stored on purpose where no rod was pressed in
        self._farthest = _FARTHEST_SHAPE * length if model.manifold.depths.any() else np.inf
        self._tables = (model.manifold.moves, model.compliance, model.loads)

    def begin(self, height: float) -> NDArray:
        """Returns the unknowns (size,) of the unloaded jaw that is to be touched at a height [m]."""
        q, rods = np.zeros(self.model.size), self.model.manifold.rods
        q[-1] = np.interp(height, rods, np.arange(len(rods)))
        return q

    def linearize(self, q: NDArray, place: NDArray) -> PressedState:
        """Linearises the equilibrium with the object at a place (depth, shape, height); see `RollingContact`."""
        moves = self.model.moves(q)
        points = place_contact(self._face, moves)
        contact = self.indenter.press(points, self.surface.stiffness, self.face_x, place)
        parts = (contact.forces, contact.springs, contact.by_shape)
        step = step_contact(q, self._tables, self._face, moves, points, parts)
        correction, force = step.correction, step.force
        if step.touches and step.size > _LARGE_STEP and not correction[-2:].any():
            share = self._find_share(q, points, correction, place)
            correction = share * correction
            force = share * force + (1.0 - share) * np.array([q[:-2:2].sum(), 0.0, q[1:-2:2].sum()])
        return PressedState(
            touches=step.touches,
            correction=correction,
            modes=step.modes,
            force=force,
            force_modes=step.force_modes,
            pressure_point=step.pressure_point,
            pressure_place=step.pressure_place,
            smallest_det=1.0,
            size=step.size,
            extrapolation=step.away / self._farthest,
        )

    def _find_share(self, q: NDArray, points: NDArray, step: NDArray, place: NDArray) -> float:
        """Returns the share of a step up to which the energy of jaw and object falls; corners make it rise again.

        Along a step of the loads that moves the rows by du and contact points (p, 3) by dx, it changes by
        (lambda - p)^T du, all as far as the step has gone.
        """
        after = self.model.moves(q + step)
        motion, moved = place_contact(self._face, after) - points, after - self.model.moves(q)

        def change_energy(share: float) -> float:
            contact = self.indenter.press(points + share * motion, self.surface.stiffness, self.face_x, place)
            return float((q[:-2] + share * step[:-2]) @ moved - (contact.forces * motion).sum())

        share, low, high = 1.0, 0.0, 1.0
        if change_energy(1.0) <= _TOO_FAR * abs(change_energy(0.0)):
            return 1.0
        for _ in range(_BISECTIONS):
            share = 0.5 * (low + high)
            low, high = (low, share) if change_energy(share) > 0.0 else (share, high)
        return share

    def approach(self, q: NDArray, step: NDArray, place: NDArray) -> NDArray:
        """Returns the step of a jaw that has lost contact, cut where its surface meets the object again."""

        def find_gap(share: float) -> float:
            points = place_contact(self._face, self.model.moves(q + share * step))
            return self.indenter.find_gap(points, self.face_x, place)

        return find_share_that_meets(find_gap) * step
