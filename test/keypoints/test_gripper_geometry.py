import numpy as np
import pytest
from keypoint_scene_fakes import CAMERA, VIEWS, FakeScene

from finforce.camera import project
from finforce.errors import PoseError
from finforce.gripper_frames import (
    BENCH_CAMERA,
    BENCH_ORIGIN_X,
    ROBOT_CAMERA,
    jaw_in_camera,
    jaw_in_gripper,
    look_at,
)
from finforce.transforms import check_pose


def test_the_jaws_close_towards_each_other():
    towards = [jaw_in_gripper(side, x)[:3, 0] for side, x in (("left", -0.04), ("right", 0.04))]
    np.testing.assert_allclose(towards, [[1, 0, 0], [-1, 0, 0]])


@pytest.mark.parametrize("view", VIEWS)
def test_every_key_point_is_in_the_picture_on_the_side_that_faces_the_camera(view):
    scene = FakeScene(view)
    for side, T in scene.poses().items():
        check_pose(T)
        points = scene.keypoints(side) @ T[:3, :3].T + T[:3, 3]
        pixels = project(points, CAMERA)
        assert (pixels > 20).all() and (pixels < (620, 460)).all()
        outward = T[:3, 1] * np.sign(scene.keypoints(side)[0, 1])
        assert (points @ outward < 0).all()


def test_the_left_jaw_is_at_the_left_of_the_picture_of_the_robot():
    pixels = FakeScene("robot").pixels()
    assert pixels["left"][:, 0].max() < CAMERA.cx < pixels["right"][:, 0].min()


def test_the_bench_camera_sees_the_jaw_where_the_recordings_have_it():
    T = jaw_in_camera(BENCH_CAMERA, "left", BENCH_ORIGIN_X)
    np.testing.assert_allclose(T[:3, 3], [0.0293674, 0.02565352, 0.11204665], atol=1e-9)


def test_a_camera_looks_at_its_target_with_its_rows_along_the_closing_axis():
    np.testing.assert_allclose(ROBOT_CAMERA[:3, 0], [1, 0, 0], atol=1e-12)
    T = look_at((0.1, 0.2, 0.3), (0.4, 0.1, 0.5), (0.0, 0.0, 1.0))
    check_pose(T)
    np.testing.assert_allclose(np.cross(T[:3, 2], [0.3, -0.1, 0.2]), 0, atol=1e-12)
    assert T[:3, 2] @ [0.3, -0.1, 0.2] > 0 < T[2, 0]


def test_an_unknown_side_is_refused():
    with pytest.raises(PoseError, match="'middle'.*left.*right"):
        jaw_in_gripper("middle", 0.0)
