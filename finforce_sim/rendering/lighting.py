"""Lights, background, exposure and surfaces of one scene, drawn by chance between given bounds."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from finforce_sim.rendering.depth_camera import smooth_field

TEXTURE_SIZE = 384  # [px] of the square background picture
TEXTURE_SPAN = 0.6  # [m] that it covers before it repeats
EXPOSURE_TARGET = 0.28  # mean linear brightness that automatic exposure aims at ...
BRIGHTEST = 0.9  # ... as long as no more than a twentieth of the image becomes brighter than this


@dataclass(frozen=True, kw_only=True, eq=False)
class Light:
    """A distant lamp.

    Attributes:
        direction: (3,) unit vector towards the lamp, gripper frame.
        color: (3,) linear intensity.
        casts_shadow: whether bodies hide it from each other.
    """

    direction: NDArray
    color: NDArray
    casts_shadow: bool = True


@dataclass(frozen=True, kw_only=True, eq=False)
class Exposure:
    """What the sensor makes of the light.

    Attributes:
        brightness: of the whole scene; 1 is a lit room, 0.05 is dim.
        largest_gain: up to which the camera brightens a dim scene.
        full_well: electrons at full brightness and unit gain; fewer make noisier pictures.
        read_noise: electrons.
        blur: standard deviation of the lens [px].
        vignetting: relative loss of light in the corners.
        white: (3,) factors of the colours.
    """

    brightness: float = 1.0
    largest_gain: float = 8.0
    full_well: float = 4000.0
    read_noise: float = 6.0
    blur: float = 0.6
    vignetting: float = 0.15
    white: NDArray


@dataclass(frozen=True, kw_only=True, eq=False)
class Lighting:
    """How a scene looks, beside its bodies' materials.

    Attributes:
        ambient: (3,) linear light from everywhere.
        lights: lamps.
        background: (s, s, 3) linear picture on the plane behind the gripper.
        background_distance: of that plane along the approach direction, from the gripper's base [m].
        exposure: of the sensor.
    """

    ambient: NDArray
    lights: tuple[Light, ...]
    background: NDArray
    background_distance: float
    exposure: Exposure


def draw_look(rng: np.random.Generator, light: str = "any") -> Lighting:
    """Return a look by chance.

    Args:
        rng: source of chance.
        light: "bright", "dim", or "any" between both.
    """
    tint = 1.0 + rng.normal(0.0, 0.06, 3)
    count = int(rng.integers(1, 4))
    lights = tuple(_draw_light(rng, tint, casts_shadow=number == 0) for number in range(count))
    return Lighting(
        ambient=tint * rng.uniform(0.15, 0.6),
        lights=lights,
        background=draw_background(rng),
        background_distance=float(rng.uniform(0.11, 0.5)),
        exposure=_draw_exposure(rng, light),
    )


def _draw_light(rng: np.random.Generator, tint: NDArray, *, casts_shadow: bool) -> Light:
    # from behind the camera or the sides: a lamp before the gripper would shine into the lens
    direction = np.array([rng.normal(0.0, 0.7), abs(rng.normal(0.6, 0.5)), rng.normal(-0.5, 0.6)])
    color = tint * (1.0 + rng.normal(0.0, 0.05, 3)) * rng.uniform(0.2, 1.0)
    return Light(direction=direction / np.linalg.norm(direction), color=color, casts_shadow=casts_shadow)


def _draw_exposure(rng: np.random.Generator, light: str) -> Exposure:
    bounds = {"bright": (0.5, 1.3), "dim": (0.06, 0.15), "any": (0.06, 1.3)}[light]
    return Exposure(
        brightness=float(np.exp(rng.uniform(*np.log(bounds)))),
        largest_gain=float(rng.uniform(4.0, 10.0)),
        full_well=float(rng.uniform(2500.0, 8000.0)),
        read_noise=float(rng.uniform(3.0, 10.0)),
        blur=float(rng.uniform(0.35, 0.9)),
        vignetting=float(rng.uniform(0.0, 0.3)),
        white=1.0 + rng.normal(0.0, 0.05, 3),
    )


def draw_background(rng: np.random.Generator) -> NDArray:
    """Return a linear picture (s, s, 3): a surface with things on it, flat, grained, ruled or cluttered."""
    rows, columns = np.mgrid[0:TEXTURE_SIZE, 0:TEXTURE_SIZE] / TEXTURE_SIZE
    picture = np.zeros((TEXTURE_SIZE, TEXTURE_SIZE, 3)) + draw_color(rng)
    for _ in range(int(rng.integers(0, 40))):
        low, size = rng.random(2), rng.uniform(0.01, 0.25, 2)
        if rng.random() < 0.5:
            inside = (abs(rows - low[0]) < size[0]) & (abs(columns - low[1]) < size[1])
        else:
            inside = ((rows - low[0]) / size[0]) ** 2 + ((columns - low[1]) / size[1]) ** 2 < 1.0
        picture[inside] = draw_color(rng)
    if rng.random() < 0.4:
        wave = np.array([rng.normal(), rng.normal()]) * rng.uniform(5.0, 60.0)
        picture *= (
            1.0 + rng.uniform(0.1, 0.6) * np.sign(np.sin(2.0 * np.pi * (rows * wave[0] + columns * wave[1])))[..., None]
        )
    grain = rng.standard_normal((TEXTURE_SIZE, TEXTURE_SIZE, 1)) * rng.uniform(0.0, 0.25)
    return np.clip(picture * (1.0 + grain), 0.0, 1.0)


PATTERNS = ("plain", "noise", "stripes", "checks", "speckles", "layers")
VOLUME_SIZE = 64  # of the tileable noise volume, per axis


@dataclass(frozen=True, kw_only=True, eq=False)
class Paint:
    """What a surface looks like.

    Attributes:
        color: (3,) linear red, green, blue in [0, 1].
        second: (3,) the pattern's other colour.
        pattern: one of `PATTERNS`; layers are the lines of a printer, across z.
        size: of the pattern [m].
        gloss: strength of the highlight.
        sharpness: exponent of the highlight.
        grain: relative contrast of fine noise on top.
        offset: (3,) [m] where the pattern begins.
    """

    color: NDArray
    second: NDArray = field(default_factory=lambda: np.zeros(3))
    pattern: str = "plain"
    size: float = 4e-3
    gloss: float = 0.1
    sharpness: float = 20.0
    grain: float = 0.05
    offset: NDArray = field(default_factory=lambda: np.zeros(3))

    def colors_at(self, places: NDArray) -> NDArray:
        """Return the colours (n, 3) at places (n, 3) [m] of the body at rest."""
        places = places + self.offset
        share = self._mix(places)[:, None]
        color = self.color * (1.0 - share) + self.second * share
        return color * (1.0 + self.grain * (_look_up(places, 0.4e-3) - 0.5))[:, None]

    def _mix(self, places: NDArray) -> NDArray:
        """Return the share (n,) of the second colour."""
        cells = places / self.size
        if self.pattern == "noise":
            return np.clip(_look_up(places, self.size / 6.0) * 2.0 - 0.5, 0.0, 1.0)
        if self.pattern == "stripes":
            return (np.mod(cells @ np.array([0.8, 0.1, 0.59]), 1.0) < 0.5).astype(float)
        if self.pattern == "checks":
            return np.mod(np.floor(cells + 1e-6).sum(axis=1), 2.0)
        if self.pattern == "speckles":
            return (_look_up(places, self.size / 12.0) > 0.72).astype(float)
        if self.pattern == "layers":
            return 0.5 + 0.5 * np.sin(2.0 * np.pi * places[:, 2] / 0.4e-3)
        return np.zeros(len(places))


@lru_cache(maxsize=1)
def _noise_volume() -> NDArray:
    """Return tileable noise (s, s, s), spread evenly over [0, 1]."""
    rng = np.random.default_rng(20)
    shape = (VOLUME_SIZE,) * 3
    volume = smooth_field(shape, 1.2, rng)
    ranks = np.empty(volume.size)
    ranks[np.argsort(volume, axis=None)] = np.linspace(0.0, 1.0, volume.size)
    return ranks.reshape(shape)


def _look_up(places: NDArray, cell: float) -> NDArray:
    """Return noise (n,) in [0, 1] at places (n, 3) [m], in cells of a size [m]."""
    index = np.floor(places / cell).astype(np.int64) % VOLUME_SIZE
    return _noise_volume()[index[:, 0], index[:, 1], index[:, 2]]


def draw_color(rng: np.random.Generator, low: float = 0.02, high: float = 0.9) -> NDArray:
    """Return a colour (3,): some are grey, some are strong, dark ones as frequent as bright ones."""
    value = np.exp(rng.uniform(np.log(low), np.log(high)))
    tint = rng.uniform(0.2, 1.0, 3) ** rng.uniform(0.0, 1.5)
    return np.clip(value * tint / tint.max(), 0.0, 1.0)


def draw_paint(rng: np.random.Generator, patterns: tuple[str, ...] = PATTERNS) -> Paint:
    """Return a paint by chance, its pattern among those given."""
    color = draw_color(rng)
    return Paint(
        color=color,
        second=np.clip(color * rng.uniform(0.5, 1.5), 0.0, 1.0) if rng.random() < 0.5 else draw_color(rng),
        pattern=str(rng.choice(patterns)),
        size=float(np.exp(rng.uniform(np.log(2e-3), np.log(20e-3)))),
        gloss=float(rng.uniform(0.0, 0.5)),
        sharpness=float(np.exp(rng.uniform(np.log(5.0), np.log(80.0)))),
        grain=float(rng.uniform(0.0, 0.25)),
        offset=rng.uniform(0.0, 0.05, 3),
    )


def draw_jaw_paint(rng: np.random.Generator) -> Paint:
    """Return the paint of a printed jaw: any colour, mostly plain, with the printer's layers or speckled."""
    color = draw_color(rng, 0.03, 0.85)
    pattern = str(rng.choice(("plain", "layers", "speckles", "noise"), p=(0.3, 0.3, 0.25, 0.15)))
    contrast = {"layers": rng.uniform(0.7, 1.0), "noise": rng.uniform(0.6, 1.3)}.get(pattern)
    second = draw_color(rng) if contrast is None else np.clip(color * contrast, 0.0, 1.0)
    return Paint(
        color=color,
        second=second,
        pattern=pattern,
        size=float(rng.uniform(2e-3, 8e-3)),
        gloss=float(rng.uniform(0.0, 0.4)),
        sharpness=float(np.exp(rng.uniform(np.log(5.0), np.log(60.0)))),
        grain=float(rng.uniform(0.0, 0.2)),
        offset=rng.uniform(0.0, 0.05, 3),
    )
