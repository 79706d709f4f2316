"""The evidence of a masked depth image for an object, and the score of a shape against it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_erosion, distance_transform_edt, maximum_filter, minimum_filter, uniform_filter
from scipy.spatial import cKDTree

from finforce.camera import CameraIntrinsics, ImageError, check_depth, check_mask, compute_rays
from finforce_contact.errors import ReconstructionError
from finforce_contact.mesh.object_mesh import LARGEST, ObjectMesh
from finforce_contact.mesh.views import MeshView

EDGE_BAND = 2  # [px] along the mask's edge and around holes, where pixels fly between object and background
SMOOTHING = 5  # [px] window over which depth is averaged
ROUGHNESS = 6e-3  # [m] of depth within a window, above which it holds a step
STEEPEST = 3.0  # tangent of the angle between ray and normal up to which a slope is no step
LEAST_POINTS = 50
FARTHEST_OBJECT = 0.6  # [m], of an object in reach of jaws that the camera sees, too
DEPTH_UNITS = (
    "does a step of its depth mean so much? TUM's is 0.2 mm (--depth-scale 0.0002), that of many BOP sets 0.1 mm; are "
    "mask and intrinsics of this image?"
)
POINT_COUNT = 2000
OCCLUSION_STEP = 6e-3  # [m] by which what lies beyond the outline is nearer when it hides the object
OUTSIDE_REACH = 4  # [px] beyond the outline where that is looked for
UNSURE_WEIGHT = 0.3  # of an outline beyond which nothing was measured, or something as near
MOST_OPEN = 0.5  # of an outline, beyond which depth goes on: a tenth of an object's on a table, 0.6 of a box around it


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
        ReconstructionError: the object is farther away or larger than what a gripper holds, or the mask holds what
            lies behind it, too.
    """
    check_depth(depth, camera)
    depth = np.where(np.nan_to_num(depth) > 0.0, depth, np.nan).astype(float)
    mask = np.asarray(mask, dtype=bool)
    if mask.shape == depth.shape and mask[[0, 0, -1, -1], [0, -1, 0, -1]].all():
        raise ImageError("mask: all four corners of the image are in it; expected the object alone: is it inverted?")
    check_mask(mask, depth, least=LEAST_POINTS)
    points = _smooth_points(depth, mask, camera)
    away, across = float(np.median(points[:, 2])), float(np.ptp(points[:, :2], axis=0).max())
    if away > FARTHEST_OBJECT or across > LARGEST:
        raise ReconstructionError(
            f"the object is {away:.2f} m away and {across:.2f} m across; expected at most {FARTHEST_OBJECT:g} m and "
            f"{LARGEST:g} m: {DEPTH_UNITS}"
        )
    own, beyond = _look_across(depth, mask)
    edge = mask & ~binary_erosion(mask, border_value=0)
    is_open = (beyond > own - OCCLUSION_STEP) & (beyond < own + OCCLUSION_STEP)
    if (share := float(is_open[edge].mean())) > MOST_OPEN:
        raise ReconstructionError(
            f"mask: beyond {100.0 * share:.0f} % of its outline the depth goes on without a step; expected the outline "
            f"of the object alone, no box around it, and an object {1e3 * OCCLUSION_STEP:g} mm high at least"
        )
    inside, outside = distance_transform_edt(np.pad(mask, 1))[1:-1, 1:-1], distance_transform_edt(~mask)
    distance = np.where(mask, 0.5 - inside, outside - 0.5)
    return ImageEvidence(
        camera=camera,
        depth=depth,
        mask=mask,
        points=points,
        normals=_estimate_normals(points),
        edge_distance=distance,
        edge_slope=np.stack(np.gradient(distance)[::-1], axis=-1),
        edge_weight=_weigh_edges(own, beyond, edge),
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


def _look_across(depth: NDArray, mask: NDArray) -> tuple[NDArray, NDArray]:
    """Return the least depth (h, w) around each pixel, in the mask and beyond it, infinite where there is none [m]."""
    size, known = 2 * OUTSIDE_REACH + 1, np.isfinite(depth)
    own, beyond = (minimum_filter(np.where(known & part, depth, np.inf), size) for part in (mask, ~mask))
    return own, beyond


def _weigh_edges(own: NDArray, beyond: NDArray, edge: NDArray) -> NDArray:
    """Return for every pixel (h, w) how far the outline nearest to it is the object's own; see `_look_across`."""
    is_free = np.isfinite(beyond) & (beyond > own + OCCLUSION_STEP)
    weight = np.where(is_free, 1.0, UNSURE_WEIGHT)
    weight[beyond < own - OCCLUSION_STEP] = 0.0
    weight[:2], weight[-2:], weight[:, :2], weight[:, -2:] = 0.0, 0.0, 0.0, 0.0
    _, (rows, columns) = distance_transform_edt(~edge, return_indices=True)
    return weight[rows, columns]


HIDING_STEP = 4e-3  # [m] by which something measured is nearer than the mesh when it hides it
MISFIT_BOUND = 5e-3  # [m] beyond which a pixel is simply not explained


@dataclass(frozen=True, kw_only=True)
class ShapeScore:
    """The score of a mesh against an image.

    Attributes:
        misfit: root mean square over the pixels of mask and mesh together, each at most `MISFIT_BOUND` [m].
        residual: median distance of the measured pixels from the mesh, along its normals [m].
        overlap: pixels in mask and mesh over those in either, without those of the mesh that something hides.
    """

    misfit: float
    residual: float
    overlap: float


def score_shape(view: MeshView, affine: NDArray, evidence: ImageEvidence, step: int = 2) -> ShapeScore:
    """Compare the image with what the camera would see of a mesh.

    Args:
        view: of the mesh.
        affine: (4, 4) map of its coordinates into the camera frame.
        evidence: of the image.
        step: every how many pixels to look.
    """
    seen = view.render(affine, evidence.camera, step)
    mask, depth = evidence.mask[::step, ::step], evidence.depth[::step, ::step]
    covered = np.isfinite(seen.depth)
    with np.errstate(invalid="ignore"):
        is_hidden = depth < seen.depth - HIDING_STEP
    # the mesh may go on where something nearer is, and nowhere else: that nothing was measured there hides nothing
    excess = covered & ~mask & ~is_hidden
    both = covered & mask
    # |n . ray|, for the ray with z = 1, is what of a difference in depth counts across the surface
    shares = np.abs(np.einsum("ij,ij->i", seen.normals, seen.points) / seen.points[:, 2])
    offsets = ((depth - seen.depth)[covered] * shares)[both[covered]]
    known = np.abs(offsets[np.isfinite(offsets)])
    missed = int((mask & ~covered).sum() + excess.sum())
    squares = np.minimum(known, MISFIT_BOUND) ** 2
    count = len(known) + missed
    overlap = both.sum() / max(both.sum() + missed, 1)
    misfit = np.sqrt((squares.sum() + missed * MISFIT_BOUND**2) / count) if count else MISFIT_BOUND
    residual = float(np.median(known)) if len(known) else np.inf
    return ShapeScore(misfit=float(misfit), residual=residual, overlap=float(overlap))


Report = Callable[[str, float], None]  # the name of a stage, and the share of it that is done
LEAST_OVERLAP = 0.8  # right ones reach 0.95, wrong ones 0.72 at most
LARGEST_RESIDUAL = 3e-3  # [m]


@dataclass(frozen=True, kw_only=True, eq=False)
class GeneratedMesh:
    """A mesh that a generator made from a picture, with its guess of where it is and how large.

    Attributes:
        vertices: (n, 3) in the generator's unit and axes.
        triangles: (m, 3).
        affine: (4, 4) map of the vertices into the camera frame [m]; a rotation times one scale, and a translation.
        name: of the object.
    """

    vertices: NDArray
    triangles: NDArray
    affine: NDArray
    name: str = "object"

    def __post_init__(self) -> None:
        A = np.asarray(self.affine, dtype=float)
        if A.shape != (4, 4) or not np.isfinite(A).all() or not np.allclose(A[3], (0.0, 0.0, 0.0, 1.0), atol=1e-6):
            raise ReconstructionError(f"pose of the generated mesh: {A.tolist()}; expected a finite (4, 4) affine map")
        scales = np.linalg.norm(A[:3, :3], axis=0)
        if scales.min() < 1e-9 or np.linalg.det(A[:3, :3] / np.maximum(scales, 1e-12)) < 0.99:
            raise ReconstructionError(
                f"pose of the generated mesh: column lengths {scales.tolist()}, determinant "
                f"{np.linalg.det(A[:3, :3]):.3g}; expected a rotation times a scale, neither sheared nor mirrored"
            )

    @property
    def mesh(self) -> ObjectMesh:
        """The triangles, in the generator's unit and axes."""
        return ObjectMesh(vertices=self.vertices, triangles=self.triangles, watertight=False, name=self.name)


@dataclass(frozen=True, kw_only=True, eq=False)
class Reconstruction:
    """An object's mesh in metres, where it is, and how well the two explain the image.

    Attributes:
        mesh: in a frame with the origin in its middle.
        T_camera_object: (4, 4) its pose.
        scale: (3,) that the given mesh was stretched by along its axes; ones where none was given.
        score: agreement with the image.
        method: that was used.
    """

    mesh: ObjectMesh
    T_camera_object: NDArray
    scale: NDArray
    score: ShapeScore
    method: str


def check_agreement(score: ShapeScore) -> None:
    """Refuse a result that does not explain the image.

    Raises:
        ReconstructionError: it does not.
    """
    if score.overlap < LEAST_OVERLAP or not score.residual <= LARGEST_RESIDUAL:
        raise ReconstructionError(
            f"no placement of the mesh explains the image: {100.0 * score.overlap:.1f} % of its outline and the mask "
            f"overlap, its surface {1e3 * score.residual:.1f} mm off; expected {100.0 * LEAST_OVERLAP:.0f} % or more "
            f"and {1e3 * LARGEST_RESIDUAL:.0f} mm or less. Is the mesh of this object, and the mask of it alone?"
        )
