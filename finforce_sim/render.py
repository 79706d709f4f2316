"""Lights, surfaces and bodies of a scene, drawn by chance between bounds; their colour and depth by ray casting."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from finforce.camera import CameraIntrinsics, compute_rays, rays_from_pixels
from finforce.compiled import njit
from finforce.optional import import_open3d

_OPTIONS = {"cache": True, "error_model": "numpy", "nogil": True}
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
        casts_shadow: True if bodies hide it from each other.
    """

    direction: NDArray
    color: NDArray
    casts_shadow: bool = True


@dataclass(frozen=True, kw_only=True, eq=False)
class Exposure:
    """The response of the sensor to light.

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
    """The appearance of a scene, apart from its bodies' materials.

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

    @cached_property
    def backdrop(self) -> NDArray:
        """The background's light (s * s, 3), row by row."""
        total = self.ambient + sum(0.5 * lamp.color for lamp in self.lights)
        return (self.background * total).reshape(-1, 3)


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
VOLUME_SIZE = 64  # of the tileable noise volume, per axis; a power of two


@dataclass(frozen=True, kw_only=True, eq=False)
class Paint:
    """The appearance of a surface.

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

    def colors_at(self, points: NDArray) -> NDArray:
        """Return the colours (n, 3) at points (n, 3) [m] of the body at rest."""
        points = points + self.offset
        share = self._mix(points)
        color = self.color[:, None] * (1.0 - share) + self.second[:, None] * share
        return (color * (1.0 + self.grain * (_look_up(points, 0.4e-3) - 0.5))).T

    def _mix(self, points: NDArray) -> NDArray:
        """Return the share (n,) of the second colour."""
        cells = points / self.size
        if self.pattern == "noise":
            return np.clip(_look_up(points, self.size / 6.0) * 2.0 - 0.5, 0.0, 1.0)
        if self.pattern == "stripes":
            return (np.mod(cells @ np.array([0.8, 0.1, 0.59]), 1.0) < 0.5).astype(float)
        if self.pattern == "checks":
            return np.mod(np.floor(cells + 1e-6).sum(axis=1), 2.0)
        if self.pattern == "speckles":
            return (_look_up(points, self.size / 12.0) > 0.72).astype(float)
        if self.pattern == "layers":
            return 0.5 + 0.5 * np.sin(2.0 * np.pi * points[:, 2] / 0.4e-3)
        return np.zeros(len(points))


@lru_cache(maxsize=1)
def _noise_volume() -> NDArray:
    """Return tileable noise (s, s, s), spread evenly over [0, 1]."""
    rng = np.random.default_rng(20)
    volume = gaussian_filter(rng.standard_normal((VOLUME_SIZE,) * 3), 1.2, mode="wrap")
    ranks = np.empty(volume.size)
    ranks[np.argsort(volume, axis=None)] = np.linspace(0.0, 1.0, volume.size)
    return ranks.reshape(volume.shape)


def _look_up(points: NDArray, cell: float) -> NDArray:
    """Return noise (n,) in [0, 1] at points (n, 3) [m], in cells of a size [m]."""
    index = np.floor(points / cell).astype(np.int64) & VOLUME_SIZE - 1
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


def smooth_field(shape: tuple[int, int], width: float, rng: np.random.Generator) -> NDArray:
    """Return normal noise (h, w) of unit variance, correlated over `width` pixels."""
    field = rng.standard_normal(shape)
    if width <= 0.0:
        return field
    radius = int(4.0 * width + 0.5)
    kernel = cv2.getGaussianKernel(2 * radius + 1, width)
    field = cv2.sepFilter2D(np.pad(field, radius, mode="wrap"), -1, kernel, kernel)[radius:-radius, radius:-radius]
    return field / field.std()


SUBPIXELS = np.array([(-0.125, -0.375), (0.375, -0.125), (-0.375, 0.125), (0.125, 0.375)])  # rotated grid
EDGE_STEP = 0.6e-3  # [m] of depth between neighbours that the slope of a surface does not explain
SHADOW_OFFSET = 0.05e-3  # [m] along the normal, so that a surface does not hide itself
SKY = 0.55  # share of the ambient light that a surface square to the camera's side gets
FAR = 3.0  # [m] where rays end that meet neither bodies nor the background's plane


@dataclass(frozen=True, kw_only=True, eq=False)
class Decal:
    """A round spot painted on a body: its centre (3,) [m] at rest, radius [m] and colour (3,)."""

    centre: NDArray
    radius: float
    color: NDArray


@dataclass(frozen=True, kw_only=True, eq=False)
class Body:
    """One thing before the camera.

    Attributes:
        vertices: (n, 3) [m], camera frame.
        triangles: (m, 3) int, counterclockwise seen from outside.
        rest: (n, 3) [m], the positions of the vertices to which the pattern sticks.
        paint: of its surface.
        decals: spots painted on it.
    """

    vertices: NDArray
    triangles: NDArray
    rest: NDArray
    paint: Paint
    decals: tuple[Decal, ...] = ()


@dataclass(frozen=True, kw_only=True, eq=False)
class Picture:
    """A rendered image.

    Attributes:
        color: (h, w, 3) linear light.
        depth: (h, w) true depth of the pixels' centres [m].
    """

    color: NDArray
    depth: NDArray


class RenderedScene:
    """Bodies ready to be looked at.

    Args:
        bodies: bodies in front of the camera.
        look: lights and background.
        R_camera_gripper: (3, 3), for the look's directions.
        base: (3,) [m] origin of the gripper in the camera frame.

    Raises:
        MissingDependencyError: Open3D is not installed.
    """

    def __init__(self, bodies: list[Body], look: Lighting, R_camera_gripper: NDArray, base: NDArray) -> None:
        open3d = import_open3d()
        self._tensor = open3d.core.Tensor
        self._scene = open3d.t.geometry.RaycastingScene(nthreads=1)
        self._bodies, self._look, self._R, self._base = bodies, look, R_camera_gripper, base
        starts = np.cumsum([0, *(len(body.vertices) for body in bodies)])
        self._rest = np.concatenate([body.rest for body in bodies])
        self._triangles = np.concatenate(
            [body.triangles + start for body, start in zip(bodies, starts[:-1], strict=True)]
        )
        owners = np.repeat(np.arange(len(bodies)), [len(body.triangles) for body in bodies])
        self._owners = np.append(owners, -1).astype(np.int16)  # the last of what meets no triangle
        vertices = np.concatenate([body.vertices for body in bodies])
        self._scene.add_triangles(
            self._tensor(vertices.astype(np.float32)), self._tensor(self._triangles.astype(np.uint32))
        )

    def render(self, camera: CameraIntrinsics, rows: slice = slice(None)) -> Picture:
        """Return some rows of the image of a camera; pixels with an edge in them are the mean of four rays."""
        rays = compute_rays(camera)[rows]
        shape = rays.shape[:2]
        flat = rays.reshape(-1, 3)
        blind = np.isnan(flat[:, 0])  # beyond what a fisheye can show
        if blind.any():
            flat = np.where(blind[:, None], [0.0, 0.0, 1.0], flat)
        hits = self._cast(flat)
        color = self._shade(flat, hits)
        rough = _find_edges(hits.depth.reshape(shape), hits.surface.reshape(shape), hits.owner.reshape(shape))
        at = np.flatnonzero(rough)
        row, column = np.divmod(at, shape[1])
        pixels = np.column_stack((column, row + (rows.start or 0)))
        fine = np.nan_to_num(rays_from_pixels((pixels[:, None] + SUBPIXELS).reshape(-1, 2), camera), nan=1.0)
        color[at] = self._shade(fine, self._cast(fine)).reshape(-1, len(SUBPIXELS), 3).mean(axis=1)
        color[blind], hits.depth[blind] = 0.0, FAR
        return Picture(color=color.reshape(*shape, 3), depth=hits.depth.reshape(shape))

    def sees(self, points: NDArray, tolerance: float = 0.5e-3) -> NDArray:
        """Say of which points (n, 3) [m], camera frame, nothing stands before them by more than a tolerance [m]."""
        depth = self._cast(points / points[:, 2:]).depth
        return depth > points[:, 2] - tolerance

    def _cast(self, rays: NDArray) -> _Hits:
        """Return what rays (n, 3) with z = 1 from the camera's centre meet first."""
        packed = np.zeros((len(rays), 6), dtype=np.float32)
        packed[:, 3:] = rays
        answer = self._scene.cast_rays(self._tensor(packed), nthreads=1)
        depth = answer["t_hit"].numpy().astype(float)
        missed = np.flatnonzero(np.isinf(depth))
        normal = self._R[:, 2]
        with np.errstate(divide="ignore"):  # the background's plane, FAR above its horizon
            behind = (normal @ self._base + self._look.background_distance) / (rays[missed] @ normal)
        depth[missed] = np.where((behind > 0.0) & (behind < FAR), behind, FAR)
        surface = np.minimum(answer["primitive_ids"].numpy(), len(self._triangles))
        return _Hits(
            depth=depth,
            owner=self._owners[surface],
            surface=surface,
            weights=answer["primitive_uvs"].numpy(),
            normals=answer["primitive_normals"].numpy(),
        )

    def _shade(self, rays: NDArray, hits: _Hits) -> NDArray:
        """Return the linear colours (n, 3) that come along rays."""
        look, R, on = self._look, self._R, np.flatnonzero(hits.owner >= 0)
        normals, starts, places = _meet(on, rays, hits, self._triangles, self._rest)
        lamps = np.array([(R @ lamp.direction, lamp.color) for lamp in look.lights]).reshape(-1, 2, 3)
        lit = np.maximum(normals @ lamps[:, 0].T, 0.0)
        for lamp, towards, share in zip(look.lights, lamps[:, 0], lit.T, strict=True):
            if lamp.casts_shadow:
                share[self._is_hidden(starts, towards, share)] = 0.0
        # light from everywhere comes least to what looks away from the open side, as the insides of the cells do
        light = (SKY + (1.0 - SKY) * normals @ R[:, 1])[:, None] * look.ambient
        gloss = np.array([(body.paint.gloss, body.paint.sharpness) for body in self._bodies])[hits.owner[on]]
        color = np.empty((len(rays), 3))
        _light_up(on, rays, (normals, self._paint(hits.owner[on], places), gloss), light, (lamps, lit), color)
        off = np.flatnonzero(hits.owner < 0)
        across = self._R[:, :2].T @ (rays[off] * hits.depth[off, None] - self._base).T
        column, row = np.floor(across / TEXTURE_SPAN * TEXTURE_SIZE).astype(np.int32) % TEXTURE_SIZE
        color[off] = self._look.backdrop[row * TEXTURE_SIZE + column]
        return color

    def _paint(self, owner: NDArray, places: NDArray) -> NDArray:
        """Return the colours (n, 3) of bodies (n,) at places (n, 3) [m] on them at rest."""
        color = np.empty((len(owner), 3))
        for index, body in enumerate(self._bodies):
            mine = np.flatnonzero(owner == index)
            points = places[mine]
            color[mine] = body.paint.colors_at(points)
            for decal in body.decals:
                color[mine[((points - decal.centre) ** 2).sum(axis=1) < decal.radius**2]] = decal.color
        return color

    def _is_hidden(self, starts: NDArray, towards: NDArray, lit: NDArray) -> NDArray:
        """Return the indices of the points (n, 3) from which bodies hide a lamp, of those where `lit` (n,) is not 0."""
        facing = np.flatnonzero(lit)
        packed = np.empty((len(facing), 6), dtype=np.float32)
        packed[:, :3], packed[:, 3:] = starts[facing], towards
        return facing[self._scene.test_occlusions(self._tensor(packed), nthreads=1).numpy()]


class _Hits(NamedTuple):
    """The hits of rays: depth (n,) [m], body (n,), triangle (n,), weights in it (n, 2), its normal (n, 3)."""

    depth: NDArray
    owner: NDArray
    surface: NDArray
    weights: NDArray
    normals: NDArray


@njit(**_OPTIONS)
def _meet(on, rays, hits, triangles, rest):
    """Return at the hits `on` normals towards the camera, points [m] just above, and places [m] at rest (3, n, 3)."""
    depth, surface, weights, normals = hits.depth, hits.surface, hits.weights, hits.normals
    met = np.empty((3, len(on), 3))
    for i, hit in enumerate(on):
        along = 0.0
        for axis in range(3):
            along += normals[hit, axis] * rays[hit, axis]
        (a, b, c), (u, v) = triangles[surface[hit]], weights[hit]
        for axis in range(3):
            met[0, i, axis] = -normals[hit, axis] if along > 0.0 else normals[hit, axis]
            met[1, i, axis] = rays[hit, axis] * depth[hit] + SHADOW_OFFSET * met[0, i, axis]
            met[2, i, axis] = (1.0 - u - v) * rest[a, axis] + u * rest[b, axis] + v * rest[c, axis]
    return met


@njit(**_OPTIONS)
def _light_up(on, rays, surface, light, lights, color):
    """Write the light (n, 3) that the hits `on` send back: albedo times light, and highlights (Blinn-Phong).

    Args:
        on: hits (k,) among the rays.
        rays: (n, 3).
        surface: at the hits normals (k, 3), albedo (k, 3), gloss and sharpness (k, 2).
        light: from everywhere (k, 3), to which that of the lamps is added.
        lights: direction and colour of the lamps (l, 2, 3), and how much of each falls on the hits (k, l).
        color: (n, 3), written at the hits.
    """
    (normals, albedo, gloss), (lamps, lit) = surface, lights
    for i, hit in enumerate(on):
        length = np.sqrt(rays[hit, 0] ** 2 + rays[hit, 1] ** 2 + rays[hit, 2] ** 2)
        color[hit] = 0.0
        for lamp in range(len(lamps)):
            if lit[i, lamp] > 0.0:
                along, square = 0.0, 0.0
                for axis in range(3):
                    half = lamps[lamp, 0, axis] - rays[hit, axis] / length
                    along, square = along + normals[i, axis] * half, square + half * half
                shine = gloss[i, 0] * max(along / np.sqrt(square), 1e-6) ** gloss[i, 1]
                for channel in range(3):
                    light[i, channel] += lit[i, lamp] * lamps[lamp, 1, channel]
                    color[hit, channel] += shine * lamps[lamp, 1, channel]
        for channel in range(3):
            color[hit, channel] += albedo[i, channel] * light[i, channel]


def _find_edges(depth: NDArray, surface: NDArray, owner: NDArray) -> NDArray:
    """Return the pixels (h, w) next to which another body, or the same at another depth, begins."""
    rough = np.zeros(depth.shape, dtype=bool)
    # views of the same pixels: neighbours in a column, then in a row
    for d, s, o, r in ((depth, surface, owner, rough), (depth.T, surface.T, owner.T, rough.T)):
        step = np.abs(d[1:] - d[:-1]) > EDGE_STEP + 0.01 * np.minimum(d[1:], d[:-1])
        changed = (o[1:] != o[:-1]) | step & (s[1:] != s[:-1])
        r[1:] |= changed
        r[:-1] |= changed
    return rough
