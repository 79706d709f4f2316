"""An object before the wrist camera that sways while plates come in and hide a part of it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from table_fakes import table_depth

from finforce.camera import CameraIntrinsics
from finforce_contact.mesh.object_mesh import ObjectMesh
from finforce_contact.mesh.views import MeshView
from finforce_sim.sensor import DepthNoise, disturb_depth

PERIOD = 1.0 / 30.0  # [s] from one image to the next
PLATE_GAP = 0.012  # [m] from the plates to the object's nearest point


@dataclass(frozen=True, kw_only=True, eq=False)
class SequenceImage:
    """One image of a sequence, with the truth.

    Attributes:
        stamp: [s].
        depth: (h, w) as the camera gives it [m], NaN where nothing was measured.
        mask: (h, w) bool, the object's visible pixels.
        T_camera_object: (4, 4) true pose.
        hidden: share of the object's pixels that the plates hide.
    """

    stamp: float
    depth: NDArray
    mask: NDArray
    T_camera_object: NDArray
    hidden: float


@dataclass(frozen=True, kw_only=True)
class Motion:
    """How the hand moves, and how much the plates hide.

    Attributes:
        speed: greatest speed of the object in the camera frame [m/s].
        turn_rate: greatest rate at which it turns there [rad/s].
        distance: from the camera to the object [m].
        hidden: share of its pixels that the plates hide while they are in, 0 to below 1.
        frames: number of images.
    """

    speed: float = 0.1
    turn_rate: float = np.deg2rad(30.0)
    distance: float = 0.22
    hidden: float = 0.0
    frames: int = 120


def render_sequence(
    mesh: ObjectMesh, camera: CameraIntrinsics, motion: Motion, seed: int, noise: DepthNoise | None = None
) -> Iterator[SequenceImage]:
    """Yield the images of a sequence, 30 a second.

    The object sways along one axis and about another. From a third of the sequence on, plates come in from both sides
    within half a second, stay, and go out again in the last sixth.

    Args:
        mesh: the object, z upwards, its origin inside.
        camera: intrinsics.
        motion: how fast, how far, how much hidden.
        seed: of view, axes and noise.
        noise: of the depth; that of a D405 when absent.
    """
    rng = np.random.default_rng(seed)
    path, view = draw_path(motion, rng), MeshView(mesh)
    lowest = float(mesh.vertices[:, 2].min())
    for index, T in enumerate(path):
        seen = view.render(T, camera).depth
        covered = np.isfinite(seen)
        truth = np.where(covered, seen, table_depth(T, lowest, camera))
        plates = _place_plates(covered, _hidden_share(index, motion))
        truth[plates] = np.nanmin(seen) - PLATE_GAP
        yield SequenceImage(
            stamp=1.0 + index * PERIOD,
            depth=disturb_depth(truth, camera, rng, noise),
            mask=covered & ~plates,
            T_camera_object=T,
            hidden=float((plates & covered).sum() / max(covered.sum(), 1)),
        )


def draw_path(motion: Motion, rng: np.random.Generator) -> NDArray:
    """Return the true poses (frames, 4, 4): a view from above, swaying with the greatest speeds of the motion."""
    downward = np.deg2rad(rng.uniform(20.0, 60.0))
    start = Rotation.from_euler("x", 0.5 * np.pi + downward) * Rotation.from_euler("z", rng.uniform(0.0, 2.0 * np.pi))
    time = np.arange(motion.frames) * PERIOD
    axes = rng.standard_normal((2, 3))
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    rates = 2.0 * np.pi * rng.uniform(0.4, 0.7, 2)
    path = np.tile(np.eye(4), (motion.frames, 1, 1))
    turns = np.outer(np.sin(rates[1] * time), axes[1] * motion.turn_rate / rates[1])
    path[:, :3, :3] = (Rotation.from_rotvec(turns) * start).as_matrix()
    path[:, :3, 3] = np.outer(np.sin(rates[0] * time), axes[0] * motion.speed / rates[0]) + (0.0, 0.0, motion.distance)
    return path


def _hidden_share(index: int, motion: Motion) -> float:
    time, length = index * PERIOD, motion.frames * PERIOD
    coming, going = (time - length / 3.0) / 0.5, (length * 5.0 / 6.0 - time) / 0.5
    return motion.hidden * float(np.clip(min(coming, going), 0.0, 1.0))


def _place_plates(covered: NDArray, hidden: float) -> NDArray:
    """Return the pixels (h, w) of two plates, from left and right, over the given share of the covered pixels."""
    plates = np.zeros(covered.shape, bool)
    columns = np.sort(np.nonzero(covered)[1])
    if hidden > 0.0 and len(columns):
        margin = int(0.5 * hidden * len(columns))
        plates[:, max(columns[0] - 60, 0) : columns[margin]] = True
        plates[:, columns[-1 - margin] + 1 : columns[-1] + 60] = True
    return plates
