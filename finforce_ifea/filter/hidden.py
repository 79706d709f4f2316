"""Force that an object may exert where key points hardly show it: next to the clamp.

An object whose clearance c from the deformed jaw has the standard deviation s at a height may press there, and one that
seems to press there may be clear of it. With the stiffness k of the jaw, the force has the standard deviation
k (s - |c| / 3).
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from finforce.compiled import njit
from finforce_ifea.contact_mechanics.indenter import HEIGHT, SHAPE, PressedObject, find_clearances
from finforce_ifea.contact_mechanics.pressed_jaw import ContactSurface

_OPTIONS = {"cache": True, "error_model": "numpy"}
# Heights next to the clamp, relative to the lowest at which key points show a force [-].
_NEXT_TO_CLAMP = np.array([0.2, 0.4, 0.6, 0.8, 1.0])
# Clearance, of either sign, beyond which the state of the contact is certain [m].
_WELL_CLEAR = 3e-3
# Clearance from which an object is apart from the jaw [sigma].
APART_SIGMAS = 3.0
_LEAST_VARIANCE = 1e-12


def list_clamped_heights(lowest: float) -> NDArray:
    """Return heights (b,) [m] next to the clamp, for the lowest at which key points show a force [m]."""
    return lowest * _NEXT_TO_CLAMP


class HiddenForce:
    """Bounds the force next to the clamp, within the uncertainty of the object's state."""

    def __init__(self, heights: NDArray, stiffness: NDArray, surface: ContactSurface) -> None:
        """Keep where such a force may act: heights (b,) [m], rising, and the stiffness of the jaw there (b,) [N/m]."""
        self._heights, self._stiffness = heights, stiffness
        self._rows = np.maximum(0, np.searchsorted(surface.heights, heights) - 1)

    def is_next_to_clamp(self, centre: float) -> bool:
        """Return whether key points tell nothing of a force about a height [m]."""
        return centre < self._heights[-1]

    def bound(
        self,
        pressed: PressedObject,
        x: NDArray,
        covariance: NDArray,
        move_surface: Callable[[], NDArray],
    ) -> float:
        """Return the standard deviation of a hidden force [N].

        Args:
            pressed: the object.
            x: state of the contact (3,).
            covariance: of x (3, 3).
            move_surface: returns the motion along x of the jaw's surface at its heights (h,) [m].
        """
        if pressed.is_round:  # a cylinder, which is small and round
            return 0.0
        clearance, stddev = _measure_clearances(tuple(pressed), x, covariance, self._heights)
        near = np.isfinite(clearance)
        if not near.any():
            return 0.0
        beyond = stddev[near] - np.abs(clearance[near] - move_surface()[self._rows[near]]) / APART_SIGMAS
        return max(0.0, float((self._stiffness[near] * beyond).max()))


@njit(**_OPTIONS)
def _measure_clearances(pressed, x, covariance, heights):
    """Return clearance and its deviation (m,) [m] at each height, infinite where the object is elsewhere or clear."""
    pressed, count, step = PressedObject(*pressed), len(heights), np.zeros(3)
    slope, variance = np.full((3, count), -1.0), np.zeros(count)
    clearance = find_clearances(pressed, x, heights)
    for i in (SHAPE, HEIGHT):
        step[:] = 0.0
        step[i] = np.sqrt(max(covariance[i, i], _LEAST_VARIANCE))
        slope[i] = find_clearances(pressed, x + step, heights) - find_clearances(pressed, x - step, heights)
        slope[i] *= 0.5 / step[i]
    for p in range(count):
        if not abs(clearance[p]) < _WELL_CLEAR:
            clearance[p] = np.inf
        for i in range(3):
            for j in range(3):
                if np.isfinite(slope[i, p] + slope[j, p]):
                    variance[p] += slope[i, p] * covariance[i, j] * slope[j, p]
    return clearance, np.sqrt(np.maximum(variance, 0.0))
