"""How stiff an undeformed jaw is against what presses on its inner surface; knows no object."""

import numpy as np

from finforce_ifea.model import JawModel
from finforce_ifea.surface import ContactSurface

# Where along the surface the line loads stand, as shares of its points.
_HEIGHTS = (0.25, 0.5, 0.75)


def measure_stiffness(model: JawModel, surface: ContactSurface) -> float:
    """Returns one over the mean compliance against line loads along -x, one at a time [N/m].

    The loads stand at a quarter, half and three quarters of the surface.
    """
    rest, loads = np.zeros(model.size), []
    for share in _HEIGHTS:
        row = int(share * (len(surface.heights) - 1))
        forces = np.zeros_like(surface.points)
        forces[row * surface.across : (row + 1) * surface.across, 0] = -1.0 / surface.across
        loads.append(model.load(surface.probe, rest, forces))
    pushes = np.stack(loads, axis=1)
    motions = model.factorise(model.linearize(rest).tangent).solve(pushes)
    return float(1.0 / np.einsum("ij,ij->j", pushes, motions).mean())
