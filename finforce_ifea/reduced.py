"""The jaw by its stored equilibria: full geometric nonlinearity without an element; knows no key point targets.

The unknowns q (2 n + 2,) are the loads on the n rows of the inner face (x and z interleaved) [N], whatever presses, and
the grid coordinates of the stored equilibrium that is nearest in shape. See `finforce_ifea.manifold`.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from finforce_ifea.factor import Factor
from finforce_ifea.manifold import Manifold
from finforce_ifea.model import LARGEST_MOVE, JawModel, Linearization
from finforce_ifea.nearest import LARGEST_GRID_STEP, find_grid_step
from finforce_ifea.reduced_loops import SHALLOW, follow, move_points, place_points

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
    """A jaw of stored equilibria; see `finforce_ifea.model.JawModel`. No springs can be added to its tangent.

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
