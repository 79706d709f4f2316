"""Colour images with aligned depth, what is found in them, and a camera that fails."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from finforce.camera import CameraIntrinsics, ImageError
from finforce_keypoints.errors import BlackImageError, EmptyDepthError, FrozenImageError

REFERENCE = "reference"  # the name of the reference point, the last row of every detection
FROZEN_AFTER = 2  # repetitions of a picture, to the bit, after which a camera counts as frozen
_WATCHED_STEP = 8  # every so many rows and columns are looked at
_DARKEST = 10  # of 255: a picture whose brightest hundredth is below this shows nothing
_BRIGHTEST_PERCENT = 99.0
_TILES = 4  # rows and columns of parts, each of which can stand still
_NEAR_BLACK, _NEAR_WHITE = 8, 247  # of 255: what is beyond may stay the same without a fault
_LIVELY = 0.2  # share of a part's pixels between these, from which on it has to change


@dataclass(frozen=True, kw_only=True, eq=False)
class RgbdImage:
    """A colour image and the depth aligned to it.

    Attributes:
        stamp: image capture time [s].
        color: (h, w, 3) uint8 RGB, as the lens made it.
        depth: (h, w) float32 distance along the optical axis [m], NaN invalid; None when there is none.
        camera: intrinsics of both.
    """

    stamp: float
    color: NDArray
    depth: NDArray | None
    camera: CameraIntrinsics


class ImagePair(NamedTuple):
    """A colour image and its depth image, None without, both as they came, and the exact stamp of the first [ns]."""

    stamp: int
    color: Any
    depth: Any


@dataclass(frozen=True, kw_only=True, eq=False)
class PixelDetection:
    """Where one jaw's key points are in an image; the K points of the jaw file first, the reference point last.

    Attributes:
        pixels: (K + 1, 2) column and row in the full raw, distorted image [px]; NaN where nothing was found.
        likelihood: (K + 1,) from 0 to 1, 0 where nothing was found.
        stddev: (K + 1,) one standard deviation of a point along a row or a column [px]; inf where nothing was found.
    """

    pixels: NDArray
    likelihood: NDArray
    stddev: NDArray


class PixelDetector(Protocol):
    """Anything that finds the key points of all jaws in one image, in one pass.

    Attributes:
        name: of the method and its network.
        sha256: of the network's files, empty without one.
    """

    name: str
    sha256: str

    def detect(self, image: RgbdImage, expected: Mapping[str, NDArray | None]) -> Mapping[str, PixelDetection]:
        """Return one detection per side.

        Args:
            image: colour, depth and camera.
            expected: side -> T_camera_jaw (4, 4) where the jaw should be; None where it was lost: look everywhere; a
                side that is absent is not looked for.

        Returns:
            side -> detection; a side that cannot be seen at all is absent.

        Raises:
            KeypointError: the image cannot be used with this method.
        """
        ...


def check_image(image: RgbdImage) -> None:
    """Refuse an image whose parts do not fit each other.

    Raises:
        ImageError: colour or depth has another size than the camera, another type, or the stamp is no time.
        EmptyDepthError: there is a depth image, without any depth.
    """
    size = (image.camera.height, image.camera.width)
    if not np.isfinite(image.stamp):
        raise ImageError(f"image: stamp {image.stamp}; expected seconds")
    if np.shape(image.color) != (*size, 3) or image.color.dtype != np.uint8:
        raise ImageError(
            f"colour image: {getattr(image.color, 'dtype', type(image.color).__name__)} of shape "
            f"{np.shape(image.color)}; expected uint8 {(*size, 3)}, the size in the camera_info"
        )
    if image.depth is not None and (np.shape(image.depth) != size or image.depth.dtype.kind != "f"):
        raise ImageError(
            f"depth image: {image.depth.dtype} of shape {np.shape(image.depth)}; expected metres of shape {size}, "
            "that of the colour image; use the depth that is aligned to colour"
        )
    if image.depth is not None and not np.isfinite(image.depth).any():
        raise EmptyDepthError(
            "the depth image is empty: no pixel has a depth; expected some; is the camera covered, or its depth stream "
            "off?"
        )


def lie_inside(image: RgbdImage, pixels: NDArray) -> NDArray:
    """Return which pixels (n, 2), column and row, lie in the image, (n,) bool; those that are NaN do not."""
    with np.errstate(invalid="ignore"):
        size = (image.camera.width - 0.5, image.camera.height - 0.5)
        return (pixels >= -0.5).all(axis=1) & (pixels <= size).all(axis=1)


def _all_colors(values: NDArray) -> NDArray:
    """Return where all three of values (h, w, 3) bool hold; ten times as fast as `all`."""
    return values[..., 0] & values[..., 1] & values[..., 2]


def _brightest(seen: NDArray) -> float:
    """Return how bright the brightest hundredth of pixels (h, w, 3) is."""
    brightness = np.maximum(np.maximum(seen[..., 0], seen[..., 1]), seen[..., 2]).ravel()
    place = int(_BRIGHTEST_PERCENT / 100.0 * (brightness.size - 1))
    return float(np.partition(brightness, place)[place])


def _share_of_tiles(values: NDArray) -> NDArray:
    """Return the share (_TILES, _TILES) of the parts of values (h, w) bool that hold."""
    height, width = (size // _TILES for size in values.shape)
    parts = values[: _TILES * height, : _TILES * width].reshape(_TILES, height, _TILES, width)
    return parts.sum(axis=(1, 3)) / max(height * width, 1)


class ImageWatch:
    """Notices a camera that gives black pictures, or the same one, or the same part of one, again and again."""

    def __init__(self, frozen_after: int = FROZEN_AFTER) -> None:
        """Keeps after how many identical pictures in a row the camera counts as frozen."""
        self._frozen_after = frozen_after
        self.reset()

    def reset(self) -> None:
        """Forget the last picture."""
        self._color = self._depth = np.empty(0)
        self._same, self._same_tiles, self._same_depth = 0, np.zeros((_TILES, _TILES), dtype=int), 0

    def check(self, image: RgbdImage) -> None:
        """Refuse a picture that shows nothing, or nothing new.

        A real sensor has noise: two pictures are never alike, not even of a scene at rest. A part of a picture that is
        neither black nor white has some, too, and so has depth.

        Raises:
            BlackImageError: nearly all of the picture is black.
            FrozenImageError: it, a part of it, or the depth image is the same as the ones before.
        """
        seen = image.color[::_WATCHED_STEP, ::_WATCHED_STEP].copy()
        self._count_same(seen, image.depth)
        if (brightest := _brightest(seen)) < _DARKEST:
            raise BlackImageError(
                f"black image: its brightest pixels are {brightest:.0f} of 255; expected at least {_DARKEST}; "
                "is the lens covered, or the exposure far too short?"
            )
        if self._same >= self._frozen_after:
            raise FrozenImageError(
                f"frozen camera: {self._same + 1} identical pictures; expected noise between them; restart the camera"
            )
        frozen = self._same_tiles >= self._frozen_after
        if frozen.any():
            row, column = np.argwhere(frozen)[0] + 1
            raise FrozenImageError(
                f"frozen camera: {frozen.sum()} of {frozen.size} parts of the picture (the first in row {row}, column "
                f"{column} of {_TILES}) are identical again and again; expected noise; restart the camera"
            )
        if self._same_depth >= self._frozen_after:
            raise FrozenImageError(
                f"frozen camera: {self._same_depth + 1} identical depth images, the colours change; expected noise "
                "between them; restart the camera"
            )

    def _count_same(self, seen: NDArray, depth: NDArray | None) -> None:
        """Count how often in a row the picture, its parts and the depth were what they had been before."""
        is_known = seen.shape == self._color.shape
        same = _all_colors(seen == self._color) if is_known else np.zeros(seen.shape[:2], dtype=bool)
        lively = _all_colors((seen > _NEAR_BLACK) & (seen < _NEAR_WHITE))
        self._same = self._same + 1 if same.all() else 0
        still = (_share_of_tiles(same) == 1.0) & (_share_of_tiles(lively) >= _LIVELY)
        self._same_tiles = np.where(still, self._same_tiles + 1, 0)
        measured = np.empty(0) if depth is None else depth[::_WATCHED_STEP, ::_WATCHED_STEP].copy()
        # a plain depth image, or one without any depth, is no camera's: it is refused for what it is
        known = measured[np.isfinite(measured)]
        is_plain = known.size == 0 or known.min() == known.max()
        is_same = not is_plain and np.array_equal(measured, self._depth, equal_nan=True)
        self._same_depth = self._same_depth + 1 if is_same else 0
        self._color, self._depth = seen, measured
