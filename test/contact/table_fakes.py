"""An object on a table before the wrist camera, a D405."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from finforce.camera import CameraIntrinsics, compute_rays
from finforce_contact.mesh.object_mesh import ObjectMesh
from finforce_contact.mesh.views import MeshView
from finforce_sim.sensor import D405_DISTORTION, DepthNoise, disturb_depth

FARTHEST = 1.0  # [m], where the table ends


def build_d405(*, distorted: bool = False, step: int = 1) -> CameraIntrinsics:
    """Return the colour camera of a D405 at 848 x 480, to which its depth is aligned.

    Args:
        distorted: with the distortion of a real unit.
        step: keep every `step`-th pixel only, for quick runs.
    """
    return CameraIntrinsics(
        width=848 // step,
        height=480 // step,
        fx=431.2 / step,
        fy=430.0 / step,
        cx=424.6 / step,
        cy=241.3 / step,
        distortion=np.array(D405_DISTORTION) if distorted else np.zeros(5),
    )


def table_depth(T: NDArray, height: float, camera: CameraIntrinsics) -> NDArray:
    """Return the depths (h, w) of the plane z = height of the object's frame, and the farthest beyond it."""
    normal = T[:3, 2]
    with np.errstate(divide="ignore"):
        depth = (normal @ T[:3, 3] + height) / (compute_rays(camera) @ normal)
    return np.where((depth > 0.0) & (depth < FARTHEST), depth, FARTHEST)


OCCLUDER_GAP = 0.02  # [m] from the object's nearest point to what hides it


@dataclass(frozen=True, kw_only=True, eq=False)
class TableScene:
    """One image of an object, with the truth.

    Attributes:
        camera: intrinsics.
        depth: (h, w) as the camera gives it [m], NaN invalid.
        mask: (h, w) bool, the object's visible pixels.
        mesh: the object, in its own frame.
        T_camera_object: (4, 4) its true pose.
    """

    camera: CameraIntrinsics
    depth: NDArray
    mask: NDArray
    mesh: ObjectMesh
    T_camera_object: NDArray


def draw_scene(
    mesh: ObjectMesh,
    camera: CameraIntrinsics,
    rng: np.random.Generator,
    noise: DepthNoise | None = None,
    hidden: float = 0.0,
) -> TableScene:
    """Return an image of an object that stands on a table, seen from 0.22 to 0.32 m away and from above.

    Args:
        mesh: the object, z upwards.
        camera: intrinsics.
        rng: source of the view and of the noise.
        noise: of the depth; that of a D405 when absent.
        hidden: share of the object's pixels that a bar before it hides, from 0 to below 1.
    """
    T = draw_pose(rng)
    seen = MeshView(mesh).render(T, camera)
    table = table_depth(T, float(mesh.vertices[:, 2].min()), camera)
    covered = np.isfinite(seen.depth)
    truth = np.where(covered, seen.depth, table)
    bar = _draw_bar(covered, hidden, rng)
    truth[bar] = np.nanmin(seen.depth) - OCCLUDER_GAP
    depth = disturb_depth(truth, camera, rng, noise)
    return TableScene(camera=camera, depth=depth, mask=covered & ~bar, mesh=mesh, T_camera_object=T)


def draw_pose(rng: np.random.Generator) -> NDArray:
    """Return a pose (4, 4) of an object near the optical axis, turned at random about its z axis."""
    downward = np.deg2rad(rng.uniform(20.0, 60.0))
    upright = Rotation.from_euler("x", 0.5 * np.pi + downward)
    roll = Rotation.from_euler("z", rng.normal(0.0, 0.15))
    T = np.eye(4)
    T[:3, :3] = (roll * upright * Rotation.from_euler("z", rng.uniform(0.0, 2.0 * np.pi))).as_matrix()
    T[:3, 3] = (*rng.uniform(-0.02, 0.02, 2), rng.uniform(0.22, 0.32))
    return T


def _draw_bar(covered: NDArray, hidden: float, rng: np.random.Generator) -> NDArray:
    """Return the pixels (h, w) of an upright or lying bar over the given share of the covered pixels."""
    bar = np.zeros(covered.shape, dtype=bool)
    if hidden <= 0.0:
        return bar
    axis = int(rng.integers(2))
    places = np.sort(np.nonzero(covered)[axis])
    begin = rng.integers(0, max(1, int((1.0 - hidden) * len(places))))
    low, high = places[begin], places[min(begin + int(hidden * len(places)), len(places) - 1)]
    bar[(slice(low, high), slice(None)) if axis == 0 else (slice(None), slice(low, high))] = True
    return bar
