"""The jaw as a geometrically nonlinear solid: co-rotational hexahedra or tetrahedra, clamped at the base."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.csgraph import reverse_cuthill_mckee

from finforce_ifea.fem.corotation import (
    add_probe_springs,
    corotational_elements,
    probe_loads,
    probe_motions,
    probe_positions,
    scatter_lower,
)
from finforce_ifea.fem.elements import centre_gradient, elasticity_matrix, hex_stiffness, tet_stiffness
from finforce_ifea.fem.factorisation import Factor, SparseFactor, factorise_banded, sparse_from_banded
from finforce_ifea.fem.model import LARGEST_MOVE, Linearization
from finforce_ifea.jaw.attachment import attach_points
from finforce_ifea.jaw.jaw_file import Material
from finforce_ifea.jaw.mesh import VolumeMesh

# Above this many multiplications a sparse factorisation with a fill-reducing order beats the band.
_BANDED_COST_LIMIT = 1e10
_ON_PLANE = 1e-9


@dataclass(frozen=True, kw_only=True, eq=False)
class SolidProbe:
    """Material points of a solid.

    Attributes:
        points: undeformed positions (p, 3) [m].
        dof: unknowns of the nodes around each point (p, m, 3); the model's size marks a clamped one.
        weights: shape functions with the mirror's sign (p, m, 3).
    """

    points: NDArray
    dof: NDArray
    weights: NDArray


class SolidModel:
    """A co-rotational solid; see `finforce_ifea.fem.model.JawModel` for what its methods take and return.

    The unknowns q (size,) [m] are the free nodal displacements in an order of small bandwidth. A mesh that mirrors
    itself in y = 0 is halved unless `symmetric` is False: loads and shapes are symmetric then.
    """

    def __init__(self, mesh: VolumeMesh, material: Material, *, symmetric: bool = True) -> None:
        """Builds element stiffnesses and the plan of assembly.

        Args:
            mesh: nodes [m] in the jaw frame, elements, clamped nodes.
            material: Young's modulus [Pa] and Poisson's ratio.
            symmetric: halve the mesh where it mirrors itself in y = 0.
        """
        self.mesh = mesh
        self.rotations, self.reach = None, LARGEST_MOVE
        mirror = find_mirror_nodes(mesh) if symmetric else None
        self.symmetric = mirror is not None
        elements = mesh.elements
        if self.symmetric:
            elements = elements[mesh.nodes[elements].mean(1)[:, 1] > 0]
        self._elements = np.ascontiguousarray(elements, np.int64)
        corners = mesh.nodes[self._elements]
        D = elasticity_matrix(material.young_modulus, material.poisson_ratio)
        stiffness = hex_stiffness(corners, D) if corners.shape[1] == 8 else tet_stiffness(corners, D)
        self._K0 = np.ascontiguousarray(stiffness * (2.0 if self.symmetric else 1.0))
        self._X = np.ascontiguousarray(corners - corners.mean(1, keepdims=True))
        self._g = np.ascontiguousarray(centre_gradient(corners))
        self._Ke = np.zeros_like(self._K0)
        self._number_unknowns(mirror)
        self._plan_assembly()

    def _number_unknowns(self, mirror: NDArray | None) -> None:
        """Numbers the free unknowns in reverse Cuthill-McKee order; mirrored nodes share theirs."""
        count = len(self.mesh.nodes)
        y = self.mesh.nodes[:, 1]
        master, self.sign, free = np.arange(count), np.ones((count, 3)), np.ones((count, 3), bool)
        free[self.mesh.clamped] = False
        if mirror is not None:
            below = y < -_ON_PLANE
            master[below] = mirror[below]
            self.sign[below, 1] = -1
            free[np.abs(y) <= _ON_PLANE, 1] = False
        ordered = _order_nodes(self._elements)
        number = np.full((count, 3), -1)
        number[ordered] = np.where(free[ordered], np.cumsum(free[ordered]).reshape(-1, 3) - 1, -1)
        self.size = int(free[ordered].sum())
        self.dof = np.where(number[master] >= 0, number[master], self.size)

    def _plan_assembly(self) -> None:
        """Prepares where each lower entry of each element matrix goes in the stored tangent."""
        dof = self.dof[self._elements].reshape(len(self._elements), -1)
        i, j = np.nonzero(np.arange(dof.shape[1])[:, None] // 3 >= np.arange(dof.shape[1]) // 3)
        row, col = dof[:, i], dof[:, j]
        keep = (row < self.size) & (col < self.size) & ((i // 3 > j // 3) | (row >= col))
        e, entry = np.nonzero(keep)
        high, low = np.maximum(row, col)[keep], np.minimum(row, col)[keep]
        self.bandwidth = int((high - low).max())
        self.banded = self.size * self.bandwidth**2 < _BANDED_COST_LIMIT
        self._source = (e * dof.shape[1] + i[entry]) * dof.shape[1] + j[entry]
        self._row, self._col = (high - low, low) if self.banded else (high, low)

    def expand(self, q: NDArray) -> NDArray:
        """Returns the displacements (nodes, 3) [m] of all mesh nodes for unknowns q (size,)."""
        return self.sign * np.append(q, 0.0)[self.dof]

    def gather(self, forces: NDArray) -> NDArray:
        """Returns the generalised load (size,) [N] of nodal forces (nodes, 3) [N]."""
        return np.bincount(self.dof.ravel(), (self.sign * forces).ravel(), self.size + 1)[: self.size]

    def vertices(self, q: NDArray) -> NDArray:
        """Returns the deformed mesh vertices (v, 3) [m], in mesh order."""
        return self.mesh.nodes + self.expand(q)

    def linearize(self, q: NDArray, *, tangent: bool = True) -> Linearization:
        """Evaluates internal force, energy and, unless `tangent` is False, the tangent stiffness at q (size,) [m]."""
        f = np.zeros_like(self.mesh.nodes)
        energy, smallest = corotational_elements(
            self.expand(q), self._elements, self._X, self._K0, self._g, tangent, f, self._Ke
        )
        force = np.bincount(self.dof.ravel(), f.ravel(), self.size + 1)[: self.size]
        stored = self._assemble() if tangent else None
        return Linearization(force=force, energy=energy, smallest_det=smallest, tangent=stored)

    def _assemble(self) -> NDArray | sparse.csc_matrix:
        if not self.banded:
            values = self._Ke.ravel()[self._source]
            return sparse.coo_matrix((values, (self._row, self._col)), (self.size, self.size)).tocsc()
        storage = np.zeros((self.bandwidth + 1, self.size), order="F")
        scatter_lower(self._Ke.ravel(), self._source, self._row, self._col, storage)
        return storage

    def factorise(self, tangent: NDArray | sparse.csc_matrix) -> Factor:
        """Factorises a stored tangent; Cholesky, or LU where the state is not stable or the band is wide."""
        if not self.banded:
            return SparseFactor(self.sparse_tangent(tangent))
        return factorise_banded(tangent) or SparseFactor(sparse_from_banded(tangent))

    def sparse_tangent(self, tangent: NDArray | sparse.csc_matrix) -> sparse.csc_matrix:
        """Returns a stored tangent as the full symmetric matrix (size, size) [N/m]."""
        if self.banded:
            return sparse_from_banded(tangent)
        return (tangent + sparse.tril(tangent, -1).T).tocsc()

    def attach(self, points: NDArray, max_distance: float = 1e-3) -> SolidProbe:
        """Returns a probe of material points (p, 3) [m, undeformed]; raises MeshError when one is off the jaw."""
        attachment = attach_points(self.mesh, points, max_distance)
        return SolidProbe(
            points=np.array(points, float),
            dof=np.ascontiguousarray(self.dof[attachment.nodes]),
            weights=np.ascontiguousarray(self.sign[attachment.nodes] * attachment.weights[:, :, None]),
        )

    def positions(self, probe: SolidProbe, q: NDArray) -> NDArray:
        """Returns the deformed positions (p, 3) [m] of a probe."""
        return probe_positions(probe.points, probe.dof, probe.weights, q)

    def project(self, probe: SolidProbe, q: NDArray, modes: NDArray) -> NDArray:
        """Returns the motions (p, 3, k) [m] of a probe for changes modes (size, k) of the unknowns."""
        return probe_motions(probe.dof, probe.weights, np.ascontiguousarray(modes))

    def load(self, probe: SolidProbe, q: NDArray, forces: NDArray) -> NDArray:
        """Returns the generalised load (size,) [N] of forces (p, 3) [N] at a probe's points."""
        return probe_loads(probe.dof, probe.weights, forces, self.size)

    def stiffen(self, tangent: NDArray | sparse.csc_matrix, probe: SolidProbe, q: NDArray, blocks: NDArray) -> None:
        """Adds springs blocks (p, 3, 3) [N/m] at a probe's points to a stored tangent, in place."""
        add_probe_springs(probe.dof, probe.weights, blocks, self.size, tangent)


def _order_nodes(elements: NDArray) -> NDArray:
    """Returns the nodes of elements (m, k) in reverse Cuthill-McKee order."""
    used, local = np.unique(elements, return_inverse=True)
    local = local.reshape(elements.shape)
    pairs = np.broadcast_to(local[:, :, None], (*local.shape, local.shape[1]))
    ones = np.ones(pairs.size)
    graph = sparse.coo_matrix((ones, (pairs.ravel(), pairs.transpose(0, 2, 1).ravel())), (len(used), len(used)))
    return used[reverse_cuthill_mckee(graph.tocsr(), symmetric_mode=True)]


def find_mirror_nodes(mesh: VolumeMesh) -> NDArray | None:
    """Returns each node's mirror image in y = 0 (n,), or None when the mesh cannot be halved there."""
    index = {tuple(point): i for i, point in enumerate(np.rint(mesh.nodes * 1e9).astype(np.int64))}
    images = np.rint(mesh.nodes * [1e9, -1e9, 1e9]).astype(np.int64)
    mirror = np.array([index.get(tuple(point), -1) for point in images])
    y = mesh.nodes[mesh.elements, 1]
    straddles = (y.min(1) < -_ON_PLANE) & (y.max(1) > _ON_PLANE)
    if (mirror < 0).any() or straddles.any() or not np.isin(mirror[mesh.clamped], mesh.clamped).all():
        return None
    present = {tuple(row) for row in np.sort(mesh.elements, axis=1)}
    images = np.sort(mirror[mesh.elements], axis=1)
    return mirror if all(tuple(row) in present for row in images) else None
