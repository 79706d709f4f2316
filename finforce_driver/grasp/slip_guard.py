"""When a held object slides, and by how much the set force is to rise for it."""

from __future__ import annotations

import math
from collections import deque

from finforce_driver.grasp.settings import GraspSettings

_SLIDES = 0.003  # [m/s] of the object over a jaw, above which it slides
_LIMIT = 1.5  # times the set force, to which it rises at most
_IN_A_ROW = 3  # velocities above the limit that are no chance
_APART = 0.4  # [s] between two rises: the gripper and the camera need that to show what the last one did
_LONGEST_GAP = 0.5  # [s] after which velocities are no longer in a row


class SlipGuard:
    """Watches how the object moves over the jaws, and raises the set force in bounded steps; off unless asked for.

    Args:
        settings: of the grasp, which say by how much the force rises, and its limit.
    """

    def __init__(self, settings: GraspSettings) -> None:
        self._settings = settings
        self.begin(math.nan)

    def begin(self, force: float) -> None:
        """Take the set force [N] that somebody asked for; rises count from there."""
        self._asked, self._raised = force, -math.inf
        self._rows: dict[str, deque[tuple[float, bool]]] = {}

    def take(self, jaw: str, speed: float, stamp: float, force: float) -> float | None:
        """Take a speed of the object over a jaw; return the force to be set now [N], None to leave it.

        Args:
            jaw: whose.
            speed: [m/s].
            stamp: of its image [s].
            force: that is set [N].
        """
        settings = self._settings
        row = self._rows.setdefault(jaw, deque(maxlen=_IN_A_ROW))
        if row and not 0.0 < stamp - row[-1][0] < _LONGEST_GAP:
            row.clear()
        row.append((stamp, speed > _SLIDES))
        slides = len(row) == _IN_A_ROW and all(fast for _, fast in row)
        if not slides or settings.slip_raise == 0.0 or stamp - self._raised < _APART:
            return None
        limit = min(_LIMIT * self._asked, settings.force_limit)
        wanted = min(force + settings.slip_raise * self._asked, limit)
        if not wanted > force:
            return None
        self._raised = stamp
        row.clear()
        return wanted
