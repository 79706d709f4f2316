"""How much too stiff 4-node tetrahedra are on a given jaw; knows no key points."""

import warnings

import numpy as np

from finforce_ifea.jaw import Jaw
from finforce_ifea.mesh import VolumeMesh
from finforce_ifea.solid import SolidModel
from finforce_ifea.tetrahedra import to_tet10


class LockingWarning(UserWarning):
    """The elements of a mesh are too stiff in bending."""


def measure_locking(jaw: Jaw, mesh: VolumeMesh) -> float:
    """Returns the stiffness of 4-node tetrahedra over that of 10-node ones on the same mesh.

    Both are loaded along -x at the middle contact candidate.
    """
    point = jaw.candidates[[len(jaw.candidates) // 2]]
    compliances = []
    for candidate in (mesh, to_tet10(mesh)):
        model = SolidModel(candidate, jaw.material)
        probe, rest = model.attach(point, 1e-3), np.zeros(model.size)
        load = model.load(probe, rest, np.array([[-1.0, 0.0, 0.0]]))
        compliances.append(float(load @ model.factorise(model.linearize(rest).tangent).solve(load)))
    return compliances[1] / compliances[0]


def warn_of_locking(jaw: Jaw, mesh: VolumeMesh) -> None:
    """Warns when a jaw's mesh has 4-node tetrahedra, and says by how much they are too stiff."""
    if mesh.tets is None or mesh.tets.shape[1] != 4:
        return
    factor = measure_locking(jaw, mesh)
    warnings.warn(
        f"jaw {jaw.name!r}: its 4-node tetrahedra lock, they are {factor:.1f} times as stiff as 10-node ones on the "
        "same mesh; forces are too large accordingly. Use 10-node tetrahedra or hexahedra",
        LockingWarning,
        stacklevel=3,
    )
