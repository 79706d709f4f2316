from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from table_fakes import build_d405, draw_scene

from finforce.camera import project
from finforce_contact.errors import ObjectMeshError
from finforce_contact.mesh.views import MeshView
from finforce_sim.objects import OBJECT_NAMES, build_object
from finforce_sim.render import smooth_field
from finforce_sim.sensor import DepthNoise, disturb_depth

CAMERA = build_d405(step=4)


def pose_at(z, rotation=None):
    T = np.eye(4)
    T[:3, 3] = (0.004, -0.003, z)
    if rotation is not None:
        T[:3, :3] = rotation.as_matrix()
    return T


@pytest.fixture(scope="module")
def cube():
    return MeshView(build_object("cube"))


def turned_cube():
    """The cube with an edge, along y, towards the camera."""
    mesh = build_object("cube")
    return replace(mesh, vertices=mesh.vertices @ Rotation.from_euler("y", np.pi / 4.0).as_matrix().T)


def test_front_of_a_cube_is_at_half_its_edge_before_its_middle(cube):
    view = cube.render(pose_at(0.3), CAMERA)
    np.testing.assert_allclose(view.points[:, 2], 0.27, atol=1e-6)
    # 60 mm at 270 mm distance, to the pixel
    widths = 60.0 / 270.0 * np.array([CAMERA.fx, CAMERA.fy])
    np.testing.assert_allclose(np.ptp(view.pixels, axis=0) + 1, widths, atol=1.0)


def test_points_project_onto_their_pixels_despite_distortion(cube):
    camera = build_d405(step=4, distorted=True)
    view = cube.render(pose_at(0.25, Rotation.from_euler("xyz", [0.4, 0.3, 0.2])), camera)
    assert len(view.points) > 500
    np.testing.assert_allclose(project(view.points, camera), view.pixels, atol=1e-3)
    np.testing.assert_array_equal(view.depth[view.pixels[:, 1], view.pixels[:, 0]], view.points[:, 2])


def test_normals_are_those_of_the_visible_faces(cube):
    rotation = Rotation.from_euler("xyz", [0.5, 0.4, 0.0])
    view = cube.render(pose_at(0.3, rotation), CAMERA)
    assert (np.einsum("ij,ij->i", view.normals, view.points) < 0.0).all()
    faces = np.vstack((rotation.as_matrix().T, -rotation.as_matrix().T))
    np.testing.assert_allclose((view.normals @ faces.T).max(axis=1), 1.0, atol=1e-5)


def test_coarse_view_holds_pixels_of_the_full_one(cube):
    full, coarse = (cube.render(pose_at(0.3), CAMERA, step).depth for step in (1, 3))
    np.testing.assert_array_equal(coarse, full[::3, ::3])


def test_scale_in_the_pose_is_a_larger_mesh(cube):
    scaled = pose_at(0.3) @ np.diag([1.5, 1.5, 0.5, 1.0])
    view = cube.render(scaled, CAMERA)
    np.testing.assert_allclose(view.points[:, 2], 0.3 - 0.015, atol=1e-6)
    assert np.ptp(view.points[:, 0]) > 0.085
    # a stretched slope: (1, 1) / sqrt 2 becomes (1 / 1.5, 1 / 0.5), to unit length
    sloped = MeshView(turned_cube()).render(scaled, CAMERA)
    slopes = np.abs(sloped.normals[:, [0, 2]])
    np.testing.assert_allclose(slopes, np.tile([1 / 3, 1.0] / np.hypot(1 / 3, 1.0), (len(slopes), 1)), atol=1e-5)


def test_rays_leave_a_cube_at_its_back(cube):
    front, back = cube.render(pose_at(0.3), CAMERA).depth, cube.render_back(pose_at(0.3), CAMERA)
    np.testing.assert_array_equal(np.isfinite(front), np.isfinite(back))
    # rays near the rim leave by the sides
    assert np.nanmax(back) == pytest.approx(0.33, abs=1e-6)


def test_mesh_behind_the_camera_or_beside_the_image_is_not_seen(cube):
    beside = pose_at(0.3)
    beside[0, 3] = 1.0
    for T in (pose_at(-0.3), beside):
        view = cube.render(T, CAMERA)
        assert len(view.points) == 0 and np.isnan(view.depth).all()


def test_camera_inside_a_mesh_sees_its_inner_side(cube):
    view = cube.render(pose_at(0.0), CAMERA)
    assert np.isfinite(view.depth).all()
    assert (np.einsum("ij,ij->i", view.normals, view.points) < 0.0).all()


def test_closest_points_lie_on_the_surface(cube):
    points = np.array([[0.004, -0.003, 0.2], [0.1, -0.003, 0.3]])
    nearest = cube.closest(points, pose_at(0.3))
    np.testing.assert_allclose(nearest.points, [[0.004, -0.003, 0.27], [0.034, -0.003, 0.3]], atol=1e-7)
    np.testing.assert_allclose(nearest.normals, [[0, 0, -1], [1, 0, 0]], atol=1e-6)


@pytest.mark.parametrize("name", OBJECT_NAMES)
def test_objects_are_closed_turned_outward_and_of_the_size_of_a_hand(name):
    mesh = build_object(name)
    directed = np.concatenate([mesh.triangles[:, [0, 1]], mesh.triangles[:, [1, 2]], mesh.triangles[:, [2, 0]]])
    edges = set(map(tuple, directed.tolist()))
    assert len(edges) == len(directed)
    assert all((b, a) in edges for a, b in edges)
    a, b, c = np.moveaxis(mesh.vertices[mesh.triangles], 1, 0)
    assert np.einsum("ij,ij->", a, np.cross(b, c)) / 6.0 > 5e-5
    assert 0.06 - 1e-9 <= np.ptp(mesh.vertices, axis=0).max() <= 0.12 + 1e-9


def test_unknown_object_is_refused():
    with pytest.raises(ObjectMeshError, match="teapot"):
        build_object("teapot")


def test_depth_noise_grows_with_the_square_of_the_distance():
    camera, rng = build_d405(step=2), np.random.default_rng(0)
    noise = DepthNoise(quantum=0.0, hole_fraction=0.0, edge_fraction=0.0)
    for z in (0.1, 0.3):
        depth = disturb_depth(np.full((camera.height, camera.width), z), camera, rng, noise)
        # 100,000 pixels in patches of some twenty: 5 %
        assert depth.std() == pytest.approx(z**2 * 0.08 / (camera.fx * 0.018), rel=0.05)


def test_each_fault_of_the_camera_shows_by_itself():
    camera = build_d405(step=2)
    depth = np.full((camera.height, camera.width), 0.3)
    depth[:, :100] = 0.2
    off = {"disparity_stddev": 0.0, "quantum": 0.0, "hole_fraction": 0.0, "edge_fraction": 0.0}

    def disturb(**change):
        return disturb_depth(depth, camera, np.random.default_rng(0), DepthNoise(**{**off, **change}))

    np.testing.assert_allclose(disturb(), depth, rtol=1e-6)
    assert np.isnan(disturb(hole_fraction=0.05)).mean() == pytest.approx(0.05, abs=0.002)
    steps = disturb(disparity_stddev=0.08, quantum=1e-3) * 1e3
    np.testing.assert_allclose(steps, np.round(steps), atol=1e-3)
    flying = disturb(edge_fraction=0.5)
    between = (flying > 0.205) & (flying < 0.295)
    assert between[:, 98:102].any() and not between[:, :98].any() and not between[:, 102:].any()
    assert np.isnan(disturb(nearest=0.25)[:, :100]).all()


def test_noise_has_unit_variance_whatever_its_width():
    for width in (0.0, 1.5, 4.0):
        field = smooth_field((300, 300), width, np.random.default_rng(1))
        assert field.std() == pytest.approx(1.0, abs=0.02)


@pytest.mark.parametrize("hidden", [0.0, 0.5])
def test_scene_shows_the_object_where_its_mask_is(hidden):
    scene = draw_scene(build_object("cylinder"), CAMERA, np.random.default_rng(3), hidden=hidden)
    whole = np.isfinite(MeshView(scene.mesh).render(scene.T_camera_object, CAMERA).depth)
    assert scene.mask.sum() / whole.sum() == pytest.approx(1.0 - hidden, abs=0.1)
    assert not (scene.mask & ~whole).any()
