"""Edges of a codec's blocks in video frames, by which frames show that are decoded from damaged or missing data."""

from __future__ import annotations

from collections import deque

import numpy as np
from numba import njit
from numpy.typing import NDArray

GRID = 8  # [px] between the edges of the smallest blocks that codecs transform
TILE = 64  # [px] edge of the squares that are counted apart
STEP = 10  # grey levels by which an edge between two blocks exceeds the differences beside it
LEAST_EXCESS = 20.0  # [sigma] of edges on the grid; 18 at most in 1900 frames of intact wrist videos
LEAST_RATIO = 2.0  # of this to the most in the frames before, which strongly compressed videos have much of
MEMORY, LEAST_MEMORY = 30, 10  # frames


class BlockWatch:
    """Compares the edges of blocks in each frame of a video with those in the frames before.

    Key frames are intact or refused by decoders; some codecs leave their blocks to be seen.
    """

    def __init__(self) -> None:
        self._before: deque[float] = deque(maxlen=MEMORY)

    def is_broken(self, grey: NDArray[np.uint8], *, is_key: bool = False) -> bool:
        """Return whether far more edges of blocks are in a frame (h, w), no key frame, than in those before."""
        excess = float(count_block_edges(grey))
        usual = max(self._before) if len(self._before) >= LEAST_MEMORY else excess
        self._before.append(excess)
        return not is_key and excess > max(LEAST_EXCESS, LEAST_RATIO * usual)


@njit(cache=True, nogil=True)
def count_block_edges(grey: NDArray[np.uint8]) -> float:
    """Return by how many sigma edges on the grid exceed those off it, in the tile (TILE, TILE) where most do.

    An edge is a step between two pixels that exceeds those on either side. Of n edges per position off the grid,
    where neither blocks nor halves of blocks meet, the deviation is sqrt(n + 4).
    """
    height, width = grey.shape
    most = 0.0
    for top in range(0, height - TILE + 1, TILE):
        for left in range(0, width - TILE + 1, TILE):
            on, off = 0, 0
            for r in range(max(top, 2), min(top + TILE, height - 1)):
                for c in range(max(left, 2), min(left + TILE, width - 1)):
                    for axis in range(2):
                        phase = (c if axis == 0 else r) % GRID
                        if phase in (1, 4, 7):
                            continue
                        if axis == 0:
                            a, b, d, e = grey[r, c - 2], grey[r, c - 1], grey[r, c], grey[r, c + 1]
                        else:
                            a, b, d, e = grey[r - 2, c], grey[r - 1, c], grey[r, c], grey[r + 1, c]
                        beside = max(abs(int(b) - int(a)), abs(int(e) - int(d)))
                        if abs(int(d) - int(b)) - beside > STEP:
                            if phase == 0:
                                on += 1
                            else:
                                off += 1
            most = max(most, (on - off / 4.0) / np.sqrt(off / 4.0 + 4.0))
    return most
