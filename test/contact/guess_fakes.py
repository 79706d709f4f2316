"""Meshes as a generator makes them of a picture: of the right shape, in the wrong place and of the wrong size."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from chamfer_fakes import compute_chamfer
from numpy.typing import NDArray
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation
from table_fakes import TableScene

from finforce_contact.mesh.object_mesh import ObjectMesh
from finforce_contact.reconstruction.evidence import GeneratedMesh


@dataclass(frozen=True, kw_only=True)
class GuessError:
    """How far a guess of a generator goes astray; standard deviations before they are brought to a distance.

    Attributes:
        scale: of the logarithm of the scale.
        turn: [rad].
        shift: [m].
        stretch: of the logarithm of the scale of each axis by itself; not brought to any distance.
    """

    scale: float = 0.3
    turn: float = 0.35
    shift: float = 8e-3
    stretch: float = 0.0


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
    shape = place_mesh(scene.mesh, np.diag([*np.exp(error.stretch * rng.standard_normal(3)), 1.0]))
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


def place_mesh(mesh: ObjectMesh, affine: NDArray) -> ObjectMesh:
    """Return a mesh moved by an affine map (4, 4)."""
    vertices = mesh.vertices @ affine[:3, :3].T + affine[:3, 3]
    return ObjectMesh(vertices=vertices, triangles=mesh.triangles, watertight=mesh.watertight, name=mesh.name)
