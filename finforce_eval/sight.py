"""What a camera truly saw of a jaw, and what a detector said of it, over time; knows no images and no scores."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, kw_only=True)
class SightTrack:
    """Where the key points of one jaw truly were, and which of them the camera could see.

    Attributes:
        stamps: (n,) image time [ns], strictly increasing.
        points: (n, K, 3) [m], jaw frame.
        pixels: (n, K, 2) column and row in the raw image [px].
        visible: (n, K) neither occluded nor outside the image.
    """

    stamps: NDArray[np.int64]
    points: NDArray[np.float64]
    pixels: NDArray[np.float64]
    visible: NDArray[np.bool_]


@dataclass(frozen=True, kw_only=True)
class DetectionTrack:
    """What the key point detector said of one jaw beside the key points themselves, image by image.

    Attributes:
        stamps: (n,) image time [ns], strictly increasing.
        pixels: (n, K, 2) column and row in the raw image [px], NaN = not found.
        points: (n, K, 3) [m], jaw frame, NaN = no depth.
        accepted: (n, K) handed on to the solver.
        reasons: (n, K) why a point was not, one word; "" where it was, or where the jaw was not found.
        found: (n,) the jaw was found in the image.
        step_ms: (n,) wall time from image to key points of all jaws [ms], NaN where it was not timed.
    """

    stamps: NDArray[np.int64]
    pixels: NDArray[np.float64]
    points: NDArray[np.float64]
    accepted: NDArray[np.bool_]
    reasons: NDArray[np.str_]
    found: NDArray[np.bool_]
    step_ms: NDArray[np.float64]
