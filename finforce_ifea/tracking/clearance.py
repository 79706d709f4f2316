"""Whether the known object is out of the jaw's reach and the jaw where it is without load.

Key points say of an unloaded jaw how deep d [m] something would press it. With the modes m_k [m/m] by which a depth
moves the points, their deviations e_k [m] from the tared jaw and the covariance N of one of them,

    d = sum m_k . e_k / sum m_k . m_k,    Var d = sum m_k . N m_k / (sum m_k . m_k)^2.
"""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from finforce_ifea.observation import Contact
from finforce_ifea.tare import Tare

# An object is away that stands in front of the undeformed surface by more than this and what its place may err [m].
AWAY = 10e-3
_SIGMAS = 3.0
# The jaw is at rest while it seems pressed by less than this [m], in one frame or in so many standard deviations of
# it, and on average over the last ones.
LARGEST_DEPTH, LARGEST_MEAN_DEPTH = 0.3e-3, 0.15e-3
_CHANCE = 4.0
_AVERAGED = 30
# Key points farther from their place are no evidence [m]; too few of them, or a depth told no better than this, none.
_FARTHEST, _FEWEST, _VAGUE = 3e-3, 4, 0.3e-3
_NEARER, _REST_REACH = 0.75, 1e-3


class AwayWatch:
    """Watches an unloaded jaw while its object is away.

    Args:
        keypoints: drawn (K, 3) [m].
        face_x: of the undeformed inner surface [m].
        modes: gives the motion of the key points in x and z by the depth (K, 2) [m/m].
    """

    def __init__(self, keypoints: NDArray, face_x: float, modes: Callable[[], NDArray]) -> None:
        self._keypoints, self._face_x, self._find_modes = keypoints, face_x, modes
        self.reset()

    def reset(self) -> None:
        """Forgets what was seen."""
        self._contact: Contact | None = None
        self._is_away = False
        self._modes: NDArray | None = None
        self._mean, self._count = 0.0, 0

    def is_idle(self, contact: Contact, points: NDArray, tare: Tare) -> bool:
        """Whether the contact's object is away and the key points (K, 3) [m] show the unloaded jaw."""
        if contact is not self._contact:
            self._contact, self._is_away = contact, is_away(contact, self._face_x)
        if not self._is_away:
            self._modes, self._count = None, 0
            return False
        if self._modes is None:
            self._modes = self._find_modes()
        return self._is_at_rest(points - self._keypoints - tare.offsets, tare)

    def _is_at_rest(self, deviations: NDArray, tare: Tare) -> bool:
        """Whether deviations (K, 3) [m] from the tared jaw are chance."""
        ways = np.sqrt((deviations * deviations).sum(axis=1))
        near = (ways < _FARTHEST) & (tare.counts > 0)
        known = int(np.isfinite(ways).sum())
        if near.sum() < max(_FEWEST, _NEARER * known):
            return False
        if np.mean(np.sort(ways[near])[: int(_NEARER * known) + 1] ** 2) > _REST_REACH**2:
            return False
        modes, deviations = self._modes[near], deviations[near][:, [0, 2]]
        gain = float((modes * modes).sum()) + 1e-12
        depth = float((modes * deviations).sum()) / gain
        stddev = float(np.sqrt((modes @ tare.noise[::2, ::2] * modes).sum())) / gain
        self._count = min(self._count + 1, _AVERAGED)
        self._mean += (depth - self._mean) / self._count
        return (
            stddev < _VAGUE
            and abs(depth) < max(LARGEST_DEPTH, _CHANCE * stddev)
            and abs(self._mean) < max(LARGEST_MEAN_DEPTH, _CHANCE * stddev / np.sqrt(self._count))
        )


def is_away(contact: Contact, face_x: float) -> bool:
    """Whether a contact's outline is in front of a surface x = face_x [m] by more than `AWAY` and its uncertainty."""
    outline = contact.outline
    if outline is None or contact.touching is not False:
        return False
    nearest = min(float(polygon[:, 0].min()) for polygon in outline.placed())
    return nearest - face_x > AWAY + _SIGMAS * float(outline.stddev[0])
