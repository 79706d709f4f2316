"""How much too stiff the elements of a jaw's mesh are: tetrahedra in bending and near nu = 0.5, distorted hexahedra."""

import warnings
from dataclasses import replace
from itertools import product

import numpy as np

from finforce_ifea.fem.solid import SolidModel
from finforce_ifea.fem.tetrahedra import to_tet10
from finforce_ifea.jaw.jaw import Jaw
from finforce_ifea.jaw.jaw_file import Material
from finforce_ifea.jaw.mesh import VolumeMesh, shape_gradients

# At this Poisson's ratio 10-node tetrahedra do not lock; the stiffness of bands at others follows from plane strain.
_EASY_RATIO = 0.3
# What is said, and where it is measured at all: 10-node tetrahedra above a ratio, hexahedra below a scaled Jacobian.
_TOLERATED = {"distorted hexahedra": 1.05, "4-node tetrahedra": 1.1, "10-node tetrahedra": 1.1}
_HARD_RATIO, _DISTORTED = 0.4, 0.8
_CORNERS = np.array(list(product((-1.0, 1.0), repeat=3)))


class LockingWarning(UserWarning):
    """The elements of a mesh are too stiff."""


def measure_locking(jaw: Jaw, mesh: VolumeMesh) -> float:
    """Return the stiffness k of a mesh over what 10-node tetrahedra on the same nodes say that it should be.

    With nu_0 = min(nu, 0.3), where these do not lock, that is k_10(nu_0) (1 - nu_0^2) / (1 - nu^2): bands bend in plane
    strain. The load acts along -x at the middle contact candidate.
    """
    material = jaw.material
    easy = replace(material, poisson_ratio=min(material.poisson_ratio, _EASY_RATIO))
    plane = (1.0 - easy.poisson_ratio**2) / (1.0 - material.poisson_ratio**2)
    return _measure_stiffness(jaw, mesh, material) / (_measure_stiffness(jaw, to_tet10(mesh), easy) * plane)


def _measure_stiffness(jaw: Jaw, mesh: VolumeMesh, material: Material) -> float:
    """Return force over motion [N/m] at the middle contact candidate."""
    model = SolidModel(mesh, material)
    probe, rest = model.attach(jaw.candidates[[len(jaw.candidates) // 2]], 1e-3), np.zeros(model.size)
    load = model.load(probe, rest, np.array([[-1.0, 0.0, 0.0]]))
    return 1.0 / float(load @ model.factorise(model.linearize(rest).tangent).solve(load))


def measure_shape(mesh: VolumeMesh) -> float:
    """Return the least scaled Jacobian of a mesh of hexahedra: det J over the lengths of its columns, 1 in a box."""
    gradients = shape_gradients(8, _CORNERS)
    jacobians = np.einsum("mni,pnj->mpij", mesh.nodes[mesh.hexes], gradients)
    return float((np.linalg.det(jacobians) / np.linalg.norm(jacobians, axis=2).prod(axis=2)).min())


def warn_of_locking(jaw: Jaw, mesh: VolumeMesh) -> None:
    """Warn when a jaw's elements are too stiff, and say by how much and what would do.

    What cannot lock is not measured: hexahedra of a drawing or of good shape, and 10-node tetrahedra of a material that
    changes its volume.
    """
    if mesh.hexes is not None:
        suspect, kind = jaw.drawing is None and measure_shape(mesh) < _DISTORTED, "distorted hexahedra"
    elif mesh.tets.shape[1] == 4:
        suspect, kind = True, "4-node tetrahedra"
    else:
        suspect, kind = jaw.material.poisson_ratio > _HARD_RATIO, "10-node tetrahedra"
    factor = measure_locking(jaw, mesh) if suspect else 1.0
    if factor > _TOLERATED[kind]:
        advice = {
            "distorted hexahedra": "Use hexahedra nearer to boxes, more of them, or 10-node tetrahedra",
            "4-node tetrahedra": "Use 10-node tetrahedra or hexahedra",
            "10-node tetrahedra": f"nu = {jaw.material.poisson_ratio:g} asks for hexahedra, or more tetrahedra",
        }
        warnings.warn(
            f"jaw {jaw.name!r}: its {kind} lock, they are {factor:.2g} times as stiff as they should be; forces are "
            f"too large accordingly. {advice[kind]}",
            LockingWarning,
            stacklevel=3,
        )
