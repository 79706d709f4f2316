"""The least noise of a camera, laid over a picture that is shown again: a bit here and there; knows no messages."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

DENSITY = 0.005  # share of the numbers that differ by one
_ROOM = 4096  # places at which the pattern may begin


class Flicker:
    """Lays noise over pictures, and takes the last noise of each away again, so that it does not add up.

    A camera never gives the same picture twice, by which a watch tells it from a frozen one.

    Args:
        seed: of the noise.
    """

    def __init__(self, seed: int) -> None:
        self._rng = np.random.default_rng((seed, 11))
        self._patterns: dict[int, NDArray] = {}
        self._last: dict[int, int] = {}

    def lay(self, numbers: NDArray, name: int) -> None:
        """Change some of a picture's numbers (n,) of unsigned integers by one, in place; zeros stay zeros.

        Args:
            numbers: of the picture.
            name: of this picture, the same whenever it is shown.
        """
        if name in self._last:
            numbers ^= self._pattern(numbers, self._last[name])
        self._last[name] = int(self._rng.integers(_ROOM))
        numbers ^= self._pattern(numbers, self._last[name])

    def _pattern(self, numbers: NDArray, start: int) -> NDArray:
        """Return the bits (n,) that change; a zero or a one may say that there is nothing."""
        pattern = self._patterns.get(numbers.size)
        if pattern is None:
            pattern = (self._rng.random(numbers.size + _ROOM) < DENSITY).astype(np.uint8)
            self._patterns[numbers.size] = pattern
        return pattern[start : start + numbers.size].astype(numbers.dtype) * (numbers > 1)
