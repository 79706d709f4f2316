"""An object on a table before the wrist camera, and meshes as a generator makes them of a picture."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation

from finforce.camera import CameraIntrinsics, compute_rays
from finforce.optional import import_trimesh
from finforce_contact.mesh.object_mesh import ObjectMesh
from finforce_contact.mesh.views import MeshView, compute_chamfer
from finforce_contact.reconstruction.evidence import GeneratedMesh
from finforce_sim.render import smooth_field
from finforce_sim.sensor import DepthNoise, disturb_depth

FARTHEST = 1.0  # [m], where the table ends


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


def roughen_mask(mask: NDArray, rng: np.random.Generator, stddev: float = 1.0, width: float = 6.0) -> NDArray:
    """Return a mask (h, w) whose outline wanders, as that of a segmentation does.

    Args:
        mask: (h, w) bool.
        rng: source of the error.
        stddev: of the outline's distance from the true one [px].
        width: over which neighbouring errors are alike [px].
    """
    inside = distance_transform_edt(mask)
    distance = np.where(mask, 0.5 - inside, distance_transform_edt(~mask) - 0.5)
    return distance < stddev * smooth_field(mask.shape, width, rng)


EDGE_LENGTH = 4e-3  # [m] of the triangles before they are bent
WAVES = 12
LONGEST_WAVE, SHORTEST_WAVE = 0.12, 0.03  # [m]


@dataclass(frozen=True, kw_only=True)
class GuessError:
    """How far a guess of a generator goes astray; standard deviations before they are brought to a distance.

    Attributes:
        scale: of the logarithm of the scale.
        turn: [rad].
        shift: [m].
        stretch: of the logarithm of the scale of each axis by itself; not brought to any distance.
        bend: root mean square of smooth dents and bulges [m]; not brought to any distance.
    """

    scale: float = 0.3
    turn: float = 0.35
    shift: float = 8e-3
    stretch: float = 0.0
    bend: float = 0.0


def draw_guess(
    scene: TableScene, rng: np.random.Generator, distance: float, error: GuessError | None = None
) -> GeneratedMesh:
    """Return a generated mesh, in a unit cube as generators give it, whose place and size are wrong.

    Args:
        scene: with the true mesh and pose.
        rng: source of the direction in which the guess is wrong.
        distance: mean Chamfer distance of the guess from the truth, both in the camera frame [m].
        error: how it is made up.
    """
    error = error or GuessError()
    growth, turn = error.scale * rng.standard_normal(), error.turn * rng.standard_normal(3) / np.sqrt(3.0)
    shift = error.shift * rng.standard_normal(3)
    shape = bend_mesh(scene.mesh, error.bend, rng)
    shape = place_mesh(shape, np.diag([*np.exp(error.stretch * rng.standard_normal(3)), 1.0]))
    true = place_mesh(scene.mesh, scene.T_camera_object)

    def guess(amount: float) -> NDArray:
        A = scene.T_camera_object.copy()
        A[:3, :3] = Rotation.from_rotvec(amount * turn).as_matrix() @ A[:3, :3] * np.exp(amount * growth)
        A[:3, 3] += amount * shift
        return A

    def excess(amount: float) -> float:
        return compute_chamfer(place_mesh(shape, guess(amount)), true, count=1000).mean - distance

    high = 1.0
    while excess(high) < 0.0:
        high *= 1.5
    affine = guess(brentq(excess, 0.0, high, xtol=1e-3))
    size = float(np.ptp(shape.vertices, axis=0).max())
    affine[:3, :3] *= size
    return GeneratedMesh(vertices=shape.vertices / size, triangles=shape.triangles, affine=affine, name=scene.mesh.name)


def bend_mesh(mesh: ObjectMesh, amount: float, rng: np.random.Generator) -> ObjectMesh:
    """Return a mesh, finely divided, with dents and bulges of `amount` [m] (root mean square); itself for zero."""
    if amount <= 0.0:
        return mesh
    remesh = import_trimesh().remesh
    vertices, triangles = remesh.subdivide_to_size(mesh.vertices, mesh.triangles, EDGE_LENGTH)
    waves = rng.standard_normal((WAVES, 3))
    waves /= np.linalg.norm(waves, axis=1, keepdims=True)
    waves *= 2.0 * np.pi / rng.uniform(SHORTEST_WAVE, LONGEST_WAVE, (WAVES, 1))
    phases = vertices @ waves.T + rng.uniform(0.0, 2.0 * np.pi, WAVES)
    bent = np.sin(phases) @ rng.standard_normal((WAVES, 3))
    bent *= amount / np.sqrt((bent**2).sum(axis=1).mean())
    return ObjectMesh(
        vertices=vertices + bent, triangles=np.asarray(triangles), watertight=mesh.watertight, name=mesh.name
    )


def place_mesh(mesh: ObjectMesh, affine: NDArray) -> ObjectMesh:
    """Return a mesh moved by an affine map (4, 4)."""
    vertices = mesh.vertices @ affine[:3, :3].T + affine[:3, 3]
    return ObjectMesh(vertices=vertices, triangles=mesh.triangles, watertight=mesh.watertight, name=mesh.name)
