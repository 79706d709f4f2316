"""Claims about bringing a mesh into agreement with one depth image, in views without noise."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from table_fakes import build_d405

from finforce.camera import compute_rays
from finforce.transforms import move_pose
from finforce_contact.mesh.views import MeshView
from finforce_contact.parameters import TrackerSettings
from finforce_contact.pose.alignment import DepthImage, Effort, MeshAligner, Samples, Visibility
from finforce_contact.pose.tracker import spread_rotations
from finforce_sim.objects import build_object

CAMERA = build_d405(step=2)


def test_starts_reach_every_rotation():
    starts = Rotation.from_matrix(spread_rotations())
    anyhow = Rotation.random(200, random_state=np.random.default_rng(0))
    nearest = [(starts * one.inv()).magnitude().min() for one in anyhow]
    assert len(starts) == 252
    assert np.rad2deg(max(nearest)) < 34.0


def test_outline_tells_what_a_flat_face_does_not():
    mesh, T = build_object("cube"), np.eye(4)
    T[:3, 3] = 0.0, 0.0, 0.25
    depth = MeshView(mesh).render(T, CAMERA).depth
    image = DepthImage(np.where(np.isnan(depth), 0.6, depth), CAMERA)
    aligner = MeshAligner(mesh, CAMERA, TrackerSettings())
    effort = Effort(gates=(0.006, 0.003, 0.003), steps=3, points=1000)
    moved = move_pose(T, np.array([0.003, -0.002, 0.001, 0.0, 0.0, 0.02]))
    found = aligner.align(moved, image, effort)
    half_a_pixel = 0.5 * 0.22 / CAMERA.fx
    assert np.abs(found.T_camera_object[:2, 3]).max() < half_a_pixel
    assert np.linalg.matrix_rank(found.information) == 6
    without = aligner.align(moved, image, replace(effort, outline=False))
    assert np.allclose(without.T_camera_object[:2, 3], moved[:2, 3], atol=1e-4)
    assert np.linalg.matrix_rank(without.information, tol=1e-6 * without.information.max()) == 3
    assert abs(without.T_camera_object[2, 3] - 0.25) < 1e-4


def test_the_edge_of_what_hides_an_object_is_not_its_outline():
    mesh, T = build_object("cube"), np.eye(4)
    T[:3, 3] = 0.0, 0.0, 0.25
    depth = MeshView(mesh).render(T, CAMERA).depth
    columns = np.flatnonzero(np.isfinite(depth).any(axis=0))
    depth[:, columns[0] - 4 : columns[0] + 10] = 0.17  # ends 4 mm beside the cube, 50 mm in front of it
    image = DepthImage(np.where(np.isnan(depth), 0.6, depth), CAMERA)
    effort = Effort(gates=(0.006, 0.003), steps=4, points=1000)
    moved = move_pose(T, np.array([-0.003, 0.0, 0.0, 0.0, 0.0, 0.0]))
    found = MeshAligner(mesh, CAMERA, TrackerSettings()).align(moved, image, effort)
    assert abs(found.T_camera_object[0, 3]) < 0.5 * 0.22 / CAMERA.fx  # half a pixel, by the other side alone


def test_image_tells_seen_hidden_absent_and_unknown_apart():
    depth = np.full((CAMERA.height, CAMERA.width), 0.2)
    columns = np.array([50, 100, 150, 200, 250])
    depth[:, 100], depth[:, 150], depth[:, 200] = 0.1, 0.4, np.nan
    points = compute_rays(CAMERA)[120, columns] * 0.201
    surface = Samples(points=points, directions=np.tile([0.0, 0.0, -1.0], (5, 1)))
    mask = np.ones(depth.shape, bool)
    mask[:, 250] = False
    comparison = DepthImage(depth, CAMERA, mask).compare_surface(surface, 0.003)
    assert comparison.visibility.tolist() == [
        Visibility.SEEN,
        Visibility.HIDDEN,
        Visibility.ABSENT,
        Visibility.UNKNOWN,
        Visibility.HIDDEN,
    ]
    assert comparison.residuals[0] == pytest.approx(0.001, abs=1e-6)  # towards the camera, as the normal
    assert np.isnan(comparison.residuals[1:]).all()
