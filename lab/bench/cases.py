"""Presses of the bench finger as its camera would see them, made from shapes of an independent program.

data/pressed_bench.npz holds key points [mm] and forces [N] of CalculiX 2.20 (20-node hexahedra, large displacements,
frictionless contact, St. Venant-Kirchhoff, 30 MPa, 0.45) for nine cylinders at depths of 1 to 10 mm. Noise, gross
errors, holes and points behind the object are those of the bench recordings' measurement model.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from finforce_ifea.jaw.jaw import Jaw, load_jaw
from finforce_ifea.jaw.jaw_file import Material
from finforce_ifea.observation import Contact, ObjectOutline, Observation

TRUTH = Path(__file__).parents[1] / "data" / "pressed_bench.npz"
YOUNG_MODULUS, POISSON_RATIO = 30e6, 0.45
HEIGHTS = {"lower": 0.020, "middle": 0.040, "upper": 0.060}
LEVELS = (0.002, 0.004, 0.006, 0.008, 0.010)
PERIOD = 1.0 / 30.0
REST_FRAMES, HOLD_FRAMES, SCORED_FRAMES = 60, 45, 30
SPEED = 2e-3
# Corners of the polygon that stands for a cylinder.
_CORNERS = 96
# Constant errors of a tracked object's origin [m] and turn [rad], as the contact estimator expects them.
_POSE_ERROR = np.array([0.5e-3, 0.5e-3, 5e-3])


@dataclass(frozen=True, kw_only=True, eq=False)
class BenchCase:
    """One cylinder pressed into the finger.

    Attributes:
        name: for tables.
        height_name: a key of `HEIGHTS`.
        height: of the cylinder's axis [m].
        radius: of the cylinder [m].
        depth: (n,) [m], rising.
        moved: displacements of the key points (n, K, 3) [m].
        force: on the jaw (n, 3) [N].
    """

    name: str
    height_name: str
    height: float
    radius: float
    depth: NDArray
    moved: NDArray
    force: NDArray


@dataclass(frozen=True, kw_only=True, eq=False)
class ReplayedPress:
    """One case as a sequence of images.

    Attributes:
        case: what was pressed.
        observations: n images.
        contacts: image by image, with the "height" of first touch and with the object's "outline".
        force: true forces on the jaw (n, 3) [N].
        held: images in the last second of a level (n,) bool.
        ends: the last image of each level (levels,).
    """

    case: BenchCase
    observations: Sequence[Observation]
    contacts: Mapping[str, Sequence[Contact]]
    force: NDArray
    held: NDArray
    ends: NDArray


def load_cases(path: Path | str = TRUTH) -> tuple[BenchCase, ...]:
    """Return the nine cases."""
    data = np.load(path)
    cases = []
    for key in sorted(name.removesuffix("_depth") for name in data if name.endswith("_depth")):
        diameter, height = key.split("_")
        cases.append(
            BenchCase(
                name=f"Ø{diameter} {height}",
                height_name=height,
                height=HEIGHTS[height],
                radius=5e-4 * float(diameter),
                depth=1e-3 * data[f"{key}_depth"].astype(float),
                moved=1e-3 * (data[f"{key}_keypoints"].astype(float) - data["keypoints0"]),
                force=data[f"{key}_force"].astype(float),
            )
        )
    return tuple(cases)


def bench_finger() -> Jaw:
    """Return the bench jaw with the material of the truth."""
    jaw = load_jaw("bench")
    return replace(jaw, material=Material(young_modulus=YOUNG_MODULUS, poisson_ratio=POISSON_RATIO))


def record_press(case: BenchCase, jaw: Jaw, camera: NoisyCamera | None = None, seed: int = 0) -> ReplayedPress:
    """Return a press to all levels at 2 mm/s, each held for 1.5 s, after two seconds at rest.

    Between the depths of the truth key points and forces are interpolated without overshoot.

    Args:
        case: what is pressed.
        jaw: the finger, whose key points are those of the truth.
        camera: makes noise and hides points; None sees everything exactly.
        seed: of the noise.
    """
    from scipy.interpolate import PchipInterpolator  # megabytes that a process measuring its memory need not have

    motion = _build_motion()
    depth = motion.depth
    grid = np.r_[0.0, case.depth]
    shapes = np.concatenate([np.zeros((1, *jaw.keypoints.shape)), case.moved])
    points = jaw.keypoints + PchipInterpolator(grid, shapes)(depth)
    force = PchipInterpolator(grid, np.concatenate([np.zeros((1, 3)), case.force]))(depth)
    axes = np.stack([jaw.inner_face_x + case.radius - depth, np.full(len(depth), case.height)], axis=1)
    random = np.random.default_rng([seed, round(1e4 * case.radius), round(1e3 * case.height)])
    likelihood = np.ones(points.shape[:2])
    if camera is not None:
        points, likelihood = camera.observe(points, axes, case.radius, random)
    contact = Contact.fixed(jaw, case.height)
    outlines = _outlines(contact, axes, case.radius, 0.0 if camera is None else random.standard_normal(3))
    return ReplayedPress(
        case=case,
        observations=[
            Observation(stamp=1.0 + PERIOD * index, points=points[index], likelihood=likelihood[index])
            for index in range(len(depth))
        ],
        contacts={"height": [contact] * len(depth), "outline": outlines},
        force=force,
        held=motion.held,
        ends=motion.ends,
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class _PressMotion:
    """Depths (n,) [m] image by image, which of them are held (n,), and the last image of each level (levels,)."""

    depth: NDArray
    held: NDArray
    ends: NDArray


def _build_motion() -> _PressMotion:
    """Return rest, then ramps to the levels, and holds."""
    parts, ends = [np.zeros(REST_FRAMES)], []
    for level in LEVELS:
        steps = max(round((level - parts[-1][-1]) / SPEED / PERIOD), 1)
        parts += [np.linspace(parts[-1][-1], level, steps + 1)[1:], np.full(HOLD_FRAMES, level)]
        ends.append(sum(map(len, parts)) - 1)
    depth = np.concatenate(parts)
    held = np.zeros(len(depth), bool)
    for end in ends:
        held[end - SCORED_FRAMES + 1 : end + 1] = True
    return _PressMotion(depth=depth, held=held, ends=np.array(ends))


def _outlines(contact: Contact, axes: NDArray, radius: float, error: NDArray | float) -> list[Contact]:
    """Return the contact with a round outline at axes (n, 2) [m], its pose off by `error` standard deviations (3,)."""
    angles = 2.0 * np.pi * np.arange(_CORNERS) / _CORNERS
    polygons = (radius * np.stack([np.cos(angles), np.sin(angles)], axis=1),)
    wrong = _POSE_ERROR * error
    return [
        replace(
            contact,
            free=False,
            outline=ObjectOutline(polygons=polygons, origin=axis + wrong[:2], tilt=float(wrong[2]), stddev=_POSE_ERROR),
        )
        for axis in axes
    ]


# Half the length of the pressed cylinders [m].
_HALF_LENGTH = 0.03
_SEEN_LIKELIHOOD, _HIDDEN_LIKELIHOOD = (0.6, 1.0), (0.02, 0.55)


@dataclass(frozen=True, kw_only=True)
class NoisyCamera:
    """A fixed RGB-D camera next to the finger.

    Attributes:
        position: in the jaw frame [m].
        noise: standard deviation of a point in every direction [m].
        depth_noise: the same along its line of sight, in addition [m].
        offset: constant error of each point of a recording [m].
        depth_scale: constant relative error of the depth.
        gross: share of points that are somewhere else and keep a high likelihood.
        gross_size: standard deviation of a gross error along each axis [m].
        holes: share of points without depth.
        hidden_trusted: share of hidden points whose likelihood is high.
    """

    position: tuple[float, float, float] = (0.055, 0.095, -0.045)
    noise: float = 0.20e-3
    depth_noise: float = 0.45e-3
    offset: float = 0.35e-3
    depth_scale: float = 0.005
    gross: float = 0.01
    gross_size: float = 0.025
    holes: float = 0.01
    hidden_trusted: float = 0.05

    def observe(
        self, points: NDArray, axes: NDArray, radius: float, random: np.random.Generator
    ) -> tuple[NDArray, NDArray]:
        """Return key points (n, K, 3) [m] next to a cylinder as seen, NaN without depth, and likelihoods (n, K).

        Args:
            points: true key points, jaw frame.
            axes: x and z of the cylinder's axis (n, 2) [m].
            radius: of the cylinder [m].
            random: where all chance comes from.
        """
        shape = points.shape[:2]
        reach = self._find_cover(points, axes, radius)
        hidden = np.isfinite(reach)
        rays = points - self.position
        seen = np.where(hidden[..., None], self.position + np.where(hidden, reach, 1.0)[..., None] * rays, points)
        sight = rays / np.linalg.norm(rays, axis=2, keepdims=True)
        constant = self.offset / np.sqrt(3.0) * random.standard_normal(points.shape[1:])
        scale = 1.0 + self.depth_scale * random.standard_normal()
        seen = self.position + scale * (seen - self.position) + constant
        seen = seen + self.noise * random.standard_normal(points.shape)
        seen += self.depth_noise * random.standard_normal((*shape, 1)) * sight
        gross = random.random(shape) < self.gross
        seen += np.where(gross[..., None], self.gross_size * random.standard_normal(points.shape), 0.0)
        seen[random.random(shape) < self.holes] = np.nan
        doubted = hidden & (random.random(shape) >= self.hidden_trusted)
        likelihood = np.where(
            doubted, random.uniform(*_HIDDEN_LIKELIHOOD, shape), random.uniform(*_SEEN_LIKELIHOOD, shape)
        )
        return seen, likelihood

    def _find_cover(self, points: NDArray, axes: NDArray, radius: float) -> NDArray:
        """Return which share of the way to each point (n, K) a cylinder lets the sight go; NaN when all of it."""
        ray = points - self.position
        start = np.array(self.position)[[0, 2]] - axes[:, None]
        a = (ray[..., [0, 2]] ** 2).sum(-1)
        b = (start * ray[..., [0, 2]]).sum(-1)
        inside = b**2 - a * ((start**2).sum(-1) - radius**2)
        wall = (-b - np.sqrt(np.maximum(inside, 0.0))) / a
        on_wall = (inside > 0.0) & (wall > 0.0) & (wall < 1.0)
        on_wall &= np.abs(self.position[1] + wall * ray[..., 1]) < _HALF_LENGTH
        end = (_HALF_LENGTH - self.position[1]) / ray[..., 1]
        met = start + end[..., None] * ray[..., [0, 2]]
        on_end = (end > 0.0) & (end < 1.0) & ((met**2).sum(-1) < radius**2)
        return np.where(on_end, end, np.where(on_wall, wall, np.nan))
