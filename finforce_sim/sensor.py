"""A colour sensor and a stereo depth camera like the D405: light and true depths into images, and their noise."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter
from scipy.special import ndtri

from finforce.camera import EQUIDISTANT, RATIONAL, CameraIntrinsics
from finforce_sim.render import BRIGHTEST, EXPOSURE_TARGET, Exposure, smooth_field

GAMMA = 2.2
FLAT_CONTRAST = 0.03  # of grey levels around a pixel, below which stereo finds too little to match
HOLES_IN_FLAT = 0.25  # share of the depth lost there, and in the dark
DARK_LEVEL = 0.06  # of an 8-bit image's range
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
    scene *= _vignette(scene.shape[:2], exposure.vignetting)
    columns, rows = np.hypot(exposure.blur, np.zeros(2) if smear is None else smear)
    scene = _filter(scene, *(cv2.getGaussianKernel(2 * int(3.0 * width + 0.5) + 1, width) for width in (rows, columns)))
    bright = float(np.quantile(scene[::8, ::8].max(axis=2), 0.95))  # a twentieth of the image exceeds it
    wanted = min(EXPOSURE_TARGET / max(float(scene.mean()), 1e-6), BRIGHTEST / max(bright, 1e-6))
    gain = float(np.clip(wanted, 0.2, exposure.largest_gain))
    electrons = scene * exposure.full_well
    noise = np.sqrt(np.maximum(electrons, 0.0) + exposure.read_noise**2)
    # of unit variance; interpolating the colour filter makes neighbours alike
    white = rng.standard_normal(scene.shape, dtype=np.float32)
    electrons += noise * (0.6 * white + 1.7 * _filter(white, *[np.array([0.25, 0.5, 0.25])] * 2))
    level = np.clip(gain * electrons / exposure.full_well, 0.0, 1.0) ** np.float32(1.0 / GAMMA)
    return np.round(255.0 * level).astype(np.uint8)


def _filter(image: NDArray, rows: NDArray, columns: NDArray) -> NDArray:
    """Return an image (h, w, 3) weighed by kernels along the rows' axis and along the columns', summed in doubles."""
    for kernels in ((np.ones(1), rows), (columns, np.ones(1))):
        image = cv2.sepFilter2D(image, cv2.CV_64F, *kernels, borderType=cv2.BORDER_REFLECT).astype(image.dtype)
    return image


@lru_cache(maxsize=2)
def _vignette(shape: tuple[int, int], loss: float) -> NDArray:
    """Return the share of light (h, w, 3) that reaches the pixels."""
    rows, columns = (np.linspace(-1.0, 1.0, size, dtype=np.float32) for size in shape)
    return np.dstack([1.0 - 0.5 * loss * (rows[:, None] ** 2 + columns[None, :] ** 2)] * 3)


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
    # pixels whose surroundings are flat and dark are hard to match
    red, green, blue = np.moveaxis(color, 2, 0)  # a tenth of the time of a mean along so short an axis
    grey = (np.add(red, green, dtype=np.float32) + blue) / np.float32(3.0) / np.float32(255.0)
    mean = uniform_filter(grey, 7)
    spread = np.sqrt(np.maximum(uniform_filter(grey * grey, 7) - mean * mean, 0.0))
    hard = np.clip(1.0 - spread / FLAT_CONTRAST, 0.0, 1.0) * np.clip(2.0 - mean / DARK_LEVEL, 0.0, 1.0)
    chance = noise.hole_fraction + HOLES_IN_FLAT * (noise.hole_fraction > 0.0) * hard
    field = smooth_field(measured.shape, HOLE_SIZE, rng)
    chance = np.clip(chance, 1e-6, 0.99)
    low = field < ndtri(np.max(chance))
    low[low] = field[low] < ndtri(np.broadcast_to(chance, low.shape)[low])
    measured[low] = np.nan
    return measured


DENSITY = 0.005  # share of the numbers that differ by one
_SHIFTS = 4096  # at which the pattern may begin


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
        self._last[name] = int(self._rng.integers(_SHIFTS))
        numbers ^= self._pattern(numbers, self._last[name])

    def _pattern(self, numbers: NDArray, start: int) -> NDArray:
        """Return the bits (n,) that change; a zero or a one may say that there is nothing."""
        pattern = self._patterns.get(numbers.size)
        if pattern is None:
            pattern = (self._rng.random(numbers.size + _SHIFTS) < DENSITY).astype(np.uint8)
            self._patterns[numbers.size] = pattern
        return pattern[start : start + numbers.size].astype(numbers.dtype) * (numbers > 1)


D405_DISTORTION = (-0.0545, 0.0568, 0.0010, 0.00034, -0.0185)


def build_d405_vga() -> CameraIntrinsics:
    """Return the colour camera of a D405 at 640 x 480, with its distortion."""
    distortion = np.array(D405_DISTORTION)
    return CameraIntrinsics(width=640, height=480, fx=431.2, fy=430.0, cx=319.6, cy=241.3, distortion=distortion)


D405, WEBCAM, FISHEYE = "d405", "webcam", "fisheye"
# by name, at 640 x 480: a webcam calibrated with the rational model, and an action camera of 155 degrees across
LENSES = {
    D405: build_d405_vga(),
    WEBCAM: CameraIntrinsics(
        width=640,
        height=480,
        fx=505.0,
        fy=504.0,
        cx=322.8,
        cy=236.9,
        distortion=np.array([0.21, -0.35, 0.0009, -0.0006, 0.02, 0.17, -0.27, -0.05]),
        model=RATIONAL,
    ),
    FISHEYE: CameraIntrinsics(
        width=640,
        height=480,
        fx=236.0,
        fy=235.5,
        cx=320.9,
        cy=238.4,
        distortion=np.array([-0.012, 0.006, -0.004, 0.0007]),
        model=EQUIDISTANT,
    ),
}


@dataclass(frozen=True, kw_only=True)
class DepthNoise:
    """The faults of a depth image; zero switches each of them off.

    Attributes:
        disparity_stddev: of the matching [px]; the depth's is z^2 disparity_stddev / (f baseline).
        baseline: between the two imagers [m].
        correlation: standard deviation of the smoothing that block matching does to the noise [px].
        quantum: step of the depth [m]; the ROS driver gives 1 mm.
        edge_width: half width of the band around a step in depth where pixels can fly [px].
        edge_fraction: of the pixels in this band that lie between foreground and background.
        hole_fraction: of the pixels without depth, in patches.
        scale_stddev: of the relative error that all pixels of an image share; 1 to 2 % in a real unit.
        nearest: depth below which nothing is measured [m].
        fattening: by how much near things look wider than they are, on every side [px].
    """

    disparity_stddev: float = 0.08
    baseline: float = 0.018
    correlation: float = 1.5
    quantum: float = 1e-3
    edge_width: int = 2
    edge_fraction: float = 0.4
    hole_fraction: float = 0.02
    scale_stddev: float = 0.0
    nearest: float = 0.07
    fattening: int = 0


D405_NOISE = DepthNoise(hole_fraction=0.005, fattening=1)


EDGE_STEP = 4e-3  # [m] in depth between neighbours, above which matching mixes the two sides
STEEPEST = 2.75  # tangent of 70 degrees between the viewing ray and a surface's normal


def disturb_depth(
    depth: NDArray, camera: CameraIntrinsics, rng: np.random.Generator, noise: DepthNoise | None = None
) -> NDArray:
    """Return a depth image as the camera would give it.

    sigma_z = z^2 sigma_d / (f B), correlated over neighbours; then mixed depths at steps, holes and rounding.

    Args:
        depth: (h, w) true depths [m], NaN where there is nothing.
        camera: intrinsics of the image.
        rng: source of the noise.
        noise: its size; that of a D405 when absent.

    Returns:
        (h, w) float32 [m], NaN where nothing was measured.
    """
    noise = noise or DepthNoise()
    mixed = _mix_edges(np.asarray(depth, dtype=float), camera, noise, rng)
    stddev = mixed**2 * noise.disparity_stddev / (camera.fx * noise.baseline)
    measured = mixed + stddev * smooth_field(mixed.shape, noise.correlation, rng)
    measured *= 1.0 + noise.scale_stddev * rng.standard_normal()
    if noise.hole_fraction > 0.0:
        field = smooth_field(mixed.shape, HOLE_SIZE, rng)
        measured[field < np.quantile(field, noise.hole_fraction)] = np.nan
    if noise.quantum > 0.0:
        measured = np.round(measured / noise.quantum) * noise.quantum
    measured[~(measured >= noise.nearest)] = np.nan
    return measured.astype(np.float32)


def _mix_edges(depth: NDArray, camera: CameraIntrinsics, noise: DepthNoise, rng: np.random.Generator) -> NDArray:
    """Return depths (h, w) with some pixels near steps put between the two sides."""
    size = 2 * noise.edge_width + 1
    near = cv2.erode(np.where(np.isnan(depth), np.inf, depth), np.ones((size, size)))
    far = cv2.dilate(np.where(np.isnan(depth), -np.inf, depth), np.ones((size, size)))
    # over a band, a slope rises, too: a step is what rises more than a surface seen at 70 degrees would
    slope = np.where(np.isfinite(near), near, 0.0) * size * STEEPEST / camera.fx
    flies = (far - near > np.maximum(EDGE_STEP, slope)) & (rng.random(depth.shape) < noise.edge_fraction)
    flies &= np.isfinite(depth)
    between = near[flies] + (far - near)[flies] * rng.random(int(flies.sum()))
    mixed = depth.copy()
    if noise.fattening:
        nearest = cv2.erode(np.where(np.isnan(depth), np.inf, depth), np.ones((2 * noise.fattening + 1,) * 2))
        mixed = np.where(depth - nearest > EDGE_STEP, nearest, depth)
    mixed[flies] = between
    return mixed
