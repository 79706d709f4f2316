"""Random views, light, dirt and noise for padded pictures."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from finforce.optional import import_cv2
from finforce.settings import check_bounds, setting
from lab.training.dataset import MARGIN
from lab.training.errors import RecipeError


@dataclass(frozen=True, kw_only=True)
class AugmentSettings:
    """How far pictures are changed; every probability is per picture."""

    shift: float = setting(12.0, "largest shift along a row and a column", "px", 0.0, 100.0)
    scale: float = setting(0.06, "largest change of size", "-", 0.0, 0.5)
    rotation: float = setting(4.0, "largest turn", "deg", 0.0, 90.0)
    perspective: float = setting(4.0, "largest shift of each corner on its own", "px", 0.0, 50.0)
    dim: float = setting(0.2, "probability of little light", "-", 0.0, 1.0)
    darkest: float = setting(0.08, "least light, as a part of the picture's own", "-", 0.001, 1.0)
    color: float = setting(0.8, "probability of another contrast, gamma and white balance", "-", 0.0, 1.0)
    gradient: float = setting(0.3, "probability of light that falls off across the picture", "-", 0.0, 1.0)
    resample: float = setting(0.6, "probability of a camera with larger pixels", "-", 0.0, 1.0)
    coarsest: float = setting(0.4, "its pixels' number beside the picture's along an axis, at least", "-", 0.05, 1.0)
    blur: float = setting(0.35, "probability of defocus or motion", "-", 0.0, 1.0)
    sharpen: float = setting(0.15, "probability of a camera's sharpening", "-", 0.0, 1.0)
    noise: float = setting(0.7, "probability of sensor noise; little light always has it", "-", 0.0, 1.0)
    jpeg: float = setting(0.3, "probability of compression", "-", 0.0, 1.0)
    occlusion: float = setting(0.65, "probability of things in front", "-", 0.0, 1.0)

    def __post_init__(self) -> None:
        check_bounds(self, RecipeError)


@dataclass(frozen=True, kw_only=True, eq=False)
class TrainingSample:
    """One picture as the network sees it.

    Attributes:
        picture: (h, w, 3) uint8 RGB.
        points: (K, 2) column and row [px]; NaN where not known.
        visible: (K,) bool; never true outside the picture.
    """

    picture: NDArray
    points: NDArray
    visible: NDArray


def augment(
    picture: NDArray, points: NDArray, visible: NDArray, settings: AugmentSettings, rng: np.random.Generator
) -> TrainingSample:
    """Return one picture seen from slightly elsewhere, in other light, partly covered.

    Args:
        picture: (h, w, 3) uint8 RGB with padding.
        points: (K, 2) column and row in it [px].
        visible: (K,) bool.
        settings: how far it is changed.
        rng: source of chance.
    """
    sample = _warp(picture, points, visible, settings, rng)
    if rng.random() < settings.occlusion:
        sample = _occlude(sample, rng)
    return TrainingSample(
        picture=change_light(sample.picture, settings, rng), points=sample.points, visible=sample.visible
    )


def change_light(picture: NDArray, settings: AugmentSettings, rng: np.random.Generator) -> NDArray:
    """Return the picture (h, w, 3) uint8 as another camera would take it in other light.

    A real camera has pixels of its own, larger ones than the picture's where it looks at the side aslant or from afar:
    light, noise and compression come at its resolution, and the picture is made of that.
    """
    cv2, (height, width) = import_cv2(), picture.shape[:2]
    if rng.random() < settings.resample:
        least = settings.coarsest ** rng.uniform(0.0, 1.0, 2)
        size = (round(width * least[0]), round(height * least[1]))
        picture = cv2.resize(picture, size, interpolation=cv2.INTER_AREA)
        taken = _change_light(picture, settings, rng)
        return cv2.resize(taken, (width, height), interpolation=cv2.INTER_LINEAR)
    return _change_light(picture, settings, rng)


def _change_light(picture: NDArray, settings: AugmentSettings, rng: np.random.Generator) -> NDArray:
    """Return the picture in other light, with a lens, a sensor and a compression of its own."""
    light = _recolor(picture, rng) if rng.random() < settings.color else picture.astype(np.float32)
    if rng.random() < settings.gradient:
        light = light * _draw_gradient(light.shape[:2], rng)[..., None]
    if rng.random() < settings.blur:
        light = _blur(light, rng)
    is_dim = rng.random() < settings.dim
    light = light * (settings.darkest ** rng.random() if is_dim else rng.uniform(0.6, 1.25))
    if is_dim or rng.random() < settings.noise:
        light = _add_noise(light, rng)
    if rng.random() < settings.sharpen:
        light = _sharpen(light, rng)
    image = np.clip(light + 0.5, 0.0, 255.0).astype(np.uint8)
    return _compress(image, rng) if rng.random() < settings.jpeg else image


def _keep_inside(picture: NDArray, points: NDArray, visible: NDArray) -> TrainingSample:
    """Return a sample whose points outside the picture are not visible."""
    height, width = picture.shape[:2]
    with np.errstate(invalid="ignore"):
        inside = ((points >= 0.0) & (points <= (width - 1, height - 1))).all(axis=1)
    return TrainingSample(picture=picture, points=points.astype(np.float32), visible=visible & inside)


def _warp(
    picture: NDArray, points: NDArray, visible: NDArray, settings: AugmentSettings, rng: np.random.Generator
) -> TrainingSample:
    """Return the part of the picture that a slightly displaced camera sees."""
    cv2 = import_cv2()
    height, width = (size - 2 * MARGIN for size in picture.shape[:2])
    corners = np.array([[0, 0], [width, 0], [width, height], [0, height]], dtype=np.float64)
    angle = np.deg2rad(rng.uniform(-settings.rotation, settings.rotation))
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    turn *= 1.0 + rng.uniform(-settings.scale, settings.scale)
    centre = corners.mean(axis=0)
    seen = (corners - centre) @ turn.T + centre + rng.uniform(-settings.shift, settings.shift, 2)
    seen += rng.uniform(-settings.perspective, settings.perspective, (4, 2))
    homography = cv2.getPerspectiveTransform((corners + MARGIN).astype(np.float32), seen.astype(np.float32))
    warped = cv2.warpPerspective(
        picture, homography, (width, height), flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
    )
    moved = cv2.perspectiveTransform(np.asarray(points, dtype=np.float64)[None], homography)[0]
    return _keep_inside(warped, moved, visible)


def _occlude(sample: TrainingSample, rng: np.random.Generator) -> TrainingSample:
    """Return the sample with one to three things in front: random outlines, flat, graded or textured."""
    cv2 = import_cv2()
    picture, visible = sample.picture.copy(), sample.visible.copy()
    height, width = picture.shape[:2]
    for _ in range(rng.integers(1, 4)):
        corners = rng.integers(3, 9)
        angles = np.sort(rng.uniform(0.0, 2.0 * np.pi, corners))
        radii = rng.uniform(0.3, 1.0, corners) * rng.uniform(6.0, 55.0)
        centre = rng.uniform((0.0, 0.0), (width, height))
        outline = centre + radii[:, None] * np.column_stack((np.cos(angles), np.sin(angles)))
        mask = np.zeros((height, width), dtype=np.uint8)
        cv2.fillPoly(mask, [np.round(outline).astype(np.int32)], 255)
        covered = mask > 0
        picture[covered] = _draw_texture(picture, rng)[covered]
        at = np.round(np.where(visible[:, None], sample.points, 0.0)).astype(int)
        visible &= ~covered[at[:, 1], at[:, 0]]
    return TrainingSample(picture=picture, points=sample.points, visible=visible)


def _draw_texture(picture: NDArray, rng: np.random.Generator) -> NDArray:
    """Return something (h, w, 3) uint8 to cover a picture with: a part of the picture itself, or graded blotches."""
    cv2 = import_cv2()
    height, width = picture.shape[:2]
    if rng.random() < 0.3:
        rolled = np.roll(picture, rng.integers(20, 150, 2), axis=(0, 1))
        return np.ascontiguousarray(rolled[:, ::-1])
    cells = int(rng.choice([1, 2, 4, 12]))
    base = rng.uniform(0.0, 255.0, 3)
    blotches = base + rng.normal(0.0, rng.uniform(0.0, 50.0), (cells, cells, 3))
    coarse = np.clip(blotches, 0.0, 255.0).astype(np.uint8)
    return cv2.resize(coarse, (width, height), interpolation=cv2.INTER_CUBIC).reshape(height, width, 3)


def _recolor(picture: NDArray, rng: np.random.Generator) -> NDArray:
    """Return the picture (h, w, 3), float32, with another contrast, gamma, saturation and white balance."""
    cv2 = import_cv2()
    level = np.arange(256.0)
    curve = 255.0 * (level / 255.0) ** np.exp(rng.uniform(-0.4, 0.4))
    middle = rng.uniform(40.0, 140.0)
    curve = np.maximum(middle + (curve - middle) * rng.uniform(0.6, 1.3), 0.0)
    table = curve[:, None] * (1.0 + rng.uniform(-0.15, 0.15, 3))
    light = cv2.LUT(picture, table.astype(np.float32)[None])
    saturation = rng.uniform(0.3, 1.4)
    mix = saturation * np.eye(3) + (1.0 - saturation) / 3.0
    return np.maximum(cv2.transform(light, mix.astype(np.float32)), np.float32(0.0))


def _draw_gradient(size: tuple[int, int], rng: np.random.Generator) -> NDArray:
    """Return factors (h, w) of light that changes smoothly across the picture."""
    cv2 = import_cv2()
    coarse = np.exp(rng.normal(0.0, 0.4, (3, 3))).astype(np.float32)
    return cv2.resize(coarse, size[::-1], interpolation=cv2.INTER_CUBIC)


def _blur(light: NDArray, rng: np.random.Generator) -> NDArray:
    """Return the picture out of focus, or moved during its exposure."""
    cv2 = import_cv2()
    if rng.random() < 0.6:
        return cv2.GaussianBlur(light, (0, 0), rng.uniform(0.4, 1.6))
    size = int(rng.choice([3, 5, 7]))
    angle = rng.uniform(0.0, np.pi)
    steps = np.linspace(-(size // 2), size // 2, 4 * size)
    kernel = np.zeros((size, size), dtype=np.float32)
    rows, columns = (np.round(size // 2 + steps * part).astype(int) for part in (np.sin(angle), np.cos(angle)))
    np.add.at(kernel, (rows, columns), 1.0)
    return cv2.filter2D(light, -1, kernel / kernel.sum())


def _sharpen(light: NDArray, rng: np.random.Generator) -> NDArray:
    """Return the picture with a camera's unsharp mask."""
    return light + np.float32(rng.uniform(0.2, 0.8)) * (light - import_cv2().GaussianBlur(light, (0, 0), 1.5))


def _add_noise(light: NDArray, rng: np.random.Generator) -> NDArray:
    """Return the picture with shot and read noise, as fine as pixels or smeared by the camera's own filter."""
    cv2 = import_cv2()
    shot, read = np.float32(rng.uniform(0.0, 0.25)), np.float32(rng.uniform(0.3, 3.0) ** 2)
    bank = _draw_noise_bank()
    start = rng.integers(len(bank) - light.size)
    noise = bank[start : start + light.size].reshape(light.shape)
    if rng.random() < 0.3:
        noise = 2.0 * cv2.GaussianBlur(noise, (0, 0), 0.8)
    return light + noise * cv2.sqrt(np.maximum(light, 0.0) * shot + read)


@lru_cache(maxsize=1)
def _draw_noise_bank() -> NDArray:
    """Return normal noise (n,), drawn once: a random piece of it costs a tenth of fresh noise."""
    return np.random.default_rng(0).standard_normal(1 << 21, dtype=np.float32)


def _compress(image: NDArray, rng: np.random.Generator) -> NDArray:
    """Return the picture after JPEG at a random quality."""
    cv2 = import_cv2()
    _, data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, int(rng.integers(35, 96))])
    return cv2.imdecode(data, cv2.IMREAD_COLOR)
