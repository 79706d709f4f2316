"""Response of the key points to a force off the middle of a finger and to a lateral one, in the linear jaw at rest.

The mechanics of the jaw's plane know neither. Both are small compared with bending, so that they are added to it.
"""

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from finforce_ifea.fem.solid import SolidModel
from finforce_ifea.jaw.jaw import KEYPOINT_DISTANCE, Jaw
from finforce_ifea.jaw.mesh import VolumeMesh

_HEIGHTS = 13
# The pair of forces that twists stands so far from the middle, as a share of half the width.
_ARM = 0.8
# Larger meshes are not worth the time: of theirs only the plane is known.
_MOST_NODES = 20_000


@dataclass(frozen=True, kw_only=True, eq=False)
class Torsion:
    """Answers of the unloaded jaw at several heights of its inner face.

    Attributes:
        heights: (m,) [m], rising.
        half_width: of the inner face [m].
        by_moment: motions of the key points (m, K, 3) per moment about the line x = inner face, y = 0 [m/(N m)].
        by_force: the same per force along y there (m, K, 3) [m/N].
        roll: slope dx/dy of the face where the moment acts, per moment (m,) [1/(N m)].
    """

    heights: NDArray
    half_width: float
    by_moment: NDArray
    by_force: NDArray
    roll: NDArray

    def at(self, height: float) -> tuple[NDArray, NDArray, float]:
        """Return the motions by moment and by force (K, 3) each and the roll at a height [m]."""
        return _interpolate(self.heights, (self.by_moment, self.by_force), self.roll, height)


@njit(cache=True, error_model="numpy")
def _interpolate(heights, motions, roll, height):
    """Return both motions (m, K, 3) and the roll (m,) between rising heights (m,) [m], those at the ends beyond."""
    low = 0
    while low < len(heights) - 2 and height >= heights[low + 1]:
        low += 1
    share = min(max((height - heights[low]) / (heights[low + 1] - heights[low]), 0.0), 1.0)
    moment, force = motions
    moment = (1.0 - share) * moment[low] + share * moment[low + 1]
    force = (1.0 - share) * force[low] + share * force[low + 1]
    return moment, force, (1.0 - share) * roll[low] + share * roll[low + 1]


def _find_narrowest(jaw: Jaw, heights: NDArray, half: float) -> float:
    """Return the least half width [m] of the inner face at heights (n,) [m], `half` where it is the same all along."""
    if jaw.section is None or not jaw.section.taper.any():
        return half
    places = np.stack([[jaw.face.read(z), z] for z in heights])
    return 0.5 * float(jaw.section.read_width(places).min())


def measure_torsion(jaw: Jaw, mesh: VolumeMesh) -> Torsion | None:
    """Return how a jaw twists and gives way sideways; None where it is no solid, or its mesh too large.

    Args:
        jaw: with its material and key points.
        mesh: of that jaw, undeformed.
    """
    is_solid = jaw.drawing is None or jaw.drawing.is_solid
    mesh = mesh if jaw.section is None else jaw.build_mesh("coarse")
    if not is_solid or len(mesh.nodes) > _MOST_NODES:
        return None
    model = SolidModel(mesh, jaw.material, symmetric=False)
    face = mesh.nodes[jaw.face.holds(mesh.nodes)]
    half, (low, high) = float(face[:, 1].max()), (face[:, 2].min(), face[:, 2].max())
    heights = np.linspace(low + 0.1 * (high - low), high - 0.05 * (high - low), _HEIGHTS)
    arm, rest = _ARM * _find_narrowest(jaw, heights, half), np.zeros(model.size)
    places = np.array([[jaw.face.read(z), y, z] for z in heights for y in (-arm, 0.0, arm)])
    probes = [model.attach(places[3 * row : 3 * row + 3], 1e-3) for row in range(_HEIGHTS)]
    twist, across = np.zeros((3, 3)), np.zeros((3, 3))
    twist[0, 0], twist[2, 0], across[1, 1] = 0.5 / arm, -0.5 / arm, 1.0
    loads = [model.load(probe, rest, force) for probe in probes for force in (twist, across)]
    steps = model.factorise(model.linearize(rest).tangent).solve(np.stack(loads, axis=1))
    motions = model.project(model.attach(jaw.keypoints, KEYPOINT_DISTANCE), rest, steps)
    roll = [
        (moved[2, 0] - moved[0, 0]) / (2.0 * arm)
        for moved in (model.project(probe, rest, steps[:, [2 * row]])[:, :, 0] for row, probe in enumerate(probes))
    ]
    by = np.moveaxis(motions, 2, 0)
    return Torsion(
        heights=heights,
        half_width=half,
        by_moment=np.ascontiguousarray(by[::2]),
        by_force=np.ascontiguousarray(by[1::2]),
        roll=np.array(roll),
    )
