"""Renderings of a mesh, and points on its surface."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray

from finforce.camera import CameraIntrinsics, project, rays_of_window
from finforce.optional import import_open3d
from finforce_contact.mesh.object_mesh import ObjectMesh

MARGIN = 2  # pixels around the projected box, for what distortion and rounding do to it


@dataclass(frozen=True, kw_only=True, eq=False)
class RenderedMesh:
    """The visible part of a mesh, on the grid of every `step`-th pixel.

    Attributes:
        depth: (ceil(h / step), ceil(w / step)) distance along the optical axis [m], NaN where the mesh is not hit.
        points: (n, 3) points hit, camera frame [m], row by row.
        normals: (n, 3) unit normals there, camera frame, towards the camera.
        pixels: (n, 2) column and row of the points in the full image [px].
    """

    depth: NDArray
    points: NDArray
    normals: NDArray
    pixels: NDArray


@dataclass(frozen=True, kw_only=True, eq=False)
class SurfacePoints:
    """Points (n, 3) [m] on a mesh and the unit normals (n, 3) there, outward as its triangles are wound."""

    points: NDArray
    normals: NDArray


class MeshView:
    """A mesh prepared for being looked at from many places; meshes that are not watertight are welcome.

    Raises:
        MissingDependencyError: Open3D is not installed.
    """

    def __init__(self, mesh: ObjectMesh) -> None:
        open3d = import_open3d()
        self._tensor = open3d.core.Tensor
        self._scene = open3d.t.geometry.RaycastingScene(nthreads=1)
        vertices = np.ascontiguousarray(mesh.vertices, dtype=np.float32)
        triangles = np.ascontiguousarray(mesh.triangles, dtype=np.uint32)
        self._scene.add_triangles(self._tensor(vertices), self._tensor(triangles))
        self._corners = np.array(list(product(*mesh.bounds.T)))

    def render(self, T_camera_object: NDArray, camera: CameraIntrinsics, step: int = 1) -> RenderedMesh:
        """Return what the camera sees of the mesh.

        Args:
            T_camera_object: (4, 4) pose of the mesh; an affine map (scale, stretch) does as well.
            camera: intrinsics; rays go through the centres of pixels, distortion included.
            step: every how many pixels and rows to look.
        """
        T = np.asarray(T_camera_object, dtype=float)
        rows, columns = self._window(T, camera, step)
        rays = rays_of_window(camera, rows, columns)
        depth = np.full((-(-camera.height // step), -(-camera.width // step)), np.nan)
        if rays.size == 0:
            nothing = np.empty((0, 3))
            return RenderedMesh(depth=depth, points=nothing, normals=nothing, pixels=np.empty((0, 2), dtype=int))
        distance, normals = self._cast(T, rays.reshape(-1, 3))
        window = depth[rows.start // step :, columns.start // step :][: rays.shape[0], : rays.shape[1]]
        window[...] = distance.reshape(rays.shape[:2])
        hit = np.isfinite(distance)
        at_row, at_column = np.divmod(np.flatnonzero(hit), rays.shape[1])
        pixels = np.column_stack((columns.start + step * at_column, rows.start + step * at_row))
        points = rays.reshape(-1, 3)[hit] * distance[hit, None]
        # normals of a stretched mesh go with the inverse
        facing = _towards_camera(normals[hit] @ np.linalg.inv(T[:3, :3]), points)
        return RenderedMesh(depth=depth, points=points, normals=facing, pixels=pixels)

    def render_back(self, T_camera_object: NDArray, camera: CameraIntrinsics, step: int = 1) -> NDArray:
        """Return the depths (ceil(h / step), ceil(w / step)) [m] at which the rays leave the mesh, NaN beside it."""
        T = np.asarray(T_camera_object, dtype=float)
        rays = rays_of_window(camera, range(0, camera.height, step), range(0, camera.width, step))
        corners = self._corners @ T[:3, :3].T + T[:3, 3]
        beyond = float(corners[:, 2].max()) + 1.0
        distance, _ = self._cast(T, -rays.reshape(-1, 3), rays.reshape(-1, 3) * beyond)
        return (beyond - distance).reshape(rays.shape[:2])

    def closest(self, points: NDArray, T_camera_object: NDArray) -> SurfacePoints:
        """Return the points of the mesh nearest to points (n, 3) [m], all in the camera frame.

        Under a map that stretches, nearest is meant in the mesh's own frame.
        """
        T = np.asarray(T_camera_object, dtype=float)
        inverse = np.linalg.inv(T[:3, :3])
        queries = np.ascontiguousarray((points - T[:3, 3]) @ inverse.T, dtype=np.float32)
        answer = self._scene.compute_closest_points(self._tensor(queries), nthreads=1)
        normals = answer["primitive_normals"].numpy().astype(float) @ inverse
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
        return SurfacePoints(points=answer["points"].numpy().astype(float) @ T[:3, :3].T + T[:3, 3], normals=normals)

    def _window(self, T: NDArray, camera: CameraIntrinsics, step: int) -> tuple[range, range]:
        """Return the rows and columns, multiples of `step`, that the mesh can be in."""
        corners = self._corners @ T[:3, :3].T + T[:3, 3]
        size = np.array([camera.width, camera.height])
        low, high = np.zeros(2, dtype=int), size
        if (corners[:, 2] > 1e-6).all():
            pixels = project(corners, camera)
            low = np.clip(np.floor(pixels.min(axis=0)) - MARGIN, 0, size).astype(int)
            high = np.clip(np.ceil(pixels.max(axis=0)) + MARGIN + 1, 0, size).astype(int)
        low = -(-low // step) * step
        return range(low[1], high[1], step), range(low[0], high[0], step)

    def _cast(self, T: NDArray, rays: NDArray, origins: NDArray | float = 0.0) -> tuple[NDArray, NDArray]:
        """Return lengths (n,), NaN without hit, and normals (n, 3) in the object frame of camera rays (n, 3)."""
        inverse = np.linalg.inv(T[:3, :3])
        packed = np.empty((len(rays), 6), dtype=np.float32)
        packed[:, :3] = (origins - T[:3, 3]) @ inverse.T
        packed[:, 3:] = rays @ inverse.T
        answer = self._scene.cast_rays(self._tensor(packed), nthreads=1)
        distance = answer["t_hit"].numpy().astype(float)
        distance[~np.isfinite(distance)] = np.nan
        return distance, answer["primitive_normals"].numpy().astype(float)


def _towards_camera(normals: NDArray, points: NDArray) -> NDArray:
    """Return unit normals (n, 3), turned so that they face the origin."""
    lengths = np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    away = np.einsum("ij,ij->i", normals, points) > 0.0
    return np.where(away[:, None], -normals, normals) / lengths


def sample_surface(mesh: ObjectMesh, count: int, rng: np.random.Generator) -> SurfacePoints:
    """Return so many points, drawn evenly over the area of a mesh."""
    which = rng.choice(len(mesh.areas), size=count, p=mesh.areas / mesh.areas.sum())
    first, second, third = mesh.vertices[mesh.triangles[which].T]
    u, v = rng.random((2, count, 1))
    folds = u + v > 1.0
    u, v = np.where(folds, 1.0 - u, u), np.where(folds, 1.0 - v, v)
    return SurfacePoints(points=first + u * (second - first) + v * (third - first), normals=mesh.normals[which])
