"""What finds the pixels of key points in an image: a network on the side plane or the whole image, or dots."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

from numpy.typing import NDArray

if TYPE_CHECKING:
    from finforce_keypoints.images import RgbdImage

REFERENCE = "reference"  # the name of the reference point, the last row of every detection


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
