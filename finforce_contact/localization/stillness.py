"""Whether a grasp holds still, so that the object's pose in the jaw need not be looked for."""

import numpy as np
from numpy.typing import NDArray

from finforce_contact.settings import ContactSettings


class RestWatch:
    """Watches the deformed inner face while the object touches."""

    def __init__(self, settings: ContactSettings) -> None:
        """Keeps how long and how still."""
        self._settings = settings
        self.reset()

    def reset(self) -> None:
        """Starts anew, moving."""
        self.resting = False
        self.ended = -np.inf
        self._since = np.inf
        self._line: NDArray | None = None

    def update(self, stamp: float, line: NDArray | None) -> None:
        """Takes the inner face (h, 2) [m] of an image [s] in contact; None without contact or surface."""
        held = self._line is not None and line is not None
        if not held or np.abs(line - self._line).max() > self._settings.rest_motion:
            if self.resting:
                self.ended = stamp
            self._line, self._since = line, stamp
        self.resting = line is not None and stamp - self._since >= self._settings.rest_time
