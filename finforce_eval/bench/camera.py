"""What the camera of the bench makes of key points: noise, gross errors, holes, points behind the object.

Knows no mechanics. The numbers are those of the bench recordings' measurement model.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

# Half the length of the pressed cylinders [m].
_HALF_LENGTH = 0.03
_SEEN_LIKELIHOOD, _HIDDEN_LIKELIHOOD = (0.6, 1.0), (0.02, 0.55)


@dataclass(frozen=True, kw_only=True, eq=False)
class MeasuredKeypoints:
    """Seen key points (n, K, 3) [m], jaw frame, NaN without depth, and their likelihoods (n, K)."""

    points: NDArray
    likelihood: NDArray


@dataclass(frozen=True, kw_only=True)
class NoisyCamera:
    """A fixed RGB-D camera beside the finger.

    Attributes:
        place: in the jaw frame [m].
        noise: standard deviation of a point in every direction [m].
        depth_noise: the same along its line of sight, in addition [m].
        offset: constant error of each point of a recording [m].
        depth_scale: constant relative error of the depth.
        gross: share of points that are somewhere else and keep a high likelihood.
        gross_size: standard deviation of a gross error along each axis [m].
        holes: share of points without depth.
        hidden_trusted: share of hidden points whose likelihood is high.
    """

    place: tuple[float, float, float] = (0.055, 0.095, -0.045)
    noise: float = 0.20e-3
    depth_noise: float = 0.45e-3
    offset: float = 0.35e-3
    depth_scale: float = 0.005
    gross: float = 0.01
    gross_size: float = 0.025
    holes: float = 0.01
    hidden_trusted: float = 0.05

    def look(self, points: NDArray, axes: NDArray, radius: float, random: np.random.Generator) -> MeasuredKeypoints:
        """Returns what the camera sees of key points (n, K, 3) [m] beside a cylinder along y.

        Args:
            points: true key points, jaw frame.
            axes: x and z of the cylinder's axis (n, 2) [m].
            radius: of the cylinder [m].
            random: where all chance comes from.
        """
        shape = points.shape[:2]
        reach = self._find_cover(points, axes, radius)
        hidden = np.isfinite(reach)
        rays = points - self.place
        seen = np.where(hidden[..., None], self.place + np.where(hidden, reach, 1.0)[..., None] * rays, points)
        sight = rays / np.linalg.norm(rays, axis=2, keepdims=True)
        constant = self.offset / np.sqrt(3.0) * random.standard_normal(points.shape[1:])
        scale = 1.0 + self.depth_scale * random.standard_normal()
        seen = self.place + scale * (seen - self.place) + constant
        seen = seen + self.noise * random.standard_normal(points.shape)
        seen += self.depth_noise * random.standard_normal((*shape, 1)) * sight
        gross = random.random(shape) < self.gross
        seen += np.where(gross[..., None], self.gross_size * random.standard_normal(points.shape), 0.0)
        seen[random.random(shape) < self.holes] = np.nan
        doubted = hidden & (random.random(shape) >= self.hidden_trusted)
        likelihood = np.where(
            doubted, random.uniform(*_HIDDEN_LIKELIHOOD, shape), random.uniform(*_SEEN_LIKELIHOOD, shape)
        )
        return MeasuredKeypoints(points=seen, likelihood=likelihood)

    def _find_cover(self, points: NDArray, axes: NDArray, radius: float) -> NDArray:
        """Returns which share of the way to each point (n, K) a cylinder lets the sight go; NaN when all of it."""
        ray = points - self.place
        start = np.array(self.place)[[0, 2]] - axes[:, None]
        a = (ray[..., [0, 2]] ** 2).sum(-1)
        b = (start * ray[..., [0, 2]]).sum(-1)
        inside = b**2 - a * ((start**2).sum(-1) - radius**2)
        wall = (-b - np.sqrt(np.maximum(inside, 0.0))) / a
        on_wall = (inside > 0.0) & (wall > 0.0) & (wall < 1.0)
        on_wall &= np.abs(self.place[1] + wall * ray[..., 1]) < _HALF_LENGTH
        end = (_HALF_LENGTH - self.place[1]) / ray[..., 1]
        met = start + end[..., None] * ray[..., [0, 2]]
        on_end = (end > 0.0) & (end < 1.0) & ((met**2).sum(-1) < radius**2)
        return np.where(on_end, end, np.where(on_wall, wall, np.nan))
