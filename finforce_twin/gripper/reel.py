"""Images of a grasp at many openings, taken beforehand and looked up by the opening."""

from __future__ import annotations

import os
from bisect import bisect_left
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from typing import Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from finforce_twin.gripper.footage import TwinFrame, true_jaw
from finforce_twin.gripper.pressing import PressedGrasp
from finforce_twin.rendering.photographer import Photographer

T = TypeVar("T")
TAKES = 2  # of every opening: a camera that stands still never gives the same image twice
COUNTS = 255  # steps of the gripper's position over its stroke
OPEN_STRIDE = 4  # of those steps between two images where nothing touches
BEFORE_TOUCH = 1e-3  # [m] of opening from which on every step has its image
MOST_WORKERS = 4  # threads, of which each renders an image
_APART = 10.0  # [s] between the stamps that seed the noise, too far for motion blur


@dataclass(frozen=True, kw_only=True, eq=False)
class Reel(Generic[T]):
    """Images by opening, in whatever form they were kept.

    Attributes:
        openings: (n,) [m], growing.
        takes: n lists of the same opening's images.
    """

    openings: NDArray
    takes: Sequence[Sequence[T]]

    def find(self, opening: float) -> int:
        """Returns the place of the image that was taken nearest to an opening [m]."""
        right = bisect_left(self.openings, opening)
        if right in (0, len(self.openings)):
            return min(right, len(self.openings) - 1)
        is_left = opening - self.openings[right - 1] < self.openings[right] - opening
        return right - 1 if is_left else right


def choose_openings(grasp: PressedGrasp, low: float, high: float) -> NDArray:
    """Returns the openings (n,) [m] between two of a gripper's [m] that deserve an image.

    In contact these are the gripper's own steps, at which it comes to rest; where nothing touches they are coarser.
    """
    steps = low + (high - low) * np.arange(COUNTS + 1) / COUNTS
    near = steps < grasp.touch_opening + BEFORE_TOUCH
    kept = near | (np.arange(COUNTS + 1)[::-1] % OPEN_STRIDE == 0)
    return steps[kept & (steps >= grasp.least_opening)]


def film_grasp(
    grasp: PressedGrasp,
    photographer: Photographer,
    openings: NDArray,
    keep: Callable[[TwinFrame], T],
    tell: Callable[[int, int], None] = lambda done, count: None,
) -> Reel[T]:
    """Returns the images of a grasp.

    Args:
        grasp: what is filmed.
        photographer: who films it.
        openings: (n,) [m], growing.
        keep: makes of an image what is kept of it; its wrenches are elastic, and it has no stamp and no object's pose.
        tell: hears how many openings of how many are done; what it raises ends the filming.
    """
    film = partial(_film_opening, grasp, photographer)
    takes, pool = [], ThreadPoolExecutor(min(os.cpu_count() or 1, MOST_WORKERS))
    try:
        for frames in pool.map(film, openings.tolist(), range(len(openings))):
            tell(len(takes) + 1, len(openings))
            takes.append([keep(frame) for frame in frames])
    finally:
        pool.shutdown(cancel_futures=True)
    return Reel(openings=openings, takes=takes)


def _film_opening(grasp: PressedGrasp, photographer: Photographer, opening: float, index: int) -> list[TwinFrame]:
    """Returns all takes at one opening [m]."""
    state = grasp.state(opening)
    view, frames = photographer.look(state), []
    for take in range(TAKES):
        shot = photographer.develop(view, _APART * (TAKES * index + take))
        jaws = {side: true_jaw(state, shot, side) for side in state.jaws}
        frames.append(TwinFrame(stamp=0, phase="", color=shot.color, depth=shot.depth, jaws=jaws, T_camera_object=None))
    return frames
