"""Mobilized friction of an object, for several coefficients at once, from its path.

The two edges of a flat object stick and slide in turn, often against each other: a contact with a gap has two parts,
any other has one. While a part sticks, the stiffness of jaw and surface tells how a motion of the object changes its
force F. Its traction ratio kappa then changes, for each coefficient mu, as

    kappa <- clamp(kappa + (t . dF - kappa n . dF) / N - (1 + kappa^2) dnu, -mu, mu),

with the normal force N along n, its turn dnu, and the tangent t. The force also depends on whether the other part
sticks, or slides at its cone. A part that touches first sticks, however little it presses: its path begins with the
ratio at which it gives way while all sticks, within the cone. Each part is a play operator of Prandtl; see Visintin,
Differential Models of Hysteresis, 1994, ch. III.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from finforce.compiled import njit
from finforce_ifea.contact_mechanics.friction import FRICTIONLESS, Traction
from finforce_ifea.contact_mechanics.pressed_jaw import RigidContact
from finforce_ifea.filter.state import DEPTH, HEIGHT

_OPTIONS = {"cache": True, "error_model": "numpy"}
# Coefficient of friction of a sticking contact [-].
_STICKS = 1e3
# Motion after which the rates are computed again [m].
_FRESH = 0.15e-3
# Longest step of the path [m].
_STEP = 0.02e-3
# Step of the finite differences [m].
_SMALL = 1e-6
# Least gap between two parts of a contact [m].
_GAP = 4e-3
# Of `measure_rates`: a part sticks while the other does, too, or while it slides.
_BOTH, _ALONE = 0, 1
_NO_RATES, _NOWHERE = np.zeros((2, 2, 3, 2)), (np.inf, np.inf)


class PathState(NamedTuple):
    """Traction ratios of the contact's parts (N, 2) [-], and their heights (2,) [m], infinite where there is none."""

    parts: NDArray
    heights: NDArray


class SlipPath:
    """Follows the path of one object.

    Attributes:
        coefficients: of friction (N,) [-].
        parts: traction ratio of the lower and the upper part of the contact, of each coefficient (N, 2) [-].
        shares: of the parts in the normal force (2,) [-].
        rates: of the ratios by the motion, see `measure_rates`; zero before anything touches.
    """

    def __init__(self, coefficients: NDArray) -> None:
        """Start with an object of some coefficients of friction (N,) that does not touch yet."""
        self.coefficients = np.asarray(coefficients, float)
        self.reset()

    def reset(self) -> None:
        """Forget the path."""
        self.parts, self.shares = np.zeros((len(self.coefficients), 2)), np.array([1.0, 0.0])
        self.rates, self._heights, self._at = _NO_RATES, np.full(2, np.inf), _NOWHERE

    @property
    def ratios(self) -> NDArray:
        """Traction ratio of the whole contact for each coefficient (N,) [-]."""
        return self.parts @ self.shares

    def move(self, contact: RigidContact, q: NDArray, x: NDArray, motion: NDArray) -> None:
        """Move the object.

        Args:
            contact: of the jaw.
            q: its unknowns (size,).
            x: state of the contact (3,).
            motion: in depth and height for each coefficient (N, 2) [m].
        """
        self.measure(contact, q, x)
        self.parts = turn_path(self.parts, self.coefficients, self.rates, motion)

    def measure(self, contact: RigidContact, q: NDArray, x: NDArray) -> None:
        """Compute the rates again where an object that may stick has moved; see `move` for the arguments."""
        if max(abs(x[0] - self._at[0]), abs(x[2] - self._at[1])) > _FRESH and self.coefficients.any():
            before = self.state
            self.rates, self.shares, self._heights = measure_rates(contact, q, x)
            self._at = _NOWHERE if np.isinf(self._heights).all() else (x[0], x[2])
            self.resume(before)

    @property
    def state(self) -> PathState:
        """State for `resume`."""
        return PathState(self.parts, self._heights)

    def resume(self, state: PathState) -> None:
        """Continue from another state; a new part of the contact starts at its ratio while everything sticks."""
        along, ahead, turned = self.rates[_BOTH, :, :, 0].T
        stuck = np.divide(along - turned, ahead, out=np.zeros(2), where=ahead != 0.0)
        self.parts = np.clip(stuck, -self.coefficients[:, None], self.coefficients[:, None])
        for i in np.flatnonzero(np.isfinite(self._heights)):
            nearest = int(np.abs(state.heights - self._heights[i]).argmin())
            if abs(state.heights[nearest] - self._heights[i]) < _GAP:
                self.parts[:, i] = state.parts[:, nearest]


@njit(**_OPTIONS)
def find_turn(rates, shares, ratio):
    """Return the size of the change of a traction ratio by depth [1/m] while all of the contact sticks."""
    return abs(find_rate(rates, shares, ratio, 1.0, 0.0))


@njit(**_OPTIONS)
def find_rate(rates, shares, ratio, depth, height):
    """Return the change of a traction ratio by a motion in depth and height [m] while all of the contact sticks."""
    turn = 0.0
    for h in range(2):
        turn += shares[h] * _find_rate(rates[_BOTH, h], ratio, depth, height)
    return turn


@njit(**_OPTIONS)
def _find_rate(rates, ratio, depth, height):
    """Return the change of a traction ratio by a motion in depth and height [m] for rates (3, 2) [1/m]."""
    along = rates[0, 0] * depth + rates[0, 1] * height
    ahead = rates[1, 0] * depth + rates[1, 1] * height
    turned = rates[2, 0] * depth + rates[2, 1] * height
    return along - ratio * ahead - (1.0 + ratio**2) * turned


@njit(**_OPTIONS)
def turn_path(parts, coefficients, rates, motion):
    """Return the ratios of both parts (N, 2) after a motion (N, 2) [m]; see the module and `measure_rates`."""
    out = parts.copy()
    for i in range(len(out)):
        mu, (depth, height) = coefficients[i], motion[i]
        steps = max(1, int(np.ceil(max(abs(depth), abs(height)) / _STEP)))
        depth, height = depth / steps, height / steps
        for _ in range(steps):
            lower = out[i, 0] + _find_rate(rates[_BOTH, 0], out[i, 0], depth, height)
            upper = out[i, 1] + _find_rate(rates[_BOTH, 1], out[i, 1], depth, height)
            if abs(upper) > mu >= abs(lower):
                lower = out[i, 0] + _find_rate(rates[_ALONE, 0], out[i, 0], depth, height)
            elif abs(lower) > mu >= abs(upper):
                upper = out[i, 1] + _find_rate(rates[_ALONE, 1], out[i, 1], depth, height)
            out[i, 0], out[i, 1] = min(max(lower, -mu), mu), min(max(upper, -mu), mu)
    return out


def measure_rates(contact: RigidContact, q: NDArray, x: NDArray) -> tuple[NDArray, NDArray, NDArray]:
    """Return rates of the parts' forces (2, 2, 3, 2) [1/m], the parts' shares (2,), and their heights (2,) [m].

    The rates are those of a part that sticks, if both do, or it alone; of the lower and the upper part; along the
    surface and ahead, relative to the part's normal force, and of the turn of the latter; by depth and height. A part
    that is missing has none, and an infinite height.
    """
    points, rates, shares, heights = contact.place_points(q), _NO_RATES.copy(), np.zeros(2), np.full(2, np.inf)
    smooth = contact.press(points, x, FRICTIONLESS)
    size, rest = np.hypot(smooth.forces[:, 0], smooth.forces[:, 2]), contact.surface.points[:, 2]
    parts = _split(size, rest)
    alone = [(_ALONE, [h]) for h in range(len(parts))] if len(parts) > 1 else []
    for case, sticking in [(_BOTH, list(range(len(parts)))), *alone] if parts else []:
        traction = Traction(0.0, np.zeros(len(points)), np.zeros(len(points)), points, np.zeros(2))
        for h in sticking:
            traction.coefficient[parts[h]] = _STICKS
        modes = contact.linearize(q, x, traction).modes
        moved = [contact.place_points(q + _SMALL * modes[:, i]) for i in (DEPTH, HEIGHT)]
        for h in sticking:
            part = parts[h]
            own = Traction(0.0, traction.coefficient[part], traction.shear[part], points[part], traction.moved)
            pressed = contact.indenter.press(points[part], contact.surface.stiffness[part], contact.face_x, x, own)
            rates[case, h] = _find_rates(tuple(pressed), tuple(smooth), part, points, *moved)
    for i, part in enumerate(parts):
        own = size[part]
        shares[i], heights[i] = own.sum() / size.sum(), (own * rest[part]).sum() / own.sum()
    return rates, shares, heights


def _split(size: NDArray, heights: NDArray) -> list[NDArray]:
    """Return the indices of the points in each part, the lower one first, for forces and heights (p,) [N, m]."""
    touching = np.flatnonzero(size)
    if not touching.size:
        return []
    gaps = np.diff(heights[touching])
    widest = int(gaps.argmax()) + 1 if len(gaps) else 0
    return [touching[:widest], touching[widest:]] if widest and gaps[widest - 1] >= _GAP else [touching]


@njit(**_OPTIONS)
def _find_rates(pressed, smooth, part, points, deeper, higher):
    """Return the rates (3, 2) [1/m] of a part that sticks, see `measure_rates`.

    Args:
        pressed: `PenaltyContact` of its points (k,) that stick, as a plain tuple.
        smooth: that of all points (p,) without friction.
        part: indices of its points (k,).
        points: where all points are (p, 3) [m].
        deeper: where they are once the object is by `_SMALL` deeper (p, 3) [m].
        higher: the same for the height.
    """
    normal, change, turned = np.zeros(3), np.zeros((3, 2)), np.zeros((3, 2))
    for i in range(len(part)):
        k = part[i]
        for c, moved in enumerate((deeper, higher)):
            for a in range(3):
                change[a, c] += pressed[2][i, a, 2 * c]
                turned[a, c] += smooth[2][k, a, 2 * c]
                for b in range(3):
                    motion = (moved[k, b] - points[k, b]) / _SMALL
                    change[a, c] -= pressed[1][i, a, b] * motion
                    turned[a, c] -= smooth[1][k, a, b] * motion
        for a in range(3):
            normal[a] += smooth[0][k, a]
    rates, square = np.empty((3, 2)), (normal**2).sum()
    for c in range(2):
        rates[0, c] = (normal[2] * change[0, c] - normal[0] * change[2, c]) / square
        rates[1, c] = (normal * change[:, c]).sum() / square
        rates[2, c] = (normal[2] * turned[0, c] - normal[0] * turned[2, c]) / square
    return rates
