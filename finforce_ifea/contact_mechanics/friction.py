"""Coulomb friction between surface points and a rigid object, with the history that it needs.

A point that touches is held by a tangential spring as stiff as the penalty along the normal. It slides once the spring
exceeds the cone,

    T = clamp(T_before - k t . (x - x_before - X + X_before), +- c N),

with the normal n and N = |normal force|, the tangent t = (n_z, -n_x), the point's place x and the object's X.
"""

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from finforce_ifea.contact_mechanics.penalty import PenaltyContact

_OPTIONS = {"cache": True, "error_model": "numpy"}


class RubbedContact(NamedTuple):
    """Contact at surface points, tangential forces included.

    Attributes:
        forces: on the points (p, 3) [N].
        springs: negative derivatives of the forces by the points' positions (p, 3, 3) [N/m].
        changes: derivatives of the forces by the object's depth, shape and height and by a lean of all forces
            (p, 3, 4).
        shear: along the tangents (p,) [N].
        mobilised: what the shear adds up to over what the cone allows, from -1 to 1.
    """

    forces: NDArray
    springs: NDArray
    changes: NDArray
    shear: NDArray
    mobilised: float


class LeaningContact:
    """Tangential forces that are one share of all normal forces, as where everything slides the same way.

    Attributes:
        lean: that share, along t.
    """

    def __init__(self) -> None:
        """Starts upright."""
        self.lean = 0.0

    def rub(self, contact: PenaltyContact, points: NDArray, stiffness: NDArray, origin: NDArray) -> RubbedContact:
        """Returns the contact with its tangential forces; see `Friction.rub`."""
        return _lean(contact.forces, contact.springs, contact.by_shape, self.lean)


class Friction:
    """The friction of one object on a surface of some points.

    Attributes:
        coefficient: of the object, 0 for none.
    """

    def __init__(self, count: int) -> None:
        """Starts with points (count) that nothing has touched."""
        self.coefficient = 0.0
        self._count = count
        self.reset()

    def reset(self) -> None:
        """Forgets what the points have done; the coefficient stays."""
        self._shear = np.zeros(self._count)
        self._before: tuple[NDArray, NDArray] | None = None

    def shift(self, change: float) -> None:
        """Counts the object's x from another place, `change` [m] more."""
        if self._before is not None:
            self._before = self._before[0], self._before[1] + np.array([change, 0.0])

    def rub(self, contact: PenaltyContact, points: NDArray, stiffness: NDArray, origin: NDArray) -> RubbedContact:
        """Returns the contact with friction.

        Args:
            contact: without friction.
            points: deformed positions (p, 3) [m].
            stiffness: of each point (p,) [N/m].
            origin: of the object (x, z) [m].
        """
        before, start = self._before or (points, origin)
        parts = (contact.forces, contact.springs, contact.by_shape)
        return _rub(parts, points, before, self._shear, stiffness, origin - start, self.coefficient)

    def settle(self, contact: PenaltyContact, points: NDArray, stiffness: NDArray, origin: NDArray) -> float:
        """Remembers an equilibrium; arguments as for `rub`. Returns how far the cone is used, from -1 to 1."""
        rubbed = self.rub(contact, points, stiffness, origin)
        self._before, self._shear = (points.copy(), origin.copy()), rubbed.shear
        return rubbed.mobilised


@njit(**_OPTIONS)
def _change(forces, springs, by_shape):
    """Returns the derivatives (p, 3, 4) of normal forces and by their lean; see `RubbedContact`."""
    changes = np.zeros((len(forces), 3, 4))
    for p in range(len(forces)):
        for a in range(0, 3, 2):
            changes[p, a, 0], changes[p, a, 1], changes[p, a, 2] = -springs[p, a, 0], by_shape[p, a], springs[p, a, 2]
        changes[p, 0, 3], changes[p, 2, 3] = forces[p, 2], -forces[p, 0]
    return changes


@njit(**_OPTIONS)
def _add_lean(lean, springs, stiff, changes):
    """Adds what a lean of one point's force makes of its springs (3, 3) and derivatives (3, 4), in place."""
    for b in range(0, 3, 2):
        stiff[0, b] += lean * springs[2, b]
        stiff[2, b] -= lean * springs[0, b]
    for i in range(3):
        ahead, aside = changes[0, i], changes[2, i]
        changes[0, i], changes[2, i] = ahead + lean * aside, aside - lean * ahead


@njit(**_OPTIONS)
def _lean(forces, springs, by_shape, lean):
    """Returns the contact with a lean of all its forces."""
    out, stiff, changes = forces.copy(), springs.copy(), _change(forces, springs, by_shape)
    for p in range(len(forces)):
        out[p, 0] += lean * forces[p, 2]
        out[p, 2] -= lean * forces[p, 0]
        _add_lean(lean, springs[p], stiff[p], changes[p])
    return RubbedContact(out, stiff, changes, np.zeros(len(forces)), 0.0)


@njit(**_OPTIONS)
def _rub(contact, points, before, shear_before, stiffness, moved, coefficient):
    """Returns the contact (forces, springs, by_shape) with friction, the object moved by `moved` (x, z) [m]."""
    forces, springs, by_shape = contact
    out, stiff, changes = forces.copy(), springs.copy(), _change(forces, springs, by_shape)
    shear, total, allowed = np.zeros(len(points)), 0.0, 0.0
    for p in range(len(points)):
        normal = np.hypot(forces[p, 0], forces[p, 2])
        if normal <= 0.0:
            continue
        tx, tz = forces[p, 2] / normal, -forces[p, 0] / normal
        slip = tx * (points[p, 0] - before[p, 0] - moved[0]) + tz * (points[p, 2] - before[p, 2] - moved[1])
        shear[p] = shear_before[p] - stiffness[p] * slip
        limit = coefficient * normal
        if abs(shear[p]) > limit:
            shear[p] = limit if shear[p] > 0.0 else -limit
            _add_lean(shear[p] / normal, springs[p], stiff[p], changes[p])
        else:
            held = stiffness[p]
            for a, ta in ((0, tx), (2, tz)):
                stiff[p, a, 0] += held * ta * tx
                stiff[p, a, 2] += held * ta * tz
                changes[p, a, 0] -= held * ta * tx
                changes[p, a, 2] += held * ta * tz
        out[p, 0] += shear[p] * tx
        out[p, 2] += shear[p] * tz
        total += shear[p]
        allowed += limit
    return RubbedContact(out, stiff, changes, shear, total / allowed if allowed > 0.0 else 0.0)
