"""The tare: constant offsets and noise of the key points of the unloaded finger."""

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import compress
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from finforce.compiled import njit
from finforce_ifea.errors import NotEnoughDataError, UnderLoadError
from finforce_ifea.settings import EstimatorSettings

# Standard deviation of a key point's noise along one axis without a tare [m].
_NOISE = 0.35e-3
# Standard deviation of its constant offset [m].
OFFSET_STDDEV = 0.4e-3
# Number of unloaded images over which offsets are averaged.
_LONGEST_TARE = 300
# Standard deviation of a key point's noise, at least [m].
_NOISE_FLOOR = 0.02e-3
# Variance of the noise along x and z up to which nothing scatters [m^2].
_UNSEEN = 2.0 * (1.01 * _NOISE_FLOOR) ** 2
# Correlation of neighbouring key points up to which it is chance [sigma].
_CHANCE = 3.0
# Largest correlation [-].
_LARGEST_CORRELATION = 0.9
# Errors of the shipped network along x relative to what it states [-]: median of scenes drawn at random.
_ERRS_BY = 0.5
# Variance of lasting errors over that of the scatter, at least [-].
_LASTS = 2.0


class StatedNoise(NamedTuple):
    """The result of a tare of key points that came with standard deviations.

    Attributes:
        covariance: of each key point in an image in which it states `stddev` (K, 3, 3) [m^2].
        stddev: stated in the tare, root mean square over its images (K, 3) [m].
    """

    covariance: NDArray
    stddev: NDArray


class PointNoise(NamedTuple):
    """Noise of the key points of one image, in the plane of the jaw's motion, their y known.

    Attributes:
        plane: covariance of each in an image as those of the tare (K, 2, 2) [m^2].
        gain: regression of x and z on y in this image (K, 2).
        width_variance: along y in this image (K,) [m^2].
        noise_ratio: variance in the tare over that in this image (K,), at most 1.
        bias: variance of an error of this image less one of the tare, which lasts while the view does (K,) [m^2].
    """

    plane: NDArray
    gain: NDArray
    width_variance: NDArray
    noise_ratio: NDArray
    bias: NDArray


def match_stated(scatter: NDArray, stddev: NDArray, floor: float) -> StatedNoise:
    """Return the noise of key points: relative sizes as stated, the common scale as the tare measured it.

    With e_ki = scatter / stddev of key point k in image i, its own level l_k and the common shape C,

        l_k = sum_i |e_ki|^2 / (3 (n_k - 1)),    C = sum_ki e_ki e_ki^T / l_k / sum_k (n_k - 1),
        N_k = max(l_k, median of l) diag(s_k) C diag(s_k) + floor^2 I,

    s_k being the stated root mean square: a key point that scatters more than it states is not believed, one that
    seems to scatter less keeps the common scale. A key point that the tare has not seen counts as the others do.

    Args:
        scatter: about each key point's mean (n, K, 3) [m], NaN where it was not used.
        stddev: stated (n, K, 3) [m].
        floor: standard deviation [m] below which no key point is believed.
    """
    ratio = np.where(np.isfinite(scatter), scatter / np.where(np.isfinite(scatter), stddev, 1.0), 0.0)
    count = np.isfinite(scatter[..., 0]).sum(axis=0)
    seen, freedom = count >= 2, np.maximum(count - 1, 1)
    level = (ratio**2).sum(axis=(0, 2)) / (3.0 * freedom)
    scatters = seen & (level > 0.0)
    outer = np.einsum("ika,ikb->kab", ratio[:, scatters], ratio[:, scatters])
    shape = np.eye(3)
    if scatters.any():
        shape = (outer / level[scatters, None, None]).sum(axis=0) / freedom[scatters].sum()
    square = np.where(np.isfinite(scatter), stddev**2, 0.0).sum(axis=0) / np.maximum(count, 1)[:, None]
    square[~seen] = square[seen].mean(axis=0)
    stated, scale = np.sqrt(square), np.maximum(np.where(seen, level, 0.0), np.median(level[seen]))
    covariance = scale[:, None, None] * stated[:, :, None] * shape * stated[:, None, :]
    return StatedNoise(covariance=covariance + floor**2 * np.eye(3), stddev=stated)


def measure_correlation(scatter: NDArray, keypoints: NDArray) -> NDArray:
    """Return the correlation of the noise of different key points (K, K).

    A detector sees neighbours with the same pixels. With r the mean correlation of key points and their nearest
    neighbours, at the mean distance d,

        rho_kl = r^(|p_k - p_l| / d);

    none where r does not differ from chance.

    Args:
        scatter: about each key point's mean (n, K, 3) [m], NaN where it was not used.
        keypoints: drawn (K, 3) [m].
    """
    distance = np.linalg.norm(keypoints[:, None] - keypoints, axis=2)
    seen = np.isfinite(scatter[..., 0]).any(axis=0)
    nearest = np.where(seen & ~np.eye(len(seen), dtype=bool), distance, np.inf).argmin(axis=1)
    own, other = scatter[:, seen][..., ::2], scatter[:, nearest[seen]][..., ::2]
    both = np.isfinite(own) & np.isfinite(other)
    own, other = (np.where(both, each, 0.0) for each in (own, other))
    squares = np.sqrt((own**2).sum(axis=0) * (other**2).sum(axis=0))
    r = float(np.mean((own * other).sum(axis=0) / np.where(squares > 0.0, squares, 1.0)))
    if not r > _CHANCE * np.sqrt(2.0 / max(both.sum(), 1)):  # neighbours count twice
        return np.eye(len(keypoints))
    return min(r, _LARGEST_CORRELATION) ** (distance / distance[seen, nearest[seen]].mean())


def compute_point_noise(usual: StatedNoise, stddev: NDArray | None, *, is_measured: bool = True) -> PointNoise:
    """Return the noise of one image's key points: N_k, enlarged for what states more than it did in the tare.

        N_ki = R N_k R,    R = diag(max(1, s_ki / s_k)),    noise_ratio_ki = tr N_k / tr N_ki (in the plane).

    A key point that states less than in the tare counts as it did there: nothing has shown that it is better.

    A detector errs in the same way while it sees the same: that is taken off with the offsets in the tare, and comes
    back with another shape. No averaging removes it,

        b_k = max((s_kx^2 + s_kz^2) / 4 - n_k, 2 n_k),    n_k = N_kxx + N_kzz,    bias_k = sqrt(b_k median(b)),

    zero when nothing is stated. Without a tare, or where nothing scatters, as in one photograph seen again, all that is
    stated lasts. In scenes of the twin drawn at random, bright and dark, by three lenses, the lasting errors of a jaw
    along x are half of what the shipped network states and 1.4 times its scatter in the median, and up to four times.
    What a detector sees badly, it states badly, too: the errors follow the geometric mean of what is stated of a point
    and of most of its jaw.

    Args:
        usual: of each key point in the tare.
        stddev: stated in this image (K, 3) [m], NaN where there is no key point; None when nothing is stated.
        is_measured: whether the usual noise was measured by a tare.
    """
    before, now = usual.stddev, stddev
    if now is None:
        before = now = np.sqrt(np.diagonal(usual.covariance, axis1=1, axis2=2))
    before, now = (np.ascontiguousarray(each, float) for each in (before, now))
    noise = PointNoise(*_enlarge_noise(np.ascontiguousarray(usual.covariance), before, now, is_measured))
    seen = np.isfinite(now[:, 0])
    if stddev is None or not seen.any():
        return noise._replace(bias=np.zeros(len(before)))
    return noise._replace(bias=np.sqrt(noise.bias * np.median(noise.bias[seen])))


@njit(cache=True)
def _enlarge_noise(covariance, usual, stddev, is_measured):
    """Return what `PointNoise` holds, where an image states `stddev` (K, 3) [m] and usual ones are (K, 3)."""
    count = len(covariance)
    plane, gain = np.empty((count, 2, 2)), np.empty((count, 2))
    along, noise_ratio, bias = np.empty(count), np.empty(count), np.empty(count)
    growth = np.empty(3)
    for k in range(count):
        noise, own, now, stated = covariance[k], 0.0, 0.0, 0.0
        for a in range(3):
            growth[a] = max(1.0, stddev[k, a] / usual[k, a])
        for a in range(2):
            i, known = 2 * a, noise[2 * a, 1] / noise[1, 1]  # what is left once y is known
            for b in range(2):
                plane[k, a, b] = noise[i, 2 * b] - known * noise[2 * b, 1]
            gain[k, a] = known * growth[i] / growth[1]
            own += plane[k, a, a]
            now += plane[k, a, a] * growth[i] ** 2
            stated += (usual[k, i] * growth[i]) ** 2
        along[k], noise_ratio[k] = noise[1, 1] * growth[1] ** 2, own / now
        scatter = noise[0, 0] + noise[2, 2]
        if is_measured and scatter > _UNSEEN:
            bias[k] = max(_ERRS_BY**2 * stated - scatter, _LASTS * scatter)
        else:
            bias[k] = max(stated - scatter, scatter)
    return plane, gain, along, noise_ratio, bias


_FARTHEST_OFFSET = 3e-3
_FARTHEST_FROM_MEDIAN = 1.8e-3


@dataclass(frozen=True, kw_only=True, eq=False)
class Tare:
    """Offsets and noise of key points.

    Attributes:
        offsets: (K, 3) [m], measured minus drawn; zero where a key point was not seen.
        counts: (K,) frames behind each offset.
        noise: covariance of one key point in one frame (3, 3) [m^2], pooled over all of them.
        correlation: of the noise of different key points (K, K), see `measure_correlation`.
        stated: that of each key point by the standard deviations that came with it; None without such.
    """

    offsets: NDArray
    counts: NDArray
    noise: NDArray
    correlation: NDArray
    stated: StatedNoise | None = None

    @cached_property
    def is_taken(self) -> bool:
        """True if any key point has an offset."""
        return bool(self.counts.any())

    def offset_variance(self, unseen: float = OFFSET_STDDEV) -> NDArray:
        """Return the variance (K,) [m^2] of each offset; `unseen` is the standard deviation without a tare [m]."""
        if unseen not in self._variances:
            self._variances[unseen] = np.where(self.counts > 0, self._seen_variance, unseen**2)
        return self._variances[unseen]

    @cached_property
    def _variances(self) -> dict[float, NDArray]:
        """By the standard deviation of what is not seen [m]."""
        return {}

    @cached_property
    def _seen_variance(self) -> NDArray:
        noise = self.noise if self.stated is None else self.stated.covariance
        return np.trace(noise, axis1=-2, axis2=-1) / 3.0 / np.maximum(self.counts, 1)

    def point_noise(self, stddev: NDArray | None) -> PointNoise:
        """Return the noise of the key points of an image that states `stddev` (K, 3) [m], or nothing.

        A tare without stated deviations stands for key points that all state its pooled noise.
        """
        if stddev is None:
            return self._silent_noise
        return compute_point_noise(self._usual, stddev, is_measured=self.is_taken)

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
    """Return the tare of key points of which nothing is known but their noise [m]."""
    return Tare(
        offsets=np.zeros((count, 3)), counts=np.zeros(count), noise=noise**2 * np.eye(3), correlation=np.eye(count)
    )


def compute_tare(
    frames: Sequence[NDArray], keypoints: NDArray, stddevs: Sequence[NDArray | None] = (None,)
) -> Tare | None:
    """Average unloaded frames.

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
    scatter[:, ~often] = np.nan
    noise = scatter[:, often].reshape(-1, 3)
    noise = np.cov(noise[np.isfinite(noise[:, 0])].T) + _NOISE_FLOOR**2 * np.eye(3)
    stated = None
    if all(stddev is not None for stddev in stddevs):
        stated = match_stated(scatter, np.stack(stddevs), _NOISE_FLOOR)
    correlation = measure_correlation(scatter, keypoints)
    return Tare(offsets=offsets, counts=np.where(often, counts, 0), noise=noise, correlation=correlation, stated=stated)


Significance = Callable[[Tare, float], float]
# Significance of a force in the offsets from which a tare seems loaded [sigma].
_LOADED_SIGMA = 3.5
# Standard deviation of the difference between the halves of a steady tare [m].
_STEADY_STDDEV = 0.03e-3
_DELAY_FRAMES = 15
_FEWEST_FRAMES = 5
# Image period up to which a tare takes all of its images [s].
_PERIOD = 1.0 / 30.0
# Longest gap between images that counts in full [s].
_LONGEST_PERIOD = 0.25
# Fraction of its images that a tare takes at any rate [-].
_LEAST_SHARE = 1.0 / 3.0
_LEAST_SEEN = 0.5
_LEAST_NEAR = 0.75
# Fraction of the key points, the nearest ones, that must be at rest [-].
_NEARER = 0.75
_REST_FRAMES = 10
# Largest root mean square distance of these in one image [m].
_REST_REACH = 1e-3
# The same on average over `_REST_FRAMES` images [m].
_REST_REACH_MEAN = 0.45e-3
# Depth beyond the second smallest of a tare from which an image is loaded [sigma].
_DEEPER_SIGMAS = 6.0
# The same, at least [m].
_LEAST_LOADED_DEPTH = 0.1e-3
# Standard deviation over the median absolute difference of two samples [-]: 1.4826 / sqrt(2).
_STDDEV_BY_DIFFERENCES = 1.05
# Fraction of a tare's images that must be unloaded [-]; the others are left out.
_LEAST_UNLOADED = 1.0 / 3.0


def find_unloaded(deviations: NDArray, modes: NDArray) -> NDArray[np.bool_]:
    """Return which images show the jaw with the least load among them (n,).

    A load moves all key points alike, and one way. The depth that an image shows is that of least squares, without the
    key points far from the median; its noise is that of the differences between successive images.

    Args:
        deviations: of the key points from the drawing, x and z (n, K, 2) [m], NaN where unused.
        modes: motion of the key points by the depth (K, 2) [m/m].
    """
    seen = np.isfinite(deviations[..., 0]).any(axis=0)
    moved, modes = deviations[:, seen] - np.nanmedian(deviations[:, seen], axis=0), modes[seen]
    square = (modes**2).sum(axis=1)
    asked = (moved * modes).sum(axis=2) / np.maximum(square, 1e-12)
    depths = np.array([_find_weighted_median(row, square) for row in asked])
    near = np.linalg.norm(moved - depths[:, None, None] * modes, axis=2) < _FARTHEST_FROM_MEDIAN
    weight = (near * square).sum(axis=1)
    depths = np.where(near, asked * square, 0.0).sum(axis=1) / np.where(weight > 0.0, weight, np.nan)
    known = depths[np.isfinite(depths)]
    if len(known) < _FEWEST_FRAMES:
        return np.isfinite(depths)
    noise = _STDDEV_BY_DIFFERENCES * float(np.median(np.abs(np.diff(known))))
    return depths <= np.partition(known, 1)[1] + max(_DEEPER_SIGMAS * noise, _LEAST_LOADED_DEPTH)


def _find_weighted_median(values: NDArray, weights: NDArray) -> float:
    """Return the weighted median of values (K,), some of which may be NaN; NaN if all are."""
    values, weights = values[(known := np.isfinite(values))], weights[known]
    order = np.argsort(values)
    passed = np.cumsum(weights[order])
    return float(values[order][np.searchsorted(passed, 0.5 * passed[-1])]) if len(values) else np.nan


class TareKeeper:
    """Collects unloaded frames, tares once there are enough, and goes on averaging until the first load."""

    def __init__(
        self,
        keypoints: NDArray,
        settings: EstimatorSettings,
        significance: Significance,
        modes: Callable[[], NDArray],
    ) -> None:
        """Begin without frames.

        Args:
            keypoints: drawn (K, 3) [m].
            settings: of the estimator.
            significance: by how many standard deviations a force explains a tare whose points are off by chance by so
                much [m].
            modes: motion of the key points in x and z by the depth (K, 2) [m/m].
        """
        self._keypoints, self._settings, self._significance = keypoints, settings, significance
        self._find_modes = modes
        self.reset()

    def reset(self) -> None:
        """Forget offsets and frames."""
        self.tare = blank_tare(len(self._keypoints), _NOISE)
        self._frames: deque[NDArray] = deque(maxlen=_LONGEST_TARE + _DELAY_FRAMES)
        self._stddevs: deque[NDArray | None] = deque(maxlen=self._frames.maxlen)
        self._open = self._settings.automatic_tare
        self._quiet, self._passed, self._fresh = 0, 0.0, 0

    @property
    def is_averaging(self) -> bool:
        """True if a tare by itself is due, or would be better with more unloaded frames."""
        return self._open and (not self.tared or len(self._frames) <= _LONGEST_TARE)

    def interrupt(self) -> None:
        """Take frames from here on alone into a tare that is asked for: what presses meanwhile is not known."""
        self._fresh = 0

    @property
    def tared(self) -> bool:
        """True if the offsets are known."""
        return self.tare.is_taken

    @property
    def is_noisy(self) -> bool:
        """True if the key points of the tare were those of a camera, whose noise no two images share."""
        return self.tared and bool(np.trace(self.tare.noise) > 3.0 * (1.01 * _NOISE_FLOOR) ** 2)

    @property
    def missing(self) -> int:
        """Frames still to come before the first tare by itself; 0 when none is due.

        A tare takes as long as `tare_frames` images at 30 Hz: fewer images where they are rarer, a third at least.
        """
        if not self._open or self.tared:
            return 0
        count, due = len(self._frames), self._settings.tare_frames
        period = max(self._passed / max(count - 1, 1), _PERIOD)
        return max(0, round(due * max(_PERIOD / period, _LEAST_SHARE)) - count)

    def add(self, points: NDArray, stddev: NDArray | None = None, *, apart: bool, dt: float) -> None:
        """Take the accepted key points (K, 3) [m] of a frame and their stated standard deviations (K, 3) [m].

        `apart` when the object is known not to touch; dt [s] since the frame before.
        """
        self._passed += min(dt, _LONGEST_PERIOD) if self._frames else 0.0
        self._fresh += 1
        self._frames.append(points)
        self._stddevs.append(stddev)
        if apart and not self.tared and not self._open and self._settings.automatic_tare:
            self._frames.clear()
            self._stddevs.clear()
            self._open, self._passed = True, 0.0

    def adopt(self, tare: Tare) -> None:
        """Take the offsets of other images; they are not averaged with what comes."""
        self.tare, self._open = tare, False

    def begin(self) -> None:
        """Tare for the first time if that is due; a jaw that looks loaded goes on without.

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
        """Take note of whether anything presses; averages more frames until something surely does."""
        self._quiet = self._quiet + 1 if quiet else 0
        if not (self._open and self.tared):
            return
        if loaded or len(self._frames) > _LONGEST_TARE:
            self._open = False
        elif self._quiet >= 2 * _DELAY_FRAMES and self._quiet % _DELAY_FRAMES == 0:
            # the newest half second is left out: a load may just have begun
            older = slice(None, -_DELAY_FRAMES)
            frames, stddevs = list(self._frames)[older], list(self._stddevs)[older]
            self.tare = compute_tare(frames, self._keypoints, stddevs) or self.tare

    def take(self) -> str:
        """Take the last frames as unloaded and learn each key point's offset; return what was found, a sentence.

        Raises:
            NotEnoughDataError: Too few unloaded frames or visible key points.
            UnderLoadError: The jaw is, or looks, loaded.
        """
        count = min(_LONGEST_TARE, self._fresh, self._quiet if self.tared else len(self._frames))
        if self.tared and self._quiet == 0 and self._fresh:
            raise UnderLoadError("cannot tare: something presses on the jaw")
        if count < _FEWEST_FRAMES:
            raise NotEnoughDataError(f"cannot tare: {count} unloaded frames, expected at least {_FEWEST_FRAMES}")
        if not self.tared:
            count = self._keep_unloaded(count)
        frames = list(self._frames)[-count:]
        tare = compute_tare(frames, self._keypoints, list(self._stddevs)[-count:])
        seen = np.isfinite(np.stack(frames)[..., 0]).mean(0) >= _LEAST_SEEN
        if seen.sum() < 3:
            raise NotEnoughDataError("cannot tare: fewer than three key points are seen in half of the frames")
        if tare is None or (tare.counts > 0).sum() < _LEAST_NEAR * seen.sum():
            raise UnderLoadError("cannot tare: the key points lie millimetres from where the unloaded jaw has them")
        if not self.tared:
            if (sigma := self._significance(tare, OFFSET_STDDEV)) > _LOADED_SIGMA:
                raise UnderLoadError(f"cannot tare: the key points look loaded ({sigma:.1f} standard deviations)")
            self._check_steady(frames)
        while len(self._frames) > count:  # what comes is averaged with these alone
            self._frames.popleft()
            self._stddevs.popleft()
        self.tare = tare
        largest, noise = np.linalg.norm(tare.offsets, axis=1).max(), np.sqrt(np.trace(tare.noise) / 3.0)
        return (
            f"tared {int((tare.counts > 0).sum())} key points over {count} frames: largest offset "
            f"{1e3 * largest:.2f} mm, noise {1e3 * noise:.2f} mm"
        )

    def _keep_unloaded(self, count: int) -> int:
        """Keep those of the last frames that show no load; return their number.

        Raises:
            UnderLoadError: Most of them show one.
        """
        frames, stddevs = list(self._frames)[-count:], list(self._stddevs)[-count:]
        unloaded = find_unloaded((np.stack(frames) - self._keypoints)[..., ::2], self._find_modes())
        left = int(unloaded.sum())
        if left < max(_FEWEST_FRAMES, _LEAST_UNLOADED * count):
            raise UnderLoadError(f"cannot tare: the jaw was loaded in {count - left} of {count} frames")
        if left < count:
            self._frames.clear()
            self._stddevs.clear()
            self._frames.extend(compress(frames, unloaded))
            self._stddevs.extend(compress(stddevs, unloaded))
        return left

    def _check_steady(self, frames: list[NDArray]) -> None:
        half = len(frames) // 2
        first, last = compute_tare(frames[:half], self._keypoints), compute_tare(frames[half:], self._keypoints)
        if half < _FEWEST_FRAMES or first is None or last is None:
            return
        counts = np.where((first.counts > 0) & (last.counts > 0), np.minimum(first.counts, last.counts) / 2, 0)
        change = replace(last, offsets=last.offsets - first.offsets, counts=counts, stated=None)
        sigma = abs(self._significance(change, _STEADY_STDDEV))
        if sigma > _LOADED_SIGMA:
            raise UnderLoadError(f"cannot tare: the load is changing ({sigma:.1f} standard deviations)")

    def is_at_rest(self, points: NDArray) -> bool:
        """Return True if key points (K, 3) [m] of one frame are where the tared, unloaded jaw has them.

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
        return tare is not None and self._significance(tare, OFFSET_STDDEV) < _LOADED_SIGMA


def _measure_bend(deviations: NDArray) -> float:
    """Return the root mean square [m] of the nearer deviations (K, 3) [m], infinite when there are too few."""
    distances = np.sort(np.linalg.norm(deviations[np.isfinite(deviations[:, 0])], axis=1))
    nearer = distances[: int(np.ceil(_NEARER * len(distances)))]
    return float(np.sqrt(np.mean(nearer**2))) if len(nearer) >= 3 else np.inf
