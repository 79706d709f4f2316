"""Lights, background and exposure of one scene, drawn by chance between given bounds."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from finforce_twin.rendering.paint import draw_color

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
