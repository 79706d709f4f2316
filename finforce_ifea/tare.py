"""What the unloaded finger tells of its key points: constant offsets and noise; knows no force."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from finforce_ifea.point_noise import PointNoise, StatedNoise, compute_point_noise, match_stated

_FARTHEST_OFFSET = 3e-3
_FARTHEST_FROM_MEDIAN = 1.8e-3
_NOISE_FLOOR = 0.02e-3


@dataclass(frozen=True, kw_only=True, eq=False)
class Tare:
    """Offsets and noise of key points.

    Attributes:
        offsets: (K, 3) [m], measured minus drawn; zero where a key point was not seen.
        counts: (K,) frames behind each offset.
        noise: covariance of one key point in one frame (3, 3) [m^2], pooled over all of them.
        stated: that of each key point by the standard deviations that came with it; None without such.
    """

    offsets: NDArray
    counts: NDArray
    noise: NDArray
    stated: StatedNoise | None = None

    def offset_variance(self, unseen: float) -> NDArray:
        """Returns the variance (K,) [m^2] of each offset; `unseen` is the standard deviation without a tare [m]."""
        return np.where(self.counts > 0, self._seen_variance, unseen**2)

    @cached_property
    def _seen_variance(self) -> NDArray:
        noise = self.noise if self.stated is None else self.stated.covariance
        return np.trace(noise, axis1=-2, axis2=-1) / 3.0 / np.maximum(self.counts, 1)

    def point_noise(self, stddev: NDArray | None) -> PointNoise:
        """Returns the noise of the key points of an image that states `stddev` (K, 3) [m], or nothing.

        A tare without stated deviations stands for key points that all state its pooled noise.
        """
        return self._silent_noise if stddev is None else compute_point_noise(self._usual, stddev)

    @cached_property
    def _usual(self) -> StatedNoise:
        count = len(self.counts)
        pooled = np.broadcast_to(np.sqrt(np.diag(self.noise)), (count, 3))
        return self.stated or StatedNoise(np.broadcast_to(self.noise, (count, 3, 3)), pooled)

    @cached_property
    def _silent_noise(self) -> PointNoise:
        """Of an image that states nothing."""
        return compute_point_noise(self._usual, None)


def blank_tare(count: int, noise: float) -> Tare:
    """Returns the tare of key points of which nothing is known but their noise [m]."""
    return Tare(offsets=np.zeros((count, 3)), counts=np.zeros(count), noise=noise**2 * np.eye(3))


def compute_tare(
    frames: Sequence[NDArray], keypoints: NDArray, stddevs: Sequence[NDArray | None] = (None,)
) -> Tare | None:
    """Averages unloaded frames.

    Points farther than 3 mm from the drawing, or 1.8 mm from their own median, are gross errors. A point seen in less
    than half of the frames has no offset: what shows it now and then is its cover.

    Args:
        frames: accepted key points of each frame (K, 3) [m], NaN where hidden.
        keypoints: drawn (K, 3) [m].
        stddevs: standard deviations stated in each frame (K, 3) [m]; unused when one states none.

    Returns:
        The tare, or None when fewer than three points were seen.
    """
    deviations = np.stack(frames) - keypoints
    deviations[np.linalg.norm(deviations, axis=2) > _FARTHEST_OFFSET] = np.nan
    seen = np.isfinite(deviations[..., 0])
    middle = np.zeros_like(keypoints)
    often = seen.sum(0) >= max(2, 0.5 * len(frames))
    middle[often] = np.nanmedian(deviations[:, often], axis=0)
    deviations[np.linalg.norm(deviations - middle, axis=2) > _FARTHEST_FROM_MEDIAN] = np.nan
    counts = np.where(often, np.isfinite(deviations[..., 0]).sum(0), 0)
    often = counts >= 2
    if often.sum() < 3:
        return None
    offsets = np.zeros_like(keypoints)
    offsets[often] = np.nanmean(deviations[:, often], axis=0)
    scatter = deviations - offsets
    noise = scatter[:, often].reshape(-1, 3)
    noise = np.cov(noise[np.isfinite(noise[:, 0])].T) + _NOISE_FLOOR**2 * np.eye(3)
    stated = None
    if all(stddev is not None for stddev in stddevs):
        scatter[:, ~often] = np.nan
        stated = match_stated(scatter, np.stack(stddevs), _NOISE_FLOOR)
    return Tare(offsets=offsets, counts=np.where(often, counts, 0), noise=noise, stated=stated)
