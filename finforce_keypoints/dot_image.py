"""Printed or painted dots in an image: their places, sizes and shapes; knows no jaw."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from finforce_bounded import check_bounds, choice, setting
from finforce_keypoints.errors import DetectorSettingsError
from finforce_keypoints.optional import import_cv2

_LARGEST_ELONGATION = 4.0  # a disc that is seen at 75 degrees off its normal
_DIMMEST = 8  # of 255: darker pixels have no colour


@dataclass(frozen=True, kw_only=True)
class DotSettings:
    """How the dots look; one dot on every key point and on the reference point, on the side that the camera sees."""

    kind: str = choice(
        "colored",
        ("colored", "light", "dark"),
        "dots of one colour on any jaw, light dots on a dark one, or dark on light",
    )
    hue: float = setting(
        120.0, "deg", 0.0, 360.0, "of colored dots: 0 red, 60 yellow, 120 green, 240 blue, 300 magenta"
    )
    hue_tolerance: float = setting(30.0, "deg", 1.0, 60.0, "a dot's hue may be off by this")
    least_saturation: float = setting(
        0.3, "1", 0.05, 1.0, "of a colored dot: (strongest - weakest) / strongest channel"
    )
    least_contrast: float = setting(0.25, "1", 0.01, 1.0, "of a light or dark dot: relative to its surroundings")
    diameter: float = setting(0.003, "m", 5e-4, 0.02, "of a dot")
    size_tolerance: float = setting(2.5, "1", 1.1, 10.0, "a dot's area may be larger or smaller by this factor")
    gate: float = setting(0.006, "m", 5e-4, 0.05, "how far a dot may be from where its neighbours let expect it")

    def __post_init__(self) -> None:
        """Refuse values out of bounds.

        Raises:
            DetectorSettingsError: a setting is out of its bounds.
        """
        check_bounds(self, DetectorSettingsError)


@dataclass(frozen=True, kw_only=True, eq=False)
class Dots:
    """Dots of one image.

    Attributes:
        pixels: (m, 2) column and row of the centroids [px].
        areas: (m,) [px^2].
        fills: (m,) area / area of the ellipse of the same moments: 1 of an ellipse, less of anything else.
    """

    pixels: NDArray
    areas: NDArray
    fills: NDArray


def find_dots(color: NDArray, settings: DotSettings, diameter: float) -> Dots:
    """Return the dots of an image.

    Args:
        color: (h, w, 3) uint8 RGB.
        settings: how they look.
        diameter: of a dot [px], about.

    Returns:
        The dots, in no order; the centroids are weighted by how much a pixel looks like a dot, so that pixels on the
        rim count by the part that the dot covers.
    """
    cv2 = import_cv2()
    look = _ColoredLook(settings) if settings.kind == "colored" else _LightLook(settings, color, diameter)
    count, labels, stats, _ = cv2.connectedComponentsWithStats(look.select(color), connectivity=8, ltype=cv2.CV_16U)
    expected = 0.25 * np.pi * diameter**2
    area = stats[:, cv2.CC_STAT_AREA]
    tolerance = 2.0 * settings.size_tolerance  # the distance of each dot is not known here
    is_wanted = (area >= expected / tolerance) & (area <= expected * tolerance)
    rows = []
    for number in np.flatnonzero(is_wanted[1:]) + 1:
        x, y, width, height = stats[number, :4].tolist()
        part = slice(max(y - 1, 0), y + height + 1), slice(max(x - 1, 0), x + width + 1)
        row = _measure(look.weigh(color, part), labels[part], number)
        if row is not None:
            rows.append(np.add(row, (part[1].start, part[0].start, 0.0, 0.0)))
    table = np.array(rows).reshape(-1, 4)
    return Dots(pixels=table[:, :2], areas=table[:, 2], fills=table[:, 3])


class _ColoredLook:
    """What pixels of one hue look like."""

    def __init__(self, settings: DotSettings) -> None:
        self._settings = settings
        hue = np.deg2rad(settings.hue)
        # a = R - (G + B) / 2, b = sqrt(3) / 2 (G - B): the chroma towards the hue is a cos + b sin.
        self._direction = np.array([1.0, -0.5, -0.5]) * np.cos(hue) + np.array([0.0, 1.0, -1.0]) * (
            np.sqrt(0.75) * np.sin(hue)
        )

    def select(self, color: NDArray) -> NDArray:
        """Return where an image (h, w, 3) has the hue (h, w) uint8."""
        cv2, settings = import_cv2(), self._settings
        hsv = cv2.cvtColor(color, cv2.COLOR_RGB2HSV)
        least = (255.0 * settings.least_saturation, _DIMMEST)
        low, high = (0.5 * (settings.hue + sign * settings.hue_tolerance) for sign in (-1.0, 1.0))  # OpenCV: 180 a turn
        mask = np.zeros(color.shape[:2], np.uint8)
        for turn in (-180.0, 0.0, 180.0):
            if low + turn <= 180.0 and high + turn >= 0.0:
                bounds = max(low + turn, 0.0), min(high + turn, 180.0)
                mask |= cv2.inRange(hsv, (bounds[0], *least), (bounds[1], 255.0, 255.0))
        return mask

    def weigh(self, color: NDArray, part: tuple[slice, slice]) -> NDArray:
        """Return the chroma towards the hue of a part of the image."""
        return np.maximum(color[part] @ self._direction, 0.0)


class _LightLook:
    """What pixels lighter, or darker, than their surroundings look like."""

    def __init__(self, settings: DotSettings, color: NDArray, diameter: float) -> None:
        cv2 = import_cv2()
        grey = cv2.cvtColor(color, cv2.COLOR_RGB2GRAY)
        # Scaled until a dot has two pixels, the median of five by five does not see it, and is OpenCV's fastest.
        scale = min(1.0, 2.0 / diameter)
        small = cv2.resize(grey, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
        around = cv2.resize(cv2.medianBlur(small, 5), grey.shape[::-1])
        above = (grey, around) if settings.kind == "light" else (around, grey)
        self._above, self._around = cv2.subtract(*above), around
        self._contrast = settings.least_contrast

    def select(self, color: NDArray) -> NDArray:
        """Return where the image is light, or dark, (h, w) uint8."""
        cv2 = import_cv2()
        return cv2.compare(self._above, cv2.multiply(cv2.max(self._around, _DIMMEST), self._contrast), cv2.CMP_GT)

    def weigh(self, color: NDArray, part: tuple[slice, slice]) -> NDArray:
        """Return how much lighter, or darker, a part of the image is."""
        return self._above[part].astype(float)


def _measure(weight: NDArray, labels: NDArray, number: int) -> tuple | None:
    """Return column, row, area and fill of one component of a cut-out, None when it is too long for a dot."""
    cv2 = import_cv2()
    whole = cv2.moments(np.where((labels == number) | (labels == 0), weight, 0.0))
    shape = cv2.moments((labels == number).astype(np.uint8), binaryImage=True)
    area = shape["m00"]
    # A pixel has a moment of its own, 1/12 px^2.
    xx, yy, xy = (shape[name] / area for name in ("mu20", "mu02", "mu11"))
    mean, half = 0.5 * (xx + yy) + 1.0 / 12.0, np.hypot(0.5 * (xx - yy), xy)
    if mean + half > _LARGEST_ELONGATION**2 * (mean - half) or whole["m00"] <= 0.0:
        return None
    fill = area / (4.0 * np.pi * np.sqrt(mean**2 - half**2))
    return whole["m10"] / whole["m00"], whole["m01"] / whole["m00"], area, fill
