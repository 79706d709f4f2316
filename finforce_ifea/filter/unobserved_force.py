"""Unobserved force of an object: next to the clamp, or along a flat face.

An object whose clearance c from the deformed jaw has the standard deviation s at a height may press there, and one that
seems to press there may be clear of it. With the stiffness k of the jaw, the force has the standard deviation
k (s - |c| / 3), but no more than what key points leave of a force at that height.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from finforce.compiled import njit
from finforce_ifea.contact_mechanics.indenter import HEIGHT, SHAPE, PressedObject, find_clearances
from finforce_ifea.contact_mechanics.pressed_jaw import ContactSurface

_OPTIONS = {"cache": True, "error_model": "numpy"}
# Heights next to the clamp, relative to the lowest at which key points show a force [-].
_NEXT_TO_CLAMP = np.array([0.2, 0.4, 0.6, 0.8, 1.0])
# Every n-th of the heights along the finger is used.
_EVERY = 3
# Distance along the finger from the pressure centre from which a force is elsewhere [m].
_ELSEWHERE = 5e-3
# Clearance, of either sign, beyond which the state of the contact is certain [m].
_WELL_CLEAR = 3e-3
# Clearance from which an object is apart from the jaw [sigma].
APART_SIGMAS = 3.0
_LEAST_VARIANCE = 1e-12


def list_clamped_heights(lowest: float) -> NDArray:
    """Return heights (b,) [m] next to the clamp, for the lowest at which key points show a force [m]."""
    return lowest * _NEXT_TO_CLAMP


class UnobservedForce:
    """Bounds the unobserved force within the uncertainty of the object's state."""

    def __init__(
        self,
        clamped: Sequence[tuple[float, float]],
        along: Sequence[tuple[float, float, float]],
        surface: ContactSurface,
    ) -> None:
        """Store the positions of such a force.

        Args:
            clamped: heights [m] next to the clamp, rising, and the stiffness of the jaw there [N/m].
            along: heights along the finger [m], stiffness [N/m], and the standard deviation of what all key points tell
                of a force there [N].
            surface: of the jaw.
        """
        self._places = np.array([*((*place, np.inf) for place in clamped), *along[::_EVERY]])
        self._clamped, self._lowest = len(clamped), clamped[-1][0]
        self._rows = np.maximum(0, np.searchsorted(surface.heights, self._places[:, 0]) - 1)

    def is_next_to_clamp(self, centre: float) -> bool:
        """Return True if key points show no force at a height [m]."""
        return centre < self._lowest

    def bound(
        self,
        pressed: PressedObject,
        x: NDArray,
        covariance: NDArray,
        centre: float,
        move_surface: Callable[[], NDArray],
    ) -> float:
        """Return the standard deviation of the unobserved force [N].

        Args:
            pressed: the object.
            x: state of the contact (3,).
            covariance: of x (3, 3).
            centre: height of the pressure [m].
            move_surface: returns the motion along x of the jaw's surface at its heights (h,) [m].
        """
        if pressed.is_round:  # a cylinder, which is small and round
            return 0.0
        clearance, stddev = _measure_clearances(tuple(pressed), x, covariance, self._places, self._clamped, centre)
        near = np.isfinite(clearance)
        if not near.any():
            return 0.0
        places, clearance = self._places[near], clearance[near]
        beyond = stddev[near] - np.abs(clearance - move_surface()[self._rows[near]]) / APART_SIGMAS
        return max(0.0, float(np.minimum(places[:, 1] * beyond, places[:, 2]).max()))


@njit(**_OPTIONS)
def _measure_clearances(pressed, x, covariance, places, clamped, centre):
    """Return clearance and its standard deviation (m,) [m] at each position, infinite where no force is possible."""
    pressed, count, step = PressedObject(*pressed), len(places), np.zeros(3)
    heights, slope, variance = places[:, 0].copy(), np.full((3, count), -1.0), np.zeros(count)
    clearance = find_clearances(pressed, x, heights)
    for i in (SHAPE, HEIGHT):
        step[:] = 0.0
        step[i] = np.sqrt(max(covariance[i, i], _LEAST_VARIANCE))
        slope[i] = find_clearances(pressed, x + step, heights) - find_clearances(pressed, x - step, heights)
        slope[i] *= 0.5 / step[i]
    for p in range(count):
        if (p >= clamped and abs(heights[p] - centre) <= _ELSEWHERE) or not abs(clearance[p]) < _WELL_CLEAR:
            clearance[p] = np.inf
        for i in range(3):
            for j in range(3):
                if np.isfinite(slope[i, p] + slope[j, p]):
                    variance[p] += slope[i, p] * covariance[i, j] * slope[j, p]
    return clearance, np.sqrt(np.maximum(variance, 0.0))
