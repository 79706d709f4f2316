"""Whether the key points of a jaw at rest lie where its file says.

A camera that is not where it is said to be shifts, turns and stretches the picture of a jaw's side, all of it an affine
map of the side's places; a load bends the finger, which is none. A load moves the key points along the closing axis, a
camera's errors move them across it, too. By both, the two are told apart.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

IMAGES = 15  # over which displacements are averaged
_LEAST_POINTS = 8  # with fewer, an affine map explains a bent finger, too
_BENT = 0.3e-3  # [m] root mean square of what no affine map explains: more of it is a load
_BENT_SHARE = 0.15  # of the displacement across the closing axis, the same


class RestCheck:
    """Finds how far the key points of one jaw at rest lie from its file, across the closing axis.

    Attributes:
        distance: the least root mean square of any IMAGES consecutive images of a jaw that is not bent [m]; NaN before.

    Args:
        rest: key points of the jaw file (K, 3) [m].
    """

    def __init__(self, rest: NDArray) -> None:
        self._rest = rest
        self.reset()

    def reset(self) -> None:
        """Forget what was seen."""
        self.distance = float("nan")
        self._begin()

    def _begin(self) -> None:
        """Begin to average."""
        self._sum, self._count, self._images = np.zeros_like(self._rest), np.zeros(len(self._rest), dtype=int), 0

    def take(self, points: NDArray) -> None:
        """Take the key points (K, 3) [m] of one image, NaN where one was not seen."""
        away = points - self._rest
        seen = np.isfinite(away).all(axis=1)
        self._sum[seen] += away[seen]
        self._count += seen
        self._images += 1
        if self._images < IMAGES:
            return
        often = self._count >= IMAGES // 2
        if often.sum() >= _LEAST_POINTS:
            self._judge(self._rest[often], self._sum[often] / self._count[often, None])
        self._begin()

    def _judge(self, rest: NDArray, away: NDArray) -> None:
        """Keep the root mean square of displacements (n, 3) [m] unless they are those of a bent jaw."""
        plane = np.column_stack((np.ones(len(rest)), rest[:, ::2]))
        left = away - plane @ np.linalg.lstsq(plane, away, rcond=None)[0]
        across, bent = (float(np.sqrt((part**2).sum(axis=1).mean())) for part in (away[:, 1:], left))
        if bent <= max(_BENT, _BENT_SHARE * across):
            self.distance = float(np.fmin(self.distance, across))
