"""Images that did not arrive, by the gaps between stamps and by the camera_info of images."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from finforce.messages import NANOSECONDS, SECOND

WINDOW = 10 * NANOSECONDS  # [ns] over which images are counted
PAUSE = 1 * NANOSECONDS  # [ns] between two images, from which on the camera was stopped
LEAST_LOST, LEAST_SHARE = 2, 0.01  # images, and their share, from which on a loss is reported
_FEWEST = 8  # gaps that tell a period
_NEIGHBOURS = 8  # gaps before and after one, among which the camera's shortest has to be: else its rate has changed
_LONG = 1.5  # periods from which on a gap is one of several
_IRREGULAR = 0.15  # periods that gaps are off whole numbers in the mean, above which the camera has no fixed rate
_ANNOUNCING = 0.9  # share of images with a camera_info of the same stamp, from which on every image has one
_HASTY, _BURSTS = 0.3, 0.15  # of the mean gap, closer than a camera takes images; share of them that tells


@dataclass(frozen=True, kw_only=True)
class ImageLosses:
    """Numbers of images that arrived and of those that did not, over some seconds.

    Attributes:
        arrived: number of images.
        lost: images that were lost on the way, as far as anybody knows.
        unsent: images without which the camera's driver went on: neither they nor their camera_info came.
        overtaken: images that newer ones replaced while this process was busy.
    """

    arrived: int = 0
    lost: int = 0
    unsent: int = 0
    overtaken: int = 0

    def __str__(self) -> str:
        shares = {"lost on the way": self.lost, "not sent": self.unsent, "overtaken": self.overtaken}
        return ", ".join(f"{self._share(count)} {name}" for name, count in shares.items() if count) or "none"

    @property
    def _total(self) -> int:
        return self.arrived + self.lost + self.unsent + self.overtaken

    def _share(self, missing: int) -> str:
        return f"{100.0 * missing / max(self._total, 1):.0f} % ({missing} of {self._total})"

    @property
    def are_many(self) -> bool:
        """True if the images that were lost, or not sent, are worth a warning."""
        return max(self.lost, self.unsent) >= self._least

    @property
    def _least(self) -> float:
        return max(LEAST_LOST, LEAST_SHARE * self._total)

    def warn(self, what: str, remedy: str) -> str:
        """Return what is wrong and what to do.

        Args:
            what: the images, as "colour".
            remedy: for images that are lost on the way.
        """
        warnings = []
        if self.lost >= self._least:
            warnings.append(f"{self._share(self.lost)} of the {what} images do not arrive: {remedy}")
        if self.unsent >= self._least:
            warnings.append(
                f"{self._share(self.unsent)} of the {what} images are missing with their camera_info: the camera's "
                "driver drops them: shorten the exposure, or give it another USB port or a less busy machine"
            )
        return "; ".join(warnings)


class Arrivals:
    """The stamps of one camera's images, over some seconds.

    With a camera_info for every image, as drivers send it, the images of those without one are known. What is missing
    beyond that shows where gaps are multiples of the shortest ones around them. An image that a busy process would not
    have taken in time counts as overtaken.
    """

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Forget all images; for a new recording, or after nobody asked for images."""
        self._stamps: deque[int] = deque()
        self._spares: deque[float] = deque()
        self._infos: deque[int] = deque()

    def take(self, stamp: int, spare: float) -> None:
        """Note an image.

        Args:
            stamp: of the image [ns].
            spare: time for which the process had nothing to do before it took the image [s].
        """
        if self._stamps and stamp <= self._stamps[-1]:
            if stamp < self._stamps[-1] - PAUSE:
                self.reset()
            else:
                return
        self._stamps.append(stamp)
        self._spares.append(spare)
        while self._stamps[0] < stamp - WINDOW:
            self._stamps.popleft()
            self._spares.popleft()

    def announce(self, stamp: int) -> None:
        """Note a camera_info of an image of `stamp` [ns]."""
        self._infos.append(stamp)
        while self._infos[0] < stamp - WINDOW:
            self._infos.popleft()

    @property
    def rhythm(self) -> str:
        """Period of the stamps in words, and whether they come in bursts, as those of arrivals do."""
        if len(self._stamps) < 3:
            return "not known yet"
        gaps = np.diff(self._stamps)
        mean, hasty = float(gaps.mean()), count_hasty(gaps)
        apart, near = f"{1e3 * SECOND * mean:.1f} ms apart", f"{1e3 * SECOND * _HASTY * mean:.1f} ms"
        if hasty < _BURSTS * len(gaps):
            return apart
        return (
            f"{apart} on average, {hasty} of {len(gaps)} within {near} of the one before: stamped on arrival, not at "
            "capture? Forces lag by the delay that the stamps hide"
        )

    def count_losses(self) -> ImageLosses:
        """Return the losses of the last seconds."""
        images = np.array(self._stamps, dtype=np.int64)
        if len(images) <= _FEWEST:
            return ImageLosses(arrived=len(images))
        infos = self._announced(images)
        sent = np.union1d(images, infos)
        period, missing = find_missing(np.diff(sent))
        gap_of = np.searchsorted(images, sent[:-1], side="right") - 1
        unsent = np.bincount(gap_of, missing, len(images) - 1)
        lost = np.bincount(gap_of[~np.isin(sent[:-1], images)], minlength=len(images) - 1)
        if not len(infos):
            lost, unsent = unsent, lost
        # a busy process takes the newest of the images that came meanwhile
        seen = np.floor(np.array(self._spares)[1:] / (SECOND * period) + 0.5) if period else np.inf
        overtaken = np.maximum(lost + unsent - seen, 0.0)
        from_lost = np.minimum(lost, overtaken)
        return ImageLosses(
            arrived=len(images),
            lost=int((lost - from_lost).sum()),
            unsent=int((unsent - (overtaken - from_lost)).sum()),
            overtaken=int(overtaken.sum()),
        )

    def _announced(self, images: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return the stamps (m,) of camera_info between images (n,), none where not every image has one."""
        infos = np.unique(np.array(self._infos, dtype=np.int64))
        if not len(infos):
            return infos
        told = images[(images >= infos[0]) & (images <= infos[-1])]
        if len(told) <= _FEWEST or np.isin(told, infos).mean() < _ANNOUNCING:
            return infos[:0]
        return infos[(infos > images[0]) & (infos < images[-1])]


def count_hasty(gaps: NDArray) -> int:
    """Return how many of gaps (n,) are shorter than any camera's by their mean."""
    return int((gaps < _HASTY * gaps.mean()).sum())


def find_missing(gaps: NDArray[np.int64]) -> tuple[float, NDArray[np.int64]]:
    """Return the period [ns] of images with gaps (n,) [ns] between them, and how many are missing in each gap (n,).

    Of a camera without a fixed rate nothing is known to be missing, and the period is 0 then; neither is anything where
    its rate has changed, nor in a pause.
    """
    nothing, short = np.zeros(len(gaps), dtype=int), gaps[gaps < PAUSE]
    if len(short) < _FEWEST or count_hasty(short) >= _BURSTS * len(short):
        return 0.0, nothing
    period = float(np.median(short[short <= _LONG * np.quantile(short, 0.1)]))
    alike = short[(short > (2.0 - _LONG) * period) & (short < _LONG * period)]
    if not len(alike):
        return 0.0, nothing
    period = float(np.median(alike))
    counts = np.maximum(np.rint(gaps / period).astype(int), 1)
    off, is_long = np.abs(gaps / period - counts), (counts > 1) & (gaps < PAUSE)
    if max(off[gaps < PAUSE].mean(), off[is_long].mean() if is_long.any() else 0.0) > _IRREGULAR:
        return 0.0, nothing
    padded = np.pad(gaps, _NEIGHBOURS, constant_values=np.iinfo(np.int64).max)
    nearest = np.lib.stride_tricks.sliding_window_view(padded, _NEIGHBOURS).min(axis=1)
    slower = np.maximum(nearest[: len(gaps)], nearest[_NEIGHBOURS + 1 :])
    return period, np.where(is_long & (slower < _LONG * period), counts - 1, 0)
