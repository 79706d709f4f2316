"""A prismatic jaw in plane strain: quadratic triangles of its section, whatever its shape.

St. Venant-Kirchhoff: with F = I + sum u_i g_i^T, E = (F^T F - I) / 2 and S = lambda tr(E) I + 2 mu E the energy of a
volume dV is S : E / 2 dV, the force of node i is F S g_i dV, and the tangent between nodes i and j, with a = F g,
is ((g_i . S g_j) I + lambda a_i a_j^T + mu (a_j a_i^T + (g_i . g_j) F F^T)) dV.

Source: Bonet, Wood, Nonlinear Continuum Mechanics for Finite Element Analysis (2008), chapters 6 and 9.
"""

import numpy as np
from numpy.typing import NDArray

from finforce.compiled import njit
from finforce_ifea.errors import MeshError
from finforce_ifea.fem.model import LARGEST_MOVE, Across, Linearization
from finforce_ifea.fem.solid import SolidModel
from finforce_ifea.jaw.jaw_file import Material
from finforce_ifea.jaw.mesh import VolumeMesh
from finforce_ifea.jaw.section import Section
from finforce_ifea.jaw.section_mesh import PlaneMesh

_SAME = 1e-8
_POINTS = np.array([[1.0, 1.0], [4.0, 1.0], [1.0, 4.0]]) / 6.0


class PlaneModel(SolidModel):
    """The section of a finger in plane strain; see `finforce_ifea.fem.model.JawModel` for what its methods take.

    The unknowns q (size,) [m] are displacements along x and z of the section's free nodes. Nodes of the extruded mesh
    that differ in y alone move alike.
    """

    across: Across = "middle"

    def __init__(self, mesh: VolumeMesh, plane: PlaneMesh, section: Section, material: Material) -> None:
        """Number the unknowns and prepare the triangles.

        Args:
            mesh: the extruded section, jaw frame [m].
            plane: its triangles.
            section: whose width counts.
            material: Young's modulus [Pa] and Poisson's ratio.

        Raises:
            MeshError: The mesh is not made of that section.
        """
        from scipy.spatial import cKDTree

        self.mesh, self.plane = mesh, plane
        self.rotations, self.reach, self.symmetric = None, LARGEST_MOVE, False
        self.sign = np.ones((len(mesh.nodes), 3))
        distance, column = cKDTree(plane.points).query(mesh.nodes[:, [0, 2]])
        # of the nodes over each point the first stands for all: the same ones in the mirrored mesh of the other jaw
        points, standing = np.unique(column, return_index=True)
        if distance.max() > _SAME or len(points) < len(plane.points):
            raise MeshError("the mesh is not the section extruded along y")
        self._elements = np.ascontiguousarray(standing[plane.triangles])
        gradients, volumes = _differentiate(plane.points[plane.triangles])
        volumes = section.read_width(_place_points(plane.points[plane.triangles])) * volumes
        self._points = gradients, volumes
        nu = material.poisson_ratio
        shear = 0.5 * material.young_modulus / (1.0 + nu)
        self._moduli = 2.0 * shear * nu / (1.0 - 2.0 * nu), shear
        self._Ke = np.zeros((len(self._elements), 18, 18))
        free = np.ones((len(mesh.nodes), 3), bool)
        free[:, 1] = False
        self._number_unknowns(standing[column], free)
        self._plan_assembly()
        self._moves = self.dof[standing][:, ::2]

    def linearize(self, q: NDArray) -> Linearization:
        """Evaluate internal force, energy and tangent stiffness at q (size,) [m]."""
        f = np.zeros(self._moves.shape)
        u = np.append(q, 0.0)[self._moves]
        energy, smallest = _add_triangles(u, self.plane.triangles, self._points, self._moduli, f, self._Ke)
        force = np.bincount(self._moves.ravel(), f.ravel(), self.size + 1)[: self.size]
        return Linearization(force=force, energy=energy, smallest_det=smallest, tangent=self._assemble())


def _place_points(corners: NDArray) -> NDArray:
    """Return the three points (t, 3, 2) [m] of triangles (t, 6, 2) with straight sides."""
    shares = np.column_stack([1.0 - _POINTS.sum(axis=1), _POINTS])
    return np.einsum("pn,tni->tpi", shares, corners[:, :3])


def _differentiate(corners: NDArray) -> tuple[NDArray, NDArray]:
    """Return shape function gradients (t, 3, 6, 2) [1/m] and areas (t, 3) [m^2] at three points of triangles."""
    r, s = _POINTS.T
    t = 1.0 - r - s
    zero = np.zeros(3)
    by_r = np.stack([1.0 - 4.0 * t, 4.0 * r - 1.0, zero, 4.0 * (t - r), 4.0 * s, -4.0 * s], axis=1)
    by_s = np.stack([1.0 - 4.0 * t, zero, 4.0 * s - 1.0, -4.0 * r, 4.0 * r, 4.0 * (t - s)], axis=1)
    local = np.stack([by_r, by_s], axis=2)
    jacobian = np.einsum("tni,pnj->tpij", corners, local)
    gradients = np.einsum("pnj,tpji->tpni", local, np.linalg.inv(jacobian))
    return np.ascontiguousarray(gradients), np.linalg.det(jacobian) / 6.0


@njit(cache=True, error_model="numpy", fastmath={"contract", "reassoc", "nsz", "arcp"})
def _add_triangles(u, elements, points, moduli, force, K):
    """Add nodal forces (n, 2) and fill lower blocks of stiffnesses K (t, 18, 18).

    Args:
        u: displacements (n, 2) [m].
        elements: nodes of each triangle (t, 6).
        points: gradients (t, 3, 6, 2) [1/m] and volumes (t, 3) [m^3] at three points of each.
        moduli: Lame's first parameter and the shear modulus [Pa].
        force: of the nodes (n, 2) [N], added to.
        K: overwritten [N/m].

    Returns:
        Energy [J] and the smallest det F.
    """
    energy, smallest = 0.0, 1e300
    (gradients, volumes), (lame, shear) = points, moduli
    a = np.empty((6, 2))
    for e in range(len(elements)):
        K[e] = 0.0
        for p in range(3):
            g, weight = gradients[e, p], volumes[e, p]
            xx, xz, zx, zz = 1.0, 0.0, 0.0, 1.0
            for i in range(6):
                ux, uz = u[elements[e, i], 0], u[elements[e, i], 1]
                xx, xz = xx + ux * g[i, 0], xz + ux * g[i, 1]
                zx, zz = zx + uz * g[i, 0], zz + uz * g[i, 1]
            smallest = min(smallest, xx * zz - xz * zx)
            e_xx, e_zz = 0.5 * (xx * xx + zx * zx - 1.0), 0.5 * (xz * xz + zz * zz - 1.0)
            e_xz = 0.5 * (xx * xz + zx * zz)
            trace = e_xx + e_zz
            s_xx, s_zz = lame * trace + 2.0 * shear * e_xx, lame * trace + 2.0 * shear * e_zz
            s_xz = 2.0 * shear * e_xz
            energy += 0.5 * weight * (s_xx * e_xx + s_zz * e_zz + 2.0 * s_xz * e_xz)
            for i in range(6):
                a[i, 0], a[i, 1] = xx * g[i, 0] + xz * g[i, 1], zx * g[i, 0] + zz * g[i, 1]
                sx, sz = s_xx * g[i, 0] + s_xz * g[i, 1], s_xz * g[i, 0] + s_zz * g[i, 1]
                force[elements[e, i], 0] += weight * (xx * sx + xz * sz)
                force[elements[e, i], 1] += weight * (zx * sx + zz * sz)
            k, m = weight * lame, weight * shear
            f_xx, f_xz, f_zz = xx * xx + xz * xz, xx * zx + xz * zz, zx * zx + zz * zz
            for i in range(6):
                sx, sz = s_xx * g[i, 0] + s_xz * g[i, 1], s_xz * g[i, 0] + s_zz * g[i, 1]
                for j in range(i + 1):
                    along = weight * (sx * g[j, 0] + sz * g[j, 1])
                    turn = weight * shear * (g[i, 0] * g[j, 0] + g[i, 1] * g[j, 1])
                    K[e, 3 * i, 3 * j] += along + k * a[i, 0] * a[j, 0] + m * a[j, 0] * a[i, 0] + turn * f_xx
                    K[e, 3 * i, 3 * j + 2] += k * a[i, 0] * a[j, 1] + m * a[j, 0] * a[i, 1] + turn * f_xz
                    K[e, 3 * i + 2, 3 * j] += k * a[i, 1] * a[j, 0] + m * a[j, 1] * a[i, 0] + turn * f_xz
                    K[e, 3 * i + 2, 3 * j + 2] += along + k * a[i, 1] * a[j, 1] + m * a[j, 1] * a[i, 1] + turn * f_zz
    return energy, smallest
