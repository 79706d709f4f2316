"""Meshes as a generator makes them of a picture: wrong in place, scale, proportions and shape."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation

from finforce.optional import import_trimesh
from finforce_contact.mesh.triangles import ObjectMesh
from finforce_contact.mesh.views import compute_chamfer
from finforce_contact.reconstruction.evidence import GeneratedMesh
from finforce_sim.scenes.pose_sequences import TableScene

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
