"""Sheets of pictures with true and found points, to look at."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from finforce.optional import import_cv2
from lab.training.scoring import Detections

ZOOM, COLUMNS = 2, 5
TRUE, HIDDEN, FOUND, REFUSED = (0, 255, 0), (110, 110, 110), (255, 40, 40), (60, 120, 255)  # RGB


def draw_sheet(path: str | Path, pictures: NDArray, detections: Detections, threshold: float) -> None:
    """Write pictures side by side: true points green, hidden ones grey, found ones red crosses, refused ones blue.

    Args:
        path: of the picture file.
        pictures: (n, h, w, 3) uint8.
        detections: what was found in them.
        threshold: likelihood from which a point is accepted.
    """
    cv2 = import_cv2()
    tiles = [draw_points(picture, detections.take(np.array([i])), threshold) for i, picture in enumerate(pictures)]
    tiles += [np.zeros_like(tiles[0])] * (-len(tiles) % COLUMNS)
    rows = [np.hstack(tiles[i : i + COLUMNS]) for i in range(0, len(tiles), COLUMNS)]
    cv2.imwrite(str(path), cv2.cvtColor(np.vstack(rows), cv2.COLOR_RGB2BGR))


def draw_points(picture: NDArray, found: Detections, threshold: float) -> NDArray:
    """Return a picture (2 h, 2 w, 3) uint8, brightened where it is dark, with its points and the found ones."""
    cv2 = import_cv2()
    gain = max(1.0, 90.0 / max(float(picture.mean()), 1.0))
    bright = np.clip(picture * gain, 0, 255).astype(np.uint8)
    tile = cv2.resize(bright, None, fx=ZOOM, fy=ZOOM, interpolation=cv2.INTER_CUBIC)
    for point, visible in zip(found.points[0], found.visible[0], strict=True):
        if np.isfinite(point).all():
            cv2.circle(tile, _place(point), 5, TRUE if visible else HIDDEN, 1)
    for pixel, is_accepted, visible in zip(
        found.pixels[0], (found.likelihood >= threshold)[0] & found.counts[0], found.visible[0], strict=True
    ):
        if np.isfinite(pixel).all() and (is_accepted or visible):
            cv2.drawMarker(tile, _place(pixel), FOUND if is_accepted else REFUSED, cv2.MARKER_CROSS, 7, 1)
    return tile


def _place(point: NDArray) -> tuple[int, int]:
    """Return the pixel of a tile at a place of its picture."""
    column, row = np.round(ZOOM * (np.asarray(point, dtype=float) + 0.5) - 0.5).astype(int)
    return int(column), int(row)
