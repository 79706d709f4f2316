"""The jaw as a geometrically nonlinear solid: co-rotational hexahedra or tetrahedra, clamped at the base.

With F = sum (X_i + u_i) g_i^T = R U, x' = R^T x and d = x' - X (about the element's centroid) an element's energy is
d.K0.d / 2. Its gradient is f_i = R (f'_i - G_i^T m) with f' = K0 d, m = sum x'_i x f'_i and
G_i = (tr(U) I - U)^-1 [g_i]; the spin of the element is sum G_i R^T du_i. The tangent is
R (P^T K0 P - [p] G - G^T [f']^T P) R^T, symmetrised, with P = I - S G and S w = w x x'. As K0 does not feel rotations
of the undeformed shape, K0 S is formed from d alone.

Source: Felippa, Haugen, A unified formulation of small-strain corotational finite elements, CMAME 194 (2005).
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from finforce.compiled import njit
from finforce_ifea.fem.elements import centre_gradient, elasticity_matrix, hex_stiffness, tet_stiffness
from finforce_ifea.fem.model import (
    LARGEST_MOVE,
    Across,
    Factor,
    Linearization,
    SparseFactor,
    SparsePlan,
    order_unknowns,
)
from finforce_ifea.jaw.attachment import attach_points
from finforce_ifea.jaw.jaw_file import Material
from finforce_ifea.jaw.mesh import VolumeMesh

_ON_PLANE = 1e-9


class _Probe(NamedTuple):
    """Material points of a solid: undeformed (p, 3) [m], and how unknowns move them (3 p, size), also transposed."""

    points: NDArray
    matrix: sparse.csr_matrix
    transposed: sparse.csc_matrix


class _Undeformed(NamedTuple):
    """The elements of a solid at rest.

    Attributes:
        nodes: of each element (m, k).
        X: coordinates about the centroid (m, k, 3) [m].
        g: shape function gradients at the centre (m, k, 3) [1/m].
        K0: stiffness (m, 3 k, 3 k) [N/m].
    """

    nodes: NDArray
    X: NDArray
    g: NDArray
    K0: NDArray


class SolidModel:
    """A co-rotational solid; see `finforce_ifea.fem.model.JawModel` for what its methods take and return.

    The unknowns q (size,) [m] are the free nodal displacements in an order of little fill. A mesh that mirrors itself
    in y = 0 is halved unless `symmetric` is False: loads and shapes are symmetric then.
    """

    @property
    def across(self) -> Across:
        """The positions of contact points along y."""
        return "half" if self.symmetric else "both"

    def __init__(self, mesh: VolumeMesh, material: Material, *, symmetric: bool = True) -> None:
        """Build element stiffnesses and the plan of assembly.

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
        self._undeformed = _Undeformed(
            self._elements,
            np.ascontiguousarray(corners - corners.mean(1, keepdims=True)),
            np.ascontiguousarray(centre_gradient(corners)),
            np.ascontiguousarray(stiffness * (2.0 if self.symmetric else 1.0)),
        )
        self._Ke = np.zeros_like(self._undeformed.K0)
        self.sign = np.ones((len(mesh.nodes), 3))
        self._mirror_unknowns(mirror)
        self._plan_assembly()

    def _mirror_unknowns(self, mirror: NDArray | None) -> None:
        """Number the free unknowns; mirrored nodes share theirs."""
        y = self.mesh.nodes[:, 1]
        master, free = np.arange(len(y)), np.ones((len(y), 3), bool)
        if mirror is not None:
            below = y < -_ON_PLANE
            master[below] = mirror[below]
            self.sign[below, 1] = -1
            free[np.abs(y) <= _ON_PLANE, 1] = False
        self._number_unknowns(master, free)

    def _number_unknowns(self, master: NDArray, free: NDArray) -> None:
        """Number the free (n, 3) of the unclamped nodes; others go with their master."""
        free[self.mesh.clamped] = False
        used = np.unique(self._elements)
        number = np.full(free.shape, -1)
        number[used] = np.where(free[used], np.cumsum(free[used]).reshape(-1, 3) - 1, -1)
        self.size = int(free[used].sum())
        self.dof = np.where(number[master] >= 0, number[master], self.size)

    def _plan_assembly(self) -> None:
        """Prepare where each lower entry of each element matrix goes in the stored tangent."""
        _, (high, low) = self._find_entries()
        self.dof = np.append(order_unknowns(high, low, self.size), self.size)[self.dof]
        self._source, (high, low) = self._find_entries()
        # the upper triangle, column by column: the pattern stays, only values change
        keys, self._slot = np.unique(high * self.size + low, return_inverse=True)
        self._pointer = np.searchsorted(keys // self.size, np.arange(self.size + 1))
        self._index = keys % self.size
        self._plan = SparsePlan(self._pointer, self._index)

    def _find_entries(self) -> tuple[NDArray, tuple[NDArray, NDArray]]:
        """Return the lower entries of all element matrices: where they are stored there, and their two unknowns."""
        dof = self.dof[self._elements].reshape(len(self._elements), -1)
        i, j = np.nonzero(np.arange(dof.shape[1])[:, None] // 3 >= np.arange(dof.shape[1]) // 3)
        row, col = dof[:, i], dof[:, j]
        keep = (row < self.size) & (col < self.size) & ((i // 3 > j // 3) | (row >= col))
        e, entry = np.nonzero(keep)
        source = (e * dof.shape[1] + i[entry]) * dof.shape[1] + j[entry]
        return source, (np.maximum(row, col)[keep], np.minimum(row, col)[keep])

    def expand(self, q: NDArray) -> NDArray:
        """Return the displacements (nodes, 3) [m] of all mesh nodes for unknowns q (size,)."""
        return self.sign * np.append(q, 0.0)[self.dof]

    def vertices(self, q: NDArray) -> NDArray:
        """Return the deformed mesh vertices (v, 3) [m], in mesh order."""
        return self.mesh.nodes + self.expand(q)

    def linearize(self, q: NDArray) -> Linearization:
        """Evaluate internal force, energy and tangent stiffness at q (size,) [m]."""
        f = np.zeros_like(self.mesh.nodes)
        energy, smallest = _add_elements(self.expand(q), self._undeformed, f, self._Ke)
        force = np.bincount(self.dof.ravel(), f.ravel(), self.size + 1)[: self.size]
        return Linearization(force=force, energy=energy, smallest_det=smallest, tangent=self._assemble())

    def _assemble(self) -> NDArray:
        return np.bincount(self._slot, self._Ke.ravel()[self._source], len(self._index))

    def factorise(self, tangent: NDArray) -> Factor:
        """Factorise a stored tangent; L D L^T, or LU where the state is not stable."""
        return self._plan.factorise(tangent) or SparseFactor(self.sparse_tangent(tangent))

    def sparse_tangent(self, tangent: NDArray) -> sparse.csc_matrix:
        """Return a stored tangent as the full symmetric matrix (size, size) [N/m]."""
        upper = sparse.csc_matrix((tangent, self._index, self._pointer), (self.size, self.size))
        return (upper + sparse.triu(upper, 1).T).tocsc()

    def attach(self, points: NDArray, max_distance: float = 1e-3) -> _Probe:
        """Return a probe of material points (p, 3) [m, undeformed]; raises MeshError when one is off the jaw."""
        attachment = attach_points(self.mesh, points, max_distance)
        column = self.dof[attachment.nodes]
        weights = self.sign[attachment.nodes] * attachment.weights[:, :, None]
        row = np.broadcast_to(np.arange(3 * len(points)).reshape(-1, 1, 3), column.shape)
        free = column < self.size
        matrix = sparse.csr_matrix((weights[free], (row[free], column[free])), (3 * len(points), self.size))
        return _Probe(np.array(points, float), matrix, matrix.T)

    def positions(self, probe: _Probe, q: NDArray) -> NDArray:
        """Return the deformed positions (p, 3) [m] of a probe."""
        return probe.points + (probe.matrix @ q).reshape(-1, 3)

    def project(self, probe: _Probe, q: NDArray, modes: NDArray) -> NDArray:
        """Return the motions (p, 3, k) [m] of a probe for changes modes (size, k) of the unknowns."""
        return (probe.matrix @ modes).reshape(*probe.points.shape, -1)

    def load(self, probe: _Probe, q: NDArray, forces: NDArray) -> NDArray:
        """Return the generalised load (size,) [N] of forces (p, 3) [N] at a probe's points."""
        return probe.transposed @ forces.ravel()

    def stiffen(self, tangent: NDArray, probe: _Probe, q: NDArray, blocks: NDArray) -> None:
        """Add springs blocks (p, 3, 3) [N/m] at a probe's points to a stored tangent, in place."""
        matrix = probe.matrix
        rows, upper = (matrix.indptr, matrix.indices, matrix.data), (self._pointer, self._index, tangent)
        _add_springs(rows, blocks, upper)


def find_mirror_nodes(mesh: VolumeMesh) -> NDArray | None:
    """Return each node's mirror image in y = 0 (n,), or None when the mesh cannot be halved there."""
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


_OPTIONS = {"cache": True, "fastmath": {"contract", "reassoc", "nsz", "arcp"}, "error_model": "numpy"}
_POLAR_ITERATIONS = 30
_POLAR_TOLERANCE = 1e-14


@njit(**_OPTIONS)
def _invert(A, out):
    """Write the inverse of a 3 x 3 matrix; return its determinant."""
    a = A[1, 1] * A[2, 2] - A[1, 2] * A[2, 1]
    b = A[1, 2] * A[2, 0] - A[1, 0] * A[2, 2]
    c = A[1, 0] * A[2, 1] - A[1, 1] * A[2, 0]
    det = A[0, 0] * a + A[0, 1] * b + A[0, 2] * c
    s = 1.0 / det
    out[0, 0], out[1, 0], out[2, 0] = a * s, b * s, c * s
    out[0, 1] = (A[0, 2] * A[2, 1] - A[0, 1] * A[2, 2]) * s
    out[1, 1] = (A[0, 0] * A[2, 2] - A[0, 2] * A[2, 0]) * s
    out[2, 1] = (A[0, 1] * A[2, 0] - A[0, 0] * A[2, 1]) * s
    out[0, 2] = (A[0, 1] * A[1, 2] - A[0, 2] * A[1, 1]) * s
    out[1, 2] = (A[0, 2] * A[1, 0] - A[0, 0] * A[1, 2]) * s
    out[2, 2] = (A[0, 0] * A[1, 1] - A[0, 1] * A[1, 0]) * s
    return det


@njit(**_OPTIONS)
def _rotate(F, R, inverse):
    """Write the rotation R of F = R U by Newton's iteration R <- (R + R^-T) / 2; return det F."""
    for i in range(3):
        for j in range(3):
            R[i, j] = F[i, j]
    det = 1.0
    for iteration in range(_POLAR_ITERATIONS):
        now = _invert(R, inverse)
        if iteration == 0:
            det = now
        change = 0.0
        for i in range(3):
            for j in range(3):
                value = 0.5 * (R[i, j] + inverse[j, i])
                change = max(change, abs(value - R[i, j]))
                R[i, j] = value
        if change < _POLAR_TOLERANCE:
            break
    return det


class _Element(NamedTuple):
    """The working arrays of one element, named as in the equations above.

    Attributes:
        F: deformation gradient (3, 3).
        R: its rotation (3, 3).
        H: (tr(U) I - U)^-1 (3, 3).
        B: see `_couplings` (3, 3).
        scratch: (3, 3).
        x: turned-back coordinates (k, 3) [m].
        d: deformation (3 k,) [m].
        fl: f' (3 k,) [N].
        p: f' - G^T m (3 k,) [N].
        G: (3, 3 k) [1/m].
        L: see `_couplings` (3 k, 3) [N].
        T: tangent before it is turned (3 k, 3 k) [N/m].
    """

    F: NDArray
    R: NDArray
    H: NDArray
    B: NDArray
    scratch: NDArray
    x: NDArray
    d: NDArray
    fl: NDArray
    p: NDArray
    G: NDArray
    L: NDArray
    T: NDArray


@njit(**_OPTIONS)
def _shape(u, nodes, X, g, element):
    """Write F, R, the turned-back coordinates x and the deformation d of an element; return det F."""
    k, F, R, x, d = len(nodes), element.F, element.R, element.x, element.d
    F[:] = 0.0
    F[0, 0] = F[1, 1] = F[2, 2] = 1.0
    mean0 = mean1 = mean2 = 0.0
    for i in range(k):
        u0, u1, u2 = u[nodes[i], 0], u[nodes[i], 1], u[nodes[i], 2]
        for b in range(3):
            F[0, b] += u0 * g[i, b]
            F[1, b] += u1 * g[i, b]
            F[2, b] += u2 * g[i, b]
        mean0, mean1, mean2 = mean0 + u0 / k, mean1 + u1 / k, mean2 + u2 / k
    det = _rotate(F, R, element.scratch)
    for i in range(k):
        w0, w1, w2 = X[i, 0] + u[nodes[i], 0], X[i, 1] + u[nodes[i], 1], X[i, 2] + u[nodes[i], 2]
        w0, w1, w2 = w0 - mean0, w1 - mean1, w2 - mean2
        for a in range(3):
            x[i, a] = R[0, a] * w0 + R[1, a] * w1 + R[2, a] * w2
            d[3 * i + a] = x[i, a] - X[i, a]
    return det


@njit(**_OPTIONS)
def _spin_matrix(F, R, U, H):
    """Write H = (tr(U) I - U)^-1 with U = R^T F."""
    for a in range(3):
        for b in range(3):
            U[a, b] = -(R[0, a] * F[0, b] + R[1, a] * F[1, b] + R[2, a] * F[2, b])
    trace = -(U[0, 0] + U[1, 1] + U[2, 2])
    for a in range(3):
        U[a, a] += trace
    _invert(U, H)


@njit(**_OPTIONS)
def _forces(K0, g, element):
    """Write f' = K0 d and p = f' - G^T m of an element; return the energy."""
    x, d, H, fl, p = element.x, element.d, element.H, element.fl, element.p
    k, energy = len(x), 0.0
    for i in range(3 * k):
        s = 0.0
        for j in range(3 * k):
            s += K0[i, j] * d[j]
        fl[i] = s
        energy += 0.5 * s * d[i]
    m0 = m1 = m2 = 0.0
    for i in range(k):
        f0, f1, f2 = fl[3 * i], fl[3 * i + 1], fl[3 * i + 2]
        m0 += x[i, 1] * f2 - x[i, 2] * f1
        m1 += x[i, 2] * f0 - x[i, 0] * f2
        m2 += x[i, 0] * f1 - x[i, 1] * f0
    h0 = H[0, 0] * m0 + H[1, 0] * m1 + H[2, 0] * m2
    h1 = H[0, 1] * m0 + H[1, 1] * m1 + H[2, 1] * m2
    h2 = H[0, 2] * m0 + H[1, 2] * m1 + H[2, 2] * m2
    for i in range(k):
        p[3 * i] = fl[3 * i] + g[i, 1] * h2 - g[i, 2] * h1
        p[3 * i + 1] = fl[3 * i + 1] + g[i, 2] * h0 - g[i, 0] * h2
        p[3 * i + 2] = fl[3 * i + 2] + g[i, 0] * h1 - g[i, 1] * h0
    return energy


@njit(**_OPTIONS)
def _spins(g, H, G):
    """Write G = H [g_i], (3, 3 k)."""
    for i in range(len(g)):
        for a in range(3):
            G[a, 3 * i] = H[a, 1] * g[i, 2] - H[a, 2] * g[i, 1]
            G[a, 3 * i + 1] = H[a, 2] * g[i, 0] - H[a, 0] * g[i, 2]
            G[a, 3 * i + 2] = H[a, 0] * g[i, 1] - H[a, 1] * g[i, 0]


@njit(**_OPTIONS)
def _couplings(K0, element):
    """Write L = K0 S + ([p] + [f']) / 2 and B = S^T K0 S + (sum x f'^T symmetrised) - (sum x.f') I of an element."""
    x, d, fl, p, L, B = element.x, element.d, element.fl, element.p, element.L, element.B
    k = len(x)
    B[:] = 0.0
    for i in range(3 * k):
        s0 = s1 = s2 = 0.0
        for j in range(k):
            k0, k1, k2 = K0[i, 3 * j], K0[i, 3 * j + 1], K0[i, 3 * j + 2]
            s0 += k2 * d[3 * j + 1] - k1 * d[3 * j + 2]
            s1 += k0 * d[3 * j + 2] - k2 * d[3 * j]
            s2 += k1 * d[3 * j] - k0 * d[3 * j + 1]
        L[i, 0], L[i, 1], L[i, 2] = s0, s1, s2
    for i in range(k):
        dot = x[i, 0] * fl[3 * i] + x[i, 1] * fl[3 * i + 1] + x[i, 2] * fl[3 * i + 2]
        for a in range(3):
            up, down = (a + 1) % 3, (a + 2) % 3
            B[a, a] -= dot
            for b in range(3):
                B[a, b] += d[3 * i + up] * L[3 * i + down, b] - d[3 * i + down] * L[3 * i + up, b]
                B[a, b] += 0.5 * (x[i, a] * fl[3 * i + b] + x[i, b] * fl[3 * i + a])
    for i in range(k):
        q0, q1 = 0.5 * (p[3 * i] + fl[3 * i]), 0.5 * (p[3 * i + 1] + fl[3 * i + 1])
        q2 = 0.5 * (p[3 * i + 2] + fl[3 * i + 2])
        L[3 * i, 1] -= q2
        L[3 * i, 2] += q1
        L[3 * i + 1, 0] += q2
        L[3 * i + 1, 2] -= q0
        L[3 * i + 2, 0] -= q1
        L[3 * i + 2, 1] += q0


@njit(**_OPTIONS)
def _tangent(K0, element, Ke):
    """Write R (K0 + (G^T B - L) G - G^T L^T) R^T, lower 3 x 3 blocks only."""
    G, L, B, R, T, scratch = element.G, element.L, element.B, element.R, element.T, element.scratch
    n = len(K0)
    for i in range(n):
        l0, l1, l2 = G[0, i], G[1, i], G[2, i]
        b0 = l0 * B[0, 0] + l1 * B[1, 0] + l2 * B[2, 0] - L[i, 0]
        b1 = l0 * B[0, 1] + l1 * B[1, 1] + l2 * B[2, 1] - L[i, 1]
        b2 = l0 * B[0, 2] + l1 * B[1, 2] + l2 * B[2, 2] - L[i, 2]
        for j in range(3 * (i // 3) + 3):
            T[i, j] = K0[i, j] + b0 * G[0, j] + b1 * G[1, j] + b2 * G[2, j]
            T[i, j] -= l0 * L[j, 0] + l1 * L[j, 1] + l2 * L[j, 2]
    for i in range(0, n, 3):
        for j in range(0, i + 3, 3):
            for a in range(3):
                for b in range(3):
                    scratch[a, b] = R[a, 0] * T[i, j + b] + R[a, 1] * T[i + 1, j + b] + R[a, 2] * T[i + 2, j + b]
            for a in range(3):
                for b in range(3):
                    Ke[i + a, j + b] = scratch[a, 0] * R[b, 0] + scratch[a, 1] * R[b, 1] + scratch[a, 2] * R[b, 2]


@njit(**_OPTIONS)
def _add_elements(u: NDArray, undeformed: _Undeformed, f: NDArray, Ke: NDArray) -> tuple[float, float]:
    """Add internal forces to f and write element tangents.

    Args:
        u: displacements (n, 3) [m].
        undeformed: the elements.
        f: internal forces (n, 3) [N], added to.
        Ke: element tangents (m, 3 k, 3 k) [N/m], overwritten (lower 3 x 3 blocks only).

    Returns:
        Elastic energy [J] and the smallest det F of all elements.
    """
    nodes, X, g, K0 = undeformed
    m, k = nodes.shape
    n = 3 * k
    F, R, H, B = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    scratch, x, d, fl, p = np.empty((3, 3)), np.empty((k, 3)), np.empty(n), np.empty(n), np.empty(n)
    element = _Element(F, R, H, B, scratch, x, d, fl, p, np.empty((3, n)), np.empty((n, 3)), np.empty((n, n)))
    energy, smallest = 0.0, 1e300
    for e in range(m):
        smallest = min(smallest, _shape(u, nodes[e], X[e], g[e], element))
        _spin_matrix(F, R, scratch, H)
        energy += _forces(K0[e], g[e], element)
        for i in range(k):
            for a in range(3):
                f[nodes[e, i], a] += R[a, 0] * p[3 * i] + R[a, 1] * p[3 * i + 1] + R[a, 2] * p[3 * i + 2]
        _spins(g[e], H, element.G)
        _couplings(K0[e], element)
        _tangent(K0[e], element, Ke[e])
    return energy, smallest


@njit(cache=True, error_model="numpy")
def _add_springs(rows, blocks, upper):
    """Add springs blocks (p, 3, 3) of points, each three rows of a sparse matrix, to the upper triangle of another."""
    (start, column, weight), (pointer, index, values) = rows, upper
    for p in range(len(blocks)):
        for a in range(3):
            for b in range(3):
                if blocks[p, a, b] == 0.0:
                    continue
                for i in range(start[3 * p + a], start[3 * p + a + 1]):
                    first, last = pointer[column[i]], pointer[column[i] + 1]
                    for j in range(start[3 * p + b], start[3 * p + b + 1]):
                        if column[j] <= column[i]:
                            place = first + np.searchsorted(index[first:last], column[j])
                            values[place] += weight[i] * blocks[p, a, b] * weight[j]
