"""A jaw of stored equilibria under a rigid object: the same as `RollingContact`, at the price of a look-up."""

import numpy as np
from numpy.typing import NDArray

from finforce_ifea.indenter import Indenter, RoundIndenter
from finforce_ifea.reduced import ReducedModel, share_rows
from finforce_ifea.reduced_loops import FaceRows, place_contact, step_contact
from finforce_ifea.rolling import PressedState, find_share_that_meets
from finforce_ifea.surface import ContactSurface

# A shape this share of the finger's length from a stored one has an error of about a per cent of its force.
_FARTHEST_SHAPE = 0.0056
# A step larger than this share of what is allowed is cut where the energy rises by this share of the fall at its start.
_LARGE_STEP, _TOO_FAR, _BISECTIONS = 0.3, 0.5, 6


class ReducedContact:
    """A reduced model, its contact surface, and the object pressed into it."""

    def __init__(self, model: ReducedModel, surface: ContactSurface, face_x: float) -> None:
        """Keeps the model, its contact surface, one point per height, and the plane x = face_x [m]."""
        self.model, self.surface, self.face_x = model, surface, face_x
        self.indenter: Indenter = RoundIndenter()
        shares = share_rows(model.manifold.heights, surface.heights)
        upper = np.clip(np.searchsorted(model.manifold.heights, surface.heights) - 1, 0, shares.shape[1] - 1)
        share = shares[np.arange(len(upper)), upper]
        self._face = FaceRows(surface.points, upper - 1, share, model.manifold.rods)
        length = surface.heights[-1] - surface.heights[0]
        # the rest alone is stored on purpose where no rod was pressed in
        self._farthest = _FARTHEST_SHAPE * length if model.manifold.depths.any() else np.inf
        self._tables = (model.manifold.moves, model.compliance, model.loads)

    def begin(self, height: float) -> NDArray:
        """Returns the unknowns (size,) of the unloaded jaw that is to be touched at a height [m]."""
        q, rods = np.zeros(self.model.size), self.model.manifold.rods
        q[-1] = np.interp(height, rods, np.arange(len(rods)))
        return q

    def linearize(self, q: NDArray, place: NDArray) -> PressedState:
        """Linearises the equilibrium with the object at a place (depth, shape, height); see `RollingContact`."""
        moves = self.model.moves(q)
        points = place_contact(self._face, moves)
        contact = self.indenter.press(points, self.surface.stiffness, self.face_x, place)
        parts = (contact.forces, contact.springs, contact.by_shape)
        step = step_contact(q, self._tables, self._face, moves, points, parts)
        correction, force = step.correction, step.force
        if step.touches and step.size > _LARGE_STEP and not correction[-2:].any():
            share = self._find_share(q, points, correction, place)
            correction = share * correction
            force = share * force + (1.0 - share) * np.array([q[:-2:2].sum(), 0.0, q[1:-2:2].sum()])
        return PressedState(
            touches=step.touches,
            correction=correction,
            modes=step.modes,
            force=force,
            force_modes=step.force_modes,
            pressure_point=step.pressure_point,
            pressure_place=step.pressure_place,
            smallest_det=1.0,
            size=step.size,
            extrapolation=step.away / self._farthest,
        )

    def _find_share(self, q: NDArray, points: NDArray, step: NDArray, place: NDArray) -> float:
        """Returns the share of a step up to which the energy of jaw and object falls; corners make it rise again.

        Along a step of the loads that moves the rows by du and contact points (p, 3) by dx, it changes by
        (lambda - p)^T du, all as far as the step has gone.
        """
        after = self.model.moves(q + step)
        motion, moved = place_contact(self._face, after) - points, after - self.model.moves(q)

        def change_energy(share: float) -> float:
            contact = self.indenter.press(points + share * motion, self.surface.stiffness, self.face_x, place)
            return float((q[:-2] + share * step[:-2]) @ moved - (contact.forces * motion).sum())

        share, low, high = 1.0, 0.0, 1.0
        if change_energy(1.0) <= _TOO_FAR * abs(change_energy(0.0)):
            return 1.0
        for _ in range(_BISECTIONS):
            share = 0.5 * (low + high)
            low, high = (low, share) if change_energy(share) > 0.0 else (share, high)
        return share

    def approach(self, q: NDArray, step: NDArray, place: NDArray) -> NDArray:
        """Returns the step of a jaw that has lost contact, cut where its surface meets the object again."""

        def find_gap(share: float) -> float:
            points = place_contact(self._face, self.model.moves(q + share * step))
            return self.indenter.find_gap(points, self.face_x, place)

        return find_share_that_meets(find_gap) * step
