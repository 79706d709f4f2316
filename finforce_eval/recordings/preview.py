"""A picture of a recording at a glance: a few of its images with the true key points."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from finforce_twin.gripper.footage import TwinFrame

COUNT, COLUMNS = 6, 2
WIDEST = 320  # [px] of an image in the picture
VISIBLE, HIDDEN = (60, 230, 90), (235, 60, 60)
ARM = 3  # [px] of the cross at a key point
NEAR, FAR = 0.07, 0.25  # [m] of the depth that is drawn from bright to dark


class Preview:
    """Keeps a few images, evenly spread, and draws them with their depth.

    Args:
        frames: how many images there will be.
    """

    def __init__(self, frames: int) -> None:
        self._wanted = set(np.linspace(0, frames - 1, min(COUNT, frames)).round().astype(int).tolist())
        self._next, self._tiles = 0, []

    def take(self, frame: TwinFrame) -> None:
        """Take the next image."""
        if self._next in self._wanted:
            step = -(-frame.color.shape[1] // WIDEST)
            tile = np.hstack((draw_keypoints(frame, step), draw_depth(frame.depth[::step, ::step])))
            self._tiles.append(tile)
        self._next += 1

    def save(self, path: Path) -> None:
        """Write what was kept; nothing without images."""
        from PIL import Image

        if not self._tiles:
            return
        missing = -len(self._tiles) % COLUMNS if len(self._tiles) > COLUMNS else 0
        tiles = [*self._tiles, *[np.zeros_like(self._tiles[0])] * missing]
        columns = min(COLUMNS, len(tiles))
        rows = [np.hstack(tiles[begin : begin + columns]) for begin in range(0, len(tiles), columns)]
        Image.fromarray(np.vstack(rows)).save(path)


def draw_keypoints(frame: TwinFrame, step: int = 1) -> NDArray[np.uint8]:
    """Return the image with a cross at each true key point, green where it is visible, else red.

    Args:
        frame: with an image (h, w, 3).
        step: every how many of its pixels are drawn.
    """
    picture = np.array(frame.color[::step, ::step])
    for jaw in frame.jaws.values():
        for pixel, visible in zip(jaw.pixels, jaw.visible, strict=True):
            if np.isfinite(pixel).all():
                _draw_cross(picture, *np.round(pixel / step).astype(int).tolist(), VISIBLE if visible else HIDDEN)
    return picture


def _draw_cross(picture: NDArray[np.uint8], column: int, row: int, color: tuple[int, int, int]) -> None:
    height, width = picture.shape[:2]
    if 0 <= column < width and 0 <= row < height:
        picture[row, max(column - ARM, 0) : column + ARM + 1] = color
        picture[max(row - ARM, 0) : row + ARM + 1, column] = color


def draw_depth(depth: NDArray) -> NDArray[np.uint8]:
    """Return a depth image (h, w) [m] in grey (h, w, 3), bright where it is near, black where there is none."""
    share = (FAR - np.nan_to_num(depth, nan=FAR)) / (FAR - NEAR)
    grey = (40.0 + 215.0 * np.clip(share, 0.0, 1.0)) * np.isfinite(depth)
    return np.repeat(grey.astype(np.uint8)[:, :, None], 3, axis=2)
