"""Small images of known objects, and guesses of them, for tests of reconstructions."""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from finforce_contact.mesh.chamfer import compute_chamfer
from finforce_contact.mesh.triangles import ObjectMesh
from finforce_contact.reconstruction.evidence import collect_evidence
from finforce_twin.rendering.depth_camera import build_d405
from finforce_twin.scenes.guesses import GuessError, draw_guess, place_mesh
from finforce_twin.scenes.objects import build_object
from finforce_twin.scenes.pose_sequences import draw_scene


@dataclass(frozen=True)
class Case:
    """An image of an object, what it says, and a generated mesh that is 14 mm off."""

    scene: object
    evidence: object
    guess: object


@lru_cache(maxsize=16)
def make_case(name, seed=0, hidden=0.0, stretch=0.0):
    """Return the case of an object at a quarter of the camera's pixels."""
    rng = np.random.default_rng(seed)
    scene = draw_scene(build_object(name), build_d405(step=2), rng, hidden=hidden)
    guess = draw_guess(scene, rng, 14e-3, GuessError(stretch=stretch))
    return Case(scene, collect_evidence(scene.depth, scene.mask, scene.camera), guess)


def distance_mm(case, mesh, affine):
    """Return the mean Chamfer distance of a placed mesh from the truth [mm]."""
    truth = place_mesh(case.scene.mesh, case.scene.T_camera_object)
    return 1e3 * compute_chamfer(place_mesh(mesh, affine), truth, count=4000).mean


def bare_mesh(vertices, triangles):
    """Return a mesh as it is."""
    return ObjectMesh(vertices=vertices, triangles=triangles, watertight=False, name="bare")
