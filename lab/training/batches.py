"""Batches of pictures, each of them seen anew: another view, light, dirt and noise, and sometimes a wrong template."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from finforce.optional import import_cv2
from lab.training.commands import import_torch
from lab.training.pictures import MARGIN, FingerPictures

torch = import_torch()
WRONG = 0.1  # share of the pictures whose template is not theirs, so that nothing of it can be seen ...
WRONG_FINGER = 0.6  # ... of which so many show another finger; the others are mirrored or upside down
MOST_BATCHES = 10**9


@dataclass(frozen=True, kw_only=True)
class AugmentSettings:
    """The ranges of random changes to pictures; every probability is per picture.

    Attributes:
        shift: largest shift along a row and a column [px].
        scale: largest change of size.
        rotation: largest turn [deg].
        perspective: largest shift of each corner on its own [px].
        dim: probability of little light.
        darkest: least light, as a part of the picture's own.
        color: probability of another contrast, gamma and white balance.
        gradient: probability of light that falls off across the picture.
        resample: probability of a camera with larger pixels.
        coarsest: least number of its pixels along an axis, as a part of the picture's.
        blur: probability of defocus or motion.
        sharpen: probability of a camera's sharpening.
        noise: probability of sensor noise; little light always has it.
        jpeg: probability of compression.
        occlusion: probability of things in front.
    """

    shift: float = 12.0
    scale: float = 0.06
    rotation: float = 4.0
    perspective: float = 4.0
    dim: float = 0.2
    darkest: float = 0.08
    color: float = 0.8
    gradient: float = 0.3
    resample: float = 0.6
    coarsest: float = 0.4
    blur: float = 0.35
    sharpen: float = 0.15
    noise: float = 0.7
    jpeg: float = 0.3
    occlusion: float = 0.65


@dataclass(frozen=True, kw_only=True, eq=False)
class Batch:
    """Pictures with what is told of their fingers, and the truth.

    Attributes:
        pictures: (B, h, w, 3) uint8.
        templates: (B, h, w, 3) uint8.
        rest: (B, P, 2) points at rest, in the templates [px]; the mark first.
        places: (B, P, 2) where they are in the pictures [px]; NaN where nobody knows.
        visible: (B, P) bool.
        keypoints: (B,) how many, from the first on, are key points.
    """

    pictures: torch.Tensor
    templates: torch.Tensor
    rest: torch.Tensor
    places: torch.Tensor
    visible: torch.Tensor
    keypoints: torch.Tensor

    def to(self, device: torch.device) -> Batch:
        """Return the batch on a device."""
        return Batch(**{name: getattr(self, name).to(device) for name in self.__dataclass_fields__})


def load_batches(
    pictures: FingerPictures,
    augmentation: AugmentSettings,
    size: int,
    *,
    workers: int = 0,
    seed: int = 0,
    first: int = 0,
) -> Iterator[Batch]:
    """Yield augmented batches without end, each picture once per round, the same for the same seed.

    Args:
        pictures: to draw from.
        augmentation: ranges of the changes.
        size: pictures in a batch.
        workers: processes that make them; 0 for none but this one.
        seed: of order and augmentation.
        first: number of the first batch, to go on where another run ended.
    """
    loader = torch.utils.data.DataLoader(
        _BatchMaker(pictures, augmentation, size, seed),
        sampler=range(first, MOST_BATCHES),
        batch_size=None,
        num_workers=workers,
        prefetch_factor=4 if workers else None,
        worker_init_fn=_use_one_thread,
    )
    for columns in loader:
        yield Batch(**columns)


def choose_pictures(number: int, size: int, count: int, seed: int) -> NDArray:
    """Return the indices (size,) below `count` of a batch; each index comes once per round, in random order."""
    places = np.arange(number * size, (number + 1) * size)
    rounds = {key: np.random.default_rng((seed, 1, key)).permutation(count) for key in set((places // count).tolist())}
    return np.array([rounds[place // count][place % count] for place in places.tolist()])


def _use_one_thread(_: int) -> None:
    """Keep OpenCV in a process of its own from taking the cores that the network needs."""
    import_cv2().setNumThreads(1)


class _BatchMaker(torch.utils.data.Dataset):
    """Batches by number: the same ones with the same seed are alike in whatever process."""

    def __init__(self, pictures: FingerPictures, augmentation: AugmentSettings, size: int, seed: int) -> None:
        self.pictures, self.augmentation, self.size, self.seed = pictures, augmentation, size, seed

    def __getitem__(self, number: int) -> dict[str, torch.Tensor]:
        rng, data = np.random.default_rng((self.seed, number)), self.pictures
        rows = choose_pictures(number, self.size, len(data), self.seed)
        samples = [augment(data.picture[i], data.place[i], data.visible[i], self.augmentation, rng) for i in rows]
        pictures = [sample.picture for sample in samples]
        places, visible = (np.stack([getattr(sample, name) for sample in samples]) for name in ("points", "visible"))
        told = rows.copy()
        for k in np.flatnonzero(rng.random(len(rows)) < WRONG):
            others = np.flatnonzero(data.finger != data.finger[rows[k]])
            places[k], visible[k] = np.nan, False
            chance = rng.random()
            if chance < WRONG_FINGER and len(others):
                told[k] = rng.choice(others)
            elif chance < 0.5 * (1.0 + WRONG_FINGER):
                pictures[k] = pictures[k][:, ::-1]
            else:
                pictures[k] = pictures[k][::-1, ::-1]
        columns = {
            "pictures": np.stack(pictures),
            "templates": data.template[data.finger[told]],
            "rest": data.rest[told],
            "places": places,
            "visible": visible,
            "keypoints": data.keypoints[told],
        }
        return {name: torch.from_numpy(np.ascontiguousarray(column)) for name, column in columns.items()}


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
        settings: ranges of the changes.
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
        light = light + np.float32(rng.uniform(0.2, 0.8)) * (light - import_cv2().GaussianBlur(light, (0, 0), 1.5))
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
