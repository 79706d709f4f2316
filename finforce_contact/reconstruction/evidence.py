"""What a masked depth image says about an object: points of its surface, and where its outline is."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_erosion, distance_transform_edt, maximum_filter, minimum_filter, uniform_filter
from scipy.spatial import cKDTree

from finforce.camera import CameraIntrinsics, check_depth, check_mask, compute_rays

EDGE_BAND = 2  # [px] along the mask's edge and around holes, where pixels fly between object and background
SMOOTHING = 5  # [px] window over which depth is averaged
ROUGHNESS = 6e-3  # [m] of depth within a window, above which it holds a step
STEEPEST = 3.0  # tangent of the angle between ray and normal up to which a slope is no step
LEAST_POINTS = 50
POINT_COUNT = 2000
OCCLUSION_STEP = 6e-3  # [m] by which what lies beyond the outline is nearer when it hides the object
OUTSIDE_REACH = 4  # [px] beyond the outline where that is looked for
UNSURE_WEIGHT = 0.3  # of an outline beyond which nothing was measured, or something as near


@dataclass(frozen=True, kw_only=True, eq=False)
class ImageEvidence:
    """The measurements that a mesh has to explain.

    Attributes:
        camera: of the images.
        depth: (h, w) [m], NaN invalid.
        mask: (h, w) bool, the object's visible pixels.
        points: (n, 3) smoothed points well inside the mask, camera frame [m].
        normals: (n, 3) their unit normals, towards the camera.
        edge_distance: (h, w) signed distance to the mask's outline [px], negative inside.
        edge_slope: (h, w, 2) its gradient, along the columns and along the rows.
        edge_weight: (h, w) how far the nearest outline is the object's own: 0 where something nearer hides it or the
            image ends, `UNSURE_WEIGHT` where what lies beyond is as near or was not measured, else 1.
    """

    camera: CameraIntrinsics
    depth: NDArray
    mask: NDArray
    points: NDArray
    normals: NDArray
    edge_distance: NDArray
    edge_slope: NDArray
    edge_weight: NDArray


def collect_evidence(depth: NDArray, mask: NDArray, camera: CameraIntrinsics) -> ImageEvidence:
    """Return what a masked depth image says about the object.

    Args:
        depth: (h, w) [m], NaN or not positive where nothing was measured.
        mask: (h, w) bool.
        camera: intrinsics of the image.

    Raises:
        ImageError: the sizes differ, the mask is empty, or too few of its pixels have a depth.
    """
    check_depth(depth, camera)
    depth = np.where(np.nan_to_num(depth) > 0.0, depth, np.nan).astype(float)
    check_mask(mask, depth, least=LEAST_POINTS)
    mask = np.asarray(mask, dtype=bool)
    points = _smooth_points(depth, mask, camera)
    distance = _edge_distance(mask)
    return ImageEvidence(
        camera=camera,
        depth=depth,
        mask=mask,
        points=points,
        normals=_estimate_normals(points),
        edge_distance=distance,
        edge_slope=np.stack(np.gradient(distance)[::-1], axis=-1),
        edge_weight=_weigh_edges(depth, mask),
    )


def _smooth_points(depth: NDArray, mask: NDArray, camera: CameraIntrinsics) -> NDArray:
    """Return at most `POINT_COUNT` points (n, 3), averaged over windows that hold no step of depth."""
    for band in range(EDGE_BAND, -1, -1):
        inside = binary_erosion(mask, iterations=band) if band else mask
        known = inside & np.isfinite(depth)
        values = np.where(known, depth, 0.0)
        share = uniform_filter(known.astype(float), SMOOTHING)
        mean = uniform_filter(values, SMOOTHING) / np.maximum(share, 1e-9)
        near = minimum_filter(np.where(known, depth, np.inf), SMOOTHING)
        far = maximum_filter(np.where(known, depth, -np.inf), SMOOTHING)
        # a window that is not full has its average beside its middle
        is_smooth = far - near < np.maximum(ROUGHNESS, STEEPEST * SMOOTHING * mean / camera.fx)
        chosen = np.flatnonzero(known & is_smooth & (share > 0.99))
        if len(chosen) >= LEAST_POINTS:
            break
    else:
        chosen = np.flatnonzero(known)
        mean = depth
    chosen = chosen[:: max(1, -(-len(chosen) // POINT_COUNT))]
    return compute_rays(camera).reshape(-1, 3)[chosen] * mean.ravel()[chosen, None]


def _estimate_normals(points: NDArray, neighbours: int = 16) -> NDArray:
    """Return unit normals (n, 3) towards the camera, of planes through the nearest points."""
    _, nearest = cKDTree(points).query(points, k=min(neighbours, len(points)))
    around = points[nearest] - points[nearest].mean(axis=1, keepdims=True)
    normals = np.linalg.eigh(np.einsum("nki,nkj->nij", around, around))[1][:, :, 0]
    return np.where(np.einsum("ij,ij->i", normals, points)[:, None] > 0.0, -normals, normals)


def _edge_distance(mask: NDArray) -> NDArray:
    """Return the signed distance (h, w) of pixel centres to the mask's outline [px], negative inside."""
    inside = distance_transform_edt(np.pad(mask, 1))[1:-1, 1:-1]
    outside = distance_transform_edt(~mask)
    return np.where(mask, 0.5 - inside, outside - 0.5)


def _weigh_edges(depth: NDArray, mask: NDArray) -> NDArray:
    """Return for every pixel (h, w) how far the outline nearest to it is the object's own."""
    size = 2 * OUTSIDE_REACH + 1
    beyond = minimum_filter(np.where(mask | np.isnan(depth), np.inf, depth), size)
    own = minimum_filter(np.where(mask & np.isfinite(depth), depth, np.inf), size)
    is_free = np.isfinite(beyond) & (beyond > own + OCCLUSION_STEP)
    weight = np.where(is_free, 1.0, UNSURE_WEIGHT)
    weight[beyond < own - OCCLUSION_STEP] = 0.0
    weight[:2], weight[-2:], weight[:, :2], weight[:, -2:] = 0.0, 0.0, 0.0, 0.0
    edge = mask & ~binary_erosion(mask, border_value=0)
    _, (rows, columns) = distance_transform_edt(~edge, return_indices=True)
    return weight[rows, columns]
