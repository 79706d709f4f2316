"""Key points drawn into a picture, with NumPy alone."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from finforce_keypoints.geometry.jaw_localizer import JawKeypoints

RADIUS = 4.0  # px
COLORS = {  # by the reason why a key point is not used
    "": (40, 220, 60),
    "likelihood": (230, 60, 50),
    "depth": (60, 120, 255),
    "workspace": (250, 170, 30),
    "image": (160, 160, 160),
}
LINE = (250, 230, 60)


def draw_keypoints(
    color: NDArray[np.uint8],
    jaws: Iterable[JawKeypoints],
    skeleton: Sequence[Sequence[int]] = (),
    *,
    radius: float = RADIUS,
) -> NDArray[np.uint8]:
    """Return a copy of a picture (h, w, 3) with a disc per key point, and lines between used neighbours.

    Green is used; red, blue, orange and grey say why not: likelihood, depth, workspace, outside the image.
    `radius` is that of the discs [px]; a quarter of it stays free.
    """
    picture = color.copy()
    for jaw in jaws:
        for one, other in skeleton:
            if jaw.valid[one] and jaw.valid[other]:
                _draw_line(picture, jaw.pixels[one], jaw.pixels[other])
        for pixel, reason in zip(jaw.pixels, jaw.reasons, strict=True):
            if np.isfinite(pixel).all():
                _draw_disc(picture, pixel, COLORS.get(str(reason), COLORS["image"]), radius)
    return picture


def _draw_line(picture: NDArray[np.uint8], start: NDArray, end: NDArray) -> None:
    """Colour the pixels from `start` to `end` (2,), column and row."""
    count = int(np.ceil(np.abs(end - start).max())) + 1
    _paint(picture, np.linspace(start, end, count), LINE)


def _draw_disc(picture: NDArray[np.uint8], pixel: NDArray, color: Sequence[int], radius: float) -> None:
    """Colour a disc with a dark rim about a pixel (2,), column and row; its centre stays as it was."""
    reach = int(radius)
    columns, rows = np.meshgrid(np.arange(-reach, reach + 1), np.arange(-reach, reach + 1))
    distance = np.hypot(columns, rows)
    for near, far, shade in ((radius - 1.0, radius, (0, 0, 0)), (0.25 * radius, radius - 1.0, color)):
        ring = (distance > near) & (distance <= far)
        _paint(picture, np.stack((columns[ring], rows[ring]), axis=-1) + pixel, shade)


def _paint(picture: NDArray[np.uint8], pixels: NDArray, color: Sequence[int]) -> None:
    """Colour pixels (n, 2), column and row, as far as they lie in the picture."""
    # a key point may lie far outside, where no integer counts pixels
    height, width, _ = picture.shape
    inside = ((pixels > -0.5) & (pixels < (width - 0.5, height - 0.5))).all(axis=1)
    columns, rows = np.rint(pixels[inside]).astype(int).T
    picture[rows, columns] = color
