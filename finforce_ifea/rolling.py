"""A jaw in equilibrium with a rigid cylinder pressed into its inner surface; knows no key point targets.

The cylinder stands for any convex object: its depth, radius and height are enough to place the pressure, which
moves and spreads along the finger by itself as the finger bends.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from finforce_ifea.model import JawModel
from finforce_ifea.penalty import press_cylinder
from finforce_ifea.surface import ContactSurface

DEPTH, LOG_RADIUS, HEIGHT = 0, 1, 2
_LARGEST_STEP = 2e-3
_BISECTIONS = 10
_TOUCH = 2e-5


@dataclass(frozen=True, kw_only=True, eq=False)
class PressedState:
    """Linearised equilibrium of one state of jaw and cylinder.

    Attributes:
        forces: contact forces on the surface points (p, 3) [N].
        points: deformed surface points (p, 3) [m].
        correction: Newton step of the unknowns towards equilibrium (size,).
        modes: motions of the unknowns by depth [per m], log radius [-] and height [per m], (size, 3).
        force_modes: derivatives of the total contact force (3, 3), columns as in modes.
        force_correction: change of the total contact force that `correction` brings (3,) [N].
        imbalance: largest unbalanced nodal force [N].
        smallest_det: smallest det F of all elements [-].
    """

    forces: NDArray
    points: NDArray
    correction: NDArray
    modes: NDArray
    force_modes: NDArray
    force_correction: NDArray
    imbalance: float
    smallest_det: float


class RollingContact:
    """A model and its contact surface; the cylinder's axis is along y at x = face + radius - depth, z = height."""

    def __init__(self, model: JawModel, surface: ContactSurface, face_x: float) -> None:
        """Keeps the model, its contact surface and the plane x = face_x [m] of the undeformed surface."""
        self.model = model
        self.surface = surface
        self.face_x = face_x

    def linearize(self, q: NDArray, place: NDArray) -> PressedState:
        """Linearises the equilibrium f_int(q) = J^T p(J q, place) at unknowns q and place (depth, ln radius, height)."""
        radius = float(np.exp(place[LOG_RADIUS]))
        points = self.model.positions(self.surface.probe, q)
        contact = press_cylinder(
            points, self.surface.stiffness, self.face_x + radius - place[DEPTH], place[HEIGHT], radius
        )
        by_place = np.empty((len(points), 3, 3))
        by_place[:, :, DEPTH] = -contact.springs[:, :, 0]
        by_place[:, :, LOG_RADIUS] = radius * (contact.by_size + contact.springs[:, :, 0])
        by_place[:, :, HEIGHT] = contact.springs[:, :, 2]
        state = self.model.linearize(q)
        self.model.stiffen(state.tangent, self.surface.probe, q, contact.springs)
        factor = self.model.factorise(state.tangent)
        loads = [self.model.load(self.surface.probe, q, contact.forces) - state.force]
        loads += [self.model.load(self.surface.probe, q, np.ascontiguousarray(by_place[:, :, k])) for k in range(3)]
        steps = factor.solve(np.stack(loads, axis=1))
        motions = self.model.project(self.surface.probe, q, steps)
        relief = -np.einsum("pab,pbk->ak", contact.springs, motions)
        return PressedState(
            forces=contact.forces,
            points=points,
            correction=steps[:, 0],
            modes=steps[:, 1:],
            force_modes=by_place.sum(0) + relief[:, 1:],
            force_correction=relief[:, 0],
            imbalance=float(np.abs(loads[0]).max(initial=0.0)),
            smallest_det=state.smallest_det,
        )

    def approach(self, q: NDArray, step: NDArray, place: NDArray) -> NDArray:
        """Returns the step of a jaw that has lost contact, cut where its surface meets the cylinder again."""
        radius = float(np.exp(place[LOG_RADIUS]))
        centre = np.array([self.face_x + radius - place[DEPTH], place[HEIGHT]])
        low, high = 0.0, 1.0
        for _ in range(_BISECTIONS):
            share = 0.5 * (low + high)
            points = self.model.positions(self.surface.probe, q + share * step)
            gap = np.sqrt(((points[:, [0, 2]] - centre) ** 2).sum(1)).min() - radius
            if gap < -_TOUCH:
                high = share
            else:
                low = share
        return high * step


def limit_step(step: NDArray) -> NDArray:
    """Returns a step of the unknowns shortened so that no node moves more than 2 mm at once."""
    largest = np.abs(step).max(initial=0.0)
    return step if largest <= _LARGEST_STEP else step * (_LARGEST_STEP / largest)
