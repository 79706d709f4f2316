"""A jaw of stored equilibria under a rigid object: the same as `RollingContact`, at the price of a look-up."""

import numpy as np
from numpy.typing import NDArray

from finforce_ifea.indenter import Indenter, RoundIndenter
from finforce_ifea.reduced import ReducedModel, share_rows
from finforce_ifea.reduced_loops import find_grid_step, place_contact, solve_contact
from finforce_ifea.rolling import PressedState
from finforce_ifea.surface import ContactSurface

_BISECTIONS, _TOUCH = 10, 2e-5
# Below this grid coordinate of the depth a jaw is too little bent to tell the height by its shape.
_SHALLOW = 0.5


class ReducedContact:
    """A reduced model, its contact surface, and the object pressed into it."""

    def __init__(self, model: ReducedModel, surface: ContactSurface, face_x: float) -> None:
        """Keeps the model, its contact surface, one point per height, and the plane x = face_x [m]."""
        self.model, self.surface, self.face_x = model, surface, face_x
        self.indenter: Indenter = RoundIndenter()
        shares = share_rows(model.manifold.heights, surface.heights)
        upper = np.clip(np.searchsorted(model.manifold.heights, surface.heights) - 1, 0, shares.shape[1] - 1)
        self._low, self._share = upper - 1, shares[np.arange(len(upper)), upper]

    def linearize(self, q: NDArray, place: NDArray) -> PressedState:
        """Linearises the equilibrium with the object at a place (depth, shape, height); see `RollingContact`."""
        model, count = self.model, self.model.rows
        moves = model.moves(q)
        points = place_contact(self.surface.points, self._low, self._share, moves)
        contact = self.indenter.press(points, self.surface.stiffness, self.face_x, place)
        steps = solve_contact(
            q, model.compliance, self._low, self._share, contact.forces, contact.springs, contact.by_shape
        )
        size = np.hypot(contact.forces[:, 0], contact.forces[:, 2])
        total = size.sum()
        share = size / total if total > 0 else np.full(len(size), np.nan)
        pressure = share @ self.surface.points
        correction = np.r_[steps[:, 0], self._turn_grid(q, moves, pressure[2])]
        total_loads = np.zeros((3, 4))
        total_loads[[0, 2]] = steps.reshape(-1, 2, 4).sum(0)
        return PressedState(
            touches=bool(total > 0),
            correction=correction,
            modes=np.concatenate([steps[:, 1:], np.zeros((2, 3))]),
            force=total_loads[:, 0] + [q[:count:2].sum(), 0.0, q[1:count:2].sum()],
            force_modes=total_loads[:, 1:],
            pressure_point=share @ points,
            pressure_place=pressure,
            smallest_det=1.0,
        )

    def _turn_grid(self, q: NDArray, moves: NDArray, height: float) -> NDArray:
        """Returns the step (2,) of the grid coordinates."""
        m, rods = q[-2:], self.model.manifold.rods
        step = find_grid_step(self.model.manifold.moves, moves, m)
        if m[0] < _SHALLOW and np.isfinite(height):
            step[1] = np.interp(height, rods, np.arange(len(rods))) - m[1]
        return step

    def approach(self, q: NDArray, step: NDArray, place: NDArray) -> NDArray:
        """Returns the step of a jaw that has lost contact, cut where its surface meets the object again."""
        low, high = 0.0, 1.0
        for _ in range(_BISECTIONS):
            share = 0.5 * (low + high)
            moves = self.model.moves(q + share * step)
            points = place_contact(self.surface.points, self._low, self._share, moves)
            if self.indenter.find_gap(points, self.face_x, place) < -_TOUCH:
                high = share
            else:
                low = share
        return high * step
