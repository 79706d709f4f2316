"""Posture of the gripper: a turn or a lift leaves behind whatever else than the jaws held an object."""

from math import isfinite, nan
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from finforce.errors import ObservationError

# Turn [rad] and lift [m] that leave a support behind, each up to a factor e.
_TURN, _LIFT = 0.15, 2e-3
# Changes below which direction [rad] and elevation [m] are noise: many of them are no motion.
_TURN_NOISE, _LIFT_NOISE = 0.05, 1e-3
# By which the length of a unit vector may be off.
_UNIT = 1e-3


class WristPosture(NamedTuple):
    """Posture of a gripper or a jaw.

    Attributes:
        gravity: direction in which things fall (3,), unit vector in its frame.
        elevation: above any level [m]; NaN if unknown.
    """

    gravity: NDArray
    elevation: float = nan


def check_posture(posture: WristPosture) -> WristPosture:
    """Return a posture as it is.

    Raises:
        ObservationError: gravity is no unit vector of three numbers, or the elevation infinite.
    """
    gravity, elevation = posture
    if not (np.shape(gravity) == (3,) and abs(np.linalg.norm(gravity) - 1.0) < _UNIT):
        raise ObservationError(f"gravity {np.asarray(gravity).tolist()}, expected a unit vector of three numbers")
    if np.isinf(elevation):
        raise ObservationError(f"an elevation of {elevation}, expected metres, or NaN where it is not known")
    return posture


class WristMove(NamedTuple):
    """A change of posture.

    Attributes:
        before: direction of gravity (3,).
        now: the same after it (3,).
        parting: turn and lift over those that leave a support behind [-].
        shows_lifts: True if the elevation is known.
    """

    before: NDArray
    now: NDArray
    parting: float
    shows_lifts: bool


class PostureTrack:
    """Follows a posture, image after image."""

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Forget the posture."""
        self._last: WristPosture | None = None

    def update(self, posture: WristPosture | None) -> WristMove | None:
        """Return what has changed since the last image; None where the posture is not known."""
        if posture is None:
            return None
        before, level = posture if self._last is None else self._last
        angle = float(np.arccos(np.clip(before @ posture.gravity, -1.0, 1.0)))
        now, parting = (posture.gravity, angle / _TURN) if angle > _TURN_NOISE else (before, 0.0)
        rise = posture.elevation - level
        if rise > _LIFT_NOISE:
            parting += rise / _LIFT
        self._last = WristPosture(now, level if 0.0 <= rise <= _LIFT_NOISE else posture.elevation)
        return WristMove(before, now, parting, isfinite(posture.elevation))
