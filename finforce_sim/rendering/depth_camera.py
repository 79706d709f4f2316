"""A stereo depth camera like the D405: intrinsics, and what it makes of true depths.

The figures are those of one published unit and of its data sheet; a camera of one's own will differ.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, maximum_filter, minimum_filter

from finforce.camera import EQUIDISTANT, RATIONAL, CameraIntrinsics

D405_DISTORTION = (-0.0545, 0.0568, 0.0010, 0.00034, -0.0185)


def build_d405_vga() -> CameraIntrinsics:
    """Return the colour camera of a D405 at 640 x 480, with its distortion."""
    distortion = np.array(D405_DISTORTION)
    return CameraIntrinsics(width=640, height=480, fx=431.2, fy=430.0, cx=319.6, cy=241.3, distortion=distortion)


def build_d405(*, distorted: bool = False, step: int = 1) -> CameraIntrinsics:
    """Return the colour camera of a D405 at 848 x 480, to which its depth is aligned.

    Args:
        distorted: with the distortion of a real unit.
        step: keep every `step`-th pixel only, for quick runs.
    """
    return CameraIntrinsics(
        width=848 // step,
        height=480 // step,
        fx=431.2 / step,
        fy=430.0 / step,
        cx=424.6 / step,
        cy=241.3 / step,
        distortion=np.array(D405_DISTORTION) if distorted else np.zeros(5),
    )


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


EDGE_STEP = 4e-3  # [m] in depth between neighbours, above which matching mixes the two sides
STEEPEST = 2.75  # tangent of 70 degrees between the viewing ray and a surface's normal
HOLE_SIZE = 3.0  # [px] standard deviation of the field that is cut to make holes


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
    near = minimum_filter(np.where(np.isnan(depth), np.inf, depth), size)
    far = maximum_filter(np.where(np.isnan(depth), -np.inf, depth), size)
    # over a band, a slope rises, too: a step is what rises more than a surface seen at 70 degrees would
    slope = np.where(np.isfinite(near), near, 0.0) * size * STEEPEST / camera.fx
    flies = (far - near > np.maximum(EDGE_STEP, slope)) & (rng.random(depth.shape) < noise.edge_fraction)
    flies &= np.isfinite(depth)
    between = near[flies] + (far - near)[flies] * rng.random(int(flies.sum()))
    mixed = depth.copy()
    if noise.fattening:
        nearest = minimum_filter(np.where(np.isnan(depth), np.inf, depth), 2 * noise.fattening + 1)
        mixed = np.where(depth - nearest > EDGE_STEP, nearest, depth)
    mixed[flies] = between
    return mixed


def smooth_field(shape: tuple[int, int], width: float, rng: np.random.Generator) -> NDArray:
    """Return normal noise (h, w) of unit variance, correlated over `width` pixels."""
    field = rng.standard_normal(shape)
    if width <= 0.0:
        return field
    field = gaussian_filter(field, width, mode="wrap")
    return field / field.std()
