"""Turns of the gripper, as the direction of gravity shows them."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

# Turn after which whatever else than the jaws held an object is left behind [rad].
LEFT_BEHIND = 0.15
# Change of the direction below which it is noise [rad]: many of them are no turn.
_NOISE = 0.05


class Turn(NamedTuple):
    """Directions of gravity (3,) before a turn and after it, unit vectors, and the angle between them [rad]."""

    before: NDArray
    now: NDArray
    angle: float


class TurnTrack:
    """Follows the direction of gravity in the frame of a gripper or a jaw, image after image."""

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Forget the direction."""
        self._direction: NDArray | None = None

    def update(self, gravity: NDArray | None) -> Turn | None:
        """Return the turn since the last image, by the direction (3,) in this one; None where that is not known."""
        if gravity is None:
            return None
        before = gravity if self._direction is None else self._direction
        angle = float(np.arccos(np.clip(before @ gravity, -1.0, 1.0)))
        self._direction = gravity if angle > _NOISE or self._direction is None else before
        return Turn(before, self._direction, angle if angle > _NOISE else 0.0)
