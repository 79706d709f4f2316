"""When offsets of key points are learnt, and from which frames; knows no mechanics."""

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from finforce_ifea.errors import NotEnoughDataError, UnderLoadError
from finforce_ifea.settings import EstimatorSettings
from finforce_ifea.tare import Tare, blank_tare, compute_tare

Significance = Callable[[Tare, float], float]
# A tare looks loaded when the force that explains the offsets exceeds this many standard deviations.
_LOADED_SIGMA = 3.5
# What the noise of an average may leave between the halves of a steady tare [m].
_STEADY_STDDEV = 0.03e-3
_DELAY_FRAMES = 15
_FEWEST_FRAMES = 5
_LEAST_SEEN = 0.5
_LEAST_NEAR = 0.75
# At rest the nearer three quarters of the key points are so near to their places [m]: in one frame, and on average.
_NEARER = 0.75
_REST_FRAMES = 10
_REST_REACH, _REST_REACH_MEAN = 1e-3, 0.45e-3


@dataclass(frozen=True, kw_only=True, eq=False)
class TareReport:
    """What a tare found.

    Attributes:
        frames: averaged.
        keypoints: that have an offset now.
        largest_offset: [m].
        noise: standard deviation of one key point along one axis [m].
    """

    frames: int
    keypoints: int
    largest_offset: float
    noise: float

    def __str__(self) -> str:
        """Returns the report as one sentence."""
        return (
            f"tared {self.keypoints} key points over {self.frames} frames: largest offset "
            f"{1e3 * self.largest_offset:.2f} mm, noise {1e3 * self.noise:.2f} mm"
        )


class TareKeeper:
    """Collects unloaded frames, tares once there are enough, and goes on averaging until the first load."""

    def __init__(self, keypoints: NDArray, settings: EstimatorSettings, significance: Significance) -> None:
        """Keeps the drawn key points (K, 3) [m] and `significance`.

        It says by how many standard deviations a force explains a tare whose points are off by chance by so much [m].
        """
        self._keypoints, self._settings, self._significance = keypoints, settings, significance
        self.reset()

    def reset(self) -> None:
        """Forgets offsets and frames."""
        self.tare = blank_tare(len(self._keypoints), self._settings.noise)
        self._frames: deque[NDArray] = deque(maxlen=self._settings.tare_memory + _DELAY_FRAMES)
        self._stddevs: deque[NDArray | None] = deque(maxlen=self._frames.maxlen)
        self._open = self._settings.automatic_tare
        self._quiet = 0

    @property
    def tared(self) -> bool:
        """Whether the offsets are known."""
        return bool(self.tare.counts.any())

    @property
    def missing(self) -> int:
        """Frames still to come before the first tare by itself; 0 when none is due."""
        due = self._open and not self.tared
        return max(0, self._settings.tare_frames - len(self._frames)) if due else 0

    def add(self, points: NDArray, stddev: NDArray | None = None, *, apart: bool) -> None:
        """Takes the accepted key points (K, 3) [m] of a frame and their stated standard deviations (K, 3) [m].

        `apart` when the object is known not to touch.
        """
        self._frames.append(points)
        self._stddevs.append(stddev)
        if apart and not self.tared and not self._open and self._settings.automatic_tare:
            self._frames.clear()
            self._stddevs.clear()
            self._open = True

    def begin(self) -> None:
        """Tares for the first time if that is due; a jaw that looks loaded goes on without.

        Raises:
            NotEnoughDataError: Too few key points are seen.
        """
        if not self._open or self.tared:
            return
        try:
            self.take()
        except UnderLoadError:
            self._open = False

    def note(self, *, quiet: bool, loaded: bool) -> None:
        """Takes note of whether anything presses; averages more frames until something surely does."""
        self._quiet = self._quiet + 1 if quiet else 0
        if not (self._open and self.tared):
            return
        if loaded or len(self._frames) > self._settings.tare_memory:
            self._open = False
        elif self._quiet >= 2 * _DELAY_FRAMES and self._quiet % _DELAY_FRAMES == 0:
            # the newest half second is left out: a load may just have begun
            older = slice(None, -_DELAY_FRAMES)
            frames, stddevs = list(self._frames)[older], list(self._stddevs)[older]
            self.tare = compute_tare(frames, self._keypoints, stddevs) or self.tare

    def take(self) -> TareReport:
        """Takes the last frames as unloaded and learns each key point's offset.

        Raises:
            NotEnoughDataError: Too few unloaded frames or visible key points.
            UnderLoadError: The jaw is, or looks, loaded.
        """
        count = min(self._settings.tare_memory, self._quiet if self.tared else len(self._frames))
        if self.tared and self._quiet == 0:
            raise UnderLoadError("cannot tare: something presses on the jaw")
        if count < _FEWEST_FRAMES:
            raise NotEnoughDataError(f"cannot tare: {count} unloaded frames, expected at least {_FEWEST_FRAMES}")
        frames = list(self._frames)[-count:]
        tare = compute_tare(frames, self._keypoints, list(self._stddevs)[-count:])
        seen = np.isfinite(np.stack(frames)[..., 0]).mean(0) >= _LEAST_SEEN
        if seen.sum() < 3:
            raise NotEnoughDataError("cannot tare: fewer than three key points are seen in half of the frames")
        if tare is None or (tare.counts > 0).sum() < _LEAST_NEAR * seen.sum():
            raise UnderLoadError("cannot tare: the key points lie millimetres from where the unloaded jaw has them")
        if not self.tared:
            self._check_unloaded(tare)
            self._check_steady(frames)
        self.tare = tare
        return TareReport(
            frames=count,
            keypoints=int((tare.counts > 0).sum()),
            largest_offset=float(np.linalg.norm(tare.offsets, axis=1).max()),
            noise=float(np.sqrt(np.trace(tare.noise) / 3.0)),
        )

    def _check_unloaded(self, tare: Tare) -> None:
        sigma = self._significance(tare, self._settings.offset_stddev)
        if sigma > _LOADED_SIGMA:
            raise UnderLoadError(f"cannot tare: the key points look loaded ({sigma:.1f} standard deviations)")

    def _check_steady(self, frames: list[NDArray]) -> None:
        half = len(frames) // 2
        first, last = compute_tare(frames[:half], self._keypoints), compute_tare(frames[half:], self._keypoints)
        if half < _FEWEST_FRAMES or first is None or last is None:
            return
        counts = np.where((first.counts > 0) & (last.counts > 0), np.minimum(first.counts, last.counts) / 2, 0)
        change = Tare(offsets=last.offsets - first.offsets, counts=counts, noise=last.noise)
        sigma = abs(self._significance(change, _STEADY_STDDEV))
        if sigma > _LOADED_SIGMA:
            raise UnderLoadError(f"cannot tare: the load is changing ({sigma:.1f} standard deviations)")

    def is_at_rest(self, points: NDArray) -> bool:
        """Whether key points (K, 3) [m] of one frame are where the tared, unloaded jaw has them.

        Neither the frame nor the average of the last ones may be bent, nor look loaded.
        """
        if not self.tared:
            return False
        rest = self._keypoints + self.tare.offsets
        recent = np.stack(list(self._frames)[-_REST_FRAMES:] or [points]) - rest
        seen = np.isfinite(recent[:, :, 0]).any(axis=0)
        mean = np.nanmean(recent[:, seen], axis=0)
        if _measure_bend(points - rest) > _REST_REACH or _measure_bend(mean) > _REST_REACH_MEAN:
            return False
        tare = compute_tare([points, points], rest)
        return tare is not None and self._significance(tare, self._settings.offset_stddev) < _LOADED_SIGMA


def _measure_bend(deviations: NDArray) -> float:
    """Returns the root mean square [m] of the nearer deviations (K, 3) [m], infinite when there are too few."""
    ways = np.sort(np.linalg.norm(deviations[np.isfinite(deviations[:, 0])], axis=1))
    nearer = ways[: int(np.ceil(_NEARER * len(ways)))]
    return float(np.sqrt(np.mean(nearer**2))) if len(nearer) >= 3 else np.inf
