"""How much of its friction an object uses, for several coefficients at once, from its path.

While the contact sticks, a motion of the object turns the force by the angle that the tangential stiffness of jaw and
surface tells; it slides once the traction ratio kappa reaches the cone. For each coefficient mu,

    kappa <- clamp(kappa + (1 + kappa^2) s(kappa) . delta, -mu, mu),

with the motion delta of the object in depth and height, and the turn s [1/m] of the force by it, relative to the force
of an object that slides without friction. This is the play operator of Prandtl; see Visintin, Differential Models of
Hysteresis, 1994, ch. III.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from finforce_ifea.contact_mechanics.friction import FRICTIONLESS, Traction
from finforce_ifea.contact_mechanics.pressed_jaw import RigidContact

# Coefficient of friction of a contact that does not slide [-].
_STICKS = 1e3
# Traction ratios at which the turn of the force is measured [-].
_RATIOS = (-0.4, 0.0, 0.4)
# Motion after which the turn is measured again [m].
_FRESH = 0.3e-3
# Longest step of the path at once [m].
_STEP = 0.1e-3


class SlipPath:
    """Follows the path of one object.

    Attributes:
        coefficients: of friction (N,) [-].
        ratios: traction ratio of each (N,) [-].
    """

    def __init__(self, coefficients: NDArray) -> None:
        """Start with an object of some coefficients of friction (N,) that does not touch yet."""
        self.coefficients = np.asarray(coefficients, float)
        self.reset()

    def reset(self) -> None:
        """Forget the path."""
        self.ratios = np.zeros(len(self.coefficients))
        self._turns: NDArray | None = None
        self._at = np.zeros(2)

    def turn_at(self, ratio: float) -> float:
        """Return the size of the turn by depth [1/m] at a traction ratio, 0 before anything touches."""
        return 0.0 if self._turns is None else abs(float(np.interp(ratio, _RATIOS, self._turns[0])))

    def move(self, contact: RigidContact, q: NDArray, x: NDArray, motion: NDArray) -> None:
        """Take the motion of the object.

        Args:
            contact: of the jaw.
            q: its unknowns (size,).
            x: state of the contact (3,).
            motion: in depth and height for each coefficient (N, 2) [m].
        """
        if not self.coefficients.any():
            return
        place = x[[0, 2]]
        if self._turns is None or np.abs(place - self._at).max() > _FRESH:
            self._turns, self._at = measure_turns(contact, q, x), place
        if self._turns is None:
            return
        steps = max(1, int(np.ceil(np.abs(motion).max() / _STEP)))
        for _ in range(steps):
            turn = np.stack([np.interp(self.ratios, _RATIOS, turns) for turns in self._turns], axis=1)
            change = (1.0 + self.ratios**2) * (motion / steps * turn).sum(axis=1)
            self.ratios = np.clip(self.ratios + change, -self.coefficients, self.coefficients)


def measure_turns(contact: RigidContact, q: NDArray, x: NDArray) -> NDArray | None:
    """Return the turn of the force by depth and height of an object that sticks (2, 3) [1/m], None without contact.

    It is that at three traction ratios, less the turn of an object that slides without friction.
    """
    points = contact.place_points(q)
    forces = contact.press(points, x, FRICTIONLESS).forces
    normal = np.hypot(forces[:, 0], forces[:, 2])
    if not normal.any():
        return None
    smooth = contact.linearize(q, x, FRICTIONLESS)
    slides, turns = _measure_turn(smooth.force, smooth.force_modes), []
    for ratio in _RATIOS:
        stuck = contact.linearize(q, x, Traction(0.0, _STICKS, ratio * normal, points, np.zeros(2)))
        force = np.array([smooth.force[0] + ratio * smooth.force[2], 0.0, smooth.force[2] - ratio * smooth.force[0]])
        turns.append(slides - _measure_turn(force, stuck.force_modes))
    return np.array(turns).T


def _measure_turn(force: NDArray, modes: NDArray) -> NDArray:
    """Return the turn (2,) [rad/m] of a force (3,) by depth and height, for its derivatives (3, 4)."""
    square = force[0] ** 2 + force[2] ** 2
    return (force[0] * modes[2, [0, 2]] - force[2] * modes[0, [0, 2]]) / square
