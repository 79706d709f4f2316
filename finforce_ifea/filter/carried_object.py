"""Motion along the finger of an object that only the jaws hold: they carry it as they bend; another support does not.

While the contact sticks, the traction ratio kappa changes with depth d and height h as dk = a dd + b dh. Of an object
that only the jaws hold it balances the inclination of their faces, kappa_u, so that

    dh = (dkappa_u - a dd) / b.

The observed motion since first touch is compared with that, and with none; one that is neither tells nothing.
"""

from __future__ import annotations

from math import isnan, log, nan

from numpy.typing import NDArray

from finforce_ifea.filter.slip_path import find_rate
from finforce_ifea.tracking.contact_state import TOUCH_DEPTH

# Standard deviation of the object's motion since first touch, relative to that of its pose, most of which lasts [-].
_MOVED = 0.5
# Relative error of the motion by which a jaw carries an object [-]: the other one may carry it differently.
_CARRIED = 0.4
# Squared distance [sigma^2] from which a motion is neither the one nor the other.
_NEITHER = 8.0
# Gain of the mean height of an object that does not touch yet [-].
_HEIGHT_GAIN = 0.05
# Motion from which that mean starts anew [m].
_ELSEWHERE = 1e-3


class CarriedObject:
    """Compares the motion of one object with the one by which the jaws would carry it.

    Attributes:
        carried: motion along the finger since first touch if only the jaws hold it [m].
    """

    def __init__(self) -> None:
        """Start with an object of which no pose has come."""
        self._height, self._height_stddev, self._first_height, self._is_seen = nan, nan, nan, False
        self.leave()

    def leave(self) -> None:
        """Reset to an object that does not touch."""
        self.carried, self._depth, self._upright, self._touches = 0.0, nan, 0.0, False

    def see(self, height: float, stddev: float) -> None:
        """Take the object's height by its pose, and its standard deviation [m]; unless it changes, it is not seen."""
        self._is_seen |= not isnan(self._height) and height != self._height
        self._height, self._height_stddev = height, stddev
        if not self._touches:
            change = height - self._first_height
            self._first_height = self._first_height + _HEIGHT_GAIN * change if abs(change) < _ELSEWHERE else height

    def follow(self, depth: float, upright: float, rates: NDArray, shares: NDArray) -> None:
        """Carry the object on to another depth.

        Args:
            depth: of the object [m].
            upright: traction ratio of an object that only the jaws hold there [-].
            rates: see `SlipPath`.
            shares: see `SlipPath`.
        """
        by_depth = find_rate(rates, shares, upright, 1.0, 0.0)
        by_height = find_rate(rates, shares, upright, 0.0, 1.0)
        if by_height != 0.0 and not isnan(self._depth):
            self.carried += (upright - self._upright - by_depth * (depth - self._depth)) / by_height
        self._depth, self._upright, self._touches = depth, upright, depth > TOUCH_DEPTH

    def shift(self, change: float) -> None:
        """Shift the depth by a change [m]."""
        self._depth += change

    @property
    def log_odds(self) -> float:
        """Log odds that only the jaws hold the object, by its motion."""
        if not (self._is_seen and self._touches):
            return 0.0
        moved, variance = self._height - self._first_height, (_MOVED * self._height_stddev) ** 2
        wide = variance + (_CARRIED * self.carried) ** 2
        stays, follows = moved**2 / variance, (moved - self.carried) ** 2 / wide
        return 0.5 * (min(stays, _NEITHER) - min(follows, _NEITHER) - log(wide / variance))
