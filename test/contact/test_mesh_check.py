"""Claims about a posed mesh compared with what a depth camera sees of it."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from table_fakes import build_d405, draw_scene

from finforce.camera import ImageError
from finforce.transforms import invert_pose, move_pose
from finforce_contact.estimator import CONTRADICTED, ContactEstimator
from finforce_contact.pose.edge_check import EdgeCheck
from finforce_contact.pose.mesh_check import LEAST_IMAGES, MeshCheck
from finforce_ifea.jaw.jaw import load_jaw
from finforce_sim.objects import build_object

CAMERA = build_d405(step=2)
NOISE = np.repeat([0.3e-3, 6e-3], 3)  # of an honest tracker [m], [rad], 1 sigma


def compare(mesh, name="mug", hidden=0.3, images=LEAST_IMAGES):
    """What is found of a mesh that is said to be of an object on a table, partly hidden by a bar."""
    rng, check, true = np.random.default_rng(5), MeshCheck(mesh, CAMERA), build_object(name)
    for _ in range(images):
        scene = draw_scene(true, CAMERA, rng, hidden=hidden)
        check.add(scene.depth, move_pose(scene.T_camera_object, NOISE * rng.standard_normal(6)))
    return check.contradiction


def changed(change, name="mug"):
    mesh = build_object(name)
    return replace(mesh, vertices=change(mesh.vertices))


@pytest.mark.parametrize("name", ["mug", "bottle", "asymmetric", "rod25"])
def test_the_right_mesh_is_not_contradicted_by_noise_or_by_what_hides_it(name):
    assert compare(build_object(name), name) == ""


@pytest.mark.parametrize(
    ("name", "change", "words"),
    [
        (
            "mug",
            lambda v: v @ Rotation.from_euler("x", -90, degrees=True).as_matrix().T,
            "turned by 90 degrees about x",
        ),
        ("mug", lambda v: 0.6 * v, "scaled by 1.6"),
        ("mug", lambda v: 1.6 * v, "scaled by 0.6"),
        ("mug", lambda v: v + [0.012, 0.0, 0.0], "shifted by (-12, 0, 0) mm"),
        ("asymmetric", lambda v: v * [-1.0, 1.0, 1.0], "mirrored along x"),
    ],
)
def test_a_wrong_mesh_is_contradicted_and_what_would_fit_is_named(name, change, words):
    found = compare(changed(change, name), name, hidden=0.0)
    assert f"the camera contradicts the mesh {name}" in found
    assert f"if the depth is right, the mesh fits when {words}" in found


def test_a_start_that_slides_to_another_place_hides_no_shift_that_fits(monkeypatch):
    find_shift, align, starts = MeshCheck._find_shift, MeshCheck._align, []

    def find_anew(self):
        starts[:] = ["slides"]
        return find_shift(self)

    def slide(self, view, effort):
        found = align(self, view, effort)
        return move_pose(found, np.array([0.03, 0.03, 0.0, 0.0, 0.0, 0.0])) if starts and starts.pop() else found

    monkeypatch.setattr(MeshCheck, "_find_shift", find_anew)
    monkeypatch.setattr(MeshCheck, "_align", slide)
    found = compare(changed(lambda v: v + [0.012, 0.0, 0.0]), hidden=0.0)
    assert "fits when shifted by (-12, 0, 0) mm" in found


def test_another_object_is_contradicted_without_a_reading_that_fits():
    assert "is it the mesh of this object, in this frame, and the depth right" in compare(
        build_object("bottle"), hidden=0.0
    )


@pytest.mark.parametrize("change", [lambda T: T, lambda T: move_to(T, 1e3 * T[:3, 3]), invert_pose])
def test_poses_in_another_unit_or_frame_show_nothing_of_the_mesh(change):
    mesh = build_object("mug")
    scene = draw_scene(mesh, CAMERA, np.random.default_rng(5), hidden=0.0)
    T = change(scene.T_camera_object)
    depth, edges = MeshCheck(mesh, CAMERA), EdgeCheck(mesh, CAMERA)
    grey = np.repeat(np.nan_to_num(255.0 * scene.depth)[..., None], 3, axis=2)
    for _ in range(LEAST_IMAGES):
        found = depth.add(scene.depth, T) + edges.add(grey, T)
    assert found == "" and depth.sees_mesh == edges.sees_mesh == np.array_equal(T, scene.T_camera_object)


def move_to(T, position):
    moved = T.copy()
    moved[:3, 3] = position
    return moved


def test_few_images_say_nothing():
    assert compare(changed(lambda v: 0.6 * v), images=LEAST_IMAGES - 1) == ""


def test_an_image_without_depth_is_refused():
    with pytest.raises(ImageError):
        MeshCheck(build_object("mug"), CAMERA).add(np.full((CAMERA.height, CAMERA.width), np.nan), np.eye(4))


def test_a_contradicted_object_gives_no_contact():
    jaw, T = load_jaw("bench"), np.eye(4)
    estimator = ContactEstimator(jaw, mesh=build_object("rod25"))
    T[:3, 3] = jaw.inner_face_x + 0.013, 0.0, 0.04
    estimator.take_pose(0.0, T)
    assert estimator.update(0.0).contact is not None
    estimator.contradiction = "seen through"
    found = estimator.update(0.1)
    assert found.contact is None and found.status == CONTRADICTED and found.message == "seen through"
    estimator.reset()
    estimator.take_pose(0.2, T)
    assert estimator.update(0.2).contact is not None
