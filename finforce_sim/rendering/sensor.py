"""A colour sensor and its stereo depth: light and true depths into the images that a camera gives, and its noise."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import convolve1d, gaussian_filter, uniform_filter
from scipy.stats import norm

from finforce.camera import CameraIntrinsics
from finforce_sim.rendering.depth_camera import DepthNoise, disturb_depth, smooth_field
from finforce_sim.rendering.lighting import BRIGHTEST, EXPOSURE_TARGET, Exposure

GAMMA = 2.2
FLAT_CONTRAST = 0.03  # of grey levels around a pixel, below which stereo finds too little to match
HOLES_IN_FLAT = 0.25  # share of the depth lost there, and in the dark
DARK_LEVEL = 0.06  # of an 8-bit image's range
D405_NOISE = DepthNoise(hole_fraction=0.005, fattening=1)
HOLE_SIZE = 3.0  # [px] standard deviation of the field that is cut to make holes


def expose(light: NDArray, exposure: Exposure, rng: np.random.Generator, smear: NDArray | None = None) -> NDArray:
    """Return the 8-bit picture that a sensor makes of light.

    The camera raises its gain until the mean is right or the gain is at its largest; shot noise grows with the gain.

    Args:
        light: (h, w, 3) linear; 1 is white in a lit room.
        exposure: of the sensor.
        rng: source of the noise.
        smear: (2,) standard deviations along the rows and columns by which motion blurs [px].

    Returns:
        (h, w, 3) uint8 red, green, blue.
    """
    scene = np.asarray(light, dtype=np.float32) * np.float32(exposure.brightness) * exposure.white.astype(np.float32)
    scene *= _vignette(scene.shape[:2], exposure.vignetting)[..., None]
    blur = np.hypot(exposure.blur, np.zeros(2) if smear is None else smear)
    scene = gaussian_filter(scene, (blur[1], blur[0], 0.0), truncate=3.0)
    wanted = min(EXPOSURE_TARGET / max(float(scene.mean()), 1e-6), BRIGHTEST / max(_bright_end(scene), 1e-6))
    gain = float(np.clip(wanted, 0.2, exposure.largest_gain))
    electrons = scene * exposure.full_well
    noise = np.sqrt(np.maximum(electrons, 0.0) + exposure.read_noise**2)
    electrons += noise * _sensor_noise(scene.shape, rng)
    level = np.clip(gain * electrons / exposure.full_well, 0.0, 1.0) ** np.float32(1.0 / GAMMA)
    return np.round(255.0 * level).astype(np.uint8)


def _bright_end(scene: NDArray) -> float:
    """Return the brightness that a twentieth of an image exceeds, from every eighth pixel of both axes."""
    return float(np.quantile(scene[::8, ::8].max(axis=2), 0.95))


def _sensor_noise(shape: tuple[int, ...], rng: np.random.Generator) -> NDArray:
    """Return noise (h, w, 3) of unit variance; interpolating the colour filter makes neighbours alike."""
    white = rng.standard_normal(shape, dtype=np.float32)
    kernel = np.array([0.25, 0.5, 0.25], dtype=np.float32)
    soft = convolve1d(convolve1d(white, kernel, axis=0), kernel, axis=1)
    return 0.6 * white + 1.7 * soft


def _vignette(shape: tuple[int, int], loss: float) -> NDArray:
    """Return the share of light (h, w) that reaches the pixels."""
    rows, columns = (np.linspace(-1.0, 1.0, size, dtype=np.float32) for size in shape)
    return 1.0 - 0.5 * loss * (rows[:, None] ** 2 + columns[None, :] ** 2)


def measure_depth(
    depth: NDArray,
    color: NDArray,
    camera: CameraIntrinsics,
    rng: np.random.Generator,
    noise: DepthNoise | None = None,
) -> NDArray:
    """Return the depth that a stereo camera finds for a picture; it loses some where the picture is flat or dark.

    Args:
        depth: (h, w) true depths [m].
        color: (h, w, 3) uint8, the picture of the same view.
        camera: intrinsics.
        rng: source of the noise.
        noise: its size; that of a D405 when absent.

    Returns:
        (h, w) float32 [m], NaN where nothing was measured.
    """
    noise = noise or D405_NOISE
    measured = disturb_depth(depth, camera, rng, replace(noise, hole_fraction=0.0))
    chance = noise.hole_fraction + HOLES_IN_FLAT * (noise.hole_fraction > 0.0) * _is_hard_to_match(color)
    field = smooth_field(measured.shape, HOLE_SIZE, rng)
    measured[field < norm.ppf(np.clip(chance, 1e-6, 0.99))] = np.nan
    return measured


def _is_hard_to_match(color: NDArray) -> NDArray:
    """Return from 0 to 1 how flat and dark (h, w) the surroundings of the pixels are."""
    grey = color.mean(axis=2, dtype=np.float32) / 255.0
    mean = uniform_filter(grey, 7)
    spread = np.sqrt(np.maximum(uniform_filter(grey * grey, 7) - mean * mean, 0.0))
    return np.clip(1.0 - spread / FLAT_CONTRAST, 0.0, 1.0) * np.clip(2.0 - mean / DARK_LEVEL, 0.0, 1.0)


DENSITY = 0.005  # share of the numbers that differ by one
_ROOM = 4096  # places at which the pattern may begin


class Flicker:
    """Lays noise over pictures, and takes the last noise of each away again, so that it does not add up.

    A camera never gives the same picture twice, by which a watch tells it from a frozen one.

    Args:
        seed: of the noise.
    """

    def __init__(self, seed: int) -> None:
        self._rng = np.random.default_rng((seed, 11))
        self._patterns: dict[int, NDArray] = {}
        self._last: dict[int, int] = {}

    def lay(self, numbers: NDArray, name: int) -> None:
        """Change some of a picture's numbers (n,) of unsigned integers by one, in place; zeros stay zeros.

        Args:
            numbers: of the picture.
            name: of this picture, the same whenever it is shown.
        """
        if name in self._last:
            numbers ^= self._pattern(numbers, self._last[name])
        self._last[name] = int(self._rng.integers(_ROOM))
        numbers ^= self._pattern(numbers, self._last[name])

    def _pattern(self, numbers: NDArray, start: int) -> NDArray:
        """Return the bits (n,) that change; a zero or a one may say that there is nothing."""
        pattern = self._patterns.get(numbers.size)
        if pattern is None:
            pattern = (self._rng.random(numbers.size + _ROOM) < DENSITY).astype(np.uint8)
            self._patterns[numbers.size] = pattern
        return pattern[start : start + numbers.size].astype(numbers.dtype) * (numbers > 1)
