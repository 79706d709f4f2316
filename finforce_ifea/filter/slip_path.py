"""Mobilized friction of an object, for several coefficients at once, from its path.

While the contact sticks, a motion of the object turns the force by the angle that the tangential stiffness of jaw and
surface tells; it slides once the traction ratio kappa reaches the cone. For each coefficient mu,

    kappa <- clamp(kappa + (1 + kappa^2) s(kappa) . delta, -mu, mu),

with the motion delta of the object in depth and height, and the turn s [1/m] of the force by it, relative to the force
of an object that slides without friction. An object that touches first sticks, however little it presses: its path
begins with the ratio at which a stuck contact gives way, within the cone. This is the play operator of Prandtl; see
Visintin, Differential Models of Hysteresis, 1994, ch. III.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from finforce.compiled import njit
from finforce_ifea.contact_mechanics.friction import FRICTIONLESS, Traction
from finforce_ifea.contact_mechanics.pressed_jaw import RigidContact

_OPTIONS = {"cache": True, "error_model": "numpy"}
# Coefficient of friction of a contact that does not slide [-].
_STICKS = 1e3
# Traction ratios at which the turn of the force is measured [-].
_RATIOS = np.array([-0.4, 0.0, 0.4])
# The one of them with which nothing acts along the surface.
_UPRIGHT = 1
# Motion after which the turn is measured again [m].
_FRESH = 0.3e-3
# Longest step of the path at once [m].
_STEP = 0.1e-3
_NO_TURNS, _NOWHERE = np.zeros((2, 3)), (np.inf, np.inf)


class SlipPath:
    """Follows the path of one object.

    Attributes:
        coefficients: of friction (N,) [-].
        ratios: traction ratio of each (N,) [-].
        turns: of the force by the motion, see `measure_turns`; zero before anything touches.
    """

    def __init__(self, coefficients: NDArray) -> None:
        """Start with an object of some coefficients of friction (N,) that does not touch yet."""
        self.coefficients = np.asarray(coefficients, float)
        self.reset()

    def reset(self) -> None:
        """Forget the path."""
        self.ratios = np.zeros(len(self.coefficients))
        self.turns, self._stuck, self._at = _NO_TURNS, 0.0, _NOWHERE

    def move(self, contact: RigidContact, q: NDArray, x: NDArray, motion: NDArray) -> None:
        """Take the motion of the object.

        Args:
            contact: of the jaw.
            q: its unknowns (size,).
            x: state of the contact (3,).
            motion: in depth and height for each coefficient (N, 2) [m].
        """
        self._measure(contact, q, x)
        self.ratios = self.preview(motion)

    def begin(self, contact: RigidContact, q: NDArray, x: NDArray) -> None:
        """Begin with an object that has just touched; see `move` for the arguments."""
        self._measure(contact, q, x)
        self.ratios = np.clip(np.full(len(self.coefficients), self._stuck), -self.coefficients, self.coefficients)

    def _measure(self, contact: RigidContact, q: NDArray, x: NDArray) -> None:
        """Measure the turns anew where an object that may stick has moved."""
        if not max(abs(x[0] - self._at[0]), abs(x[2] - self._at[1])) > _FRESH or not self.coefficients.any():
            return
        turns, self._stuck = measure_turns(contact, q, x)
        self.turns, self._at = (_NO_TURNS, _NOWHERE) if turns is None else (turns, (x[0], x[2]))

    def preview(self, motion: NDArray) -> NDArray:
        """Return the traction ratios (N,) after a motion in depth and height (N, 2) [m], by the last turn."""
        return turn_path(self.ratios, self.coefficients, self.turns, motion)


@njit(**_OPTIONS)
def find_turn(turns, ratio):
    """Return the size of the turn by depth [1/m] at a traction ratio; see `measure_turns`."""
    return abs(np.interp(ratio, _RATIOS, turns[0]))


@njit(**_OPTIONS)
def turn_path(ratios, coefficients, turns, motion):
    """Return the ratios (N,) after a motion (N, 2) [m]; see the module and `measure_turns`."""
    out, largest = ratios.copy(), 0.0
    for i in range(len(motion)):
        largest = max(largest, abs(motion[i, 0]), abs(motion[i, 1]))
    steps = max(1, int(np.ceil(largest / _STEP)))
    for i in range(len(out)):
        for _ in range(steps):
            change = 0.0
            for a in range(2):
                change += motion[i, a] / steps * np.interp(out[i], _RATIOS, turns[a])
            change *= 1.0 + out[i] ** 2
            out[i] = min(max(out[i] + change, -coefficients[i]), coefficients[i])
    return out


def measure_turns(contact: RigidContact, q: NDArray, x: NDArray) -> tuple[NDArray | None, float]:
    """Return the turn of the force by depth and height of an object that sticks (2, 3) [1/m], None without contact.

    It is that at three traction ratios, less the turn of an object that slides without friction. With it comes the
    traction ratio of a contact that has stuck since it began.
    """
    points = contact.place_points(q)
    forces = contact.press(points, x, FRICTIONLESS).forces
    normal = np.hypot(forces[:, 0], forces[:, 2])
    if not normal.any():
        return None, 0.0
    smooth = contact.linearize(q, x, FRICTIONLESS)
    slides, turns, by_depth = _measure_turn(smooth.force, smooth.force_modes), [], []
    for ratio in _RATIOS:
        stuck = contact.linearize(q, x, Traction(0.0, _STICKS, ratio * normal, points, np.zeros(2)))
        force = np.array([smooth.force[0] + ratio * smooth.force[2], 0.0, smooth.force[2] - ratio * smooth.force[0]])
        turns.append(slides - _measure_turn(force, stuck.force_modes))
        by_depth.append(stuck.force_modes[:, 0])
    ahead, along = smooth.force[[0, 2]], smooth.force[[2, 0]] * [1.0, -1.0]
    gained = by_depth[_UPRIGHT][[0, 2]]
    return np.array(turns).T.copy(), float(gained @ along / (gained @ ahead))


def _measure_turn(force: NDArray, modes: NDArray) -> NDArray:
    """Return the turn (2,) [rad/m] of a force (3,) by depth and height, for its derivatives (3, 4)."""
    square = force[0] ** 2 + force[2] ** 2
    return (force[0] * modes[2, [0, 2]] - force[2] * modes[0, [0, 2]]) / square
