"""Surfaces as a camera sees them: colours, patterns and gloss, drawn by chance."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from finforce_twin.rendering.depth_camera import smooth_field

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
