"""The outline of a rigid object in the plane of the finger, and where it is now."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from finforce_ifea.errors import ContactError

_LARGEST = 1.0


@dataclass(frozen=True, kw_only=True, eq=False)
class ObjectOutline:
    """What an object shows to a finger that bends in the x-z plane.

    Attributes:
        polygons: (n, 2) each, x and z [m] about the outline's origin; outer ones counterclockwise, holes clockwise.
        origin: x and z [m] of that origin in the jaw frame.
        tilt: turn of the polygons about the origin [rad]; positive turns x towards z.
        stddev: (3,) of the origin's x and z [m] and of the tilt [rad].
    """

    polygons: tuple[NDArray, ...]
    origin: NDArray
    tilt: float
    stddev: NDArray

    def __post_init__(self) -> None:
        """Refuses what is no outline.

        Raises:
            ContactError: No polygon, fewer than three corners, numbers that are not finite or not metres.
        """
        if not self.polygons or any(p.ndim != 2 or p.shape[1] != 2 or len(p) < 3 for p in self.polygons):
            shapes = [p.shape for p in self.polygons]
            raise ContactError(f"outline of polygons {shapes}, expected at least one of shape (n >= 3, 2)")
        numbers = np.concatenate([p.ravel() for p in self.polygons] + [np.ravel(self.origin), [self.tilt]])
        if np.shape(self.origin) != (2,) or not np.isfinite(numbers).all() or np.abs(numbers[:-1]).max() > _LARGEST:
            raise ContactError("outline with coordinates that are not finite or beyond a metre, expected metres")
        spread = np.asarray(self.stddev)
        if spread.shape != (3,) or not (np.isfinite(spread) & (spread > 0)).all():
            raise ContactError(f"outline with standard deviations {self.stddev}, expected three finite ones above zero")

    def placed(self) -> tuple[NDArray, ...]:
        """Returns the polygons (n, 2) [m] in x and z of the jaw frame."""
        c, s = np.cos(self.tilt), np.sin(self.tilt)
        turn = np.array([[c, s], [-s, c]])
        return tuple(p @ turn + self.origin for p in self.polygons)


def are_same_polygons(first: tuple[NDArray, ...], second: tuple[NDArray, ...]) -> bool:
    """Returns whether two sets of polygons (n, 2) are equal, so that what was computed from one holds for the other."""
    return first is second or (len(first) == len(second) and all(map(np.array_equal, first, second)))
