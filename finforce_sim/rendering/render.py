"""Colour and depth of bodies before a background, by ray casting in one thread."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from finforce.camera import CameraIntrinsics, compute_rays, rays_from_pixels
from finforce.optional import import_open3d
from finforce_sim.rendering.lighting import TEXTURE_SIZE, TEXTURE_SPAN, Light, Lighting, Paint

SUBPIXELS = np.array([(-0.125, -0.375), (0.375, -0.125), (-0.375, 0.125), (0.125, 0.375)])  # rotated grid
EDGE_STEP = 0.6e-3  # [m] of depth between neighbours that the slope of a surface does not explain
SHADOW_OFFSET = 0.05e-3  # [m] along the normal, so that a surface does not hide itself
SKY = 0.55  # share of the ambient light that a surface square to the camera's side gets
FAR = 3.0  # [m] where rays end that meet neither bodies nor the background's plane


@dataclass(frozen=True, kw_only=True, eq=False)
class Decal:
    """A round spot painted on a body: its place (3,) [m] at rest, radius [m] and colour (3,)."""

    place: NDArray
    radius: float
    color: NDArray


@dataclass(frozen=True, kw_only=True, eq=False)
class Body:
    """One thing before the camera.

    Attributes:
        vertices: (n, 3) [m], camera frame.
        triangles: (m, 3) int, counterclockwise seen from outside.
        rest: (n, 3) [m], the places of the vertices to which the pattern sticks.
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
        owner: (h, w) int16 index of the body seen at the pixels' centres, -1 for the background.
    """

    color: NDArray
    depth: NDArray
    owner: NDArray


@dataclass(frozen=True, kw_only=True, eq=False)
class Window:
    """Rows and columns of an image that are rendered; the rest stays black and at FAR."""

    rows: slice
    columns: slice


class RenderedScene:
    """Bodies ready to be looked at.

    Args:
        bodies: what stands before the camera.
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
        self._owners = np.repeat(np.arange(len(bodies)), [len(body.triangles) for body in bodies])
        vertices = np.concatenate([body.vertices for body in bodies])
        self._scene.add_triangles(
            self._tensor(vertices.astype(np.float32)), self._tensor(self._triangles.astype(np.uint32))
        )

    def render(self, camera: CameraIntrinsics, window: Window | None = None) -> Picture:
        """Return the image of a camera; pixels with an edge in them are the mean of four rays."""
        rows, columns = (window.rows, window.columns) if window else (slice(None), slice(None))
        rays = compute_rays(camera)[rows, columns]
        shape = rays.shape[:2]
        flat = rays.reshape(-1, 3)
        blind = np.isnan(flat).any(axis=1)  # beyond what a fisheye can show
        flat = np.where(blind[:, None], [0.0, 0.0, 1.0], flat)
        hits = self._cast(flat)
        color = self._shade(flat, hits)
        rough = _find_edges(hits.depth.reshape(shape), hits.surface.reshape(shape), hits.owner.reshape(shape))
        at = np.flatnonzero(rough)
        row, column = np.divmod(at, shape[1])
        pixels = np.column_stack((column + (columns.start or 0), row + (rows.start or 0)))
        fine = np.nan_to_num(rays_from_pixels((pixels[:, None] + SUBPIXELS).reshape(-1, 2), camera), nan=1.0)
        color[at] = self._shade(fine, self._cast(fine)).reshape(-1, len(SUBPIXELS), 3).mean(axis=1)
        color[blind], hits.depth[blind], hits.owner[blind] = 0.0, FAR, -1
        picture = Picture(
            color=np.zeros((camera.height, camera.width, 3)),
            depth=np.full((camera.height, camera.width), FAR),
            owner=np.full((camera.height, camera.width), -1, dtype=np.int16),
        )
        picture.color[rows, columns] = color.reshape(*shape, 3)
        picture.depth[rows, columns] = hits.depth.reshape(shape)
        picture.owner[rows, columns] = hits.owner.reshape(shape)
        return picture

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
        surface = answer["primitive_ids"].numpy().astype(np.int64)
        hit = np.isfinite(depth)
        owner = np.where(hit, self._owners[np.where(hit, surface, 0)], -1)
        plane = self._background_depth(rays)
        return _Hits(
            depth=np.where(hit, depth, plane),
            owner=owner,
            surface=np.where(hit, surface, -1),
            weights=answer["primitive_uvs"].numpy().astype(float),
            normals=answer["primitive_normals"].numpy().astype(float),
        )

    def _background_depth(self, rays: NDArray) -> NDArray:
        """Return the depth (n,) [m] at which rays (n, 3) meet the background's plane, FAR above its horizon."""
        normal = self._R[:, 2]
        with np.errstate(divide="ignore"):
            depth = (normal @ self._base + self._look.background_distance) / (rays @ normal)
        return np.where((depth > 0.0) & (depth < FAR), depth, FAR)

    def _shade(self, rays: NDArray, hits: _Hits) -> NDArray:
        """Return the linear colours (n, 3) that come along rays."""
        color = np.empty((len(rays), 3))
        outside = hits.owner < 0
        color[outside] = self._look_at_background(rays[outside] * hits.depth[outside, None])
        on = np.flatnonzero(~outside)
        points = rays[on] * hits.depth[on, None]
        normals = hits.normals[on]
        normals = np.where((np.einsum("ij,ij->i", normals, rays[on]) > 0.0)[:, None], -normals, normals)
        albedo, gloss, sharpness = self._paint(hits, on)
        # light from everywhere comes least to what looks away from the open side, as the insides of the cells do
        light = (SKY + (1.0 - SKY) * normals @ self._R[:, 1])[:, None] * self._look.ambient
        shine = np.zeros_like(light)
        view = -rays[on] / np.linalg.norm(rays[on], axis=1, keepdims=True)
        for lamp in self._look.lights:
            towards = self._R @ lamp.direction
            lit = np.clip(normals @ towards, 0.0, None) * self._is_lit(points, normals, towards, lamp)
            light += lit[:, None] * lamp.color
            half = view + towards
            half /= np.linalg.norm(half, axis=1, keepdims=True)
            facing = np.clip(np.einsum("ij,ij->i", normals, half), 1e-6, None)
            shine += ((lit > 0.0) * gloss * facing**sharpness)[:, None] * lamp.color
        color[on] = albedo * light + shine
        return color

    def _paint(self, hits: _Hits, on: NDArray) -> list[NDArray]:
        """Return the colours (n, 3), gloss (n,) and sharpness (n,) of the bodies' surfaces at some hits."""
        owner, corners = hits.owner[on], self._rest[self._triangles[hits.surface[on]]]
        u, v = hits.weights[on].T[..., None]
        places = (1.0 - u - v) * corners[:, 0] + u * corners[:, 1] + v * corners[:, 2]
        color = np.empty((len(on), 3))
        for index, body in enumerate(self._bodies):
            mine = owner == index
            color[mine] = body.paint.colors_at(places[mine])
            for decal in body.decals:
                near = mine & (((places - decal.place) ** 2).sum(axis=1) < decal.radius**2)
                color[near] = decal.color
        gloss = np.array([body.paint.gloss for body in self._bodies])[owner]
        sharpness = np.array([body.paint.sharpness for body in self._bodies])[owner]
        return [color, gloss, sharpness]

    def _is_lit(self, points: NDArray, normals: NDArray, towards: NDArray, lamp: Light) -> NDArray:
        """Say which points (n, 3) a lamp reaches."""
        if not lamp.casts_shadow:
            return np.ones(len(points))
        packed = np.empty((len(points), 6), dtype=np.float32)
        packed[:, :3] = points + SHADOW_OFFSET * normals
        packed[:, 3:] = towards
        return ~self._scene.test_occlusions(self._tensor(packed), nthreads=1).numpy()

    def _look_at_background(self, points: NDArray) -> NDArray:
        """Return the light (n, 3) of the background at points (n, 3) [m], camera frame."""
        across = (points - self._base) @ self._R[:, :2]
        index = np.floor(across / TEXTURE_SPAN * TEXTURE_SIZE).astype(int) % TEXTURE_SIZE
        total = self._look.ambient + sum(0.5 * lamp.color for lamp in self._look.lights)
        return self._look.background[index[:, 1], index[:, 0]] * total


@dataclass(frozen=True, kw_only=True, eq=False)
class _Hits:
    """What rays met: depth (n,) [m], body (n,), triangle (n,), place in it (n, 2), its normal (n, 3)."""

    depth: NDArray
    owner: NDArray
    surface: NDArray
    weights: NDArray
    normals: NDArray


def _find_edges(depth: NDArray, surface: NDArray, owner: NDArray) -> NDArray:
    """Return the pixels (h, w) beside which another body, or the same at another depth, begins."""
    rough = np.zeros(depth.shape, dtype=bool)
    for axis in (0, 1):
        other = np.diff(owner, axis=axis) != 0
        step = np.abs(np.diff(depth, axis=axis)) > EDGE_STEP + 0.01 * np.minimum(
            *(np.take(depth, range(low, depth.shape[axis] - 1 + low), axis=axis) for low in (0, 1))
        )
        changed = other | step & (np.diff(surface, axis=axis) != 0)
        for low in (0, 1):
            part = [slice(None), slice(None)]
            part[axis] = slice(low, depth.shape[axis] - 1 + low)
            rough[tuple(part)] |= changed
    return rough
