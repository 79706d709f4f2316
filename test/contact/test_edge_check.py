"""Claims about a posed mesh compared with edges in colour images of it."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from table_fakes import build_d405, draw_scene

from finforce.transforms import move_pose
from finforce_contact.mesh.views import MeshView
from finforce_contact.pose.edge_check import EdgeCheck
from finforce_contact.pose.mesh_check import LEAST_IMAGES
from finforce_sim.objects import build_object

CAMERA = build_d405(step=2)
NOISE = np.repeat([0.3e-3, 6e-3], 3)  # of an honest tracker [m], [rad], 1 sigma


def draw_color(mesh, T_camera_object, rng):
    """An image (h, w, 3) of a bright object before rectangles of any brightness, behind a dark bar."""
    color = np.full((CAMERA.height, CAMERA.width), 90.0)
    for row, column, height, width in rng.integers(4, CAMERA.height // 2, (12, 4)):
        color[row : row + height, column : column + width] = rng.uniform(30, 130)
    shown = np.isfinite(MeshView(mesh).render(T_camera_object, CAMERA).depth)
    color[shown] = 180.0
    bar = int(np.argwhere(shown)[:, 1].mean())
    color[:, bar - 6 : bar + 6] = 20.0
    noisy = color[:, :, None] + rng.normal(0, 4.0, (*color.shape, 3))
    return noisy.clip(0, 255).astype(np.uint8)


def compare(mesh, true, images=LEAST_IMAGES, draw=draw_color):
    """What is found of a mesh in images of an object."""
    rng, check = np.random.default_rng(5), EdgeCheck(mesh, CAMERA)
    for _ in range(images):
        T = draw_scene(true, CAMERA, rng, hidden=0.0).T_camera_object
        check.add(draw(true, T, rng), move_pose(T, NOISE * rng.standard_normal(6)))
    return check.contradiction


def turned(name, axis):
    mesh, turn = build_object(name), Rotation.from_euler(axis, -90, degrees=True)
    return replace(mesh, vertices=turn.apply(mesh.vertices))


@pytest.mark.parametrize("name", ["mug", "bottle", "asymmetric", "rod25"])
def test_the_right_mesh_is_not_contradicted_by_noise_nor_by_what_is_around_it(name):
    assert compare(build_object(name), build_object(name)) == ""


@pytest.mark.parametrize(("name", "axis"), [("asymmetric", "x"), ("asymmetric", "y"), ("bottle", "y"), ("mug", "x")])
def test_a_turned_mesh_is_contradicted_and_the_turn_is_named(name, axis):
    found = compare(turned(name, axis), build_object(name))
    assert f"the camera contradicts the mesh {name}: edges in colour are not at its outline" in found
    assert f"the mesh fits when turned by 90 degrees about {axis}" in found


def test_few_images_or_images_without_edges_contradict_nothing():
    mesh, true = turned("bottle", "x"), build_object("bottle")
    assert compare(mesh, true, images=LEAST_IMAGES - 1) == ""
    dark = lambda *_: np.zeros((CAMERA.height, CAMERA.width, 3), dtype=np.uint8)  # noqa: E731
    assert compare(mesh, true, draw=dark) == ""
    away = EdgeCheck(mesh, CAMERA)
    assert away.add(dark(), move_pose(np.eye(4), np.array([9.0, 0.0, 0.5, 0.0, 0.0, 0.0]))) == ""
