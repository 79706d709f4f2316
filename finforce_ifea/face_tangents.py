"""What loads on the rows of a jaw's inner face do to it at an equilibrium; knows no manifold and no object."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.linalg import eigh
from scipy.sparse.linalg import splu

from finforce_ifea.mechanics import Mechanics

# Loads below this share of the largest are rounding errors; rows that the mesh cannot tell apart share a load.
_NOTHING, _RIDGE = 1e-7, 1e-9
_EVERY = 3
# Of the responses of one equilibrium so many combinations say nearly all.
_LEADING = 12


@dataclass(frozen=True, kw_only=True, eq=False)
class FaceTangent:
    """One equilibrium at the rows, x and z of each interleaved (2 n,).

    Attributes:
        load: that holds the jaw (2 n,) [N].
        move: of the rows (2 n,) [m].
        compliance: of the rows (2 n, 2 n) [m/N].
        shape: of the unknowns in the basis (r,).
        shape_compliance: (r, 2 n).
    """

    load: NDArray
    move: NDArray
    compliance: NDArray
    shape: NDArray
    shape_compliance: NDArray


class Face:
    """The rows of the inner face as the full model moves them.

    Attributes:
        basis: shapes of the unknowns (size, r), orthonormal; to be set before an equilibrium is described.
    """

    def __init__(self, mechanics: Mechanics, heights: NDArray) -> None:
        """Keeps the rows at heights (n,) [m]."""
        surface, self._model = mechanics.contact.surface, mechanics.model
        across = surface.points[: surface.across, 1]
        points = np.array([[mechanics.contact.face_x, y, z] for z in heights for y in across])
        self._probe, self._across, self._count = self._model.attach(points, 1e-3), len(across), len(heights)
        self.basis = np.zeros((self._model.size, 0))

    def describe(self, q: NDArray) -> FaceTangent:
        """Returns the equilibrium of unknowns q (size,) and what unit loads at the rows do to it."""
        model, count = self._model, 2 * self._count
        responses, state = self._respond(q), model.linearize(q, tangent=False)
        moves = self._average(model.project(self._probe, q, responses)).reshape(count, count)
        moved = model.positions(self._probe, q) - model.positions(self._probe, np.zeros(model.size))
        return FaceTangent(
            load=self._find_load(q, state.force),
            move=self._average(moved[:, :, None]).reshape(count),
            compliance=0.5 * (moves + moves.T),
            shape=self.basis.T @ q,
            shape_compliance=self.basis.T @ responses,
        )

    def find_basis(self, states: NDArray, count: int) -> None:
        """Sets the basis to the `count` shapes that say most of equilibria (m, size) and of what loads do to them."""
        parts, largest = [], 0.0
        for q in states[:: _EVERY**2]:
            responses = self._respond(q)[:, ::_EVERY]
            largest = max(largest, np.abs(responses).max())
            parts.append(_condense(responses, _LEADING))
        share = (np.abs(states).max() or 1.0) / largest / len(states)
        samples = np.concatenate([states.T, share * np.concatenate(parts, axis=1)], axis=1)
        self.basis = np.linalg.qr(_condense(samples, min(count, *samples.shape)))[0]

    def _respond(self, q: NDArray) -> NDArray:
        """Returns the changes (size, 2 n) of the unknowns by unit loads at the rows."""
        model = self._model
        return model.factorise(model.linearize(q).tangent).solve(self._unit_loads(q))

    def _find_load(self, q: NDArray, force: NDArray) -> NDArray:
        """Returns the load on the rows (2 n,) [N] that balances an internal force (size,), as far as it can."""
        loads = sparse.csc_matrix(self._unit_loads(q))
        normal = (loads.T @ loads).tocsc()
        normal += _RIDGE * normal.diagonal().max() * sparse.eye(normal.shape[0], format="csc")
        load = splu(normal).solve(loads.T @ force)
        load[np.abs(load) < _NOTHING * np.abs(load).max()] = 0.0
        return load

    def _average(self, moves: NDArray) -> NDArray:
        """Returns x and z motions (n, 2, k) of the rows, the mean across the face, of those of points (p, 3, k)."""
        return moves.reshape(self._count, self._across, 3, -1).mean(1)[:, [0, 2]]

    def _unit_loads(self, q: NDArray) -> NDArray:
        """Returns the loads (size, 2 n) of unit forces along x and z at each row."""
        columns = np.zeros((len(q), 2 * self._count))
        for row in range(self._count):
            for number, axis in enumerate((0, 2)):
                forces = np.zeros((self._count * self._across, 3))
                forces[row * self._across : (row + 1) * self._across, axis] = 1.0 / self._across
                columns[:, 2 * row + number] = self._model.load(self._probe, q, forces)
        return columns


def _condense(samples: NDArray, count: int) -> NDArray:
    """Returns the `count` orthogonal combinations (size, count) that say most of samples (size, m).

    Their scalar products (m, m) take the place of the unknowns' (size, size), which a large mesh could not store.
    """
    m = samples.shape[1]
    return samples @ eigh(samples.T @ samples, subset_by_index=(max(m - count, 0), m - 1))[1]
