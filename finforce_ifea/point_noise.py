"""How noisy each key point of an image is: the tare's scatter, scaled by what the detector states; knows no jaw."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray


class StatedNoise(NamedTuple):
    """What a tare found of key points that came with standard deviations.

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
        trust: variance in the tare over that in this image (K,), at most 1.
        standing: variance that was stated in the tare beyond what its images scattered (K,) [m^2].
    """

    plane: NDArray
    gain: NDArray
    width_variance: NDArray
    trust: NDArray
    standing: NDArray


def match_stated(scatter: NDArray, stddev: NDArray, floor: float) -> StatedNoise:
    """Returns the noise of key points: relative sizes as stated, the common scale as the tare measured it.

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


def compute_point_noise(usual: StatedNoise, stddev: NDArray | None) -> PointNoise:
    """Returns the noise of one image's key points: N_k, enlarged for what states more than it did in the tare.

        N_ki = R N_k R,    R = diag(max(1, s_ki / s_k)),    trust_ki = tr N_k / tr N_ki (in the plane).

    A key point that states less than in the tare counts as it did there: nothing has shown that it is better.

    A detector errs in the same way while it sees the same: what is stated and does not scatter in the tare stands still
    there, is taken off with the offsets, and comes back in another shape with the next sight. No averaging removes it,

        standing_k = max(0, (s_kx^2 + s_kz^2) / 2 - tr N_k), zero when nothing is stated;

    up to twice the variance of the scatter is taken for chance.

    Args:
        usual: of each key point in the tare.
        stddev: stated in this image (K, 3) [m], NaN where there is no key point; None when nothing is stated.
    """
    plane, gain = condition_on_width(usual.covariance)
    width_variance = usual.covariance[:, 1, 1]
    if stddev is None:
        return PointNoise(plane, gain, width_variance, np.ones(len(plane)), np.zeros(len(plane)))
    growth = np.fmax(1.0, stddev / usual.stddev)
    across, along = growth[:, [0, 2]], growth[:, 1]
    own = np.einsum("kaa->ka", plane)
    stated = (usual.stddev[:, [0, 2]] ** 2).sum(axis=1)
    return PointNoise(
        plane=plane,
        gain=gain * across / along[:, None],
        width_variance=width_variance * along**2,
        trust=own.sum(axis=1) / (own * across**2).sum(axis=1),
        standing=np.maximum(0.0, 0.5 * stated - np.einsum("kaa->k", usual.covariance[:, ::2, ::2])),
    )


def condition_on_width(noise: NDArray) -> tuple[NDArray, NDArray]:
    """Returns the in-plane noise (..., 2, 2) [m^2] left of (..., 3, 3) once y is known, and its regression on y."""
    shared = noise[..., [0, 2], 1]
    gain = shared / noise[..., 1, 1, None]
    plane = noise[..., [0, 2], :][..., [0, 2]]
    return plane - gain[..., :, None] * shared[..., None, :], gain
